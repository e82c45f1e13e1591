"""Captures: their formats, loading, held-out photos, conversion, conventions and metric scale."""
