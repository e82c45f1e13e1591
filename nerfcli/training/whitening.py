"""Whitened camera parameters: a unit step in any of them moves the picture by the same amount.

A rotation by 0.001 moves a picture by a pixel, a translation by 0.001 by less if the scene is far; a rotation about one
axis resembles a translation along another. One learning rate suits all of them in coordinates in which a unit step
along any axis moves what the camera sees by one unit, and no two axes have the same effect.
"""

import numpy as np
import torch
from torch import Tensor, nn

from nerfcli.training.adam import BETAS, EPS


def whitening(jacobian: np.ndarray) -> np.ndarray:
    """Return the symmetric (K, K) map from whitened to parameter steps: (S + 0.1 diag(S) + 1e-8)^(-1/2), S = J^T J.

    Args:
        jacobian: (M, K) derivatives of the image positions by the parameters.

    Source: Park et al. 2023, CamP: camera preconditioning for neural radiance fields, arXiv:2308.10902, eq. 8.
    """
    squares = jacobian.T @ jacobian
    squares = squares + np.diag(0.1 * np.diag(squares) + 1e-8)  # poorly determined parameters do not move far
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
        """Return the change (N, K) of the parameters for their gradient (N, K)."""
        white = (self._whitenings @ gradient[..., None])[..., 0]  # symmetric: its own transpose
        self.steps += 1
        self.first.lerp_(white, 1 - BETAS[0])
        self.second.lerp_(white.square(), 1 - BETAS[1])
        steps = int(self.steps)
        mean = self.first / (1 - BETAS[0] ** steps)
        spread = (self.second / (1 - BETAS[1] ** steps)).sqrt()
        return -rate * (self._whitenings @ (mean / (spread + EPS))[..., None])[..., 0]
