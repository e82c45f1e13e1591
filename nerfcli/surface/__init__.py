"""Geometry extracted from a field: depths seen from the photos, fused into surfaces and points; and volumes."""
