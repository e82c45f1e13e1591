"""The training step and its parts: losses, optimiser, learned cameras, extent, point depth."""
