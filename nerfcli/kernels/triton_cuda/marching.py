"""The samples of rays: those in occupied cells, and those among them that absorb light, packed without gaps.

Same operations as `reference.occupied_samples` and `reference.visible_samples`. Rays are marched twice: first to count,
then to write. The number of samples stays on the device, as the host would have to wait for it: buffers are as large as
earlier steps needed, and the host waits only once, to learn whether they were large enough.
"""

from dataclasses import dataclass

import torch
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.contraction import CONTRACTIONS, sample_widths
from nerfcli.kernels.interface import WIDTH, HashGrid, March, Rays, Samples
from nerfcli.kernels.triton_cuda import hash_grid, networks
from nerfcli.kernels.triton_cuda.launch import INTERPRETED, blocks, jit, launch
from nerfcli.kernels.triton_cuda.rays import (
    RAYS,
    STEPS,
    blocks_of,
    cube,
    fill_ray_indices,
    load3,
    own_rays,
    ray_indices,
    samples_at,
    store3,
)

# Room for samples is a multiple of ROOM, about SPARE times the number needed last.
ROOM, SPARE = 2**6 if INTERPRETED else 2**14, 1.25


@dataclass
class Capacity:
    """Room for the occupied samples of a step, learned from the steps before; 0 before the first one."""

    samples: int = 0

    def fit(self, needed: int) -> None:
        """Make room for `needed` samples, without shrinking for small changes."""
        if not needed <= self.samples <= 4 * max(needed, ROOM):
            self.samples = ROOM * blocks(int(SPARE * needed) + 1, ROOM)


@jit
def _march(
    origins, directions, edges, jitter, occupied, side, intervals, offsets,
    counts, starts, ends, coordinates, room, rays, WRITES: tl.constexpr,
    CONTRACTION: tl.constexpr, RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    there = ray < rays
    ox, oy, oz = load3(origins, ray[:, None], there[:, None])
    dx, dy, dz = load3(directions, ray[:, None], there[:, None])
    shift = tl.load(jitter + ray, mask=there, other=0.0)[:, None]
    scale = side.to(tl.float32)
    found = tl.zeros([RAYS], tl.int64)
    if WRITES:
        found = tl.load(offsets + ray, mask=there, other=0)
    for first in range(0, intervals, STEPS):
        k = first + tl.arange(0, STEPS)
        within = k < intervals
        near = tl.load(edges + k, mask=within, other=0.0)[None, :]
        middle = tl.load(edges + k + 1, mask=within, other=0.0)[None, :]
        far = tl.load(edges + k + 2, mask=within, other=0.0)[None, :]
        start, end = near + shift * (middle - near), middle + shift * (far - middle)
        t = (start + end) * 0.5
        x, y, z = cube(ox + dx * t, oy + dy * t, oz + dz * t, CONTRACTION)
        inside = (x >= 0.0) & (y >= 0.0) & (z >= 0.0) & (x <= 1.0) & (y <= 1.0) & (z <= 1.0)
        inside = inside & within[None, :] & there[:, None]
        column = tl.minimum(tl.where(inside, x * scale, 0.0).to(tl.int32), side - 1)
        row = tl.minimum(tl.where(inside, y * scale, 0.0).to(tl.int32), side - 1)
        layer = tl.minimum(tl.where(inside, z * scale, 0.0).to(tl.int32), side - 1)
        kept = inside & (tl.load(occupied + (layer * side + row) * side + column, mask=inside, other=0) != 0)
        number = kept.to(tl.int32)
        if WRITES:
            place = found[:, None] + tl.cumsum(number, 1) - 1
            fits = kept & (place < room)
            tl.store(starts + place, start, mask=fits)
            tl.store(ends + place, end, mask=fits)
            store3(coordinates, place, fits, x, y, z)
        found += tl.sum(number, 1)
    if not WRITES:
        tl.store(counts + ray, found, mask=there)


@jit
def _visible(
    density, starts, ends, offsets, counts, sources, coordinates, cell_depths, side, deepest, least, room, rays,
    WRITES: tl.constexpr, VISITS: tl.constexpr, RAYS: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    """Count the samples of each ray that are not faint, and in front of which the optical depth is below a limit.

    With WRITES, `counts` are the offsets of these samples, and their places are written to `sources`. With VISITS, the
    cells of `cell_depths` are raised to the optical depths of the samples in front of the limit.
    """
    ray, there, first, last, longest = own_rays(offsets, rays, RAYS)
    last = tl.minimum(last, room)
    depth = tl.zeros([RAYS], tl.float32)
    found = tl.zeros([RAYS], tl.int64)
    if WRITES:
        found = tl.load(counts + ray, mask=there, other=0)
    for step in range(0, longest, STEPS):
        i, valid = samples_at(first, last, step, STEPS)
        # In front of each: a sum over the samples shifted by one place, so that nothing is subtracted from a sum.
        ahead = valid & (i > first[:, None])
        length = tl.load(ends + i - 1, mask=ahead, other=0.0) - tl.load(starts + i - 1, mask=ahead, other=0.0)
        shifted = tl.load(density + i - 1, mask=ahead, other=0.0) * length
        before = depth[:, None] + tl.cumsum(shifted, 1)
        length = tl.load(ends + i, mask=valid, other=0.0) - tl.load(starts + i, mask=valid, other=0.0)
        own = tl.load(density + i, mask=valid, other=0.0) * length
        reached = valid & (before < deepest)
        if VISITS:
            scale = side.to(tl.float32)
            x, y, z = load3(coordinates, i, reached)
            column = tl.minimum((x * scale).to(tl.int32), side - 1)
            row = tl.minimum((y * scale).to(tl.int32), side - 1)
            layer = tl.minimum((z * scale).to(tl.int32), side - 1)
            # A NaN is left out; it differs from itself.
            tl.atomic_max(
                cell_depths + (layer * side + row) * side + column, own, mask=reached & (own == own), sem="relaxed"
            )
        faint = own * tl.exp(-before) < least
        number = tl.where(reached & (faint == 0), 1, 0)
        if WRITES:
            tl.store(sources + found[:, None] + tl.cumsum(number, 1) - 1, i, mask=number > 0)
        found += tl.sum(number, 1)
        depth += tl.sum(shifted, 1)
    if not WRITES:
        tl.store(counts + ray, found, mask=there)


@jit
def _compact(
    sources, starts, ends, density, coordinates, code,
    starts_out, ends_out, density_out, coordinates_out, code_out, samples,
    BLOCK: tl.constexpr,
):  # fmt: skip
    to = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = to < samples
    at = tl.load(sources + to, mask=valid, other=0)
    tl.store(starts_out + to, tl.load(starts + at, mask=valid), mask=valid)
    tl.store(ends_out + to, tl.load(ends + at, mask=valid), mask=valid)
    tl.store(density_out + to, tl.load(density + at, mask=valid), mask=valid)
    for axis in tl.static_range(3):
        tl.store(coordinates_out + to * 3 + axis, tl.load(coordinates + at * 3 + axis, mask=valid), mask=valid)
    f = tl.arange(0, 32)
    row = tl.load(code + at[:, None] * 32 + f[None, :], mask=valid[:, None])
    tl.store(code_out + to[:, None] * 32 + f[None, :], row, mask=valid[:, None])


def occupied_samples(rays: Rays, along: March) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `reference.occupied_samples`; float32."""
    offsets = _counted(rays, along)
    samples = int(offsets[-1])
    return *_written(rays, along, offsets, room=samples), offsets


def visible_samples(
    rays: Rays, along: March, grid: HashGrid, *, table: Tensor, capacity: Capacity, cell_depths: Tensor | None = None
) -> Samples:
    """See `reference.visible_samples`; codes are float16, and so is `table`, that of the grid.

    If the capacity, which is kept from call to call, is large enough, the host waits only once.
    """
    offsets = _counted(rays, along)
    count, least = len(rays.origins), along.least_weight
    if capacity.samples == 0:
        capacity.fit(int(offsets[-1]))
    while True:
        room = capacity.samples
        starts, ends, coordinates = _written(rays, along, offsets, room=room)
        needed = offsets[-1]
        limit = needed.clamp_max(room)
        widths = None
        if grid.antialias and rays.cones is not None:
            widths = _widths(rays, along, starts, ends, offsets)
        code = hash_grid.encode(coordinates, table, grid.resolutions, widths=widths, count=limit, dtype=torch.float16)
        density = networks.density(code, grid.layers, count=limit)
        spans = density, starts, ends, offsets
        counts = torch.empty(count, dtype=torch.int64, device=offsets.device)
        cells, side = (density, 0) if cell_depths is None else (cell_depths, len(cell_depths))
        ends_at = float(along.max_optical_depth)
        launch(
            _visible, blocks_of(count), *spans, counts, counts, coordinates, cells, side, ends_at, least, room, count,
            WRITES=False, VISITS=cell_depths is not None, RAYS=RAYS, STEPS=STEPS,
        )  # fmt: skip
        kept = _offsets(counts)
        candidates, samples = torch.stack([needed, kept[-1]]).tolist()  # the host waits
        capacity.fit(candidates)
        if candidates <= room:
            if samples > 0 or candidates == 0 or least == 0.0:
                break
            least = 0.0  # all are faint: keep them, see `reference.visible_samples`
    index = ray_indices(kept, samples)
    device = starts.device
    sources = torch.empty(samples, dtype=torch.int64, device=device)
    launch(
        _visible, blocks_of(count), *spans, kept, sources, coordinates, cells, side, ends_at, least, room, count,
        WRITES=True, VISITS=False, RAYS=RAYS, STEPS=STEPS,
    )  # fmt: skip
    reached = [torch.empty(samples, device=device) for _ in range(3)]
    places = torch.empty(samples, 3, device=device)
    codes = torch.empty(samples, WIDTH, dtype=torch.float16, device=device)
    launch(
        _compact, (blocks(samples, 128),), sources, starts, ends, density, coordinates, code,
        *reached, places, codes, samples, BLOCK=128,
    )  # fmt: skip
    return Samples(reached[0], reached[1], reached[2], codes, places, kept, index)


def _counted(rays: Rays, along: March) -> Tensor:
    """Return the offsets (R + 1,) of the occupied samples."""
    counts = torch.empty(len(rays.origins), dtype=torch.int64, device=rays.origins.device)
    _launch_march(rays, along, counts, counts, (rays.jitter, rays.jitter, rays.jitter), room=0)
    return _offsets(counts)


def _written(rays: Rays, along: March, offsets: Tensor, *, room: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return starts, ends and coordinates of the first `room` occupied samples."""
    device = offsets.device
    out = torch.empty(room, device=device), torch.empty(room, device=device), torch.empty(room, 3, device=device)
    _launch_march(rays, along, offsets, None, out, room=room)
    return out


def _launch_march(
    rays: Rays, along: March, offsets: Tensor, counts: Tensor | None, out: tuple[Tensor, Tensor, Tensor], *, room: int
) -> None:
    count = len(rays.origins)
    launch(
        _march, blocks_of(count), rays.origins.contiguous(), rays.directions.contiguous(), along.edges.contiguous(),
        rays.jitter.contiguous(), along.occupied.contiguous().view(torch.uint8), along.occupied.shape[0],
        len(along.edges) - 2, offsets, offsets if counts is None else counts, *out, room, count, WRITES=counts is None,
        CONTRACTION=CONTRACTIONS.index(along.contraction), RAYS=RAYS, STEPS=STEPS,
    )  # fmt: skip


def _offsets(counts: Tensor) -> Tensor:
    """Return the offsets (R + 1,) of rays with these counts (R,)."""
    offsets = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=offsets[1:])
    return offsets


def _widths(rays: Rays, along: March, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
    """Return the widths of pixels at samples; those in unused places of the buffers mean nothing."""
    index = torch.zeros(len(starts), dtype=torch.int64, device=starts.device)
    fill_ray_indices(offsets.clamp_max(len(starts)), index)
    return sample_widths(rays, starts, ends, index=index, contraction=along.contraction)
