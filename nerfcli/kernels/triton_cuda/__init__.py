"""The hot operations on GPUs of compute capability 8.0 or newer, by Triton: compiled on first use, cached on disk."""
