"""Checks of a capture before any long work: one file per topic."""
