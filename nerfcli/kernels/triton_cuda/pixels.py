"""Rays and colours of the pixels drawn in training, in one launch. Same operation as `reference.pixel_rays`."""

import torch
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.interface import PixelTable
from nerfcli.kernels.triton_cuda.launch import blocks, jit, launch

BLOCK = 128


@jit
def _pixels(
    chosen, first_pixel, first_bearing, bearings, poses, colours, origins,
    directions, out, photos, halvings, count, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
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
    bearing = (
        tl.load(first_bearing + low, mask=valid, other=0) + pixel - tl.load(first_pixel + low, mask=valid, other=0)
    )
    x = tl.load(bearings + bearing * 3, mask=valid, other=0.0)
    y = tl.load(bearings + bearing * 3 + 1, mask=valid, other=0.0)
    z = tl.load(bearings + bearing * 3 + 2, mask=valid, other=0.0)
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
    launch(
        _pixels, (blocks(count, BLOCK),), chosen.contiguous(), pixels.first_pixel, pixels.first_bearing,
        pixels.bearings, pixels.poses.contiguous(), pixels.colours, origins, directions, colours, photos,
        max(0, photos - 1).bit_length(), count, CHANNELS=channels, BLOCK=BLOCK,
    )  # fmt: skip
    return origins, directions, colours
