"""Inverse depths from a pair of photos of cameras that moved sideways: both pictures rectified, matched by rows."""

import math

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
    places = (
        focal * rays[:, :2] / np.maximum(rays[:, 2:], LEAST_RISE)
    )  # corners that are turned away further would make the box too large
    return places.min(0), places.max(0)
