"""The voxel grid of a volume: number, position and size of its voxels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.ct.geometry import ScanGeometry


@dataclass(frozen=True)
class VoxelGrid:
    """Cubic voxels along the axes of the scan's frame.

    Args:
        shape: number of voxels (z, y, x).
        first: (x, y, z) centre of the first voxel, in the scan's unit.
        size: side of a voxel, > 0.
    """

    shape: tuple[int, int, int]
    first: tuple[float, float, float]
    size: float

    def __post_init__(self) -> None:
        if min(self.shape) < 1 or not self.size > 0 or not np.isfinite([*self.first, self.size]).all():
            raise ValueError(f"no grid: shape {self.shape}, first voxel {self.first}, size {self.size}")

    @staticmethod
    def of(shape: Sequence[int], first: Sequence[float], size: float) -> "VoxelGrid":
        """Return the grid of three counts (z, y, x) and the three coordinates (x, y, z) of the first centre."""
        return VoxelGrid((shape[0], shape[1], shape[2]), (first[0], first[1], first[2]), size)

    @property
    def voxels(self) -> int:
        """Number of voxels."""
        return math.prod(self.shape)

    def axis(self, name: str) -> np.ndarray:
        """Centres of the voxels along "x", "y" or "z"."""
        index = "xyz".index(name)
        return self.first[index] + self.size * np.arange(self.shape[2 - index])

    def coarser(self, factor: int) -> "VoxelGrid":
        """Return a grid over the same box with voxels `factor` times as large, their number rounded up."""
        shape = tuple(-(-count // factor) for count in self.shape)
        half = self.size * (factor - 1) / 2
        return VoxelGrid.of(shape, [centre + half for centre in self.first], self.size * factor)


def centred_grid(extent: tuple[float, float, float], size: float) -> VoxelGrid:
    """Return a grid around the frame's origin that covers a box of these lengths (x, y, z) with whole voxels."""
    counts = [max(1, int(np.ceil(length / size - 1e-9))) for length in extent]
    return VoxelGrid.of(counts[::-1], [-(count - 1) / 2 * size for count in counts], size)


def grid_of_scan(geometry: ScanGeometry, size: float | None = None) -> VoxelGrid:
    """Return a grid over the region that any view sees, with voxels of a pixel's size at the object.

    Across the axis, the grid is the square around the circle that the outermost ray of any view touches; along z, it
    spans the detector's height at the axis. A detector of one row gets one layer.

    Args:
        size: side of a voxel; by default the smaller side of a pixel at the object, or its width for a single row.
    """
    height, width = geometry.pixel_at_origin
    size = min(height, width) if size is None and geometry.rows > 1 else (width if size is None else size)
    origins, directions = geometry.rays()
    origins, directions = origins[..., :2], directions[..., :2]
    across = np.abs(origins[..., 0] * directions[..., 1] - origins[..., 1] * directions[..., 0])
    radius = float((across / np.linalg.norm(directions, axis=-1)).max())
    if geometry.rows == 1:
        z = 0.0 if geometry.beam == "cone" else float(np.median(geometry.centre[:, 2]))
        grid = centred_grid((2 * radius, 2 * radius, size), size)
        return VoxelGrid(grid.shape, (grid.first[0], grid.first[1], z), size)
    return centred_grid((2 * radius, 2 * radius, geometry.rows * height), size)


def layers_of_rays(grid: VoxelGrid, geometry: ScanGeometry) -> VoxelGrid:
    """Return the layers of a grid that the rays of a scan cross, for a scan with fewer rows than the grid's."""
    origins, directions = geometry.rays()
    across = np.linalg.norm(directions[..., :2], axis=-1)
    nearest = -(origins[..., :2] * directions[..., :2]).sum(-1) / across**2
    radius = max(abs(end) for name in "xy" for end in grid.axis(name)[[0, -1]])
    heights = [origins[..., 2] + (nearest + side * radius / across) * directions[..., 2] for side in (-1, 1)]
    low = int(np.floor((min(h.min() for h in heights) - grid.first[2]) / grid.size))
    high = int(np.ceil((max(h.max() for h in heights) - grid.first[2]) / grid.size)) + 1
    low, high = max(low, 0), min(high, grid.shape[0])
    low = min(low, grid.shape[0] - 1)
    first = (grid.first[0], grid.first[1], grid.first[2] + low * grid.size)
    return VoxelGrid((max(high - low, 1), *grid.shape[1:]), first, grid.size)
