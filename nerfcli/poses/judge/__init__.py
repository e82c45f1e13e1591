"""Acceptance checks of a model of structure from motion, and the uncertainty of its poses."""
