"""Geometry from a field: depth maps of its views, fused to meshes or points, and the files that hold them."""
