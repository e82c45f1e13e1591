"""What several photos of one scene have in common: matches, tracks, points, and what they say of cameras."""
