"""Where rays are cut: schedules of distances, stratified places, and draws from a histogram."""

import math

import torch
from torch import Tensor


def step_edges(near: float, far: float, *, shortest_step: float, growth: float) -> Tensor:
    """Distances that cut every ray: steps of `shortest_step`, growing with distance.

    step(t) = max(shortest_step, growth * t * max(1, t)): a pixel covers more the farther away it is, and beyond the
    unit ball equal steps in 1 / t are about equal steps in contracted space.

    Args:
        near, far: 0 <= near < far.
        shortest_step: > 0.
        growth: step per distance at distance 1, >= 0; 0 gives equal steps.

    Returns:
        (S + 2,) float64, increasing, the first at `near`, the last but one at or beyond `far`; one more edge than
        the intervals need, so that a jittered cut always has a right neighbour.

    Raises:
        ValueError: the distances are not in order or the step is not positive.
    """
    if not 0 <= near < far < math.inf or shortest_step <= 0 or growth < 0:
        raise ValueError(f"need 0 <= near < far and a positive step, got {near}, {far}, {shortest_step}, {growth}")
    edges = [near]
    while edges[-1] < far:
        edges.append(edges[-1] + step_length(edges[-1], shortest_step, growth))
    edges.append(edges[-1] + step_length(edges[-1], shortest_step, growth))
    return torch.tensor(edges, dtype=torch.float64)


def step_length(distance: float, shortest_step: float, growth: float) -> float:
    """The step of `step_edges` at a distance."""
    return max(shortest_step, growth * distance * max(1.0, distance))


def stratified(near: Tensor, far: Tensor, *, uniform: Tensor) -> Tensor:
    """One draw in each of S equal strata of [near, far].

    t_i = near + (far - near) * (i + u_i) / S

    Args:
        near, far: (R,).
        uniform: (R, S) draws in [0, 1); 1/2 everywhere gives the midpoints.

    Returns:
        (R, S), increasing along each ray.

    Source: Mildenhall et al. 2020, NeRF, arXiv:2003.08934, eq. 2.
    """
    count = uniform.shape[1]
    strata = torch.arange(count, dtype=uniform.dtype, device=uniform.device)
    return near[:, None] + (far - near)[:, None] * ((strata + uniform) / count)


def inverse_cdf(edges: Tensor, weights: Tensor, *, uniform: Tensor) -> Tensor:
    """Draws from a histogram with constant density inside each bin.

    Args:
        edges: (R, B + 1), increasing.
        weights: (R, B) >= 0, any sum; a ray without weight is drawn uniformly over its bins' lengths.
        uniform: (R, S) in [0, 1].

    Returns:
        (R, S) distances inside the edges; increasing if `uniform` is. A draw never falls into a bin without weight,
        except at its border.

    Raises:
        ValueError: edges does not have one more column than weights.

    Source: Mildenhall et al. 2020, NeRF, arXiv:2003.08934, section 5.2.
    """
    if edges.shape[-1] != weights.shape[-1] + 1:
        raise ValueError(f"edges must be (rays, {weights.shape[-1] + 1}), got {tuple(edges.shape)}")
    largest = weights.amax(-1, keepdim=True)
    # Shares of the largest: sums of very large or very small weights would leave the range of the dtype.
    weights = torch.where(largest > 0, weights / torch.where(largest > 0, largest, 1.0), edges.diff(dim=-1))
    cumulated = weights.cumsum(-1)
    total = cumulated[:, -1:]
    cdf = torch.cat([torch.zeros_like(total), cumulated / total], dim=-1)
    # The last bin that carries weight is the last a draw may fall into, whatever rounding did to the sums.
    last = (weights > 0).long().cumsum(-1).argmax(-1, keepdim=True)
    right = torch.searchsorted(cdf.contiguous(), uniform.contiguous(), right=True)
    bins = torch.minimum((right - 1).clamp_min(0), last)
    low, high = cdf.gather(-1, bins), cdf.gather(-1, bins + 1)
    share = ((uniform - low) / torch.where(high > low, high - low, 1.0)).clamp(0.0, 1.0)
    left = edges.gather(-1, bins)
    return left + share * (edges.gather(-1, bins + 1) - left)
