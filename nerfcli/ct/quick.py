"""Quick reconstruction of one detector row, to test geometries.

A volume fitted to every second view has to predict the others, which it can only do if the geometry is right.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.reconstruct import Projector
from nerfcli.ct.scan import Scan

# Number of accelerated steps of the reconstruction; more steps fit noise.
STEPS = 15
MOST_VIEWS = 96
# Rows of a cone beam within this fraction of the detector's height from the plane of the source count as fan beams.
FAN_PART = 0.05


@dataclass(frozen=True)
class Row:
    """Line integrals of one detector row, as a scan in a plane.

    Args:
        geometry: with one row, everything at z = 0.
        integrals: (V, columns) float32.
    """

    geometry: ScanGeometry
    integrals: np.ndarray

    def binned(self, columns: int) -> "Row":
        """Return the row with at most `columns` columns, each a mean of neighbours."""
        factor = -(-self.geometry.columns // columns)
        kept = self.geometry.columns // factor
        means = self.integrals[:, : kept * factor].reshape(len(self.integrals), kept, factor).mean(2)
        return Row(self.geometry.binned(factor), means)

    def select(self, views: np.ndarray) -> "Row":
        """Return the row with some of its views, given by their indices."""
        return Row(self.geometry.select(views), self.integrals[views])

    def thinned(self) -> "Row":
        """Return the row with at most `MOST_VIEWS` views, at equal steps."""
        views = len(self.integrals)
        return self.select(np.unique(np.linspace(0, views - 1, min(MOST_VIEWS, views)).round().astype(int)))


def highest_contrast_row(scan: Scan, views: np.ndarray | None = None) -> Row:
    """Choose the row with the most contrast; for a cone beam, only among rows near the plane of the source.

    Args:
        views: indices of the views to read; all that have a usable pixel if not given.
    """
    views = scan.live_views if views is None else views
    geometry = scan.geometry.select(views)
    rows = np.arange(geometry.rows)
    if geometry.beam == "cone" and geometry.rows > 1:
        middle = _row_of_source(geometry)
        rows = rows[np.abs(rows - middle) <= max(0.5, FAN_PART * geometry.rows)]
        rows = rows if len(rows) else np.array([int(np.clip(round(middle), 0, geometry.rows - 1))])
    some = views[:: max(1, len(views) // 16)]
    shown = scan.line_integrals(some)[:, rows].std(axis=(0, 2))
    row = int(rows[int(np.argmax(shown))])
    flat = np.array([1.0, 1.0, 0.0])
    emitter = geometry.emitter * flat
    if geometry.beam == "parallel":
        emitter = emitter / np.linalg.norm(emitter, axis=1, keepdims=True)
    centre = geometry.centre + (row - (geometry.rows - 1) / 2) * geometry.row_step
    plane = replace(geometry, emitter=emitter, centre=centre * flat, column_step=geometry.column_step * flat, rows=1)
    return Row(plane, scan.only_rows(row, row + 1).line_integrals(views)[:, 0])


def misfit(row: Row, *, shift: float = 0.0, mirrored: bool = False) -> np.ndarray:
    """Return mean squared errors (views // 2,) with which a reconstruction from every second view predicts the others.

    Args:
        shift: columns that the detector is moved by, see `ScanGeometry.shifted`.
        mirrored: whether its columns are read from the other side.
    """
    geometry = row.geometry.mirrored() if mirrored else row.geometry
    views, moved = np.arange(geometry.views), replace(row, geometry=geometry.shifted(shift))
    grid, others = grid_of_row(moved), moved.select(views[1::2])
    volume = reconstructed(moved.select(views[::2]), grid)
    return ((predicted(volume, grid, others) - others.integrals) ** 2).mean(1)


def predicted(volume: Tensor, grid: VoxelGrid, row: Row) -> np.ndarray:
    """Return line integrals (V, columns) of a volume (1, Y, X) along the rays of a row."""
    return Projector(row.geometry, grid).forward(volume).numpy()


def reconstructed(row: Row, grid: VoxelGrid) -> Tensor:
    """Return a volume (1, Y, X), by SIRT with positivity and Nesterov's momentum."""
    measured = torch.from_numpy(np.ascontiguousarray(row.integrals, dtype=np.float32))
    projector = Projector(row.geometry, grid)
    chord = projector.forward(torch.ones(grid.shape))
    by_ray = torch.where(chord > grid.size, 1 / chord.clamp_min(grid.size), 0)
    met = projector.backward(torch.ones_like(chord))
    by_voxel = torch.where(met > 0, 1 / met.clamp_min(1e-3 * float(met.max())), 0)
    volume = torch.zeros(grid.shape)
    ahead, momentum = volume, 1.0
    for _ in range(STEPS):
        left = (measured - projector.forward(ahead)) * by_ray
        stepped = (ahead + by_voxel * projector.backward(left)).clamp_min(0)
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        ahead = stepped + (momentum - 1) / following * (stepped - volume)
        volume, momentum = stepped, following
    return volume


def grid_of_row(row: Row) -> VoxelGrid:
    """Return a square grid around the circle that the outermost ray touches, with voxels of a pixel's size."""
    _, width = row.geometry.pixel_at_origin
    origins, directions = row.geometry.rays()
    across = np.abs(origins[..., 0] * directions[..., 1] - origins[..., 1] * directions[..., 0]).max()
    count = 2 * int(np.ceil(float(across) / width)) + 1
    edge = -(count - 1) / 2 * width
    return VoxelGrid((1, count, count), (edge, edge, 0.0), width)


def _row_of_source(geometry: ScanGeometry) -> float:
    """Return the detector row at the height of the source, median over views."""
    lift = geometry.emitter[:, 2] - geometry.centre[:, 2]
    down = np.where(geometry.row_step[:, 2] == 0, -1.0, geometry.row_step[:, 2])
    return (geometry.rows - 1) / 2 + float(np.median(lift / down))
