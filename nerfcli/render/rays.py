"""Rays of a camera through the centres of its pixels, in the training frame.

Ray of pixel p:  origin = R c + t scaled,  direction = R_frame R_cam bearing(p)  with unit norm, so that distances
along rays are lengths and density times length is an optical depth.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity


@dataclass(frozen=True)
class Rays:
    """The rays of one picture, row by row.

    Args:
        origin: (3,) the camera's centre, training frame.
        directions: (H * W, 3) unit.
        valid: (H * W,) bool; pixels that the lens model cannot invert have no ray.
        cosines: (H * W,) between each ray and the optical axis: z = distance * cosine.
        width, height: of the picture.
    """

    origin: Tensor
    directions: Tensor
    valid: Tensor
    cosines: Tensor
    width: int
    height: int


def frame_rays(frame: Frame, training_from_scene: Similarity, device: torch.device) -> Rays:
    """Rays of every pixel of a frame; geometry in float64, the result in float32."""
    bearings, valid = frame.camera.pixel_bearings()
    world_from_cam = training_from_scene.apply_pose(frame.world_from_cam)
    directions = bearings @ world_from_cam[:3, :3].T

    def tensor(values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=device)

    return Rays(
        origin=tensor(world_from_cam[:3, 3]),
        directions=tensor(directions),
        valid=torch.as_tensor(valid, device=device),
        cosines=tensor(bearings[:, 2]),
        width=frame.camera.width,
        height=frame.camera.height,
    )
