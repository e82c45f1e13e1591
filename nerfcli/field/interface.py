"""What training, rendering and checkpoints ask of a field, whatever it is made of."""

import abc
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, NamedTuple

from torch import Tensor, nn


@dataclass(frozen=True)
class FieldSettings(abc.ABC):
    """What makes two fields of one kind have the same shape: all that a checkpoint needs besides the numbers.

    Args:
        contraction: how space becomes the unit cube, one of `kernels.CONTRACTIONS`.
        view_degree: spherical harmonics of the direction that colours may depend on, 0 (not at all) to 3.
    """

    kind: ClassVar[str]

    contraction: str
    view_degree: int = 3

    def to_json(self) -> dict[str, Any]:
        """Plain values, the kind among them; see `kinds.settings_from_json`."""
        return {"kind": self.kind, **asdict(self)}


class Samples(NamedTuple):
    """The samples of R rays that light gets to, packed as in `kernels.reference`, without gradients.

    Args:
        starts, ends: (N,) distances along the ray.
        density: (N,) what the field says there.
        code: (N, C) what the field computed on the way to the density and can go on with to the colour.
        coordinates: (N, 3) in the field's unit cube.
        offsets: (R + 1,) int64.
        widths: (N,) of pixels there, see `kernels.hash_encode`; None where they do not matter.
    """

    starts: Tensor
    ends: Tensor
    density: Tensor
    code: Tensor
    coordinates: Tensor
    offsets: Tensor
    widths: Tensor | None = None


class Field(nn.Module, abc.ABC):
    """Density by position, colour by position and direction, on the unit cube of `kernels.grid_coordinates`.

    How this kind is trained best: `rate_factor` times the learning rate, and `closing_steps` until rays pass over cells
    that hold little.
    """

    rate_factor: float = 1.0
    closing_steps: ClassVar[int] = 150

    @property
    @abc.abstractmethod
    def settings(self) -> FieldSettings:
        """Kind and size."""

    @abc.abstractmethod
    def rows(self) -> nn.Parameter | None:
        """(..., F) those of the parameters of which a sample touches only some rows; None where there are none.

        Training changes rows that were touched and leaves the others alone, see `kernels.adam_rows`. All other
        parameters take part in every sample.
        """

    def refine(self, share: float) -> None:
        """Have the details learn that are due at this share of the budget, see `hash_field`; below 0, fewer than at
        first.

        Those that do not learn yet are as they were made: nothing that can be seen.
        """

    @abc.abstractmethod
    def density(self, coordinates: Tensor) -> Tensor:
        """Density (N,) in 1 / training unit at coordinates (N, 3) of the unit cube."""

    @abc.abstractmethod
    def radiance(self, coordinates: Tensor, directions: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Density (N,) and sRGB colour (N, 3) at coordinates (N, 3), seen along `directions` (R, 3) of `rays` (N,)."""

    @abc.abstractmethod
    def visible_samples(
        self,
        origins: Tensor,
        directions: Tensor,
        edges: Tensor,
        *,
        jitter: Tensor,
        occupied: Tensor,
        deepest: float,
        cones: Tensor | None = None,
    ) -> Samples:
        """The samples of rays that light gets to; see `kernels.visible_samples`.

        Args:
            cones: (R,) width of the pixel of each ray per distance; what has no levels does not look at it.
        """

    @abc.abstractmethod
    def colour_of_code(self, code: Tensor, directions: Tensor, rays: Tensor) -> Tensor:
        """Colour (N, 3) from what `visible_samples` has computed already, (N, C)."""

    @abc.abstractmethod
    def radiance_of_samples(
        self, samples: Samples, directions: Tensor, rays: Tensor, *, sink: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """`radiance` of what `visible_samples` gave, with gradients.

        Args:
            sink: of the shape of `rows`; their gradient is added to it, and autograd gets none.
        """
