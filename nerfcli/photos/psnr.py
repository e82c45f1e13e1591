"""Peak signal-to-noise ratio."""

import math

# The value for identical pictures, where the logarithm diverges: an RMS error of 1e-5, 0.003 grey levels of 255.
MOST_PSNR = 100.0


def psnr_of(error: float) -> float:
    """Return the PSNR in dB of a mean squared error of values in [0, 1]: -10 log10, at most 100."""
    return -10.0 * math.log10(max(error, 10.0 ** (-MOST_PSNR / 10)))
