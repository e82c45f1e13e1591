"""What structure from motion starts from: photos, masks, pairs, settings, and the job of the worker."""
