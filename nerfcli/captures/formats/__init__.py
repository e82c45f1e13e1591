"""Formats in which captures, models and trajectories are stored: one file each, to and from `Capture`."""
