"""Checks of the numbers in captures, which may be damaged even if the file parses: cameras, positions and poses."""

from collections.abc import Callable

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.errors import UserError

# Positions and depths in scene units. Beyond this, float64 cannot resolve a millimetre, even in UTM coordinates.
MOST_UNITS = 1e12

# Width and height; the largest stitched pictures have a million.
MOST_PIXELS = 10**7

# Focal lengths in pixels, principal points, distortion terms.
MOST_PARAMETER = 1e12
# Largest deviation of a rotation from orthonormal, or of a quaternion's length from 1: files print 4 digits or more,
# so more is a mistake, not rounding.
_MAX_DEVIATION = 1e-2
# Rotations that deviate by less are kept, bit for bit.
_ROUNDING = 1e-13


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


def rigid_poses(matrices: np.ndarray, where: Callable[[int], str]) -> np.ndarray:
    """Return poses (N, 4, 4) with rotations orthonormal to 1e-13, from (N, 3, 4) or (N, 4, 4) as a file holds them.

    Args:
        matrices: with a rotation in the upper left and a position in the fourth column; a fourth row is ignored.
        where: returns the file and field of the matrix with a given index, to begin the message.

    Raises:
        UserError: a matrix is not finite, mirrored, or farther from a rotation than rounding explains.
    """
    rotations, positions = matrices[:, :3, :3], matrices[:, :3, 3]
    _refuse(
        ~plausible(matrices[:, :3].reshape(-1, 12)),
        where,
        what=f"contains a number that is not finite or above {MOST_UNITS:g}",
        hint="the pose of this image is invalid; remove its entry",
    )
    bend = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(1, 2), initial=0)
    _refuse(
        bend > _MAX_DEVIATION,
        where,
        what="the upper left 3x3 block is not a rotation",
        hint="rows must be orthogonal and of length 1",
    )
    _refuse(
        np.linalg.det(rotations) < 0,
        where,
        what="mirrors the scene (determinant -1)",
        hint="expected a right-handed camera frame",
    )
    bent = bend > _ROUNDING
    if bent.any():
        rotations = rotations.copy()
        rotations[bent] = rigid.nearest_rotation(rotations[bent])
    return rigid.from_parts(rotations, positions)


def rigid_pose(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return `rigid_poses` of one matrix (3, 4) or (4, 4): a pose (4, 4)."""
    return rigid_poses(matrix[None], lambda _: where)[0]


def quaternion_pose(xyzw: np.ndarray, position: np.ndarray, where: str) -> np.ndarray:
    """Return the pose (4, 4) of a quaternion (4,) in the order x, y, z, w and a position (3,).

    Raises:
        UserError: the quaternion's length differs from 1 by more than rounding explains.
    """
    length = np.linalg.norm(xyzw)
    if abs(length - 1.0) > _MAX_DEVIATION:
        raise UserError(f"{where}: its quaternion has length {length:.4g}", "expected length 1")
    return rigid.from_parts(rigid.rotation_from_quaternion(xyzw[[3, 0, 1, 2]]), position)


def _refuse(wrong: np.ndarray, where: Callable[[int], str], *, what: str, hint: str) -> None:
    if wrong.any():
        raise UserError(f"{where(int(np.argmax(wrong)))}: {what}", hint)
