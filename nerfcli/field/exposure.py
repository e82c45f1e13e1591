"""Exposure and white balance of individual photos: a gain per channel, in linear light.

The field holds the colours at mean exposure; a photo shows them multiplied by its gains. The logarithms of the gains
have mean 0 over the photos: what all photos have in common is left to the field, and rendered pictures need no gains.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

# A ray with less opacity has no meaningful colour of its own.
LEAST_OPACITY = 1e-3


def linear_from_srgb(levels: Tensor) -> Tensor:
    """Convert sRGB levels >= 0 to linear light; levels above 1 continue along the curve. Differentiable.

    Source: IEC 61966-2-1.
    """
    curved = ((levels.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(levels <= 0.04045, levels / 12.92, curved)


def srgb_from_linear(light: Tensor) -> Tensor:
    """Convert linear light >= 0 to sRGB levels, not clipped. Differentiable."""
    curved = 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(light <= 0.0031308, light * 12.92, curved)


def exposed(rgb: Tensor, log_gains: Tensor) -> Tensor:
    """Return sRGB colours as a photo with these gains shows them, not clipped.

    srgb(exp(log_gain) * linear(rgb)), channel by channel

    Differentiable in both.
    """
    return srgb_from_linear(linear_from_srgb(rgb) * log_gains.exp())


def changed_in_front(
    rgb: Tensor, change: Callable[[Tensor], Tensor], *, transmittance: Tensor, behind: Tensor | float
) -> Tensor:
    """Return sRGB colours (..., 3) on a background with a change, such as `exposed`, to what is in front of it alone.

    Args:
        rgb: composited on `behind`.
        transmittance: (..., 1) fraction of the light from behind.
    """
    opacity, passing = 1.0 - transmittance, transmittance * behind
    own = (rgb - passing).clamp_min(0.0) / opacity.clamp_min(LEAST_OPACITY)
    return opacity * change(own) + passing


class Exposure(nn.Module):
    """The gains of the training photos.

    Args:
        start: (P, 3) initial logarithms of the gains; only differences between photos matter.
        learned: (P,) bool, the photos whose gains are learned; those of the others keep their differences.
    """

    _learned: Tensor

    def __init__(self, start: Tensor, learned: Tensor):
        super().__init__()
        self.free = nn.Parameter(start.clone())
        self.register_buffer("_learned", learned[:, None], persistent=False)

    def log_gains(self) -> Tensor:
        """Return the logarithms of the gains (P, 3), with mean 0 over the photos in every channel."""
        gains = torch.where(self._learned, self.free, self.free.detach())
        return gains - gains.mean(0)

    def forward(self, rgb: Tensor, photos: Tensor) -> Tensor:
        """Return colours (R, 3) as the photos (R,) show them."""
        return exposed(rgb, self.log_gains()[photos])
