"""Line integrals through a grid of voxels, and their transpose. Letters as in `interface`."""

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
        volume: (Z, Y, X).
        origins: (R, 3) points (x, y, z) on the lines.
        directions: (R, 3) of any length but 0.
        first: (x, y, z) centre of the first voxel.
        size: side of a voxel.

    Returns:
        (R,), in units of the volume times `size`. Differentiable in the volume, and in origins and directions where
        neither a plane's cell nor the axis changes.

    Source: Joseph 1982, An improved algorithm for reprojecting rays through pixel images, IEEE TMI 1(3).
    """
    total = volume.new_zeros(len(origins))
    for axis in range(3):
        chosen = (_dominant(directions) == axis).nonzero()[:, 0]
        if len(chosen) == 0:
            continue
        index, weight = _taps(volume.shape, origins[chosen], directions[chosen], axis=axis, first=first, size=size)
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
    for axis in range(3):
        chosen = (_dominant(directions) == axis).nonzero()[:, 0]
        if len(chosen) == 0:
            continue
        index, weight = _taps(shape, origins[chosen], directions[chosen], axis=axis, first=first, size=size)
        spread = values[chosen, None, None] * weight.to(values.dtype)
        total = total.index_add(0, index.reshape(-1), spread.reshape(-1))
    return total.reshape(shape)


def _dominant(directions: Tensor) -> Tensor:
    """Return the axis (R,) that each line is most aligned with; the first one in a tie."""
    return directions.abs().argmax(1)


def _taps(
    shape: tuple[int, ...],
    origins: Tensor,
    directions: Tensor,
    *,
    axis: int,
    first: tuple[float, float, float],
    size: float,
) -> tuple[Tensor, Tensor]:
    """Return indices and weights (R, planes, 4) of the voxels that lines along one axis cross; weight 0 outside."""
    counts = {0: shape[2], 1: shape[1], 2: shape[0]}
    strides = {0: 1, 1: shape[2], 2: shape[1] * shape[2]}
    b, c = (other for other in range(3) if other != axis)
    start = (origins - origins.new_tensor(first)) / size
    slope = directions / directions[:, axis : axis + 1]
    plane = torch.arange(counts[axis], device=origins.device, dtype=origins.dtype)
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
