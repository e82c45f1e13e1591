"""The training step and its parts: losses, optimizer, learned cameras, extent, point depth."""
