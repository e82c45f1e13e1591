"""Interface of a field of any type, as training, rendering and checkpoints use it."""

import abc
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

from torch import Tensor, nn

from nerfcli import kernels


@dataclass(frozen=True)
class FieldSettings(abc.ABC):
    """Settings that determine the shapes of a field: all that a checkpoint needs besides the tensors.

    Args:
        contraction: how space is mapped into the unit cube, one of `kernels.CONTRACTIONS`.
        view_degree: highest degree of the direction's spherical harmonics that colours depend on, 0 (not at all) to 3.

    In a training, rays skip all cells that hold little after at most `closing_steps` steps.
    """

    kind: ClassVar[str]
    closing_steps: ClassVar[int] = 150

    contraction: str
    view_degree: int = 3

    @property
    def detailed(self) -> bool:
        """True if the field shows more when it is rendered in shorter steps than those of its training."""
        return False

    @property
    def is_compiled(self) -> bool:
        """True if the fast backends have kernels for a field of this size; else it is the reference's."""
        return True

    @property
    @abc.abstractmethod
    def size_text(self) -> str:
        """Type and size for people, such as "129x129x129 voxels"."""

    def to_json(self) -> dict[str, Any]:
        """Return plain values, including the kind; see `kinds.settings_from_json`."""
        return {"kind": self.kind, **asdict(self)}


class Field(nn.Module, abc.ABC):
    """Density by position, colour by position and direction, on the unit cube of `kernels.grid_coordinates`.

    `backend` renders `medium`. Each kind has its own settings for training: `rate_factor` multiplies the learning rate,
    `row_decay` is the weight decay of rows, see `reference.adam_rows`. A training sets `table_grad`, see
    `kernels.HashGrid`, for the gradient of `rows`.
    """

    table_grad: Tensor | None = None
    rate_factor: float = 1.0
    row_decay: float = 0.0

    def __init__(self, settings: FieldSettings) -> None:
        super().__init__()
        self._settings = settings
        self._backend: kernels.Backend | None = None

    @property
    def backend(self) -> kernels.Backend:
        """Backend of this field, chosen on first use and again after a move to another device or dtype."""
        if self._backend is None:
            some = next(self.parameters())
            plain = kernels.Backend(some.device)
            self._backend = kernels.backend_for(some.device, some.dtype) if self.settings.is_compiled else plain
        return self._backend

    @backend.setter
    def backend(self, backend: kernels.Backend) -> None:
        self._backend = backend

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self._backend = None
        return super()._apply(fn, recurse)

    @property
    def settings(self) -> FieldSettings:
        """Kind and size; each kind of field narrows the type."""
        return self._settings

    def rows(self) -> nn.Parameter | None:
        """Return the parameter (..., F) of which a sample touches only some rows; None if there is none.

        Training changes rows that were touched and leaves the rest alone, see `reference.adam_rows`. All other
        parameters take part in every sample.
        """
        return None

    @abc.abstractmethod
    def medium(self, detail: float = 1.0) -> kernels.HashGrid | kernels.Medium:
        """Return the medium that backends render.

        Args:
            detail: fraction of the details that a training adds, which the field includes; 1 or more for all, below 0
                for fewer than at the start. Details left out are as in an untrained field: nothing visible.
        """
