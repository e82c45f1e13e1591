"""The radiance field as one network, all of whose weights take part in every sample."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn

from nerfcli.field.hash_field import HARMONICS
from nerfcli.field.interface import Field, FieldSettings
from nerfcli.kernels import spherical_harmonics
from nerfcli.kernels.activations import density_from_log


@dataclass(frozen=True)
class FourierFieldSettings(FieldSettings):
    """Size of the field.

    Args:
        octaves: frequencies of the Fourier features of each coordinate; the finest has a period of 2^(1 - octaves) of
            the cube's side.
        width: neurons of the hidden layers; half as many in the colour's.
        layers: hidden layers before the density.
    """

    kind: ClassVar[str] = "mlp"
    closing_steps: ClassVar[int] = 600

    octaves: int = 10
    width: int = 128
    layers: int = 4

    @property
    def size_text(self) -> str:
        return f"network of {self.layers} layers of width {self.width} on {self.octaves} octaves of Fourier features"


class FourierField(Field):
    """Fourier features, rectified layers, a density; then the direction, one more layer, a colour.

    The density network's biases start at zero and its last weights small: a fog of density about 1.
    Source: Mildenhall et al. 2020, NeRF, arXiv:2003.08934, section 5.1 and appendix A, with half of the layers.
    """

    settings: FourierFieldSettings

    def __init__(self, settings: FourierFieldSettings):
        super().__init__(settings)
        width = settings.width
        # Wide layers change more by the same step: the rate is proportional to 1 / width.
        # Source: Yang et al. 2022, Tensor programs V, arXiv:2203.03466, table 3.
        self.rate_factor = 0.3 * 64 / width
        sizes = (6 * settings.octaves, *[width] * settings.layers)
        self.trunk = nn.Sequential()
        for inputs, outputs in pairwise(sizes):
            self.trunk.extend([_linear(inputs, outputs), nn.ReLU()])
        self.log_density = _linear(width, 1)
        with torch.no_grad():
            self.log_density.weight.mul_(0.1)
        self.colour = nn.Sequential(_linear(width + HARMONICS, width // 2), nn.ReLU(), _linear(width // 2, 3))

    def medium(self, detail: float = 1.0) -> "FourierField":
        return self

    def density(self, coordinates: Tensor) -> Tensor:
        """See `kernels.Medium`."""
        return density_from_log(self.log_density(self._hidden(coordinates))[:, 0])

    def radiance(self, coordinates: Tensor, directions: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        """See `kernels.Medium`."""
        hidden = self._hidden(coordinates)
        harmonics = spherical_harmonics(directions, self.settings.view_degree)[rays]
        rgb = torch.sigmoid(self.colour(torch.cat([hidden, harmonics], dim=-1)))
        return density_from_log(self.log_density(hidden)[:, 0]), rgb

    def _hidden(self, coordinates: Tensor) -> Tensor:
        """Return the last hidden layer (N, width)."""
        return self.trunk(fourier_features(2.0 * coordinates - 1.0, self.settings.octaves))


def fourier_features(x: Tensor, octaves: int) -> Tensor:
    """Return sines and cosines at octave frequencies.

    gamma(x) = [sin(pi x), cos(pi x), ..., sin(2^(octaves - 1) pi x), cos(2^(octaves - 1) pi x)]

    Returns:
        (..., D * 2 * octaves): component after component, octave after octave, sine before cosine.

    Differentiable. In float32 the highest octave has an absolute error of about 2^(octaves - 1) * pi * |x| * 6e-8.
    Source: Mildenhall et al. 2020, NeRF, arXiv:2003.08934, eq. 4.
    """
    frequencies = math.pi * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    phases = x[..., None] * frequencies  # (..., D, octaves)
    return torch.stack([phases.sin(), phases.cos()], dim=-1).flatten(-3)


def _linear(inputs: int, outputs: int) -> nn.Linear:
    """Return a layer that keeps the variance of rectified inputs, without bias at first.

    Source: He et al. 2015, arXiv:1502.01852, eq. 10.
    """
    layer = nn.Linear(inputs, outputs)
    nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
    nn.init.zeros_(layer.bias)
    return layer
