"""The rays and colours of the pixels drawn in training. Letters as in `interface`."""

import torch
from torch import Tensor

from nerfcli.kernels.interface import PixelTable


def pixel_rays(chosen: Tensor, pixels: PixelTable) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rays of chosen pixels (N,) int64 of many photos, and their colours.

    Returns:
        origins (N, 3), directions (N, 3) = rotation @ bearing, colours (N, C) in [0, 1].
    """
    photo = torch.searchsorted(pixels.first_pixel, chosen, right=True) - 1
    bearing = pixels.bearings[pixels.first_bearing[photo] + chosen - pixels.first_pixel[photo]]
    pose = pixels.poses[photo]
    directions = (pose[:, :3, :3] * bearing[:, None, :]).sum(-1)  # a batched product of 3x3 is slower
    return pose[:, :3, 3], directions, pixels.colours[chosen].to(pose.dtype) / 255.0
