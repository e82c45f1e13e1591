"""Volumes: line integrals, their transpose, total variation, and denoising by it. Letters as in `interface`."""

from collections.abc import Iterator

import torch
from torch import Tensor


def project(
    volume: Tensor, origins: Tensor, directions: Tensor, *, first: tuple[float, float, float], size: float
) -> Tensor:
    """Return the line integrals of a volume along straight lines, by Joseph's method.

    A line is cut at the planes of voxel centres of the axis it is most aligned with. In each plane the four voxels
    around the point are interpolated; voxels outside the grid are 0:

        integral = size / |d_a| * sum over planes k of volume interpolated at (k, b(k), c(k))

    Exact for values that are constant or linear along the line between planes; error of second order in `size` for
    smooth ones. Lines are infinite: the grid has to be between source and detector.

    Args:
        origins: (R, 3) points (x, y, z) on the lines.
        directions: (R, 3) of any length but 0.
        first: (x, y, z) centre of the first voxel.

    Returns:
        (R,), in units of the volume times `size`.

    Source: Joseph 1982, An improved algorithm for reprojecting rays through pixel images, IEEE TMI 1(3).
    """
    total = volume.new_zeros(len(origins))
    for chosen, index, weight in _taps(volume.shape, (origins - origins.new_tensor(first)) / size, directions, size):
        integral = (volume.reshape(-1)[index] * weight.to(volume.dtype)).sum((1, 2))
        total = total.index_add(0, chosen, integral)
    return total


def back_project(
    values: Tensor,
    origins: Tensor,
    directions: Tensor,
    *,
    shape: tuple[int, int, int],
    first: tuple[float, float, float],
    size: float,
) -> Tensor:
    """Spread values along lines: the transpose of `project`, (Z, Y, X) from (R,).

    Formula: sum over r of values[r] * d project(volume)[r] / d volume. Source: as for `project`.
    """
    total = values.new_zeros(shape[0] * shape[1] * shape[2])
    for chosen, index, weight in _taps(shape, (origins - origins.new_tensor(first)) / size, directions, size):
        spread = values[chosen, None, None] * weight.to(values.dtype)
        total = total.index_add(0, index.reshape(-1), spread.reshape(-1))
    return total.reshape(shape)


def _taps(
    shape: tuple[int, ...], places: Tensor, directions: Tensor, size: float
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield the lines (R,) that are most aligned with an axis, the first one in a tie, for each axis that has some, and
    indices and weights (R, planes, 4) of the voxels that they cross; weight 0 outside. `places` are in voxels from the
    centre of the first one."""
    dominant = directions.abs().argmax(1)
    for axis in range(3):
        chosen = (dominant == axis).nonzero()[:, 0]
        if len(chosen):
            yield chosen, *_taps_along(axis, shape, places[chosen], directions[chosen], size)


def _taps_along(
    axis: int, shape: tuple[int, ...], start: Tensor, directions: Tensor, size: float
) -> tuple[Tensor, Tensor]:
    counts = {0: shape[2], 1: shape[1], 2: shape[0]}
    strides = {0: 1, 1: shape[2], 2: shape[1] * shape[2]}
    b, c = (other for other in range(3) if other != axis)
    slope = directions / directions[:, axis : axis + 1]
    plane = torch.arange(counts[axis], device=start.device, dtype=start.dtype)
    length = size * slope.norm(dim=1)

    index = (plane.long() * strides[axis])[None, :, None]
    weight = length[:, None, None]
    for other in (b, c):
        place = start[:, other, None] + (plane - start[:, axis, None]) * slope[:, other, None]  # (R, planes)
        low = place.floor()
        fraction = place - low
        both = torch.stack([low, low + 1], dim=-1).long()  # (R, planes, 2)
        inside = (both >= 0) & (both < counts[other])
        part = torch.stack([1 - fraction, fraction], dim=-1) * inside
        index = (index[..., :, None] + (both.clamp(0, counts[other] - 1) * strides[other])[..., None, :]).flatten(-2)
        weight = (weight[..., :, None] * part[..., None, :]).flatten(-2)
    return index, weight


def denoise_total_variation(target: Tensor, threshold: Tensor, dual: Tensor, *, iterations: int) -> Tensor:
    """Approach the volume x >= 0 that minimises

        sum over voxels of (x - target)^2 / (2 threshold)  +  sum over voxels of |difference to the next voxels|

    by projected gradient steps on the dual problem: x = max(0, target - threshold * D^T dual) with the forward
    differences D (0 at the last voxels), and |dual| <= 1 in each voxel.

    Args:
        target: (Z, Y, X).
        threshold: (Z, Y, X) > 0: how far a step between neighbours may move a voxel.
        dual: (3, Z, Y, X), initial dual variables for x, y and z; overwritten with the final ones, from which the next
            call for a similar target can start.
        iterations: >= 0.

    Returns:
        (Z, Y, X), >= 0. No gradients.

    Source: Chambolle 2004, An algorithm for total variation minimization and applications; Beck and Teboulle 2009,
    Fast gradient-based algorithms for constrained total variation image denoising, IEEE TIP 18(11), section IV.
    """
    # The step is 1 / (12 t) for each voxel's dual, with t the largest threshold it touches: |D D^T| is at most 12.
    largest = threshold.clone()
    for axis in range(3):
        n = threshold.shape[axis] - 1
        largest.narrow(axis, 0, n).copy_(
            torch.maximum(largest.narrow(axis, 0, n).clone(), threshold.narrow(axis, 1, n))
        )
    for _ in range(iterations):
        differences = _differences(_primal(target, threshold, dual))
        stepped = dual + differences / (12 * largest)
        dual.copy_(stepped / stepped.norm(dim=0).clamp_min(1))
    return _primal(target, threshold, dual)


def total_variation(volume: Tensor) -> Tensor:
    """Return the sum over voxels of the norm of the differences to the next voxels along x, y and z, 0 at the last."""
    return _differences(volume).norm(dim=0).sum()


def _primal(target: Tensor, threshold: Tensor, dual: Tensor) -> Tensor:
    transposed = torch.zeros_like(target)
    for index, axis in enumerate((2, 1, 0)):
        n = target.shape[axis] - 1
        inner = dual[index].narrow(axis, 0, n)
        transposed.narrow(axis, 0, n).sub_(inner)
        transposed.narrow(axis, 1, n).add_(inner)
    return (target - threshold * transposed).clamp_min(0)


def _differences(volume: Tensor) -> Tensor:
    out = volume.new_zeros(3, *volume.shape)
    for index, axis in enumerate((2, 1, 0)):
        n = volume.shape[axis] - 1
        out[index].narrow(axis, 0, n).copy_(volume.narrow(axis, 1, n) - volume.narrow(axis, 0, n))
    return out
