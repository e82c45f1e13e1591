"""What each component of a model is worth on a scene: trainings with and without it, measured on held-out photos."""
