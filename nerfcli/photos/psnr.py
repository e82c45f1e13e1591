"""Peak signal-to-noise ratio."""

import math


def psnr_of(error: float) -> float:
    """Return the PSNR in dB of a mean squared error of values in [0, 1]: -10 log10, at most 100.

    The logarithm diverges for identical pictures. 100 dB are an RMS error of 1e-5, 0.003 grey levels of 255.
    """
    return -10.0 * math.log10(max(error, 1e-10))
