"""Points of the surface, found in the training photos with the poses that the scene gives.

Some capture formats bring cameras and no points. Where the cameras look, nobody knows then how far what they see is
away; matched features tell, within a few seconds.
"""

from collections.abc import Sequence

import numpy as np

from nerfcli.train.matching import Matches, radians_per_pixel
from nerfcli.train.photos import Photo

# How far a point may be from where its features are; poses and lenses of captures are often off by a pixel or two.
WITHIN_PX = 3.0
# Rays that meet at less than this are as good as parallel: the distance would be made of noise.
LEAST_ANGLE_RAD = np.radians(0.5)


def triangulate(photos: Sequence[Photo], matched: Sequence[Matches]) -> np.ndarray:
    """Points (N, 3) in the scene's frame, float64, that two photos agree on; N is 0 where nothing was matched.

    Accuracy: a few per cent of the distance at best, and a few wrong ones are among them: good for percentiles.
    """
    return np.concatenate([np.zeros((0, 3)), *(_points(photos, matches) for matches in matched)])


def _points(photos: Sequence[Photo], matches: Matches) -> np.ndarray:
    """The points (M, 3) of the matches of two photos that fit their poses."""
    one, other = (photos[index] for index in matches.photos)
    rays = [_world_rays(photo, pixels) for photo, pixels in zip((one, other), matches.pixels, strict=True)]
    tolerances = tuple(WITHIN_PX * radians_per_pixel(photo.frame.camera) for photo in (one, other))
    return meetings((one.frame.centre, other.frame.centre), (rays[0], rays[1]), (tolerances[0], tolerances[1]))


def meetings(
    centres: tuple[np.ndarray, np.ndarray], rays: tuple[np.ndarray, np.ndarray], tolerances: tuple[float, float]
) -> np.ndarray:
    """Where rays of two cameras meet, (M, 3): of the pairs that do, the middles of their closest points.

    Args:
        centres: (3,) of each camera.
        rays: (N, 3) unit directions of each; NaN where there is none.
        tolerances: how far a ray may pass beside its point, in radians as its camera sees it.
    """
    (p, q), (d, e) = centres, rays
    baseline = q - p
    cosine = np.einsum("ni,ni->n", d, e)
    along_d, along_e = d @ baseline, e @ baseline
    # Closest points p + s d and q + t e: d and e are both across their connection.
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (along_d - cosine * along_e) / (1 - cosine**2)
        t = (cosine * along_d - along_e) / (1 - cosine**2)
        first, second = p + s[:, None] * d, q + t[:, None] * e
        half_gap = np.linalg.norm(first - second, axis=1) / 2
        angle = np.arctan2(np.linalg.norm(np.cross(d, e), axis=1), cosine)
        good = (s > 0) & (t > 0) & (angle > LEAST_ANGLE_RAD)
        good &= (half_gap < tolerances[0] * s) & (half_gap < tolerances[1] * t)
    return (first[good] + second[good]) / 2


def _world_rays(photo: Photo, pixels: np.ndarray) -> np.ndarray:
    bearings, valid = photo.frame.camera.bearings(pixels)
    return np.where(valid[:, None], bearings, np.nan) @ photo.frame.world_from_cam[:3, :3].T
