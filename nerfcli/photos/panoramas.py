"""Recognize panoramas of the whole sphere, as 360-degree cameras take them.

Their columns are equal steps of longitude and their rows equal steps of latitude: they are twice as wide as high, the
left and the right edge are neighbours, and the first and the last row each show a single place.
"""

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nerfcli.photos.images import opened

# More than this fraction of the photos of a camera must look like panoramas, so that all of them are.
MOST_OF_A_CAMERA = 0.5
# COLMAP's name of their camera model.
PANORAMA = "EQUIRECTANGULAR"
# Pictures are compared at this width: stitching errors of a few pixels do not matter there.
_WIDTH = 256
# Colours differ across the edges by at most this many times as much as between usual neighbours, and this fraction of
# what they differ by an eighth to half of the picture apart; along the first and last row by this fraction of what they
# differ along others; and the edges have at least this standard deviation, in levels: empty ones say nothing. Of 1,476
# other photos cropped to this shape, none is within all four; of 60 panoramas all but one are.
_MOST_SEAM_OVER_STEP, _MOST_SEAM_OVER_FAR, _MOST_POLE_OVER_ROW, _LEAST_EDGE = 5.0, 0.6, 0.7, 15.0
# The names of Google's Photo Sphere XMP metadata; values are attributes or elements.
_PROJECTION = re.compile(rb"GPano:ProjectionType\W{1,4}(\w+)")
_WIDTHS = re.compile(rb"GPano:(?:FullPanoWidthPixels|CroppedAreaImageWidthPixels)\W{1,4}(\d+)")


def is_panorama(path: Path, picture: NDArray[np.uint8]) -> bool:
    """Return whether a photo, whose upright pixels are (H, W, C), shows the whole sphere: by its metadata or edges."""
    height, width = picture.shape[:2]
    return width == 2 * height and (_states_sphere(path) or _shows_sphere(picture))


def _states_sphere(path: Path) -> bool:
    """Return whether a photo's XMP describes a panorama of which nothing is cropped."""
    with opened(path) as image:
        xmp = image.info.get("xmp", b"")
    if not isinstance(xmp, bytes):
        return False
    projection = _PROJECTION.search(xmp)
    return projection is not None and projection[1] == b"equirectangular" and len(set(_WIDTHS.findall(xmp))) < 2


def _shows_sphere(picture: NDArray[np.uint8]) -> bool:
    small = cv2.resize(picture[..., :3], (_WIDTH, _WIDTH // 2), interpolation=cv2.INTER_AREA).astype(np.float64)
    seam = np.abs(small[:, 0] - small[:, -1]).mean()
    step = np.median(np.abs(np.diff(small, axis=1)).mean(axis=(0, 2)))
    far = np.median([np.abs(small - np.roll(small, _WIDTH * part // 8, axis=1)).mean() for part in (1, 2, 3, 4)])
    rows = small.std(axis=1).mean(axis=1)
    row = np.median(rows[_WIDTH // 8 : -_WIDTH // 8])
    edge = small[:, 0].std(axis=0).mean()
    return bool(
        seam < _MOST_SEAM_OVER_STEP * step
        and seam < _MOST_SEAM_OVER_FAR * far
        and max(rows[0], rows[-1]) < _MOST_POLE_OVER_ROW * row
        and edge > _LEAST_EDGE
    )
