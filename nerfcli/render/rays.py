"""Rays of a camera through its pixels, in the training frame.

Ray of pixel p:  origin = s R c + t,  direction = R R_cam bearing(p), with the camera's centre c and the similarity
(s, R, t) from the scene to the training frame. Directions have unit norm, so that distances along rays are lengths and
density times length is an optical depth.
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
    """Rays of pixels of one picture, row by row; the rays of a pixel are adjacent.

    Args:
        origin: (3,) the camera's centre, training frame.
        directions: (N, 3) unit.
        valid: (N,) bool; False where the lens model cannot be inverted.
        cosines: (N,) of the angle between each ray and the optical axis: z = distance * cosine.
        cones: (N,) footprint of each ray per distance: the width of a pixel, or of an equal part of its area.
    """

    origin: Tensor
    directions: Tensor
    valid: Tensor
    cosines: Tensor
    cones: Tensor


def pixel_rays(
    frame: Frame, training_from_scene: Similarity, *, pixels: np.ndarray, places: np.ndarray, device: torch.device
) -> PictureRays:
    """Return the rays of pixels (M,), numbered row by row, at the same places (P, 2) in [0, 1]^2 in each: N = M * P.

    Computed in float64; the result is in float32.
    """
    return _turned(frame, training_from_scene, *_bearings(frame.camera, pixels, places, device), count=len(places))


def successive_rays(
    frame: Frame, training_from_scene: Similarity, *, pixels: range, count: int, device: torch.device
) -> PictureRays:
    """Return `pixel_rays` at `places_in_pixel(count)`; bearings are cached for further pictures of the same camera."""
    return _turned(frame, training_from_scene, *_bearings_of_range(frame.camera, pixels, count, device), count=count)


def _turned(
    frame: Frame, training_from_scene: Similarity, bearings: Tensor, valid: Tensor, *, count: int
) -> PictureRays:
    """Return the rays of bearings (N, 3), float64, in the axes of the camera, with `count` rays per pixel."""
    world_from_cam = torch.from_numpy(training_from_scene.apply_pose(frame.world_from_cam)).to(bearings.device)
    # Not a matrix product, whose rounding depends on the number of rows.
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
    """Return the bearings (N, 3) float64 and whether each exists, (N,) bool."""
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
