"""Hard cases with known answers, run on the user's machine, with errors and their bounds."""
