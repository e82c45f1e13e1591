"""Inverse depths from a pair of photos of cameras that moved sideways, or along the viewing direction.

Pictures of sideways movement are rectified, and matched by rows. Those of a movement along the viewing direction cannot
be rectified by a homography, as the epipole, the place of one camera in the other's picture, is in the picture or
beside it. They are sampled along epipolar lines instead, which start there.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.matching.stereo_view import (
    BLOCK_PX,
    DISPARITY_ERROR_PX,
    FEWEST_SHARED,
    View,
    disparities,
    disparity_count,
    per_pixel,
    range_of,
    seen_by,
)

# If the plane is narrower or wider than this in the other photo, its view is too oblique for the plane to be used.
LEAST_NARROWING, MOST_NARROWING = 0.3, 3.0
# Pairs cannot be rectified if the cosine between the baseline and the viewing direction is larger than this.
MOST_FORWARD_COS = 0.85
# Points at a smaller cosine to the common viewing direction of a pair are left out.
LEAST_RISE = 0.2


def sideways_depths(one: View, other: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return inverse depths (h, w) of the first view's pixels by matching a pair, NaN where unknown, and their errors.

    None where the pair cannot be rectified. Both pictures are turned so that the baseline is along their rows: a point
    at z in the turned axes then has the disparity f * baseline / z. The second picture is then stretched so that the
    plane that fits the points (P, 3) best has zero disparity: surfaces near it look alike in both.
    """
    baseline = float(np.linalg.norm(other.centre - one.centre))
    forward = one.turn[2] + other.turn[2]
    forward = forward / np.linalg.norm(forward)
    x = (other.centre - one.centre) / max(baseline, 1e-300)
    if baseline == 0.0 or abs(x @ forward) > MOST_FORWARD_COS:
        return None
    y = np.cross(forward, x)
    y /= np.linalg.norm(y)
    turned = np.stack([x, y, np.cross(x, y)])
    focal = one.matrix[0, 0]
    # In the turned axes, the inverse z of a plane is affine in (x / z, y / z).
    seen = (points - one.centre) @ turned.T
    seen = seen[seen[:, 2] > LEAST_RISE * np.linalg.norm(seen, axis=1)]
    if len(seen) < FEWEST_SHARED:
        return None
    inverse_z = 1.0 / seen[:, 2]
    plane = _fitted_plane(seen[:, :2] * inverse_z[:, None], inverse_z)  # by x / z, y / z, and 1
    narrowing = 1.0 - baseline * plane[0]
    if not LEAST_NARROWING < narrowing < MOST_NARROWING:
        plane, narrowing = np.array([0.0, 0.0, np.median(inverse_z)]), 1.0
    off = inverse_z - (seen[:, :2] * inverse_z[:, None]) @ plane[:2] - plane[2]
    least, most = range_of(off, float(np.median(inverse_z)))
    per_disparity = narrowing / (focal * baseline)  # inverse z
    # The matcher prefers whole disparities: make that of the plane whole.
    least = per_disparity * math.floor(least / per_disparity)
    count = disparity_count((most - least) / per_disparity)
    low, high = _bounds(one, turned, focal)
    other_low, other_high = _bounds(other, turned, focal)
    top, bottom = max(low[1], other_low[1]), min(high[1], other_high[1])
    # The matcher skips as many columns on the left as there are disparities. The least disparity is made 0.
    width, height = int(high[0] - low[0]) + 1 + count, int(bottom - top)
    if height < 2 * BLOCK_PX or width * height > 4 * one.grey.size:
        return None
    picture = np.array([[focal, 0.0, count - low[0]], [0.0, focal, -top], [0.0, 0.0, 1.0]])
    homography = picture @ turned @ one.turn.T @ np.linalg.inv(one.matrix)
    left = cv2.warpPerspective(one.grey, homography, (width, height), flags=cv2.INTER_LINEAR)
    # On the plane moved by `least`, (x / z, y / z) of the first view is at this place of the second one.
    stretched = np.array([[narrowing, -baseline * plane[1], -baseline * plane[2]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    stretched[0, 2] -= baseline * least
    back = other.matrix @ other.turn @ turned.T @ stretched @ np.linalg.inv(picture)
    right = cv2.warpPerspective(other.grey, back, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    found = disparities(left, right, count)
    ahead_x, ahead_y, rise = per_pixel(turned @ one.turn.T @ np.linalg.inv(one.matrix), one.grey.shape)
    rise = np.maximum(rise, LEAST_RISE)
    ahead_x, ahead_y = ahead_x / rise, ahead_y / rise
    column = np.float32(focal) * ahead_x + np.float32(picture[0, 2])
    row = np.float32(focal) * ahead_y + np.float32(picture[1, 2])
    nowhere = float("nan")
    found = cv2.remap(found, column, row, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=nowhere)
    across, down, middle = plane.astype(np.float32)
    inverse_z = found * np.float32(per_disparity) + ahead_x * across + ahead_y * down + (middle + np.float32(least))
    # A point at depth 1 / rho along the optical axis is at z = rise / rho in the turned axes.
    rho = inverse_z * rise
    rho[~(rho > 0)] = np.nan
    return rho, np.float32(DISPARITY_ERROR_PX * per_disparity) * rise


def _fitted_plane(places: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Fit a x + b y + c to values (N,) at (x, y) (N, 2) by least absolute differences; return (a, b, c)."""
    design = np.column_stack([places, np.ones(len(places))])
    floor = 1e-3 * float(np.median(np.abs(values)))
    weights = np.ones(len(values))
    plane = np.zeros(3)
    for _ in range(10):
        plane = np.linalg.lstsq(design * np.sqrt(weights)[:, None], values * np.sqrt(weights), rcond=None)[0]
        weights = 1.0 / np.maximum(np.abs(design @ plane - values), floor)
    return plane


def _bounds(view: View, turned: np.ndarray, focal: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest coordinates (2,) of a view's corners in a turned picture, pixels."""
    height, width = view.grey.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], dtype=np.float64)
    rays = corners @ (turned @ view.turn.T @ np.linalg.inv(view.matrix)).T
    # Corners that are turned away further would make the box too large.
    places = focal * rays[:, :2] / np.maximum(rays[:, 2:], LEAST_RISE)
    return places.min(0), places.max(0)


# Pairs whose baseline is at a larger angle from the viewing direction are not matched: the cosine of that angle.
LEAST_FORWARD_COS = 0.5
# Tangents of the angles from the baseline between which pixels are matched: near the baseline, parallax is too small.
LEAST_TANGENT, MOST_TANGENT = 0.05, 3.7
# The largest magnification from one photo to the other that is searched.
MOST_MAGNIFICATION = 3.0


def forward_depths(one: View, other: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return inverse depths (h, w) of the first view's pixels by matching a pair, NaN where unknown, and their errors.

    None where the baseline is across the view, or the views share too few of the points (P, 3).

    Let z be along the baseline of length b, r the distance from it, and phi the direction around it. A point at
    (phi, r, z) from the first camera is at (phi, r, z - b) from the second. In pictures sampled in rows of phi and
    columns of u = log(r / z), it is in the same row, and

        u' - u = log(z / (z - b)) = d,    z = b / (1 - exp(-d))

    A surface across the baseline is shifted as a whole, not magnified. Source of log-polar epipolar images: Pollefeys,
    Koch & van Gool 1999, A simple and efficient rectification method for general motion, ICCV (polar); the logarithm,
    which removes the magnification, as in log-polar image registration.
    """
    baseline = float(np.linalg.norm(other.centre - one.centre))
    if baseline == 0.0:
        return None
    axis = (other.centre - one.centre) / baseline
    forward = one.turn[2] + other.turn[2]
    cos = axis @ forward / max(float(np.linalg.norm(forward)), 1e-12)
    if abs(cos) < LEAST_FORWARD_COS:
        return None
    if cos < 0.0:  # the second camera is behind the first
        axis, baseline = -axis, -baseline
    axes = _axes(axis, one.turn)
    span = _range(points @ axes.T - axes @ one.centre, baseline)
    if span is None:
        return None
    ahead = per_pixel(axes @ one.turn.T @ np.linalg.inv(one.matrix), one.grey.shape)
    tangents = np.hypot(ahead[0], ahead[1]) / np.maximum(ahead[2], 1e-6)
    valid = (ahead[2] > 0.0) & (tangents > LEAST_TANGENT) & (tangents < MOST_TANGENT)
    if not valid.any():
        return None
    logs, around = np.log(np.where(valid, tangents, 1.0)), np.arctan2(ahead[1], ahead[0])
    grid = _grid(logs[valid], around[valid], span, focal=one.matrix[0, 0], is_ahead=baseline > 0.0)
    if grid.height < 4 * BLOCK_PX:
        return None
    offset = math.copysign(span[0], -grid.scale)  # d of disparity 0
    left, right = _sampled(one, axes, grid.u, grid.phi), _sampled(other, axes, grid.u + np.float32(offset), grid.phi)
    found = cv2.remap(
        disparities(left, right, grid.count),
        np.where(valid, grid.columns(logs), -1.0).astype(np.float32),
        grid.rows(around).astype(np.float32),
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )
    shift = np.float32(offset) - found / np.float32(grid.scale)
    rho = ahead[2] * -np.expm1(-shift) / np.float32(baseline)
    height, width = rho.shape
    column, row, z = seen_by(other, one, np.arange(width), np.arange(height)[:, None], rho)
    inside = (z > 0) & (column >= 0) & (column < other.grey.shape[1]) & (row >= 0) & (row < other.grey.shape[0])
    rho[~(valid & inside & (rho > 0))] = np.nan
    # Near the baseline, columns are narrower than the photo's pixels.
    px = np.maximum(1.0 / abs(grid.scale), 1.0 / (one.matrix[0, 0] * np.maximum(tangents, LEAST_TANGENT)))
    magnified = np.exp(-np.where(np.isfinite(shift), shift, 0.0))
    return rho, (DISPARITY_ERROR_PX * px * magnified * np.abs(ahead[2] / baseline)).astype(np.float32)


@dataclass(frozen=True)
class _Grid:
    """Where a picture is sampled along epipolar lines.

    Args:
        start: u of the first column after `count` that the matcher skips, as many as there are disparities.
        scale: columns per unit of u, negative if u decreases: matches must be further left in the other picture.
        first: phi of the first row after a margin.
        row_scale: rows per radian.
        width, height: of the sampled picture.
    """

    start: float
    scale: float
    count: int
    first: float
    row_scale: float
    width: int
    height: int

    @property
    def u(self) -> np.ndarray:
        """Logarithms of tangents (width,) of the columns."""
        return (self.start + (np.arange(self.width) - self.count) / self.scale).astype(np.float32)

    @property
    def phi(self) -> np.ndarray:
        """Angles (height,) of the rows, radians."""
        return (self.first + (np.arange(self.height) - BLOCK_PX) / self.row_scale).astype(np.float32)

    def columns(self, logs: np.ndarray) -> np.ndarray:
        """Return the columns of logarithms of tangents."""
        return (logs - self.start) * self.scale + self.count

    def rows(self, around: np.ndarray) -> np.ndarray:
        """Return the rows of angles around the baseline."""
        return np.mod(around - self.first, 2.0 * math.pi) * self.row_scale + BLOCK_PX


def _grid(logs: np.ndarray, around: np.ndarray, span: tuple[float, float], *, focal: float, is_ahead: bool) -> _Grid:
    """Return the grid for pixels (N,) at these logarithms of tangents and angles around the baseline.

    Args:
        span: the least and the largest shift to search.
        focal: focal length, pixels.
        is_ahead: whether the other camera is ahead. Then it sees everything further out.
    """
    first, angle = _sector(around)
    extent = float(np.ptp(logs))
    full = focal * math.exp(float(logs.max()))  # as fine as the photo where that is coarsest
    by_area = math.sqrt(logs.size / (angle * max(extent, 1e-3)))  # as many pixels as the photo
    finer = math.sqrt(2.0)  # columns are twice as fine as rows
    scale, row_scale = (min(full, by_area * factor) for factor in (finer, 1.0 / finer))
    count = disparity_count((span[1] - span[0]) * scale)
    return _Grid(
        float(logs.max() if is_ahead else logs.min()),
        -scale if is_ahead else scale,
        count,
        first,
        row_scale,
        width=int(extent * scale) + 1 + count,
        height=int(angle * row_scale) + 1 + 2 * BLOCK_PX,
    )


def _axes(axis: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return orthonormal axes (3, 3) of which the last is the given one, from the camera's axes `turn`."""
    across = turn[int(np.abs(turn[:2] @ axis).argmin())]
    across = across - (across @ axis) * axis
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(axis, across), axis])


def _range(seen: np.ndarray, baseline: float) -> tuple[float, float] | None:
    """Return the least and the largest shift |d| to search, from points (P, 3) in the axes; None for too few points."""
    z, away = seen[:, 2], np.hypot(seen[:, 0], seen[:, 1])
    nearer = np.minimum(z, z - baseline)  # from the camera that is ahead
    z = z[(away > LEAST_TANGENT * z) & (away < MOST_TANGENT * nearer)]
    if len(z) < FEWEST_SHARED:
        return None
    shifts = np.abs(np.log(z / (z - baseline)))
    least, most = range_of(shifts, float(np.median(shifts)))
    least, most = max(0.0, least), min(most, math.log(MOST_MAGNIFICATION))
    return (least, most) if most > least else None


def _sector(angles: np.ndarray) -> tuple[float, float]:
    """Return where the sector that contains these angles (N,) begins, and how large it is, radians; 2 pi at most."""
    degrees = np.unique(np.floor(angles * (360 / (2.0 * math.pi))).astype(np.int64) % 360)
    gaps = np.diff(degrees, append=degrees[0] + 360)
    largest = int(gaps.argmax())
    size = 361 - int(gaps[largest])
    return 2.0 * math.pi / 360 * float(degrees[(largest + 1) % len(degrees)]), 2.0 * math.pi / 360 * size


def _sampled(view: View, axes: np.ndarray, u: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return the picture (rows of phi, columns of u) of a view, 0 where it shows nothing."""
    tangents = np.exp(u)
    x, y, z = (
        a * np.outer(np.cos(phi), tangents) + b * np.outer(np.sin(phi), tangents) + c
        for a, b, c in (view.matrix @ view.turn @ axes.T).astype(np.float32)
    )
    in_front = z > 1e-6
    z = np.where(in_front, z, 1.0)
    column, row = (np.where(in_front, values / z, -1.0).astype(np.float32) for values in (x, y))
    return cv2.remap(view.grey, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
