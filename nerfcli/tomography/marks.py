"""Marks of voxels that the views of a scan do not determine: their values come from the regularisation.

A mark is a sum: `UNSEEN` (no view sees the voxel), `TRUNCATED` (above or below the detector in some views: its value
holds up to a smooth offset), `WEDGE` (directions are missing from the scan: edges along them are not seen) and
`OUTSIDE` (beside the detector in some views, so that directions are missing there: the corners of the grid).
"""

import numpy as np

from nerfcli.tomography.geometry import ScanGeometry
from nerfcli.tomography.grid import VoxelGrid

UNSEEN, TRUNCATED, WEDGE, OUTSIDE = 1, 2, 4, 8
MEANINGS = {
    UNSEEN: "no view",
    TRUNCATED: "above or below the detector in some views",
    WEDGE: "missing wedge",
    OUTSIDE: "beside the detector in some views",
}

# A gap between directions counts as a wedge when it is this many times the usual step, and this many degrees.
WEDGE_STEPS = 4
WEDGE_DEG = 10.0
# Number of bins of directions over half a turn, one for each bit of an integer.
_BINS = 60


def marks(geometry: ScanGeometry, grid: VoxelGrid) -> np.ndarray:
    """Compute the marks (Z, Y, X) uint8 for the fitted views.

    A voxel is seen by a view when its centre falls on the detector. The wedge is that of the middle of the grid: it
    differs little between voxels.

    Args:
        geometry: of the views that were fitted.
        grid: of the volume.
    """
    seen, beside = np.zeros(grid.shape, dtype=np.int32), np.zeros(grid.shape, dtype=np.int32)
    y, x = np.meshgrid(grid.axis("y"), grid.axis("x"), indexing="ij")
    ends = grid.axis("z")[[0, -1]]
    all_directions, directions = np.zeros(x.shape, dtype=np.int64), np.zeros(x.shape, dtype=np.int64)
    for view in range(geometry.views):
        # Columns and rows of a voxel are linear in z, as detectors are flat and lines straight: for a detector along
        # the axis exactly, else nearly; both ends of each vertical line are computed, and the layers between.
        layers = [
            geometry.pixel_of(view, np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)).reshape(*x.shape, 2)
            for z in ends
        ]
        across = np.zeros(x.shape, dtype=bool)
        for k, share in enumerate(np.linspace(0, 1, grid.shape[0])):
            pixel = (1 - share) * layers[0] + share * layers[1]
            # A voxel whose centre is half a pixel beyond the last pixel's centre is still met by its rays.
            with np.errstate(invalid="ignore"):
                across = (pixel[..., 0] > -1) & (pixel[..., 0] < geometry.columns)
                along = (pixel[..., 1] > -1) & (pixel[..., 1] < geometry.rows) | (geometry.rows == 1)
            seen[k] += across & along
            beside[k] += ~across
        # The bin of a direction, and the two that it lies between: the same direction may be rounded otherwise.
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
    shares = {mark: 100 * float(((found & mark) > 0).mean()) for mark in chosen}
    return [f"{share:.3g} % of the voxels: {MEANINGS[mark]}" for mark, share in shares.items() if share > 0]


def _directions(geometry: ScanGeometry, view: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Directions of the rays through points, as lines, in bins: rays from both ends are the same."""
    emitter = geometry.emitter[view]
    if geometry.beam == "parallel":
        return np.full(x.shape, np.arctan2(emitter[1], emitter[0]) / np.pi * _BINS)
    return np.arctan2(y - emitter[1], x - emitter[0]) / np.pi * _BINS


def _bit(place: np.ndarray) -> np.ndarray:
    return np.int64(1) << np.mod(place, _BINS).astype(np.int64)


def missing_wedge_deg(geometry: ScanGeometry) -> float:
    """Return the largest gap between directions of rays through the origin, as lines around z, in degrees.

    0 where it is less than a few times the usual step: then the views go all around. A fan of rays fills gaps at the
    object's border that are left at the origin, so that this is the gap at the middle.

    Args:
        geometry: of the views.
    """
    direction = geometry.emitter if geometry.beam == "parallel" else -geometry.emitter
    angle = np.sort(np.rad2deg(np.arctan2(direction[:, 1], direction[:, 0])) % 180)
    if len(angle) < 2:
        return 180.0
    gaps = np.diff(np.append(angle, angle[0] + 180))
    largest, usual = float(gaps.max()), float(np.median(gaps[gaps > 1e-6])) if (gaps > 1e-6).any() else 180.0
    return largest if largest > WEDGE_STEPS * usual and largest > WEDGE_DEG else 0.0
