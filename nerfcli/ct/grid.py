"""The voxels of a volume: number, position and size, and marks of those that the views of a scan do not determine.

The values of marked voxels come from the regularisation. A mark is a sum of flags: `UNSEEN` (no view sees the voxel),
`TRUNCATED` (above or below the detector in some views: its value is right up to a smooth offset), `WEDGE` (the scan
lacks directions: edges along them are not seen) and `OUTSIDE` (beside the detector in some views, so that directions
are missing there: the corners of the grid).
"""

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


UNSEEN, TRUNCATED, WEDGE, OUTSIDE = 1, 2, 4, 8
MEANINGS = {
    UNSEEN: "no view",
    TRUNCATED: "above or below the detector in some views",
    WEDGE: "missing wedge",
    OUTSIDE: "beside the detector in some views",
}

# A gap between directions counts as a wedge if it exceeds this many usual steps, and this many degrees.
WEDGE_STEPS = 4
WEDGE_DEG = 10.0
# Number of bins of directions over half a turn, one for each bit of an integer.
_BINS = 60


def marks(geometry: ScanGeometry, grid: VoxelGrid) -> np.ndarray:
    """Compute the marks (Z, Y, X) uint8 for the fitted views.

    A voxel is seen by a view if its centre projects onto the detector. The missing wedge is computed at the origin, as
    it differs little between voxels.
    """
    seen, beside = np.zeros(grid.shape, dtype=np.int32), np.zeros(grid.shape, dtype=np.int32)
    y, x = np.meshgrid(grid.axis("y"), grid.axis("x"), indexing="ij")
    ends = grid.axis("z")[[0, -1]]
    all_directions, directions = np.zeros(x.shape, dtype=np.int64), np.zeros(x.shape, dtype=np.int64)
    for view in range(geometry.views):
        # A voxel's column and row are linear in z, exactly for a detector parallel to the axis, else nearly: both ends
        # of each vertical line are projected, and the layers between them are interpolated.
        layers = [
            geometry.pixel_of(view, np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)).reshape(*x.shape, 2)
            for z in ends
        ]
        across = np.zeros(x.shape, dtype=bool)
        for k, fraction in enumerate(np.linspace(0, 1, grid.shape[0])):
            pixel = (1 - fraction) * layers[0] + fraction * layers[1]
            # A voxel centred less than half a pixel beyond the detector's edge still counts as seen.
            with np.errstate(invalid="ignore"):
                across = (pixel[..., 0] > -1) & (pixel[..., 0] < geometry.columns)
                along = (pixel[..., 1] > -1) & (pixel[..., 1] < geometry.rows) | (geometry.rows == 1)
            seen[k] += across & along
            beside[k] += ~across
        # `all_directions` gets the nearest bin, `directions` both bins around it: rounding may differ between views.
        place = _directions(geometry, view, x, y)
        low = np.floor(place)
        all_directions |= _bit(np.rint(place))
        directions |= np.where(across, _bit(low) | _bit(low + 1), 0)
    out = np.zeros(grid.shape, dtype=np.uint8)
    out[seen == 0] = UNSEEN
    out[(seen > 0) & (seen + beside < geometry.views)] |= TRUNCATED
    out[(seen > 0) & (all_directions & ~directions != 0)] |= OUTSIDE
    if missing_wedge_deg(geometry) > 0:
        out[seen > 0] |= WEDGE
    return out


def marks_in_words(found: np.ndarray, chosen: tuple[int, ...] = tuple(MEANINGS)) -> list[str]:
    """Describe the percentage of voxels with each mark."""
    fractions = {mark: 100 * float(((found & mark) > 0).mean()) for mark in chosen}
    return [f"{fraction:.3g} % of the voxels: {MEANINGS[mark]}" for mark, fraction in fractions.items() if fraction > 0]


def _directions(geometry: ScanGeometry, view: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return directions of the rays through points, in bins; opposite rays are the same line, `_BINS` bins apart."""
    emitter = geometry.emitter[view]
    if geometry.beam == "parallel":
        return np.full(x.shape, np.arctan2(emitter[1], emitter[0]) / np.pi * _BINS)
    return np.arctan2(y - emitter[1], x - emitter[0]) / np.pi * _BINS


def _bit(place: np.ndarray) -> np.ndarray:
    return np.int64(1) << np.mod(place, _BINS).astype(np.int64)


def missing_wedge_deg(geometry: ScanGeometry) -> float:
    """Return the largest gap in degrees of `gaps_deg`; 0 if it is below the thresholds of a wedge."""
    largest, usual = gaps_deg(geometry)
    return largest if largest > WEDGE_STEPS * usual and largest > WEDGE_DEG else 0.0


def gaps_deg(geometry: ScanGeometry) -> tuple[float, float]:
    """Return the largest and the usual gap in degrees between rays through the origin, as undirected lines around z.

    Only the origin is considered; at the object's border, the fan of rays fills some of the gaps.
    """
    direction = geometry.emitter if geometry.beam == "parallel" else -geometry.emitter
    angle = np.sort(np.rad2deg(np.arctan2(direction[:, 1], direction[:, 0])) % 180)
    if len(angle) < 2:
        return 180.0, 0.0
    gaps = np.diff(np.append(angle, angle[0] + 180))
    return float(gaps.max()), float(np.median(gaps[gaps > 1e-6])) if (gaps > 1e-6).any() else 180.0
