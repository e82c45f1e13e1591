"""What an expert would say of a capture before any long work: one file per thing that can be wrong with it."""
