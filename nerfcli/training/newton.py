"""Gauss-Newton steps of poses: each ray gives a gradient, and a curvature estimated from gradient and loss."""

import torch
from torch import Tensor, nn

# Decay of the running mean of the curvature per step: a photo has few rays in one step.
MEMORY = 0.95
# Added to losses: smaller ones, those of about one level of 255, give no reliable curvature.
_LEAST_LOSS = 3e-5
# In square pixels. Photos are held no tighter when their mean motion is below this.
_LEAST_SPREAD = 0.05


class NewtonSteps(nn.Module):
    """Steps of P poses, each with 6 parameters: translation and rotation.

    A ray whose loss is k r^2 / 2 has the gradient g = k r J and the curvature k J J^T = g g^T / (2 loss), which needs
    no second derivative. Three channels with the same error count as one.

    Args:
        count: P.
        picture_px: (P, 6) mean squared motion of the picture, in square pixels, per squared unit of each parameter.
    """

    def __init__(self, count: int, picture_px: Tensor):
        super().__init__()
        self._picture_px = picture_px
        self.curvature: Tensor
        self.weight: Tensor
        self.register_buffer("curvature", torch.zeros(count, 6, 6, dtype=torch.float64))
        self.register_buffer("weight", torch.zeros((), dtype=torch.float64))

    def learn(self, gradients: Tensor, losses: Tensor, photos: Tensor) -> Tensor:
        """Update the curvature from some rays, and return the sum (P, 6) of their gradients.

        Args:
            gradients: (R, 6) of each ray's own loss.
            losses: (R,) the loss of each ray.
            photos: (R,) the photo index of each ray.
        """
        of_ray = gradients[:, :, None] * gradients[:, None, :] / (2.0 * losses + _LEAST_LOSS)[:, None, None]
        curvature = torch.zeros_like(self.curvature).index_add_(0, photos, of_ray)
        slope = torch.zeros_like(self._picture_px).index_add_(0, photos, gradients)
        self.curvature.lerp_(curvature, 1.0 - MEMORY)
        self.weight.lerp_(torch.ones_like(self.weight), 1.0 - MEMORY)
        return slope

    def change(self, slope: Tensor, so_far: Tensor, *, damping: float, holding: float) -> Tensor:
        """Return the parameter change (P, 6) that minimises the loss, assumed quadratic in them, for the current field.

            -(H + damping diag(H) + L)^-1 (slope + L so_far),  L = holding diag(mean H) / spread^2, in square pixels

        L holds back translations and rotations, each as one kind, the more the less all photos have moved in that way
        so far. Errors of the cameras show in directions that the photos determine; the same kind of change is then
        preferred in directions that they do not. Centres that were right stay right, and so do whole cameras.

        Args:
            slope: (P, 6) the sum of the gradients of a step's rays.
            so_far: (P, 6) the current poses relative to the given ones.
            damping: of each parameter by itself; poorly determined ones move slowly.
            holding: strength with which changes of less than a pixel are held back.
        """
        floor = 1e-12
        curvature = self.curvature / self.weight.clamp_min(floor)
        diagonal = torch.diagonal(curvature, dim1=-2, dim2=-1)
        spread = (self._picture_px * so_far.square()).view(-1, 2, 3).sum(-1).mean(0)
        held = holding * diagonal.mean(0) / spread.clamp_min(_LEAST_SPREAD).square().repeat_interleave(3)
        matrix = curvature + torch.diag_embed(damping * diagonal + held + floor)
        return -torch.linalg.solve(matrix, slope + held * so_far)
