"""One page about a training run, or about several side by side."""
