"""Marks of voxels that the views of a scan do not determine: their values come from the regularisation.

A mark is a sum of flags: `UNSEEN` (no view sees the voxel), `TRUNCATED` (above or below the detector in some views: its
value is right up to a smooth offset), `WEDGE` (the scan lacks directions: edges along them are not seen) and `OUTSIDE`
(beside the detector in some views, so that directions are missing there: the corners of the grid).
"""

import numpy as np

from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.grid import VoxelGrid

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
