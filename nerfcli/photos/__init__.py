"""Photos as they are trained on and compared with: their pixels, masks and exposures."""
