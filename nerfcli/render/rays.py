"""Rays of a camera through its pixels, in the training frame.

Ray of pixel p:  origin = R c + t scaled,  direction = R_frame R_cam bearing(p)  with unit norm, so that distances
along rays are lengths and density times length is an optical depth.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity

# One sample of a pixel: its centre.
CENTRES = np.array([[0.5, 0.5]])


@dataclass(frozen=True)
class PictureRays:
    """Rays of pixels of one picture, row by row, those of a pixel side by side.

    Args:
        origin: (3,) the camera's centre, training frame.
        directions: (N, 3) unit.
        valid: (N,) bool; places that the lens model cannot invert have no ray.
        cosines: (N,) between each ray and the optical axis: z = distance * cosine.
        cones: (N,) width per distance of what a ray stands for: a pixel's, or a share of its area.
    """

    origin: Tensor
    directions: Tensor
    valid: Tensor
    cosines: Tensor
    cones: Tensor


def pixel_rays(
    frame: Frame, training_from_scene: Similarity, *, pixels: np.ndarray, places: np.ndarray, device: torch.device
) -> PictureRays:
    """Rays of pixels (M,), counted row by row, at the same places (P, 2) inside [0, 1]^2 of each: N = M * P.

    Geometry is in float64, the result in float32.
    """
    return _turned(frame, training_from_scene, *_bearings(frame.camera, pixels, places, device), count=len(places))


def successive_rays(
    frame: Frame, training_from_scene: Similarity, *, pixels: range, count: int, device: torch.device
) -> PictureRays:
    """`pixel_rays` at `places_in_pixel(count)`; what the next picture of the same camera needs again is kept."""
    return _turned(frame, training_from_scene, *_bearings_of_range(frame.camera, pixels, count, device), count=count)


def _turned(
    frame: Frame, training_from_scene: Similarity, bearings: Tensor, valid: Tensor, *, count: int
) -> PictureRays:
    """Rays from bearings (N, 3), float64, in the axes of the camera; `count` of them are of the same pixel."""
    world_from_cam = torch.from_numpy(training_from_scene.apply_pose(frame.world_from_cam)).to(bearings.device)
    # Component by component: products of matrices round differently with the number of rows.
    columns = world_from_cam[:3, :3].T
    directions = bearings[:, :1] * columns[0] + bearings[:, 1:2] * columns[1] + bearings[:, 2:] * columns[2]
    width = 1.0 / (frame.camera.focal_px * math.sqrt(count))
    return PictureRays(
        origin=world_from_cam[:3, 3].float(),
        directions=directions.float(),
        valid=valid,
        cosines=bearings[:, 2].float(),
        cones=torch.full((len(bearings),), width, device=bearings.device),
    )


def _bearings(camera: Camera, pixels: np.ndarray, places: np.ndarray, device: torch.device) -> tuple[Tensor, Tensor]:
    """(N, 3) float64 and (N,) bool, whether there are any."""
    corners = np.stack([pixels % camera.width, pixels // camera.width], axis=-1)
    bearings, valid = camera.bearings((corners[:, None] + places).reshape(-1, 2))
    return torch.from_numpy(bearings).to(device), torch.from_numpy(valid).to(device)


@functools.lru_cache(maxsize=8)  # 2 million rays, 25 bytes each
def _bearings_of_range(camera: Camera, pixels: range, count: int, device: torch.device) -> tuple[Tensor, Tensor]:
    return _bearings(camera, np.arange(pixels.start, pixels.stop), places_in_pixel(count), device)


def places_in_pixel(count: int) -> np.ndarray:
    """Return the sample positions inside each pixel: (count, 2) in [0, 1]^2, the same for every pixel and picture.

    x_i = (i + 1/2) / count, y_i = (rank of the base-2 radical inverse of i + 1/2) / count: one place in every row and
    every column of a count x count grid, and one in each of count equal boxes where count is a power of two. Their mean
    is the pixel's centre.

    Source: Hammersley 1960; as n-rooks, Shirley 1991, Discrepancy as a quality measure for sample distributions.
    """
    inverse = [int(f"{i:032b}"[::-1], 2) for i in range(count)]
    rank = np.argsort(np.argsort(inverse))
    return (np.stack([np.arange(count), rank], axis=-1) + 0.5) / count
