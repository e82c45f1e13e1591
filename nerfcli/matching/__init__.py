"""Multi-view geometry of the photos of a scene: matches, tracks, points, consistency of cameras."""
