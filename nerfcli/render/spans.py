"""Rays through a field of blocks: each span of a ray inside a block's cell is rendered by the field of that block."""

import math

import torch
from torch import Tensor

from nerfcli.field.blocks_field import BlocksField
from nerfcli.field.interface import Field
from nerfcli.kernels import Intervals, March, Rays, RaysSeen, ray_indices


def trace_in_spans(
    field: BlocksField,
    rays: Rays,
    march: March,
    *,
    background: Tensor,
    fractions: tuple[float, ...],
    negligible: float,
) -> RaysSeen:
    """Render rays as `Backend.trace_rays` does, without jitter and with the samples kept.

    Spans of intervals are halved until the midpoints of their first and last intervals are in the same cell; this
    suffices because cells are convex. With T_k the transmittance of the spans in front of span k,
    colour = sum_k T_k colour_k + T background. The distribution of depth is computed from the samples of all spans.
    """
    intervals = len(march.edges) - 2
    rgb, left_out = torch.zeros_like(rays.origins), torch.zeros_like(rays.jitter)
    transmittance = torch.ones_like(rays.jitter)
    stop = math.exp(-march.max_optical_depth) * (1 + 1e-5)  # with a margin, so that rounding does not hide a stop
    seen_spans: list[tuple[Tensor, Intervals]] = []
    waiting = [(0, intervals, torch.arange(len(rays.origins), device=rays.origins.device))]
    while waiting:  # the nearest span of each ray comes first
        first, last, alive = waiting.pop()
        alive = alive[transmittance[alive] > stop]
        edges = march.edges[first : last + 1]
        nearest, farthest = (
            field.block_numbers(rays.origins[alive] + rays.directions[alive] * (edges[k] + edges[k + 1]) / 2)
            for k in (0, -2)
        )
        divided = alive[nearest != farthest]
        if len(divided) > 0:
            middle = (first + last) // 2
            waiting += [(middle, last, divided), (first, middle, divided)]
        for number in range(len(field.fields)):
            own = alive[(nearest == number) & (farthest == number)]
            if len(own) == 0:
                continue
            seen = _seen_in_block(
                field,
                number,
                Rays(rays.origins[own], rays.directions[own], rays.jitter[own]),
                march._replace(edges=torch.cat([edges, edges[-1:]])),
                negligible * (last - first) / intervals,
            )
            passed, through = transmittance[own], seen.ends.transmittance
            rgb[own] += passed[:, None] * seen.rgb
            # A stop inside the span ends the whole ray; its error is added below.
            span_error = seen.truncation_error - torch.where(through <= stop, through, 0.0)
            left_out[own] += passed * span_error.clamp_min(0.0)
            transmittance[own] = passed * through
            seen_spans.append((own, seen.intervals))
    packed = _joined(seen_spans, rays)
    light = field.backend.light_ends(packed, fractions=fractions)
    behind = torch.maximum(background, 1.0 - background).amax(-1)
    error = left_out + torch.where(light.transmittance <= stop, light.transmittance * behind, 0.0)
    return RaysSeen(rgb + light.transmittance[:, None] * background, light, error, packed)


def _seen_in_block(field: BlocksField, number: int, rays: Rays, march: March, negligible: float) -> RaysSeen:
    """Render rays on black with the field of one block; the samples returned are in the frame of all blocks."""
    block, own = field.settings.blocks[number], field.fields[number]
    assert isinstance(own, Field)
    seen = own.backend.trace_rays(
        rays._replace(origins=(rays.origins - rays.origins.new_tensor(block.centre)) / block.radius),
        March(march.edges / block.radius, field.occupancy[number], block.field.contraction, march.max_optical_depth),
        own.medium(),
        background=rays.origins.new_zeros(3),
        negligible=negligible,
    )
    density, starts, ends, offsets = seen.intervals
    in_all = Intervals(density / block.radius, starts * block.radius, ends * block.radius, offsets)
    return seen._replace(intervals=in_all)


def _joined(spans: list[tuple[Tensor, Intervals]], rays: Rays) -> Intervals:
    """Join the samples of all spans, packed ray after ray."""
    counts = torch.zeros(len(rays.origins), dtype=torch.int64, device=rays.origins.device)
    for own, intervals in spans:
        counts[own] += intervals.offsets.diff()
    offsets = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    begins = offsets[:-1].clone()
    density, starts, ends = (rays.origins.new_empty(int(offsets[-1])) for _ in range(3))
    for own, intervals in spans:
        ray = ray_indices(intervals.offsets)
        places = (begins[own] - intervals.offsets[:-1])[ray] + torch.arange(len(ray), device=ray.device)
        density[places], starts[places], ends[places] = intervals.density, intervals.starts, intervals.ends
        begins[own] += intervals.offsets.diff()
    return Intervals(density, starts, ends, offsets)
