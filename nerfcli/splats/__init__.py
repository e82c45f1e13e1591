"""Gaussian splats: made from a trained field, refined on its training photos, rendered, read and written."""
