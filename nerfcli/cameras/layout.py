"""Layout of the cameras of a capture: what they look at, which way is up, whether they surround something.

Notation: a camera has centre c and unit viewing direction d.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import KDTree

from nerfcli.cameras.frame import Frame

# Below this typical angle between the optical axes, they do not determine where they meet.
_PARALLEL_RAD = np.radians(3.0)

# The mean viewing direction is shorter than this if the cameras look all around; it is 0.64 for half a circle.
_ALL_AROUND = 0.4


# The cameras surround something if no gap between neighbouring headings is wider than this.
_WIDEST_GAP_RAD = np.radians(150.0)


def centres_of(frames: Sequence[Frame]) -> np.ndarray:
    """Return the camera centres, (frames, 3)."""
    return np.stack([frame.centre for frame in frames])


def views_of(frames: Sequence[Frame]) -> np.ndarray:
    """Return the unit viewing directions (optical axes), (frames, 3)."""
    return np.stack([frame.world_from_cam[:3, 2] for frame in frames])


def gaps_between(centres: np.ndarray) -> np.ndarray:
    """Return the distances of two or more centres (N, 3) to the nearest other one, (N,)."""
    return KDTree(centres).query(centres, k=2)[0][:, 1]


def focus_point(frames: Sequence[Frame], *, depth_hint: float | None = None) -> np.ndarray:
    """Return the point that the cameras look at, (3,): the one nearest to their optical axes.

    It minimises the sum of its distances to the axes (not of their squares, so that a few cameras that look elsewhere
    do not move it), by iteratively reweighted least squares. There is no such point if the axes are parallel or
    meet behind most cameras. The result is then the mean centre if the cameras look all around, else the point
    `depth_hint` in front of the mean camera. Without a hint, the depth is 5 times the cameras' spread, since people who
    photograph a scene from the front step aside by a fraction of its depth.

    Raises:
        ValueError: no frame.
    """
    if not frames:
        raise ValueError("focus_point needs at least one frame")
    centres, views = centres_of(frames), views_of(frames)
    across = np.eye(3) - views[:, :, None] * views[:, None, :]  # (frames, 3, 3), projects onto the plane normal to d
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())
    # The smallest eigenvalue is the mean squared sine between the axes and their common direction.
    if np.linalg.eigvalsh(across.mean(axis=0))[0] > np.sin(_PARALLEL_RAD) ** 2:
        point = nearest_to_rays(centres, views, lambda off, offsets: 1.0 / np.maximum(off, 1e-6 * spread + 1e-300))
        depths = np.einsum("ni,ni->n", point - centres, views)
        if np.mean(depths > 0) > 0.5:
            return point
    if np.linalg.norm(views.mean(axis=0)) < _ALL_AROUND:
        return centres.mean(axis=0)
    if depth_hint is None:
        depth_hint = 5.0 * spread if spread > 0 else 1.0  # parallel axes do not tell
    return centres.mean(axis=0) + depth_hint * mean_direction(views)


def nearest_to_rays(
    origins: np.ndarray, directions: np.ndarray, weigh: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    """Find the point (3,) nearest to rays, by iteratively reweighted least squares.

    x = (sum_i w_i (I - d_i d_i^T))^-1 sum_i w_i (I - d_i d_i^T) o_i

    Args:
        origins, directions: (n, 3), unit directions, n >= 2, not all parallel.
        weigh: returns the weights (n,), given the distances (n,) of the point from the rays and its offsets (n, 3)
            from their origins.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weights, point = np.ones(len(origins)), np.zeros(3)
    for _ in range(30):
        normal = np.einsum("n,nij->ij", weights, across)
        point = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weights, across, origins))
        offsets = point - origins
        weights = weigh(np.linalg.norm(np.einsum("nij,nj->ni", across, offsets), axis=1), offsets)
        weights = weights / weights.sum()
    return point


def up_direction(frames: Sequence[Frame]) -> np.ndarray:
    """Estimate the up direction of the world, (3,), unit.

    People tilt a camera up and down but not sideways, so the horizontal axes of the pictures are in the ground plane.
    If they clearly span a plane, up is its normal. If they do not (all cameras look the same way), or if the normal is
    more than 60 degrees from the mean of the pictures' own up directions, up is that mean.
    """
    mean_up = mean_direction(-np.stack([frame.world_from_cam[:3, 1] for frame in frames]))
    right = np.stack([frame.world_from_cam[:3, 0] for frame in frames])
    eigenvalues, eigenvectors = np.linalg.eigh(right.T @ right / len(frames))
    normal = eigenvectors[:, 0] * np.sign(eigenvectors[:, 0] @ mean_up)
    level = eigenvalues[1] > 0.03 and eigenvalues[0] < 0.1 * eigenvalues[1]  # 0.03: the axes fan out by 10 degrees
    return normal if level and normal @ mean_up > np.cos(np.radians(60)) else mean_up


def surrounds(frames: Sequence[Frame], up: np.ndarray) -> bool:
    """Return whether the cameras look at something from all sides: no gap of 150 degrees between their headings."""
    east, north = horizontal_axes(up)
    views = views_of(frames)
    heading = np.stack([views @ east, views @ north], axis=-1)
    level = np.linalg.norm(heading, axis=1) > 0.1  # a camera that looks straight down has no heading
    if level.sum() < 3:
        return False
    angles = np.sort(np.arctan2(heading[level, 1], heading[level, 0]))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    return bool(gaps.max() < _WIDEST_GAP_RAD)


def horizontal_axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors (3,) perpendicular to `up` and each other; with `up` last the three are right-handed."""
    east = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def mean_direction(directions: np.ndarray) -> np.ndarray:
    """Return the normalised mean (3,) of unit vectors (N, 3), without those that are more than 60 degrees off it.

    Those excluded are photos taken with the camera on its side. If the vectors cancel out, return the first one.
    """
    kept = np.ones(len(directions), dtype=bool)
    mean = directions[0]
    for _ in range(3):
        total = directions[kept].sum(axis=0)
        length = np.linalg.norm(total)
        if length < 1e-9 * len(directions):
            return mean
        mean = total / length
        kept = directions @ mean > 0.5
        if not kept.any():
            return mean
    return mean
