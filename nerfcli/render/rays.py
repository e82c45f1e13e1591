"""Rays of a camera through the centres of its pixels, in the training frame.

Ray of pixel p:  origin = s R c + t,  direction = R R_cam bearing(p), with the camera's centre c and the similarity
(s, R, t) from the scene to the training frame. Directions have unit norm, so that distances along rays are lengths and
density times length is an optical depth.
"""

import functools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity


@dataclass(frozen=True)
class PictureRays:
    """Rays of pixels of one picture, row by row.

    Args:
        origin: (3,) the camera's centre, training frame.
        directions: (N, 3) unit.
        valid: (N,) bool; False where the lens model cannot be inverted.
        cosines: (N,) of the angle between each ray and the optical axis: z = distance * cosine.
        cones: (N,) footprint of each ray per distance: the width of a pixel.
    """

    origin: Tensor
    directions: Tensor
    valid: Tensor
    cosines: Tensor
    cones: Tensor


def pixel_rays(
    frame: Frame, training_from_scene: Similarity, *, pixels: np.ndarray, device: torch.device
) -> PictureRays:
    """Return the rays of pixels (N,), numbered row by row; computed in float64, the result is in float32."""
    return _turned(frame, training_from_scene, *_bearings(frame.camera, pixels, device))


def successive_rays(
    frame: Frame, training_from_scene: Similarity, *, pixels: range, device: torch.device
) -> PictureRays:
    """Return `pixel_rays`; bearings are cached for further pictures of the same camera."""
    return _turned(frame, training_from_scene, *_bearings_of_range(frame.camera, pixels, device))


def _turned(frame: Frame, training_from_scene: Similarity, bearings: Tensor, valid: Tensor) -> PictureRays:
    """Return the rays of bearings (N, 3), float64, in the axes of the camera."""
    world_from_cam = torch.from_numpy(training_from_scene.apply_pose(frame.world_from_cam)).to(bearings.device)
    # Not a matrix product, whose rounding depends on the number of rows.
    columns = world_from_cam[:3, :3].T
    directions = bearings[:, :1] * columns[0] + bearings[:, 1:2] * columns[1] + bearings[:, 2:] * columns[2]
    return PictureRays(
        origin=world_from_cam[:3, 3].float(),
        directions=directions.float(),
        valid=valid,
        cosines=bearings[:, 2].float(),
        cones=torch.full((len(bearings),), 1.0 / frame.camera.focal_px, device=bearings.device),
    )


def _bearings(camera: Camera, pixels: np.ndarray, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the bearings (N, 3) float64 and whether each exists, (N,) bool."""
    corners = np.stack([pixels % camera.width, pixels // camera.width], axis=-1)
    bearings, valid = camera.bearings(corners + 0.5)
    return torch.from_numpy(bearings).to(device), torch.from_numpy(valid).to(device)


@functools.lru_cache(maxsize=8)  # 2 million rays, 25 bytes each
def _bearings_of_range(camera: Camera, pixels: range, device: torch.device) -> tuple[Tensor, Tensor]:
    return _bearings(camera, np.arange(pixels.start, pixels.stop), device)
