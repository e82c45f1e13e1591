"""Suggest further views, which would see as much as possible of the surface that too few photos see."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nerfcli.cameras import paths
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import focus_point, up_direction
from nerfcli.cameras.rigid import look_at, rotation_from_vector
from nerfcli.errors import UserError
from nerfcli.render.visibility import DepthMap
from nerfcli.surface.extent import Grid

# A point that this many photos see gains nothing from another one.
ENOUGH = 2
# Candidates on each path, 6 degrees apart on a full orbit; and angles by which the orbit is also tilted.
PER_PATH, TILTS_DEG = 60, (-15.0, 15.0)
# A candidate is too close to a surface if its 5th percentile of depths is below this fraction of every photo's.
_NEAR, _LEAST_NEAR = 0.05, 0.5


def candidate_frames(frames: Sequence[Frame], *, depth_hint: float) -> list[Frame]:
    """Return views between and around the photos: on a path through them, an orbit, and the orbit tilted up and down.

    Args:
        depth_hint: distance of the scene, for cameras with parallel axes.
    """
    flight = paths.interpolate(frames, count=PER_PATH)
    try:
        orbit = paths.orbit(frames, count=PER_PATH, depth_hint=depth_hint)
    except UserError:  # all cameras at one place: no orbit
        return list(flight)
    focus, up = focus_point(frames, depth_hint=depth_hint), up_direction(frames)
    tilted = [_tilted(frame, focus, up, angle) for angle in TILTS_DEG for frame in orbit]
    return [*flight, *orbit, *tilted]


def _tilted(frame: Frame, focus: np.ndarray, up: np.ndarray, angle_deg: float) -> Frame:
    """Return the view turned upwards by an angle around the focus, at the same distance from it."""
    offset = frame.centre - focus
    across = np.cross(offset, up)
    turn = rotation_from_vector(np.radians(angle_deg) * across / np.linalg.norm(across))
    return replace(frame, name=f"{frame.name}_{angle_deg:+g}", world_from_cam=look_at(focus + turn @ offset, focus, up))


def in_free_space(views: Sequence[DepthMap], photos: Sequence[DepthMap]) -> list[DepthMap]:
    """Return the views that are not inside or close to a surface, compared with the closest photo."""
    nearest = min((_near(photo) for photo in photos), default=0.0)
    return [view for view in views if _near(view) >= _LEAST_NEAR * nearest]


def _near(view: DepthMap) -> float:
    there = view.distances[np.isfinite(view.distances)]
    return float(np.quantile(there, _NEAR)) if len(there) else np.inf


def surface_points(views: Sequence[DepthMap], grid: Grid) -> np.ndarray:
    """Return one surface point (N, 3) for each voxel of a grid in which views see any, from the first such view."""
    points = np.concatenate([view.points() for view in views])
    points = points[((points >= grid.low) & (points < grid.high)).all(axis=1)]
    cells = np.floor((points - grid.low) / grid.voxel_size).astype(np.int64)
    keys = np.ravel_multi_index(tuple(cells.T), grid.shape)
    return points[np.unique(keys, return_index=True)[1]]


def next_views(seen: np.ndarray, coverage: np.ndarray, *, count: int) -> list[tuple[int, int]]:
    """Choose views greedily, each the one that sees most points that fewer than `ENOUGH` photos see.

    The sum of min(coverage, ENOUGH) over the points is submodular: its gain is at least 1 - 1/e of the best choice's.

    Args:
        seen: (N, views) bool, True where a candidate sees a point.
        coverage: (N,) number of photos that see each point.
        count: most views to choose; fewer if no further view adds anything.

    Returns:
        Index of each view, and the number of points whose coverage it improves.

    Source: Nemhauser, Wolsey, Fisher 1978, An analysis of approximations for maximizing submodular set functions.
    """
    coverage, chosen = coverage.copy(), list[tuple[int, int]]()
    while len(chosen) < count:
        gains = seen[coverage < ENOUGH].sum(axis=0)
        gains[[index for index, _ in chosen]] = 0  # a second photo from the same place has no parallax
        best = int(np.argmax(gains))
        if not gains[best]:
            break
        chosen.append((best, int(gains[best])))
        coverage += seen[:, best]
    return chosen
