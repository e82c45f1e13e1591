"""One page about a training, or about several side by side."""
