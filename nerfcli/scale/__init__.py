"""Metric scale from known distances, GPS, markers or control points, with its uncertainty; georeferencing."""
