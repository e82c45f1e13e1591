"""Rendered frames as files: what is asked for, one frame's files, the walk over all frames, videos."""
