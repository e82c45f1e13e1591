"""Hard numerical cases with known answers, run on the user's machine and checked against error bounds."""
