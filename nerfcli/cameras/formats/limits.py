"""Limits of the numbers in captures: anything beyond is damage, even if the file parses."""

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.errors import UserError

# Positions and depths in scene units. Beyond this, float64 cannot resolve a millimetre, even in UTM coordinates.
MOST_UNITS = 1e12

# Width and height; the largest stitched pictures have a million.
MOST_PIXELS = 10**7

# Focal lengths in pixels, principal points, distortion terms.
MOST_PARAMETER = 1e12


def plausible(positions: np.ndarray) -> np.ndarray:
    """Return whether each position (..., 3), or number (..., 1), is finite and below `MOST_UNITS`; (...,) bool."""
    return np.asarray((np.abs(positions) < MOST_UNITS).all(axis=-1))  # False at NaN


def checked_camera(model: str, width: int, height: int, params: tuple[float, ...], *, where: str) -> Camera:
    """Return the camera given by a file, if its numbers are valid and within the limits.

    Raises:
        UserError: a size or parameter is invalid or beyond its limit; the message begins with `where`.
    """
    if max(width, height) > MOST_PIXELS:
        raise UserError(
            f"{where}: invalid size of a picture: {_short(width)}x{_short(height)} pixels",
            f"width and height must be at most {MOST_PIXELS}",
        )
    if not all(abs(value) < MOST_PARAMETER for value in params):  # True at NaN
        raise UserError(
            f"{where}: invalid camera parameters {', '.join(f'{value:g}' for value in params)}",
            f"every parameter must be a finite number below {MOST_PARAMETER:g}",
        )
    try:
        return Camera(model, width, height, params)
    except UserError as error:
        raise UserError(f"{where}: {error.message}", error.hint) from error


def _short(number: int) -> str:
    return str(number) if number < 10**12 else f"{float(number):.3g}" if number < 10**300 else "1e300 or more"
