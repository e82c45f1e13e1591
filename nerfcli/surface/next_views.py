"""Suggest further views: those that would see most of the surface that too few photos see."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nerfcli.cameras import paths
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import focus_point, up_direction
from nerfcli.cameras.rigid import look_at, rotation_from_vector
from nerfcli.errors import UserError
from nerfcli.render.visibility import DepthMap
from nerfcli.surface.grid import Grid

# Photos that have to see a point before another one adds nothing.
ENOUGH = 2
# Candidates on each path: 6 degrees apart where it goes once around. The orbit is also tilted by these angles.
PER_PATH, TILTS_DEG = 60, (-15.0, 15.0)
# A candidate whose near depths (their 5th percentile) are below this share of those of every photo stands in something.
_NEAR, _LEAST_NEAR = 0.05, 0.5


def candidate_frames(frames: Sequence[Frame], *, depth_hint: float) -> list[Frame]:
    """Return views between and around the photos: their flight, their orbit, and the orbit tilted up and down.

    Args:
        frames: the training photos.
        depth_hint: distance to what they look at, for cameras with parallel axes.
    """
    flight = paths.interpolate(frames, count=PER_PATH)
    try:
        orbit = paths.orbit(frames, count=PER_PATH, depth_hint=depth_hint)
    except UserError:  # all in one place: there is nothing to go around
        return list(flight)
    focus, up = focus_point(frames, depth_hint=depth_hint), up_direction(frames)
    tilted = [_tilted(frame, focus, up, angle) for angle in TILTS_DEG for frame in orbit]
    return [*flight, *orbit, *tilted]


def _tilted(frame: Frame, focus: np.ndarray, up: np.ndarray, angle_deg: float) -> Frame:
    """Return the view from higher above the focus, at the same distance from it."""
    offset = frame.centre - focus
    across = np.cross(offset, up)
    turn = rotation_from_vector(np.radians(angle_deg) * across / np.linalg.norm(across))
    return replace(frame, name=f"{frame.name}_{angle_deg:+g}", world_from_cam=look_at(focus + turn @ offset, focus, up))


def in_free_space(views: Sequence[DepthMap], photos: Sequence[DepthMap]) -> list[DepthMap]:
    """Return the views that do not stand in or close to a surface, judged by how close photos stand."""
    nearest = min((_near(photo) for photo in photos), default=0.0)
    return [view for view in views if _near(view) >= _LEAST_NEAR * nearest]


def _near(view: DepthMap) -> float:
    there = view.distances[np.isfinite(view.distances)]
    return float(np.quantile(there, _NEAR)) if len(there) else np.inf


def surface_points(views: Sequence[DepthMap], grid: Grid) -> np.ndarray:
    """Return a point (N, 3) of the surface for each voxel of a grid in which a view sees one; the first view's."""
    points = np.concatenate([view.points() for view in views])
    points = points[((points >= grid.low) & (points < grid.high)).all(axis=1)]
    cells = np.floor((points - grid.low) / grid.voxel_size).astype(np.int64)
    keys = np.ravel_multi_index(tuple(cells.T), grid.shape)
    return points[np.unique(keys, return_index=True)[1]]


def next_views(seen: np.ndarray, coverage: np.ndarray, *, count: int) -> list[tuple[int, int]]:
    """Choose views one after the other, each the one that sees most points that fewer than `ENOUGH` photos see.

    The sum of min(coverage, ENOUGH) over the points is submodular: it reaches at least 1 - 1/e of the best choice.

    Args:
        seen: (N, views) bool, which candidate sees which point.
        coverage: (N,) of the photos.
        count: how many to choose; fewer where no view adds anything.

    Returns:
        Index of each view, and the number of points that it adds to.

    Source: Nemhauser, Wolsey, Fisher 1978, An analysis of approximations for maximizing submodular set functions.
    """
    coverage, chosen = coverage.copy(), list[tuple[int, int]]()
    while len(chosen) < count:
        gains = seen[coverage < ENOUGH].sum(axis=0)
        gains[[index for index, _ in chosen]] = 0  # a second photo from one place has no parallax
        best = int(np.argmax(gains))
        if not gains[best]:
            break
        chosen.append((best, int(gains[best])))
        coverage += seen[:, best]
    return chosen
