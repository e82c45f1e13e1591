"""Pixels on disk: photos and pictures (`images`), depth maps that say what they mean (`depth`), `video`."""
