"""Photos for training and evaluation: their pixels, masks and exposures."""
