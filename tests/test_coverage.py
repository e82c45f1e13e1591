"""Cells that photos may fill: seen by two, or far enough away from one."""

import numpy as np
import torch

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.field.contraction import training_points
from nerfcli.fit.coverage import covered_cells
from nerfcli.fit.point_depth import PointDepths
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.photos.pool import PixelPool

SIDE = 32
CAMERA = Camera.pinhole(20, 20, 20.0)  # half of the view is 0.5 wide at distance 1


def pool_of(*places: float) -> PixelPool:
    """Return the pixels of cameras at (x, 0, -1) that look along z."""
    photos = []
    for x in places:
        pose = np.eye(4)
        pose[:3, 3] = (x, 0.0, -1.0)
        photos.append(LoadedPhoto(Frame(f"{x}.png", CAMERA, pose), np.zeros((20, 20, 3), np.uint8), None))
    return PixelPool(photos, Similarity(1.0, np.eye(3), np.zeros(3)), torch.device("cpu"))


def at_distances(pool: PixelPool, *distances: float) -> PointDepths:
    """Return the known distance of one pixel of each photo."""
    return PointDepths(pool.first_pixel + 210, torch.tensor(distances), torch.ones(len(distances)))


def views_of(x: float, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return whether the camera at x sees each point, and the distances of the points from it."""
    away = points - torch.tensor([x, 0.0, -1.0])
    return (away[..., 2] > 0) & (away[..., :2].abs() < 0.5 * away[..., 2:]).all(-1), away.norm(dim=-1)


def middles() -> torch.Tensor:
    """Return the centres of cells in the training frame, (SIDE, SIDE, SIDE, 3), indexed [z, y, x]."""
    axis = (torch.arange(SIDE) + 0.5) / SIDE
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    return training_points(torch.stack([x, y, z], dim=-1), "l2")


def test_space_near_a_camera_that_no_other_one_sees_is_not_covered():
    pool = pool_of(-0.4, 0.4)
    covered = covered_cells(pool, SIDE, "l2", at_distances(pool, 1.5, 2.5))
    first, far_from_first = views_of(-0.4, middles())
    second, far_from_second = views_of(0.4, middles())
    expected = (first & second) | (first & (far_from_first >= 1.5)) | (second & (far_from_second >= 2.5))
    assert torch.equal(covered, expected)
    assert 0.05 < covered.float().mean() < 0.5


def test_photos_without_depths_take_the_median_of_the_others_and_all_without_any_need_a_second_photo():
    pool = pool_of(-0.4, 0.4)
    one = at_distances(pool, 1.5, 1.5)
    of_first = PointDepths(one.numbers[:1], one.distances[:1], one.trust[:1])
    assert torch.equal(covered_cells(pool, SIDE, "l2", of_first), covered_cells(pool, SIDE, "l2", one))
    both = views_of(-0.4, middles())[0] & views_of(0.4, middles())[0]
    assert torch.equal(covered_cells(pool, SIDE, "l2", None), both)


def test_a_single_photo_may_fill_what_lies_behind_its_median_depth():
    pool = pool_of(0.0)
    seen, distance = views_of(0.0, middles())
    assert torch.equal(covered_cells(pool, SIDE, "l2", at_distances(pool, 1.2)), seen & (distance >= 1.2))
