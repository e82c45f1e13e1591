"""Schedule of the steps along rays."""

import math

import torch
from torch import Tensor


def step_edges(near: float, far: float, *, shortest_step: float, growth: float) -> Tensor:
    """Return the distances that cut every ray, in steps of `shortest_step` that grow with distance.

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
    """Return the step of `step_edges` at a distance."""
    return max(shortest_step, growth * distance * max(1.0, distance))
