"""Denoising of a volume by its total variation. Letters as in `interface`."""

import torch
from torch import Tensor


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
