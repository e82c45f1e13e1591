"""Complete steps from input to result (do, keep, resume or refuse), called by the command line and Python programs."""
