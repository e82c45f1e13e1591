"""Marching for fields whose density is no part of it: all samples in occupied cells first, then those that are lit."""

from collections.abc import Callable

import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.field.interface import Samples

# Samples whose densities are computed at a time.
CHUNK = 2**16


@torch.no_grad()
def visible_samples(
    origins: Tensor,
    directions: Tensor,
    edges: Tensor,
    *,
    jitter: Tensor,
    occupied: Tensor,
    contraction: str,
    deepest: float,
    density: Callable[[Tensor], Tensor],
    code: Callable[[Tensor], Tensor],
) -> Samples:
    """The same samples as `kernels.visible_samples` gives, for another density.

    What stands behind surfaces is computed and left out, which the compiled operation avoids.

    Args:
        origins, directions, edges, jitter, occupied, contraction, deepest: see `kernels.visible_samples`.
        density: (N, 3) coordinates to (N,).
        code: (N, 3) coordinates of the samples that are kept to their (N, C).
    """
    starts, ends, coordinates, offsets = kernels.occupied_samples(
        origins, directions, edges, jitter=jitter, occupied=occupied, contraction=contraction
    )
    thickness = torch.cat([density(chunk) for chunk in coordinates.split(CHUNK)])
    lit, offsets = kernels.lit_samples(thickness, ends - starts, offsets, deepest=deepest)
    kept = coordinates[lit]
    return Samples(starts[lit], ends[lit], thickness[lit], code(kept), kept, offsets)
