"""Conversion between formats of captures: formats, losses, conventions."""
