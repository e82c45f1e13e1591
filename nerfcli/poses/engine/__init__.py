"""pycolmap at work, in a process of its own: features, matches, attempts to map, and what supervises it."""
