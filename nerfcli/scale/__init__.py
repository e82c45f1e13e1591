"""Metric scale: metres per scene unit from known distances, GPS, or printed markers, with its uncertainty."""
