"""Hard cases with known answers, run on the user's machine: how large the errors are, and how large they may be."""
