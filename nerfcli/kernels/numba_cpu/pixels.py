"""Rays and colours of chosen pixels on CPU threads. Same operation as `reference.pixel_rays`."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from nerfcli.kernels.interface import PixelTable
from nerfcli.kernels.numba_cpu.threads import use_threads


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def _pixel_rays(
    chosen: Any, first_pixel: Any, first_bearing: Any, bearings: Any, poses: Any, photos: Any, origins: Any,
    directions: Any, colours: Any,
) -> None:  # fmt: skip
    for i in numba.prange(chosen.shape[0]):
        pixel = chosen[i]
        photo = np.searchsorted(first_pixel, pixel, side="right") - 1
        bearing = bearings[first_bearing[photo] + pixel - first_pixel[photo]]
        for axis in range(3):
            row = poses[photo, axis]
            directions[i, axis] = row[0] * bearing[0] + row[1] * bearing[1] + row[2] * bearing[2]
            origins[i, axis] = row[3]
        for channel in range(photos.shape[1]):
            colours[i, channel] = np.float32(photos[pixel, channel]) / np.float32(255)


def pixel_rays(chosen: Tensor, pixels: PixelTable) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.pixel_rays`; float32 on the CPU."""
    use_threads()
    origins, directions = torch.empty(len(chosen), 3), torch.empty(len(chosen), 3)
    colours = torch.empty(len(chosen), pixels.colours.shape[1])
    _pixel_rays(*(x.numpy() for x in (chosen, *pixels, origins, directions, colours)))
    return origins, directions, colours
