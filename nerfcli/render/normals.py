"""Normals of the surface in a depth map."""

import numpy as np

# Neighbours whose depths differ by more than this fraction are not on the same surface.
_STEP = 0.1


def normals_of_points(points: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the unit normals (H, W, 3) of the points of a picture, towards the camera, in its axes.

    Cross product of central differences along rows and columns; one-sided where a neighbour is missing or on another
    surface. NaN where both neighbours are, and where there is no depth.

    Args:
        points: (H, W, 3) in the axes of the camera.
        depth: (H, W) depth of the points, along the optical axis or along the ray; NaN where unknown.
    """
    across, down = _slope(points, depth, axis=1), _slope(points, depth, axis=0)
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.divide(normals, length, out=np.full_like(normals, np.nan), where=length > 0)
    # Points are measured from the camera: a normal towards it is against the ray.
    away = (normals * points).sum(-1) > 0
    return np.where(away[..., None], -normals, normals).astype(np.float32)


def _slope(points: np.ndarray, depth: np.ndarray, *, axis: int) -> np.ndarray:
    """Return the change of the points per pixel along an axis, NaN where neither neighbour is on the same surface."""
    missing = np.full_like(np.take(points, [0], axis), np.nan)
    steps = np.diff(points, axis=axis)
    jump = np.abs(np.diff(depth, axis=axis)) > _STEP * np.minimum(*_sides(depth, axis))
    steps[jump] = np.nan
    after, before = np.concatenate([steps, missing], axis), np.concatenate([missing, steps], axis)
    both = (after + before) / 2
    return np.where(np.isnan(both), np.where(np.isnan(after), before, after), both)


def _sides(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the values without the last, and without the first, along an axis."""
    count = values.shape[axis]
    return np.take(values, range(count - 1), axis), np.take(values, range(1, count), axis)
