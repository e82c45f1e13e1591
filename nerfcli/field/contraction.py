"""Inverse of the contraction: from the field's grids back to space."""

from torch import Tensor

# Contracted radius 2 is infinity; cells at the grid's corners, beyond it, are mapped to this radius.
LARGEST_RADIUS = 1e6


def uncontract(points: Tensor) -> Tensor:
    """Return the inverse of `kernels.contract`.

    x = y for |y| <= 1, else y / |y| / (2 - |y|)

    Args:
        points: (..., 3); a norm of 2 or more is infinitely far and becomes 1e6.

    Returns:
        (..., 3). Relative error grows as radius * 1e-7 in float32: the far field is coarse by design.
    """
    norm = points.square().sum(-1, keepdim=True).clamp_min(1.0).sqrt()
    radius = 1.0 / (2.0 - norm).clamp_min(1.0 / LARGEST_RADIUS)
    return points / norm * radius


def training_points(coordinates: Tensor, contraction: str) -> Tensor:
    """Return the inverse of `kernels.grid_coordinates`: unit cube to training frame."""
    if contraction == "none":
        return (coordinates - 0.5) * 2.0
    return uncontract((coordinates - 0.5) * 4.0)
