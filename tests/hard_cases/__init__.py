"""Hard cases with 60-digit or closed-form answers, for the reference and the compiled kernels."""
