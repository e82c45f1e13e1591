"""Rays and colours of chosen pixels on CPU threads. Same operation as `reference.pixel_rays`."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.interface import BearingGrids, PixelTable
from nerfcli.kernels.numba_cpu.threads import use_threads


@numba.njit(inline="always")
def _bearing(photo: Any, place: Any, first_bearing: Any, bearings: Any, widths: Any, corners: Any) -> Any:
    """Return the bearing of the pixel of a photo at a place, counted row by row."""
    if corners.shape[0] == 0:
        at = first_bearing[photo] + place
        return bearings[at, 0], bearings[at, 1], bearings[at, 2]
    width, below = widths[photo, 0], widths[photo, 1]
    at = first_bearing[photo] + place // width * below + place % width
    weight = corners[photo]
    if weight[0] == np.float32(1):
        return bearings[at, 0], bearings[at, 1], bearings[at, 2]
    x = y = z = np.float32(0)
    for corner in range(4):
        other = at + (corner & 1) + (corner >> 1) * below
        x += weight[corner] * bearings[other, 0]
        y += weight[corner] * bearings[other, 1]
        z += weight[corner] * bearings[other, 2]
    scale = np.float32(1) / np.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _pixel_rays(
    chosen: Any, first_pixel: Any, first_bearing: Any, bearings: Any, poses: Any, photos: Any, widths: Any,
    corners: Any, origins: Any, directions: Any, colours: Any,
) -> None:  # fmt: skip
    for i in numba.prange(chosen.shape[0]):
        pixel = chosen[i]
        photo = np.searchsorted(first_pixel, pixel, side="right") - 1
        x, y, z = _bearing(photo, pixel - first_pixel[photo], first_bearing, bearings, widths, corners)
        for axis in range(3):
            row = poses[photo, axis]
            directions[i, axis] = row[0] * x + row[1] * y + row[2] * z
            origins[i, axis] = row[3]
        for channel in range(photos.shape[1]):
            colours[i, channel] = np.float32(photos[pixel, channel]) / np.float32(255)


def pixel_rays(chosen: Tensor, pixels: PixelTable) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.pixel_rays`; float32 on the CPU."""
    use_threads()
    origins, directions = torch.empty(len(chosen), 3), torch.empty(len(chosen), 3)
    colours = torch.empty(len(chosen), pixels.colours.shape[1])
    grids = pixels.grids or BearingGrids(torch.empty(0, 2, dtype=torch.int64), torch.empty(0, 4))
    _pixel_rays(*(x.numpy() for x in (chosen, *pixels[:5], *grids, origins, directions, colours)))
    return origins, directions, colours
