"""A grid of cubic voxels along the axes of the scene's frame."""

import math
from dataclasses import dataclass

import numpy as np

from nerfcli.errors import UserError

# Most voxels along a side; beyond, not even the index of the blocks fits into memory.
MOST_CELLS = 2048


@dataclass(frozen=True)
class Grid:
    """Voxel (i, j, k) is a cube of side `voxel_size` whose centre is low + voxel_size * (i + 1/2, j + 1/2, k + 1/2).

    Args:
        low: (3,) low corner of the first voxel.
        voxel_size: > 0, scene units.
        shape: voxels along x, y and z.
    """

    low: np.ndarray
    voxel_size: float
    shape: tuple[int, int, int]

    @staticmethod
    def over(box: tuple[float, ...], voxel_size: float) -> "Grid":
        """Return the grid that covers a box, starting at its low corner.

        Raises:
            UserError: it would have too many voxels.
        """
        low, high = np.array(box[:3], dtype=np.float64), np.array(box[3:], dtype=np.float64)
        shape = tuple(max(1, math.ceil(round(length / voxel_size, 6))) for length in high - low)
        if max(shape) > MOST_CELLS:
            raise UserError(
                f"a voxel size of {voxel_size:.4g} gives {max(shape)} voxels along a side of the box; at most "
                f"{MOST_CELLS} are supported",
                f"use a smaller --box, or a --voxel-size of at least {(high - low).max() / MOST_CELLS:.4g}",
            )
        return Grid(low, voxel_size, (shape[0], shape[1], shape[2]))

    def centres(self, indices: np.ndarray) -> np.ndarray:
        """Return the centres (..., 3) of voxels with indices (..., 3)."""
        return self.low + self.voxel_size * (indices + 0.5)

    @property
    def high(self) -> np.ndarray:
        """The corner (3,) opposite to `low`."""
        return self.low + self.voxel_size * np.array(self.shape)


def check_box(box: tuple[float, ...]) -> tuple[float, ...]:
    """Return the box after checking that its low corner is below its high corner.

    Raises:
        UserError: the corners are not in order, or a number is not finite.
    """
    values = np.array(box, dtype=np.float64)
    if values.shape != (6,) or not np.isfinite(values).all() or not (values[:3] < values[3:]).all():
        raise UserError(
            f"invalid --box {','.join(f'{value:g}' for value in box)}",
            "expected X0,Y0,Z0,X1,Y1,Z1 in the scene's units, the low corner first",
            exit_code=2,
        )
    return tuple(values.tolist())
