"""The step of a training, and its parts: losses, optimiser, cameras that learn, space, known depth."""
