"""Whole steps from input to result: do, keep, resume or refuse; what the command line and Python programs call."""
