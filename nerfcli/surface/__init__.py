"""Geometry taken out of a field: depths seen from the photos, fused into surfaces, points and volumes."""
