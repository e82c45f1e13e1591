"""Hard cases with answers in 60 digits or closed form, for the definitions and the compiled kernels."""
