"""The radiance field: a multiresolution hash grid with a small density network and a small colour network."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn

from nerfcli.field.interface import Field, FieldSettings
from nerfcli.kernels import HashGrid
from nerfcli.kernels.interface import FEATURES, WIDTH

# Outputs of the density network, the log density first; all of them are inputs of the colour network.
GEOMETRY = 16
HARMONICS = 16
# Number of levels that learn from the start of a training.
FIRST_LEVELS = 4
# Trainings of smaller tables are too short to learn the details.
DETAILED_LOG2_ROWS = 17
# Weight decay. Values in rows are about 0.1; in steps of some thousand rays, their gradients have a median of 2e-8 to
# 5e-8, a root mean square of 1e-5. See `training.step.row_decay` for more rays.
ROW_DECAY = 1e-6


@dataclass(frozen=True)
class HashFieldSettings(FieldSettings):
    """Size of the field.

    Args:
        levels, features: number of grids, from coarse to fine, and of values per table row.
        log2_rows: rows per level as a power of two.
        coarsest, finest: cells per axis of the first and the last level; those between are in geometric progression.
        width: neurons of the hidden layers.
        antialias: whether levels finer than a pixel fade out.
    """

    kind: ClassVar[str] = "hash"

    levels: int = 8
    features: int = 4
    log2_rows: int = 16
    coarsest: int = 16
    finest: int = 1024
    width: int = 32
    antialias: bool = False

    @property
    def detailed(self) -> bool:
        return self.log2_rows >= DETAILED_LOG2_ROWS

    @property
    def is_compiled(self) -> bool:
        return (self.levels * self.features, self.features, self.width) == (WIDTH, FEATURES, WIDTH)

    @property
    def size_text(self) -> str:
        cells = f"{self.levels} levels of {self.coarsest} to {self.finest} cells per axis"
        return f"hash grid, {cells}, 2^{self.log2_rows} rows each; networks of width {self.width}"

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells per axis of each level."""
        growth = math.log(self.finest / self.coarsest) / max(1, self.levels - 1)
        return tuple(round(self.coarsest * math.exp(growth * level)) for level in range(self.levels))


class HashField(Field):
    """The field that backends compile: see `kernels.HashGrid`.

    The table starts near zero and the networks have no biases, so a fresh field is a grey fog of density 1: thin enough
    that every sample of a ray gets a gradient.

    Weight decay shrinks rows that the photos determine poorly. Adam divides by the size of a row's gradients, so decay
    counts more where gradients are small; it hardly changes rows of surfaces that many photos see.
    Source: Barron et al. 2023, Zip-NeRF, arXiv:2304.06706, section 4, where it is normalised by level.
    """

    settings: HashFieldSettings
    row_decay = ROW_DECAY

    def __init__(self, settings: HashFieldSettings):
        super().__init__(settings)
        width, encoded = settings.width, settings.levels * settings.features
        shape = (settings.levels, 2**settings.log2_rows, settings.features)
        self.table = nn.Parameter(torch.empty(shape).uniform_(-1e-4, 1e-4))
        sizes = ((width, encoded), (GEOMETRY, width), (width, GEOMETRY + HARMONICS), (width, width), (3, width))
        # They keep the variance of rectified inputs.
        weights = (nn.Parameter(torch.empty(size)) for size in sizes)
        self.weights = nn.ParameterList(nn.init.kaiming_uniform_(weight, nonlinearity="relu") for weight in weights)
        _make_linear(self.weights[:2])
        _make_linear(self.weights[2:])

    def rows(self) -> nn.Parameter:
        return self.table

    def medium(self, detail: float = 1.0) -> HashGrid:
        return HashGrid(
            self.table,
            _resolutions_at(detail, self.settings.resolutions),
            tuple(self.weights),
            self.settings.view_degree,
            self.settings.antialias,
            self.table_grad,
        )

    @torch.no_grad()
    def forget_directions(self, degree: int) -> None:
        """Zero the weights of harmonics above `degree`. The field does not change if these harmonics were 0 so far."""
        self.weights[2][:, GEOMETRY + (degree + 1) ** 2 :] = 0.0


@torch.no_grad()
def _make_linear(weights: Iterable[Tensor]) -> None:
    """Make a network of rectified layers linear until it learns: half of the neurons have the negatives of the others.

    The random signs of independent neurons would decide how easily a feature raises the density, and with it which of
    several explanations of the photos is learned: see "The first weights" in docs/research/schedule.md.
    Source: Balduzzi et al. 2017, The shattered gradients problem, arXiv:1702.08591.
    """
    for layer, following in pairwise(weights):
        half = len(layer) // 2
        layer[half:] = -layer[:half]
        following[:, half:] = -following[:, :half]


def _resolutions_at(detail: float, resolutions: tuple[int, ...]) -> tuple[int, ...]:
    """Return the resolutions of the levels that learn with a detail, the coarsest first, and 0 for the others."""
    levels, first = len(resolutions), min(FIRST_LEVELS, len(resolutions))
    learning = max(1, first + math.floor((levels - first) * detail))
    return tuple(side if level < learning else 0 for level, side in enumerate(resolutions))
