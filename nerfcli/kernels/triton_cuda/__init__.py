"""The hot operations on GPUs from compute capability 8.0 on, by Triton: machine code is made on first use and kept."""
