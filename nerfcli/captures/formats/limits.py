"""Checks of the numbers in captures, which may be damaged even if the file parses: cameras, positions and poses."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.errors import UserError, listed, several

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
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
# A rotation scaled by less is no rotation but an entry that was never filled.
_LEAST_SCALE = 1e-9


def plausible(positions: np.ndarray) -> np.ndarray:
    """Return whether each position (..., 3), or number (..., 1), is finite and below `MOST_UNITS`; (...,) bool."""
    return np.asarray((np.abs(positions) < MOST_UNITS).all(axis=-1))  # False at NaN


def checked_camera(model: str, width: int, height: int, params: tuple[float, ...], *, where: str) -> Camera:
    """Return the camera given by a file, if its numbers are valid and within the limits.

    Raises:
        UserError: a size or parameter is invalid or beyond its limit; the message begins with `where`.
    """
    if max(width, height) > MOST_PIXELS:
        hint = f"width and height must be at most {MOST_PIXELS}"
        raise UserError(f"{where}: invalid size of a picture: {width:.12g}x{height:.12g} pixels", hint)
    if not all(abs(value) < MOST_PARAMETER for value in params):  # True at NaN
        hint = f"every parameter must be a finite number below {MOST_PARAMETER:g}"
        raise UserError(f"{where}: invalid camera parameters {', '.join(f'{value:g}' for value in params)}", hint)
    if model == "EQUIRECTANGULAR" and abs(width - 2 * height) > 1:
        hint = "a picture of the whole sphere is twice as wide as high; ordinary photos have another camera model"
        raise UserError(f"{where}: invalid size of an EQUIRECTANGULAR picture: {width}x{height} pixels", hint)
    try:
        return Camera(model, width, height, params)
    except UserError as error:
        raise UserError(f"{where}: {error.message}", error.hint) from error


def rigid_pose(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return a pose (4, 4) with a rotation orthonormal to 1e-13, from (3, 4) or (4, 4) as a file holds it.

    Args:
        matrix: with a rotation in the upper left and a position in the fourth column.
        where: the file and field of the matrix, to begin the message.

    Raises:
        UserError: the matrix is not finite, mirrored, farther from a rotation than rounding explains, or has a fourth
            row other than 0, 0, 0, 1.
    """
    if not plausible(matrix[:3].ravel()):
        what = f"contains a number that is not finite or above {MOST_UNITS:g}"
        raise UserError(f"{where}: {what}", "the pose of this image is invalid; remove its entry")
    if len(matrix) == 4 and not np.allclose(matrix[3], _LAST_ROW, rtol=0, atol=_MAX_DEVIATION):
        last = " ".join(f"{value:g}" for value in matrix[3])
        hint = "the position is in the last column; write matrices row by row, not column by column"
        raise UserError(f"{where}: its last row is {last}, expected 0 0 0 1", hint)
    rotation = matrix[:3, :3]
    bend = _bend(rotation)
    if bend > _MAX_DEVIATION:
        what = "the upper left 3x3 block is not a rotation"
        raise UserError(f"{where}: {what}", "rows must be orthogonal and of length 1")
    if np.linalg.det(rotation) < 0:
        raise UserError(f"{where}: mirrors the scene (determinant -1)", "expected a right-handed camera frame")
    return rigid.from_parts(rigid.nearest_rotation(rotation) if bend > _ROUNDING else rotation, matrix[:3, 3])


class NotFiniteError(UserError):
    """A number in a file is infinite, NaN or null."""


class FramePoses:
    """Collects the poses of a capture's frames, and leaves out single ones that are unusable.

    Programs write NaN, null or zeros where tracking was lost: the other frames are good. Rotations that are scaled
    evenly, as by the size of an object in Blender, are normalised. Those that are scaled unevenly or mirrored are
    mistakes of the whole file, and refused.
    """

    def __init__(self) -> None:
        self._lost, self._scales, self._count = list[tuple[str, UserError]](), list[float](), 0

    def read(self, name: str, where: str, matrix: Callable[[], np.ndarray]) -> np.ndarray | None:
        """Return the pose (4, 4) of a frame, rigid, from the matrix (3, 4) or (4, 4) in the file; None if unusable.

        Args:
            where: the file and field of the matrix, to begin a message.
            matrix: reads the matrix; a `NotFiniteError` says that this frame has none.

        Raises:
            UserError: the upper left block is mirrored, or neither a rotation nor an evenly scaled one; or the fourth
                row is not 0, 0, 0, 1.
        """
        found = self._checked(name, where, matrix)
        return None if found is None else rigid_pose(found[0], where)

    def read_inverse(self, name: str, where: str, matrix: Callable[[], np.ndarray]) -> np.ndarray | None:
        """Return the inverse of a frame's matrix as `read` does: the scale applies to its fourth column, too."""
        found = self._checked(name, where, matrix)
        if found is None:
            return None
        scaled, scale = found[0].copy(), found[1]
        scaled[:3, 3] /= scale
        return rigid.inverse(rigid_pose(scaled, where))

    def read_quaternion(
        self, name: str, where: str, values: Callable[[], Sequence[float] | np.ndarray]
    ) -> np.ndarray | None:
        """Return the pose (4, 4) of a frame from the quaternion xyzw and the position in the file; None if unusable.

        Raises:
            UserError: the quaternion's length differs from 1 by more than rounding explains.
        """
        self._count += 1
        try:
            pose = np.array(values())  # (7,)
            if not pose[:4].any():
                raise NotFiniteError(f"{where}: its quaternion has length 0", "expected length 1")
        except NotFiniteError as error:
            self._lost.append((name, error))
            return None
        length = np.linalg.norm(pose[:4])
        if abs(length - 1.0) > _MAX_DEVIATION:
            raise UserError(f"{where}: its quaternion has length {length:.4g}", "expected length 1")
        return rigid.from_parts(rigid.rotation_from_quaternion(pose[[3, 0, 1, 2]]), pose[4:])

    def notes(self) -> tuple[str, ...]:
        """Return what was left out and normalised, for people.

        Raises:
            UserError: fewer than two frames, or less than half of them, have a usable pose.
        """
        said = list(left_out(self._lost, self._count))
        if self._scales:
            low, high = min(self._scales), max(self._scales)
            scale = f"{low:.4g}" if high - low < 1e-3 * high else f"{low:.4g} to {high:.4g}"
            said.append(f"the rotations of {several(len(self._scales), 'frame')} are scaled by {scale}: normalised")
        return tuple(said)

    def _checked(self, name: str, where: str, matrix: Callable[[], np.ndarray]) -> tuple[np.ndarray, float] | None:
        """Return a matrix with its rotation at length 1, and the scale that it had."""
        self._count += 1
        try:
            found = matrix()
            if not np.isfinite(found[:3]).all():
                raise NotFiniteError(f"{where}: contains a number that is not finite", "expected a pose")
            if not plausible(found[:3].ravel()):
                return found, 1.0  # for `rigid_pose` to refuse
            scale = float(np.sqrt((found[:3, :3] ** 2).sum() / 3))
            if scale < _LEAST_SCALE:
                raise NotFiniteError(f"{where}: its rotation is zero", "expected a pose")
        except NotFiniteError as error:
            self._lost.append((name, error))
            return None
        if abs(scale - 1) <= _MAX_DEVIATION / 2:
            return found, 1.0
        even = found.copy()
        even[:3, :3] /= scale
        if _bend(even[:3, :3]) > _MAX_DEVIATION:
            return found, 1.0
        self._scales.append(scale)
        return even, scale


def left_out(lost: Sequence[tuple[str, UserError]], count: int) -> tuple[str, ...]:
    """Return a line that names the frames that were left out, for people; none if there are none.

    Raises:
        UserError: fewer than two of the frames remain, or less than half.
    """
    if not lost:
        return ()
    remaining = count - len(lost)
    _, error = lost[0]
    if remaining < 2 or 2 * remaining < count:
        hint = f"at least 2, and half of them, are needed: {error.hint}"
        raise UserError(f"{error.message}; only {remaining} of {several(count, 'frame')} can be used", hint)
    names = listed([name for name, _ in lost])
    return (f"{len(lost)} of {several(count, 'frame')} left out: {names} ({error.message})",)


def largest_of(
    kind: str, counts: Mapping[str, int], kept: str, *, noun: str = "photo", others: str = "others"
) -> tuple[str, ...]:
    """Return a line on the part of a file that is read, none if it is the only one; `counts` of the parts' photos."""
    rest = ", ".join(f"{name} with {count}" for name, count in counts.items() if name != kept)
    what = f"{kind} {kept}".strip() + f" with {several(counts[kept], noun)} is read"
    return (f"{what}; {others}, which are in other coordinates: {rest}",) if rest else ()


def without(names: Sequence[str], what: str) -> tuple[str, ...]:
    """Return a line on the photos that are left out, as they are without a pose or the like; none if there are none."""
    return (f"{several(len(names), 'photo')} without {what} left out: {listed(names)}",) if names else ()


def _bend(rotation: np.ndarray) -> float:
    """Return by how much a rotation (3, 3) deviates from orthonormal."""
    return float(np.abs(rotation @ rotation.T - np.eye(3)).max())
