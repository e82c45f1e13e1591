"""Adam on rows of a table. Letters as in `interface`."""

import torch
from torch import Tensor

from nerfcli.kernels.interface import AdamStep


@torch.no_grad()
def adam_rows(table: Tensor, gradient: Tensor, first: Tensor, second: Tensor, *, step: AdamStep) -> None:
    """Take one step of Adam with weight decay, in place, on rows with a nonzero gradient, and zero the gradient.

    g := g + decay table
    m = b1 m + (1 - b1) g,  v = b2 v + (1 - b2) g^2
    table -= rate (m / (1 - b1^number)) / (sqrt(v / (1 - b2^number)) + eps)

    A row that no sample touched keeps its moments and its value: it neither drifts on old momentum nor decays, and
    costs nothing.

    Source: Kingma and Ba 2015, Adam, arXiv:1412.6980, algorithm 1; skipping untouched rows as in Müller et al. 2022.
    """
    number, rate, betas, eps, decay = step
    touched = (gradient != 0).any(-1)
    g = gradient[touched] + decay * table[touched]
    first[touched] = betas[0] * first[touched] + (1 - betas[0]) * g
    second[touched] = betas[1] * second[touched] + (1 - betas[1]) * g * g
    mean = first[touched] / (1 - betas[0] ** number)
    spread = (second[touched] / (1 - betas[1] ** number)).sqrt()
    table[touched] -= rate * mean / (spread + eps)
    gradient.zero_()
