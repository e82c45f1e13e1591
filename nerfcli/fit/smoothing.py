"""Smoothing of large photos in the first part of a training."""

from nerfcli.photos.pool import Drawn, Pool
from nerfcli.runs.settings import AUTO_LONGER_SIDE_PX

# Until this share of the budget. On 17 photos of 1008x756, a minute has a ray for every second pixel, five minutes have
# two for each: the finest detail teaches little at first.
SMOOTHED_SHARE = 0.6


def smoothed_at(fraction: float, drawn: Drawn, pool: Pool) -> Drawn:
    """Return pixels as they are learned from at a fraction of the budget:
    at first smoothed, where photos are larger than an automatic downscale makes them.
    """
    if fraction >= SMOOTHED_SHARE or pool.longer_side_px <= AUTO_LONGER_SIDE_PX:
        return drawn
    return pool.smoothed(drawn)
