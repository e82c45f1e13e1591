"""Rigid transforms, unit quaternions (wxyz) and similarities of space, as plain NumPy float64 arrays.

A transform is named `b_from_a` and maps coordinates of frame a to coordinates of frame b, so that adjacent names
cancel in a product: `c_from_a = c_from_b @ b_from_a`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerfcli.errors import UserError

# Below this angle in radians, differences of nearly equal terms are replaced by series; five terms are exact there.
SERIES_BELOW = 0.25


def inverse(b_from_a: np.ndarray) -> np.ndarray:
    """Return the inverse `a_from_b` of rigid transforms (..., 4, 4), by transposing the rotation: no linear solve."""
    b_from_a = np.asarray(b_from_a, dtype=np.float64)
    rotation = np.swapaxes(b_from_a[..., :3, :3], -1, -2)
    a_from_b = np.zeros_like(b_from_a)
    a_from_b[..., :3, :3] = rotation
    a_from_b[..., :3, 3] = -(rotation @ b_from_a[..., :3, 3, None])[..., 0]
    a_from_b[..., 3, 3] = 1.0
    return a_from_b


def apply(b_from_a: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform points of frame a to coordinates of frame b.

    Args:
        b_from_a: (4, 4), or (..., 4, 4) for one transform per set of points.
        points: (3,) or (N, 3) with one transform, (..., N, 3) with many.

    Returns:
        The points in frame b, of the same shape as `points` (broadcast over the leading dimensions).
    """
    b_from_a, points = np.asarray(b_from_a, dtype=np.float64), np.asarray(points, dtype=np.float64)
    rotated = points @ np.swapaxes(b_from_a[..., :3, :3], -1, -2)
    translation = b_from_a[..., :3, 3]
    return rotated + (translation if b_from_a.ndim == 2 else translation[..., None, :])


def from_parts(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the transform (..., 4, 4) with the given rotation (..., 3, 3) and translation (..., 3)."""
    rotation, translation = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    b_from_a = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    b_from_a[..., :3, :3] = rotation
    b_from_a[..., :3, 3] = translation
    b_from_a[..., 3, 3] = 1.0
    return b_from_a


def rotation_from_quaternion(wxyz: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) in the order wxyz, of any non-zero length.

    Raises:
        ValueError: a quaternion has zero or non-finite length.
    """
    wxyz = np.asarray(wxyz, dtype=np.float64)
    length = np.linalg.norm(wxyz, axis=-1, keepdims=True)
    if not np.all(np.isfinite(length) & (length > 0)):
        raise ValueError("a quaternion must have a finite length above zero")
    w, x, y, z = np.moveaxis(wxyz / length, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return unit quaternions (..., 4), wxyz with w >= 0, of rotations (..., 3, 3); exact to rounding near pi too."""
    rotation = np.asarray(rotation, dtype=np.float64)
    xyzw = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(canonical=True)
    return xyzw[:, [3, 0, 1, 2]].reshape(*rotation.shape[:-2], 4)


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """Return exp: the rotations (..., 3, 3) about vectors (..., 3), by their lengths in radians.

    Orthonormal to rounding at any length; near 0 each entry keeps its relative accuracy.
    """
    vector = np.asarray(vector, dtype=np.float64)
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    return rotation_from_quaternion(np.concatenate([np.cos(half), np.sinc(half / np.pi) * vector / 2], axis=-1))


def vector_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return log: the vectors (..., 3) along the axes of rotations (..., 3, 3), with the angle in [0, pi] as length.

    It is computed from the quaternion, whose parts w and |(x, y, z)| are the cosine and sine of half the angle, so the
    angle is exact to rounding, at pi too. At pi, an axis and its opposite are the same rotation, and rounding chooses
    between them.
    """
    wxyz = quaternion_from_rotation(rotation)
    sine = np.linalg.norm(wxyz[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, wxyz[..., :1])
    return wxyz[..., 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0)


def transform_from_twist(twist: np.ndarray) -> np.ndarray:
    """Return exp of SE(3): the rigid motions (..., 4, 4) of twists (..., 6) = (translational u, rotational w).

    The rotation is exp(w) and the translation V u with V = 1 + b W + c W^2, W = w x, b = (1 - cos a) / a^2,
    c = (a - sin a) / a^3, a = |w|: a screw motion at constant speed for a unit of time.

    Source: Murray, Li and Sastry 1994, A mathematical introduction to robotic manipulation, eq. 2.36.
    """
    twist = np.asarray(twist, dtype=np.float64)
    u, w = twist[..., :3], twist[..., 3:]
    angle = np.linalg.norm(w, axis=-1, keepdims=True)
    b = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    small = angle < SERIES_BELOW
    safe = np.where(small, 1.0, angle)
    c = np.where(small, _series(angle, (6, -120, 5040, -362880, 39916800)), (safe - np.sin(safe)) / safe**3)
    turned = np.cross(w, u)
    return from_parts(rotation_from_vector(w), u + b * turned + c * np.cross(w, turned))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation (..., 3, 3) nearest in the Frobenius norm to a matrix that is nearly a rotation."""
    u, _, vt = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(u @ vt))
    return (u * np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)[..., None, :]) @ vt


def look_at(centre: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return `world_from_cam` (4, 4) of a camera at `centre` that looks at `target`, with `up` upwards in the picture.

    The camera has OpenCV axes. If `up` is parallel to the view, the world axis farthest from the view is used instead.

    Raises:
        ValueError: centre and target coincide.
    """
    centre = np.asarray(centre, dtype=np.float64)
    view = np.asarray(target, dtype=np.float64) - centre
    distance = np.linalg.norm(view)
    if not distance > 0:
        raise ValueError(f"look_at needs a target apart from the centre, got both at {centre}")
    forward = view / distance
    right = np.cross(forward, up)
    if np.linalg.norm(right) <= 1e-9 * np.linalg.norm(up):
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    return from_parts(np.stack([right, np.cross(forward, right), forward], axis=-1), centre)


@dataclass(frozen=True)
class Similarity:
    """The map b = scale * rotation @ a + translation, between frames that differ in scale, orientation and origin."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    @staticmethod
    def identity() -> "Similarity":
        """Return the similarity that changes nothing."""
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Map points (..., 3) of frame a to frame b."""
        return self.scale * (np.asarray(points, dtype=np.float64) @ self.rotation.T) + self.translation

    def apply_pose(self, world_from_cam: np.ndarray) -> np.ndarray:
        """Map camera poses (..., 4, 4) to frame b: centres and rotations are mapped, and the results stay rigid."""
        world_from_cam = np.asarray(world_from_cam, dtype=np.float64)
        return from_parts(self.rotation @ world_from_cam[..., :3, :3], self.apply(world_from_cam[..., :3, 3]))

    def inverse(self) -> "Similarity":
        """Return the map back: a = rotation.T @ (b - translation) / scale."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def compose(self, inner: "Similarity") -> "Similarity":
        """Return `self` after `inner`: c_from_b.compose(b_from_a) is c_from_a."""
        return Similarity(self.scale * inner.scale, self.rotation @ inner.rotation, self.apply(inner.translation))

    def matrix(self) -> np.ndarray:
        """Return the homogeneous matrix (4, 4); its upper left block is scale * rotation, so it is not rigid."""
        return from_parts(self.scale * self.rotation, self.translation)

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers: {"scale", "rotation" (3 rows), "translation"}; floats survive a round trip exactly."""
        return {
            "scale": float(self.scale),
            "rotation": np.asarray(self.rotation, dtype=np.float64).tolist(),
            "translation": np.asarray(self.translation, dtype=np.float64).tolist(),
        }

    @staticmethod
    def from_json(content: dict[str, Any]) -> "Similarity":
        """Return the similarity that `to_json` described."""
        try:
            scale = float(content["scale"])
            rotation = np.array(content["rotation"], dtype=np.float64)
            translation = np.array(content["translation"], dtype=np.float64)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise _bad_similarity(f"{type(error).__name__}: {error}") from error
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise _bad_similarity(f"rotation {rotation.shape} and translation {translation.shape}")
        finite = np.isfinite(scale) and np.isfinite(rotation).all() and np.isfinite(translation).all()
        if not finite or scale <= 0:
            raise _bad_similarity(f"scale {scale}, or a number that is not finite")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
            raise _bad_similarity("the rotation is not orthonormal with determinant 1")
        return Similarity(scale, rotation, translation)


def _series(angle: np.ndarray, divisors: tuple[int, ...]) -> np.ndarray:
    """Return 1 / divisors[0] + angle^2 / divisors[1] + angle^4 / divisors[2] + ..."""
    return np.polynomial.polynomial.polyval(angle**2, 1 / np.array(divisors, dtype=np.float64))


def _bad_similarity(what: str) -> UserError:
    return UserError(
        f"this is not a similarity transform: {what}",
        'expected {"scale": number above 0, "rotation": 3 rows of 3, "translation": 3 numbers}',
    )
