"""The rays and colours of the pixels drawn in training. Letters as in `interface`."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfcli.kernels.interface import PixelTable


def pixel_rays(chosen: Tensor, pixels: PixelTable) -> tuple[Tensor, Tensor, Tensor]:
    """Return origins (N, 3), directions (N, 3) and colours (N, C) in [0, 1] of chosen pixels (N,) int64 of many photos.

    directions = rotation @ bearing
    """
    photo = torch.searchsorted(pixels.first_pixel, chosen, right=True) - 1
    bearing = _bearings(photo, chosen - pixels.first_pixel[photo], pixels)
    pose = pixels.poses[photo]
    directions = (pose[:, :3, :3] * bearing[:, None, :]).sum(-1)  # a batched product of 3x3 is slower
    return pose[:, :3, 3], directions, pixels.colours[chosen].to(pose.dtype) / 255.0


def _bearings(photo: Tensor, place: Tensor, pixels: PixelTable) -> Tensor:
    """Return the bearings (N, 3) of the pixels at places (N,) of photos (N,), counted row by row."""
    first, grids = pixels.first_bearing[photo], pixels.grids
    if grids is None:
        return pixels.bearings[first + place]
    width, grid_width = grids.widths[photo].unbind(-1)
    upper = first + place // width * grid_width + place % width
    around = torch.stack([upper, upper + 1, upper + grid_width, upper + grid_width + 1], dim=-1)
    # Corners of weight 0 may be beyond the last bearing.
    bearings, weights = pixels.bearings[around.clamp_max(len(pixels.bearings) - 1)], grids.corners[photo][:, :, None]
    return torch.where(weights[:, 0] == 1, bearings[:, 0], normalize((weights * bearings).sum(1), dim=-1))
