"""Input of structure from motion: photos, masks, pairs, settings, and the job of the worker."""
