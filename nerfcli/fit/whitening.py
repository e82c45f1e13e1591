"""Steps of camera parameters, all of which move the picture alike.

A turn of a thousandth moves a picture by a pixel, a move of a thousandth by less than one where the scene is far; a
turn about one axis is nearly a move along another. One learning rate suits them all in coordinates in which a unit
step along any axis moves what the camera sees by a unit, and no two axes do the same.
"""

import numpy as np
import torch
from torch import Tensor, nn

# Of the sums of squares, so that poorly determined parameters do not move far: CamP's choice.
DAMPING = 0.1
_FLOOR = 1e-8
BETAS = (0.9, 0.99)
EPS = 1e-15


def whitening(jacobian: np.ndarray) -> np.ndarray:
    """(K, K) symmetric, from whitened steps to those of the parameters: (S + 0.1 diag(S) + 1e-8)^(-1/2), S = J^T J.

    Args:
        jacobian: (M, K), how what is seen moves with the parameters.

    Source: Park et al. 2023, CamP: camera preconditioning for neural radiance fields, arXiv:2308.10902, eq. 8.
    """
    squares = jacobian.T @ jacobian
    squares = squares + np.diag(DAMPING * np.diag(squares) + _FLOOR)
    values, vectors = np.linalg.eigh(squares)
    return (vectors / np.sqrt(values)) @ vectors.T


class WhitenedAdam(nn.Module):
    """Adam on N sets of K parameters, each in its whitened coordinates.

    Args:
        whitenings: (N, K, K), see `whitening`.
    """

    def __init__(self, whitenings: np.ndarray):
        super().__init__()
        self._whitenings = torch.from_numpy(whitenings)
        shape = whitenings.shape[:2]
        self.first: Tensor
        self.second: Tensor
        self.steps: Tensor
        self.register_buffer("first", torch.zeros(shape, dtype=torch.float64))
        self.register_buffer("second", torch.zeros(shape, dtype=torch.float64))
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))

    def change(self, gradient: Tensor, rate: float) -> Tensor:
        """(N, K) what to add to the parameters whose gradient (N, K) this is."""
        white = (self._whitenings @ gradient[..., None])[..., 0]  # symmetric: its own transpose
        self.steps += 1
        self.first.lerp_(white, 1 - BETAS[0])
        self.second.lerp_(white.square(), 1 - BETAS[1])
        steps = int(self.steps)
        mean = self.first / (1 - BETAS[0] ** steps)
        spread = (self.second / (1 - BETAS[1] ** steps)).sqrt()
        return -rate * (self._whitenings @ (mean / (spread + EPS))[..., None])[..., 0]
