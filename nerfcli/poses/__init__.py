"""Structure from motion with pycolmap, in a separate process; `structure_from_motion` is the entry point."""
