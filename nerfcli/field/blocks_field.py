"""A field of several blocks: cells of ground, each with a field of its own.

Letters as in `kernels.interface`; B blocks; ground coordinates are distances along two horizontal directions.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from nerfcli.field.contraction import training_points
from nerfcli.field.interface import Field, FieldSettings
from nerfcli.kernels import grid_coordinates


@dataclass(frozen=True)
class Block:
    """One block, in units of the joined field's training frame.

    Args:
        field: kind and size of its field.
        centre, radius: of its own training frame, whose points are (point - centre) / radius.
        low, high: (2,) bounds of its half-open cell in ground coordinates; infinite at the edge of the scene.
    """

    field: FieldSettings
    centre: tuple[float, ...]
    radius: float
    low: tuple[float, ...]
    high: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain values, with None where the cell is unbounded."""
        ends = {name: [v if math.isfinite(v) else None for v in getattr(self, name)] for name in ("low", "high")}
        return {**asdict(self), **ends, "field": self.field.to_json()}


def cell_end(values: Sequence[float | None], unbounded: float) -> tuple[float, ...]:
    """Read `low` or `high` of `Block.to_json`, with `unbounded` where the cell is unbounded."""
    return tuple(unbounded if value is None else value for value in values)


@dataclass(frozen=True)
class BlocksFieldSettings(FieldSettings):
    """The blocks of a field; each point of space is in the cell of exactly one.

    Args:
        ground: (2, 3) horizontal unit directions.
        occupancy_side: cells per axis of the occupancy grid of each block.
        blocks: at least one.
    """

    kind: ClassVar[str] = "blocks"

    ground: tuple[tuple[float, ...], ...] = ()
    occupancy_side: int = 1
    blocks: tuple[Block, ...] = ()

    @property
    def size_text(self) -> str:
        return f"{len(self.blocks)} blocks"

    def to_json(self) -> dict[str, Any]:
        return {**super().to_json(), "blocks": [block.to_json() for block in self.blocks]}


class BlocksField(Field):
    """The fields of blocks side by side; each point is evaluated in the field of its cell.

    It is not trained itself: each block is trained separately. `render.spans` renders pictures of it.

    Args:
        fields: of the blocks, in the order of the settings.
        occupancy: (B, G, G, G) bool, each block's over its own cube; space is empty where it is False.
    """

    settings: BlocksFieldSettings
    occupancy: Tensor

    def __init__(self, settings: BlocksFieldSettings, fields: Sequence[Field], occupancy: Tensor):
        super().__init__(settings)
        self.fields = nn.ModuleList(fields)
        self.register_buffer("occupancy", occupancy)

    def density(self, coordinates: Tensor) -> Tensor:
        """See `kernels.Medium`."""
        density = coordinates.new_zeros(len(coordinates))
        for field, radius, own, inside in self._divided(coordinates):
            density[own] = field.density(inside) / radius
        return density

    def radiance(
        self, coordinates: Tensor, directions: Tensor, rays: Tensor, *, sink: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """See `kernels.Medium`."""
        density, rgb = coordinates.new_zeros(len(coordinates)), coordinates.new_zeros(len(coordinates), 3)
        for field, radius, own, inside in self._divided(coordinates):
            per_radius, rgb[own] = field.radiance(inside, directions, rays[own])
            density[own] = per_radius / radius
        return density, rgb

    def is_occupied(self, coordinates: Tensor) -> Tensor:
        """Return whether space is occupied at coordinates (N, 3), as (N,) bool."""
        found = torch.zeros(len(coordinates), dtype=torch.bool, device=coordinates.device)
        for _, _, own, _ in self._divided(coordinates):
            found[own] = True
        return found

    def block_numbers(self, points: Tensor) -> Tensor:
        """Return the index (N,) int64 of the block whose cell contains each point (N, 3) of the training frame."""
        places = self._places(points)
        numbers = torch.zeros_like(places[:, 0], dtype=torch.int64)
        for number, block in enumerate(self.settings.blocks):
            numbers[_in_cell(places, block)] = number
        return numbers

    def _places(self, points: Tensor) -> Tensor:
        """Return the ground coordinates (N, 2) of points (N, 3)."""
        # Not a matrix product, whose rounding depends on the number of rows.
        return (points[:, None] * points.new_tensor(self.settings.ground)).sum(-1)

    def _divided(self, coordinates: Tensor) -> Iterator[tuple[Field, float, Tensor, Tensor]]:
        """Yield each block's field and radius, the indices (M,) of the points (N, 3) that are in its cell and occupied,
        and the coordinates (M, 3) of these points in its own unit cube.
        """
        settings, side = self.settings, self.settings.occupancy_side
        points = training_points(coordinates, settings.contraction)
        places = self._places(points)
        for block, field, occupied in zip(settings.blocks, self.fields, self.occupancy, strict=True):
            assert isinstance(field, Field)
            own = _in_cell(places, block).nonzero()[:, 0]
            centred = (points[own] - points.new_tensor(block.centre)) / block.radius
            inside = grid_coordinates(centred, block.field.contraction)
            x, y, z = (inside.clamp(0, 1) * side).long().clamp_max(side - 1).unbind(-1)
            kept = occupied[z, y, x] & ((inside >= 0) & (inside <= 1)).all(-1)
            yield field, block.radius, own[kept], inside[kept]


def _in_cell(places: Tensor, block: Block) -> Tensor:
    """Return whether ground coordinates (N, 2) are in the cell of a block, as (N,) bool."""
    return ((places >= places.new_tensor(block.low)) & (places < places.new_tensor(block.high))).all(-1)
