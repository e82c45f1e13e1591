"""Metric scale from known distances, GPS or markers, with its uncertainty."""
