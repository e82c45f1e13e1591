"""Samples along rays, whatever the field: those in occupied cells, and those of them that light gets to.

Definitions as in `reference`: short, plain torch, any dtype, never optimised. Same letters.
"""

import torch
from torch import Tensor

from nerfcli.kernels.reference import march, optical_depth_before, sample_coordinates


def occupied_samples(
    origins: Tensor,
    directions: Tensor,
    edges: Tensor,
    *,
    jitter: Tensor,
    occupied: Tensor,
    contraction: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The samples of `reference.march` with their places.

    Returns:
        starts (N,), ends (N,), coordinates (N, 3) in the field's unit cube, offsets (R + 1,).
    """
    starts, ends, offsets = march(origins, directions, edges, jitter=jitter, occupied=occupied, contraction=contraction)
    coordinates = sample_coordinates(origins, directions, starts, ends, offsets=offsets, contraction=contraction)
    return starts, ends, coordinates, offsets


def lit_samples(density: Tensor, lengths: Tensor, offsets: Tensor, *, deepest: float) -> tuple[Tensor, Tensor]:
    """Which samples have an optical depth below `deepest` in front of them, as `reference.visible_samples` has it.

    Returns:
        lit (N,) bool, and the offsets (R + 1,) of those that are.
    """
    lit = optical_depth_before(density, lengths, offsets) < deepest
    return lit, torch.nn.functional.pad(lit.cumsum(0), (1, 0))[offsets]
