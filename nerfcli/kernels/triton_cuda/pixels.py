"""Rays and colours of the pixels drawn in training, in one launch. Same operation as `reference.pixel_rays`."""

import torch
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.interface import PixelTable
from nerfcli.kernels.triton_cuda.launch import blocks, jit, launch
from nerfcli.kernels.triton_cuda.rays import load3


@jit
def _weighted(bearings, at, below, corners, valid):
    """Return the weighted sum of the bearings around a pixel, normalised; the first as it is if its weight is 1."""
    first_x, first_y, first_z = load3(bearings, at, valid)
    weight = tl.load(corners, mask=valid, other=1.0)
    alone = weight == 1.0
    x, y, z = weight * first_x, weight * first_y, weight * first_z
    for corner in tl.static_range(1, 4):
        other_x, other_y, other_z = load3(bearings, at + corner % 2 + corner // 2 * below, valid & ~alone)
        factor = tl.load(corners + corner, mask=valid, other=0.0)
        x, y, z = x + factor * other_x, y + factor * other_y, z + factor * other_z
    norm = tl.sqrt(x * x + y * y + z * z)
    norm = tl.where(norm > 0.0, norm, 1.0)
    return tl.where(alone, first_x, x / norm), tl.where(alone, first_y, y / norm), tl.where(alone, first_z, z / norm)


@jit
def _pixels(
    chosen, first_pixel, first_bearing, bearings, poses, colours, widths, corners, origins,
    directions, out, photos, halvings, count, CHANNELS: tl.constexpr, GRIDS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    pixel = tl.load(chosen + i, mask=valid, other=0)
    # The last photo whose first pixel is at or before the pixel.
    low = tl.zeros([BLOCK], tl.int32)
    high = low + photos
    for _ in range(halvings):
        middle = (low + high) // 2
        right = tl.load(first_pixel + middle, mask=valid, other=0) <= pixel
        low, high = tl.where(right, middle, low), tl.where(right, high, middle)
    place = pixel - tl.load(first_pixel + low, mask=valid, other=0)
    at = tl.load(first_bearing + low, mask=valid, other=0)
    if GRIDS:
        width = tl.load(widths + low * 2, mask=valid, other=1)
        below = tl.load(widths + low * 2 + 1, mask=valid, other=1)
        at += place // width * below + place % width
        x, y, z = _weighted(bearings, at, below, corners + low * 4, valid)
    else:
        x, y, z = load3(bearings, at + place, valid)
    for axis in tl.static_range(3):
        row = poses + low * 16 + axis * 4
        along = tl.load(row, mask=valid, other=0.0) * x + tl.load(row + 1, mask=valid, other=0.0) * y
        along += tl.load(row + 2, mask=valid, other=0.0) * z
        tl.store(directions + i * 3 + axis, along, mask=valid)
        tl.store(origins + i * 3 + axis, tl.load(row + 3, mask=valid, other=0.0), mask=valid)
    for channel in tl.static_range(CHANNELS):
        value = tl.load(colours + pixel * CHANNELS + channel, mask=valid, other=0).to(tl.float32)
        tl.store(out + i * CHANNELS + channel, value / 255.0, mask=valid)


def pixel_rays(chosen: Tensor, pixels: PixelTable) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.pixel_rays`; float32."""
    count, photos, channels = len(chosen), len(pixels.poses), pixels.colours.shape[1]
    device = chosen.device
    origins, directions = torch.empty(count, 3, device=device), torch.empty(count, 3, device=device)
    colours = torch.empty(count, channels, device=device)
    widths, corners = pixels.grids or (pixels.first_pixel, pixels.bearings)  # not read without grids
    launch(
        _pixels, (blocks(count, 128),), chosen.contiguous(), pixels.first_pixel, pixels.first_bearing,
        pixels.bearings, pixels.poses.contiguous(), pixels.colours, widths, corners, origins, directions, colours,
        photos, max(0, photos - 1).bit_length(), count, CHANNELS=channels, GRIDS=pixels.grids is not None, BLOCK=128,
    )  # fmt: skip
    return origins, directions, colours
