"""Pictures of a point: its rendering, and maps of the distance to the photo and to the converged rendering."""

import hashlib
from pathlib import Path

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.media.colours import levels_of
from nerfcli.pages.embedded_pictures import fitted, jpeg_bytes

FOLDER = "pictures"
LONGEST_PX = 480
# Differences shown in the last colour, the same on every page so that pictures of two benches can be compared.
MOST_ERROR, MOST_QUADRATURE = 64 / 255, 16 / 255
_COLOURS = "viridis"


def slug(name: str) -> str:
    """Return a file name for a setting's name."""
    return hashlib.sha256(name.encode()).hexdigest()[:12]


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write a small JPEG of (H, W, 3) uint8."""
    with atomic_path(path) as partial:
        partial.write_bytes(jpeg_bytes(picture, longest_px=LONGEST_PX))


def write_difference(path: Path, one: np.ndarray, other: np.ndarray, *, most: float) -> None:
    """Write a small JPEG of the largest difference over channels between pictures (H, W, 3) in [0, 1].

    Differences of `most` or more have the last colour. They are averaged over the area of a small pixel, not taken
    between small pictures.
    """
    difference = fitted(np.abs(one - other).max(-1).astype(np.float32), LONGEST_PX)
    level = np.rint(np.clip(difference / most, 0.0, 1.0) * 255).astype(np.uint8)
    with atomic_path(path) as partial:
        partial.write_bytes(jpeg_bytes(levels_of(_COLOURS)[level]))
