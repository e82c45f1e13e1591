"""Coverage: grid cells that the training photos may fill, as several of them see into the cell, or one from afar."""

import math

import numpy as np
import torch
from torch import Tensor

from nerfcli.field.contraction import training_points
from nerfcli.fit.point_depth import PointDepths
from nerfcli.photos.pool import PixelPool

# Photos that have to see into a cell. A single photo may fill it only beyond this fraction of the median distance of
# what it shows: anything nearer would look right to that photo, and no other one contradicts it.
LEAST_PHOTOS, OWN_SPACE = 2, 1.0
# Margin on half the diagonal field of view.
BEYOND_CORNER = 1.1


def covered_cells(pool: PixelPool, side: int, contraction: str, depths: PointDepths | None) -> Tensor:
    """Return which cells of a grid over the unit cube photos may fill.

    A cell is covered if its centre is in the view of two photos, or in the view of one and at least `OWN_SPACE` times
    that photo's median known distance away. Occlusion is not considered.

    Args:
        side: cells per axis.
        depths: pixels at known distances; a photo without any takes the median over all photos.

    Returns:
        (side, side, side) bool, indexed [z, y, x].
    """
    numbers = torch.arange(side**3)
    place = torch.stack([numbers % side, numbers // side % side, numbers // side**2], dim=-1)
    points = training_points((place + 0.5) / side, contraction).double().numpy()
    nearest = _median_distances(pool, depths)
    count = np.zeros(side**3, dtype=np.int64)
    for camera, pose, own in zip(pool.cameras, pool.poses.double().cpu().numpy(), nearest, strict=True):
        left = np.flatnonzero(count < LEAST_PHOTOS)
        away = points[left] - pose[:3, 3]
        distances = np.linalg.norm(away, axis=1)
        # No pixel is farther from the axis than this: only points within it are projected through the lens.
        widest = min(180.0, math.hypot(*camera.fov_deg))
        near_axis = away @ pose[:3, 2] >= distances * math.cos(math.radians(widest / 2 * BEYOND_CORNER))
        left, distances = left[near_axis], distances[near_axis]
        pixels, valid = camera.project(away[near_axis] @ pose[:3, :3])
        inside = valid & camera.contains(pixels)
        count[left] += np.where(inside, np.where(distances >= OWN_SPACE * own, LEAST_PHOTOS, 1), 0)
    covered = torch.from_numpy(count >= LEAST_PHOTOS).reshape(side, side, side)
    return covered.to(pool.colours.device)


def _median_distances(pool: PixelPool, depths: PointDepths | None) -> np.ndarray:
    """Return the median known distance of each photo; infinite if no photo has any."""
    count = len(pool.cameras)
    if depths is None or len(depths.numbers) == 0:
        return np.full(count, np.inf)
    photos, distances = pool.photo_of(depths.numbers).cpu().numpy(), depths.distances.cpu().numpy()
    medians = np.full(count, np.median(distances))
    for photo in np.unique(photos):
        medians[photo] = np.median(distances[photos == photo])
    return medians
