"""Find held-out photos that the field renders far worse than the others."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from nerfcli.errors import listed

# A photo is far below the others if it lacks this many standard deviations, estimated by the median absolute deviation,
# and this many dB. In sound runs the worst photo lacks up to 2 deviations and 2 dB; where views are uneven, 5 dB.
_DEVIATIONS, _LEAST_DB = 5.0, 6.0
# Standard deviation of a normal distribution over its median absolute deviation.
_NORMAL = 1.4826
# Fewer photos do not show what is usual, and more than this fraction of them are no exceptions.
_FEWEST, _MOST = 5, 0.25


def outliers(images: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the images whose PSNR is far below the median of all, the lowest first.

    Args:
        images: with "name" and "psnr", as in metrics.json.
    """
    if len(images) < _FEWEST:
        return []
    median = statistics.median(image["psnr"] for image in images)
    deviation = _NORMAL * statistics.median(abs(image["psnr"] - median) for image in images)
    limit = median - max(_LEAST_DB, _DEVIATIONS * deviation)
    low = sorted((image for image in images if image["psnr"] < limit), key=lambda image: image["psnr"])
    return low if len(low) <= _MOST * len(images) else []


def outlier_warnings(images: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a warning that names the images far below the others; none if there are none."""
    low = outliers(images)
    if not low:
        return []
    median = statistics.median(image["psnr"] for image in images)
    names = listed([f"{image['name']} ({image['psnr']:.1f} dB)" for image in low])
    return [
        f"far below the median of {median:.1f} dB: {names}. The pose may be wrong, or the photo shows what no "
        "training photo does: nerfcli doctor SCENE checks poses, nerfcli report RUN shows the pictures"
    ]
