"""The two small networks behind the hash grid. Letters as in `interface`."""

import torch
from torch import Tensor

from nerfcli.kernels.activations import density_from_log


def geometry(encoded: Tensor, weights: tuple[Tensor, ...]) -> Tensor:
    """Return the outputs of the density network, (N, E) to (N, G): W2 relu(W1 x); the first is the log density."""
    return torch.relu(encoded @ weights[0].t()) @ weights[1].t()


def density(encoded: Tensor, weights: tuple[Tensor, ...]) -> Tensor:
    """Return the density (N,) of encoded positions (N, E).

    density = exp((W2 relu(W1 x))_0), the exponent clipped to [-15, 15]; see `density_from_log`. Layers after W1 (H, E)
    and W2 (G, H) are ignored.
    """
    return density_from_log(geometry(encoded, weights)[:, 0])


def radiance(encoded: Tensor, harmonics: Tensor, rays: Tensor, weights: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Return density (N,) and colour (N, 3), in (0, 1), of encoded positions seen along rays.

    g = W2 relu(W1 x),  density = exp(g_0),  rgb = sigmoid(C3 relu(C2 relu(C1 [g, harmonics of the ray])))

    Args:
        encoded, harmonics: (N, E), and (R, S) encoded direction of each ray.
        rays: (N,) int64, the ray of each sample.
        weights: W1 (H, E), W2 (G, H), C1 (H, G + S), C2 (H, H), C3 (3, H); no biases.

    Differentiable in encoded, harmonics and weights.
    """
    shape = geometry(encoded, weights)
    hidden = torch.relu(torch.cat([shape, harmonics[rays]], dim=-1) @ weights[2].t())
    hidden = torch.relu(hidden @ weights[3].t())
    return density_from_log(shape[:, 0]), torch.sigmoid(hidden @ weights[4].t())
