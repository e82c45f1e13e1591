"""Training: evidence and selection of components, the step and its schedule, the loop, checkpoints, the run folder."""
