"""Peak signal-to-noise ratio."""

import math

# Identical pictures: the error of less than a thousandth of a grey level, where the logarithm has no end.
MOST_PSNR = 100.0


def psnr_of(error: float) -> float:
    """Return the PSNR in dB of a mean squared error of values in [0, 1]: -10 log10, at most 100."""
    return -10.0 * math.log10(max(error, 10.0 ** (-MOST_PSNR / 10)))
