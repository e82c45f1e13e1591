"""Poses as files print them, made exactly rigid."""

from collections.abc import Callable

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.formats.fields import malformed
from nerfcli.cameras.formats.limits import MOST_UNITS, plausible
from nerfcli.errors import UserError

# Largest deviation of a rotation from orthonormal, or of a quaternion's length from 1: files print 4 digits or more,
# so more is a mistake, not rounding.
_MAX_DEVIATION = 1e-2

# Rotations that deviate by less are kept, bit for bit.
_ROUNDING = 1e-13


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
        raise malformed(where, f"its quaternion has length {length:.4g}", "expected length 1")
    return rigid.from_parts(rigid.rotation_from_quaternion(xyzw[[3, 0, 1, 2]]), position)


def _refuse(wrong: np.ndarray, where: Callable[[int], str], *, what: str, hint: str) -> None:
    if wrong.any():
        raise UserError(f"{where(int(np.argmax(wrong)))}: {what}", hint)
