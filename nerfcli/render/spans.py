"""Rays traced span by span, front to back, for fields whose density backends do not compile.

Marching through such a field cannot stop behind a surface: all samples of a ray are asked for their density at once.
Spans of a ray are traced one after the other, and only where light still gets to.
"""

import math

import torch
from torch import Tensor

from nerfcli.field.interface import Field
from nerfcli.kernels import Intervals, March, Rays, RaysSeen, ray_indices, reference

# Intervals of a span: fewer cost more calls, more are computed behind surfaces.
SPAN = 64


def trace_in_spans(
    field: Field, rays: Rays, march: March, *, background: Tensor, shares: tuple[float, ...], negligible: float
) -> RaysSeen:
    """`Backend.trace_rays` with the samples, of rays without jitter.

    With T the light that passes the spans in front of span k:  colour = sum_k T_k colour_k + T background. Where light
    ends is computed from the samples of all spans.
    """
    count, device = len(rays.origins), rays.origins.device
    firsts = range(0, len(march.edges) - 2, SPAN)
    rgb, left_out = torch.zeros_like(rays.origins), torch.zeros_like(rays.jitter)
    transmittance, alive = torch.ones_like(rays.jitter), torch.arange(count, device=device)
    stop = math.exp(-march.max_optical_depth) * (1 + 1e-5)  # rounding must not hide a stop
    spans: list[tuple[Tensor, Intervals]] = []
    for first in firsts:
        cuts = march.edges[first : first + SPAN + 1]
        seen = field.backend.trace_rays(
            Rays(rays.origins[alive], rays.directions[alive], rays.jitter[alive]),
            march._replace(edges=torch.cat([cuts, cuts[-1:]])),
            field.medium(),
            background=rgb.new_zeros(3),
            negligible=negligible / len(firsts),
        )
        passed, through = transmittance[alive], seen.ends.transmittance
        rgb[alive] += passed[:, None] * seen.rgb
        # The span's own stop is one of the whole ray, and counted there.
        left_out[alive] += passed * (seen.truncation_error - torch.where(through <= stop, through, 0.0)).clamp_min(0.0)
        transmittance[alive] = passed * through
        spans.append((alive, seen.intervals))
        alive = alive[transmittance[alive] > stop]
        if len(alive) == 0:
            break
    intervals = _joined(spans, count)
    density, starts, ends, offsets = intervals
    light = reference.light_ends(density, starts, ends, offsets=offsets, shares=shares)
    behind = torch.maximum(background, 1.0 - background).amax(-1)
    error = left_out + torch.where(light.transmittance <= stop, light.transmittance * behind, 0.0)
    return RaysSeen(rgb + light.transmittance[:, None] * background, light, error, intervals)


def _joined(spans: list[tuple[Tensor, Intervals]], count: int) -> Intervals:
    """Return the samples of `count` rays, of which each span has those of some, packed ray after ray."""
    counts = torch.stack(
        [intervals.offsets.new_zeros(count).index_copy(0, rays, intervals.offsets.diff()) for rays, intervals in spans]
    )
    offsets = torch.nn.functional.pad(counts.sum(0).cumsum(0), (1, 0))
    begins = offsets[:-1] + counts.cumsum(0) - counts  # (spans, rays)
    density, starts, ends = (spans[0][1].density.new_empty(int(offsets[-1])) for _ in range(3))
    for (rays, intervals), begin in zip(spans, begins, strict=True):
        own = ray_indices(intervals.offsets)
        places = begin[rays[own]] + torch.arange(len(own), device=own.device) - intervals.offsets[own]
        density[places], starts[places], ends[places] = intervals.density, intervals.starts, intervals.ends
    return Intervals(density, starts, ends, offsets)
