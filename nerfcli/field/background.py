"""Background beyond the field: a colour by direction."""

import torch
from torch import Tensor, nn

Colour = tuple[float, float, float]


class SphereBackground(nn.Module):
    """sRGB by direction: a grid over the cube around the unit sphere, interpolated at the direction, then a sigmoid.

    Interpolation is trilinear, with no seam and no pole. A grid of a single vertex is one learned colour.

    Args:
        side: vertices per axis; with 32, cells are 3.7 degrees wide.
    """

    def __init__(self, side: int = 32):
        super().__init__()
        self.logits = nn.Parameter(torch.zeros(3, side, side, side))

    def forward(self, directions: Tensor) -> Tensor:
        """Return colours (R, 3) in (0, 1) for unit directions (R, 3). Differentiable in the grid."""
        places = directions[None, None, None]  # (1, 1, 1, R, 3)
        values = torch.nn.functional.grid_sample(
            self.logits[None], places, mode="bilinear", padding_mode="border", align_corners=True
        )  # (1, 3, 1, 1, R)
        return torch.sigmoid(values[0, :, 0, 0].t())

    def roughness(self) -> Tensor:
        """Return the sum of squared differences between neighbouring vertices of the grid, in logits; a scalar.

        Differentiable. Its gradient moves each vertex towards its neighbours; a grid of a single vertex has none.
        """
        return torch.stack([self.logits.diff(dim=axis).square().sum() for axis in (1, 2, 3)]).sum()


Background = Colour | SphereBackground


def colours_behind(background: Background, directions: Tensor) -> Tensor:
    """Return the sRGB colours (R, 3) behind the field along directions (R, 3)."""
    if isinstance(background, SphereBackground):
        return background(directions)
    return directions.new_tensor(background).expand(len(directions), 3)
