"""Checks of a capture before any long computation: one module per topic."""
