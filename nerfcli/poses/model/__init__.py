"""Parts of a model of structure from motion: lenses, poses of further photos, sub-models, held-out evidence."""
