"""The corners of a dark square in a picture, from straight lines along its four edges.

The corners that OpenCV 5.0 finds are inside a blurred square by 0.2 px (CORNER_REFINE_SUBPIX) to 0.7 px, so a marker
of 64 pixels measures 0.4 % too small. Lines through the middles of edges do not have this bias.
"""

import cv2
import numpy as np

# Profiles across an edge: their number, the part of the edge that they cover, and their sampling step in pixels.
_PROFILES = 48
_PART = (0.1, 0.9)
_STEP_PX = 0.25

# Reach of profiles to both sides: as a fraction of the edge, well within the dark rim (1/9 in a 7x7 marker), because
# blur brings in light from behind the rim; and its limits in pixels.
_REACH = 1 / 12
_REACH_PX = (1.5, 8.0)

# Number of rounds: profiles must be centred on the edge to be unbiased, so each round starts from the last lines.
_ROUNDS = 4

# Least contrast across an edge in grey levels of 255, and least number of the 48 profiles that must show the edge.
_LEAST_CONTRAST = 20.0
_LEAST_PROFILES = 12


def refined_corners(grey: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """Return the corners of a dark square on white, to a few hundredths of a pixel; None if an edge is not visible.

    On each profile across an edge, the edge is at the mean position of the rise in brightness. A line is fitted to
    these positions, and neighbouring lines intersect in the corners.

    Args:
        grey: (H, W) uint8.
        corners: (4, 2) approximate, in either sense of rotation; pixel centres at whole numbers, as in OpenCV.

    Returns:
        (4, 2) float64, in the same order.
    """
    corners = np.asarray(corners, dtype=np.float64)
    start = corners
    for _ in range(_ROUNDS):
        lines = [_edge(grey, corners[k], corners[(k + 1) % 4], corners.mean(axis=0)) for k in range(4)]
        found = np.array([line for line in lines if line is not None])
        if len(found) < 4:
            return None
        # A corner is where its own edge meets the one before: rows [normal, offset] of n . p = offset.
        pairs = np.stack([found, np.roll(found, 1, axis=0)], axis=1)
        if np.abs(np.linalg.det(pairs[:, :, :2])).min() < 0.05:
            return None
        corners = np.linalg.solve(pairs[:, :, :2], pairs[:, :, 2:])[..., 0]
    side = np.linalg.norm(start - np.roll(start, 1, axis=0), axis=1).mean()
    return corners if np.abs(corners - start).max() < max(_REACH_PX[0], 2 * _REACH * side) else None


def _edge(grey: np.ndarray, a: np.ndarray, b: np.ndarray, middle: np.ndarray) -> np.ndarray | None:
    """Return the line [nx, ny, offset] of the edge from a to b of a dark square around `middle`, if visible."""
    length = float(np.linalg.norm(b - a))
    if length < 1:
        return None
    along = (b - a) / length
    outwards = np.array([along[1], -along[0]])
    outwards *= np.sign(outwards @ ((a + b) / 2 - middle)) or 1.0
    reach = float(np.clip(_REACH * length, *_REACH_PX))
    across = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    feet = a + np.linspace(*_PART, _PROFILES)[:, None] * (b - a)
    places = (feet[:, None, :] + across[:, None] * outwards).astype(np.float32)
    profiles = cv2.remap(grey, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rises = np.clip(np.diff(profiles.astype(np.float64), axis=1), 0.0, None)
    contrast = rises.sum(axis=1)
    seen = contrast >= max(_LEAST_CONTRAST, 0.5 * float(np.median(contrast)))
    if seen.sum() < _LEAST_PROFILES:
        return None
    between = (across[:-1] + across[1:]) / 2
    points = feet[seen] + (rises[seen] @ between / contrast[seen])[:, None] * outwards
    near = np.ones(len(points), dtype=bool)
    line = np.zeros(3)
    for _ in range(2):
        mean = points[near].mean(axis=0)
        normal = np.linalg.svd(points[near] - mean)[2][1]
        line = np.array([*normal, normal @ mean])
        off = np.abs(points @ normal - line[2])
        near = off <= 3 * 1.4826 * np.median(off) + 1e-3
    return line
