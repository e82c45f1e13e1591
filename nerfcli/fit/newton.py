"""Steps of poses as Gauss and Newton take them: rays say how far they are from their photos, and how sure that is."""

import torch
from torch import Tensor, nn

from nerfcli.fit.ranks import ALONE, Alone

# Of what rays say of curvature, what is left a step later: a photo has few rays in one step.
MEMORY = 0.95
# A loss of less than this, as of a level of 255, says nothing of a slope.
_LEAST_LOSS = 3e-5
_FLOOR = 1e-12
# Square pixels. Where all photos have moved by less, they are held no tighter.
_LEAST_SPREAD = 0.05


class NewtonSteps(nn.Module):
    """Steps of P poses; in each 6 numbers that change them, moves and turns.

    A ray whose loss is k r^2 / 2 has the gradient g = k r J, and the curvature k J J^T = g g^T / (2 loss): known
    without a second derivative. Three channels that err alike are as one.

    Args:
        count: P.
        picture_px: (P, 6) square pixels that the picture moves by, on average, with a unit of each number squared.
    """

    def __init__(self, count: int, picture_px: Tensor):
        super().__init__()
        self._picture_px = picture_px
        self.curvature: Tensor
        self.weight: Tensor
        self.register_buffer("curvature", torch.zeros(count, 6, 6, dtype=torch.float64))
        self.register_buffer("weight", torch.zeros((), dtype=torch.float64))

    def learn(self, gradients: Tensor, losses: Tensor, photos: Tensor, ranks: Alone = ALONE) -> Tensor:
        """Take in what some rays say; gives the sum (P, 6) of their gradients.

        Args:
            gradients: (R, 6) of each ray's own loss.
            losses: (R,).
            photos: (R,) whose rays they are.
            ranks: each has rays of its own.
        """
        of_ray = gradients[:, :, None] * gradients[:, None, :] / (2.0 * losses + _LEAST_LOSS)[:, None, None]
        curvature = torch.zeros_like(self.curvature).index_add_(0, photos, of_ray)
        slope = torch.zeros_like(self._picture_px).index_add_(0, photos, gradients)
        ranks.add_up(curvature, slope)
        self.curvature.lerp_(curvature, 1.0 - MEMORY)
        self.weight.lerp_(torch.ones_like(self.weight), 1.0 - MEMORY)
        return slope

    def change(self, slope: Tensor, so_far: Tensor, *, damping: float, holding: float) -> Tensor:
        """(P, 6) what to add to the numbers for the least loss, were it quadratic and the field as it is.

            (H + damping diag(H) + L)^-1 (slope + L so_far),  L = holding diag(mean H) / spread^2, in square pixels

        L holds moves and turns back, each as one kind, by how little all photos have moved or turned so far: errors
        of the cameras show in directions that the photos determine, and that kind of change is preferred in those that
        they do not. Centres that were right stay so, and so do cameras.

        Args:
            slope: (P, 6) the sum of the gradients of a step's rays.
            so_far: (P, 6) how far the poses are from the given ones.
            damping: of each number by itself; poorly determined ones move slowly.
            holding: how strongly what is less than a pixel is held.
        """
        curvature = self.curvature / self.weight.clamp_min(_FLOOR)
        diagonal = torch.diagonal(curvature, dim1=-2, dim2=-1)
        spread = (self._picture_px * so_far.square()).view(-1, 2, 3).sum(-1).mean(0)
        held = holding * diagonal.mean(0) / spread.clamp_min(_LEAST_SPREAD).square().repeat_interleave(3)
        matrix = curvature + torch.diag_embed(damping * diagonal + held + _FLOOR)
        return -torch.linalg.solve(matrix, slope + held * so_far)
