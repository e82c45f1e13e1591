"""The centre of rotation of a scan: the shift of the detector with which half of the views predict the others best.

Geometries are tested on one detector row: a volume fitted quickly to every second view has to predict the others, which
it can only do if the geometry is right.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

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


# Largest number of columns of the binned row for the search of the centre, and for its refinement.
COARSE, FINE = 80, 200
# The search covers this fraction of the detector's width to either side.
RANGE = 0.12
# Standard errors by which one hypothesis has to predict better than another.
SIGNIFICANT = 3.0
# Smaller shifts are not worth a correction.
LEAST_PX = 0.1
FEWEST_VIEWS = 8
_PRECISE_PX = 0.02


@dataclass(frozen=True)
class Centre:
    """The centre of rotation under one hypothesis.

    Args:
        shift: columns that the detector has to be moved by.
        errors: (views // 2,) mean squared errors of the views that were not fitted, at the best shift.
        at_stated: the same without a shift.
        error: standard error of the shift, in columns.
    """

    shift: float
    errors: np.ndarray
    at_stated: np.ndarray
    error: float

    @property
    def is_off(self) -> bool:
        """True if the shift predicts other views significantly better and exceeds `LEAST_PX` and twice its error."""
        by, _ = margin(self.errors, self.at_stated)
        return by > SIGNIFICANT and abs(self.shift) > max(LEAST_PX, 2 * self.error)


def centre_of(row: Row, *, mirrored: bool = False) -> Centre:
    """Estimate the shift of the detector.

    Whole columns of a coarse row are searched over the whole range; then a finer row refines the best shift by halving
    steps, and by a parabola at the end.
    """
    coarse, fine = row.binned(COARSE), row.binned(FINE)
    columns = row.geometry.columns
    bound = max(2, int(np.ceil(RANGE * coarse.geometry.columns)))
    shifts = np.arange(-bound, bound + 1)
    means = [float(misfit(coarse, shift=float(shift), mirrored=mirrored).mean()) for shift in shifts]
    factor = columns // fine.geometry.columns
    between = (columns // coarse.geometry.columns) / factor
    best = float(shifts[int(np.argmin(means))]) * between
    step = between / 2

    @cache
    def errors(shift: float) -> np.ndarray:
        return misfit(fine, shift=shift, mirrored=mirrored)

    while step * factor > _PRECISE_PX * 4:
        around = [best - step, best, best + step]
        best = min(around, key=lambda shift: float(errors(shift).mean()))
        if best == around[1]:
            step /= 2
    shift, error = _parabola(best, max(step * 2, 0.25), errors)
    return Centre(factor * shift, errors(shift), errors(0.0), factor * error)


def _parabola(best: float, step: float, errors: Callable[[float], np.ndarray]) -> tuple[float, float]:
    """Return the minimum of a parabola through three shifts and its standard error over views."""
    low, middle, high = (errors(best + k * step) for k in (-1, 0, 1))

    def lowest(chosen: np.ndarray | slice) -> float:
        one, two, three = (float(part[chosen].mean()) for part in (low, middle, high))
        bend = one - 2 * two + three
        return 0.0 if bend <= 0 else float(np.clip((one - three) / (2 * bend), -1, 1))

    at = lowest(slice(None))
    views = np.arange(len(middle))
    if len(views) < 3:
        return best + at * step, step
    without = np.array([lowest(views != view) for view in views])
    error = float(np.sqrt((len(views) - 1) / len(views) * ((without - without.mean()) ** 2).sum()))
    return best + at * step, max(error * step, 1e-3)


def margin(better: np.ndarray, worse: np.ndarray) -> tuple[float, float]:
    """Compare two predictions: the difference in standard errors over views, and the ratio of rms.

    The difference is the larger of two test statistics: of the mean gain, and of signed ranks, which a few views with
    large gains do not weaken.

    Source of the second: Wilcoxon 1945, Individual comparisons by ranking methods, Biometrics Bulletin 1(6).
    """
    gain = worse - better
    ratio = float(np.sqrt(worse.mean() / max(better.mean(), 1e-300)))
    if len(gain) < 2 or not gain.any():
        return 0.0, ratio
    error = float(gain.std(ddof=1) / np.sqrt(len(gain)))
    ranks = 1 + np.argsort(np.argsort(np.abs(gain)))
    by_ranks = float((np.sign(gain) * ranks).sum() / np.sqrt((ranks.astype(float) ** 2).sum()))
    return max(float(gain.mean()) / max(error, 1e-300), by_ranks), ratio
