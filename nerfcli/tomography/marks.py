"""What the views of a scan cannot determine, voxel by voxel: values there are a guess of the regularisation.

A mark is the sum of `UNSEEN` (no view looks there), `TRUNCATED` (some views do not: the region is seen from one side
only, and its values hold up to a smooth offset) and `WEDGE` (directions are missing: edges across them are not seen).
"""

import numpy as np

from nerfcli.tomography.geometry import ScanGeometry
from nerfcli.tomography.grid import VoxelGrid

UNSEEN = 1
TRUNCATED = 2
WEDGE = 4

# A gap between directions counts as a wedge when it is this many times the usual step, and this many degrees.
WEDGE_STEPS = 4
WEDGE_DEG = 10.0


def marks(geometry: ScanGeometry, grid: VoxelGrid) -> np.ndarray:
    """The marks (Z, Y, X) uint8 of the views that were fitted.

    A voxel is seen by a view when its centre falls on the detector. The wedge is that of the middle of the grid: it
    differs little between voxels.

    Args:
        geometry: of the views that were fitted.
        grid: of the volume.
    """
    seen = np.zeros(grid.shape, dtype=np.int32)
    y, x = np.meshgrid(grid.axis("y"), grid.axis("x"), indexing="ij")
    ends = grid.axis("z")[[0, -1]]
    for view in range(geometry.views):
        # Columns and rows of a voxel are linear in z, as detectors are flat and lines straight: for a detector along
        # the axis exactly, else nearly; both ends of each vertical line are asked, and the layers between.
        layers = [
            geometry.pixel_of(view, np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)).reshape(*x.shape, 2)
            for z in ends
        ]
        share = np.linspace(0, 1, grid.shape[0])
        for k, s in enumerate(share):
            pixel = (1 - s) * layers[0] + s * layers[1]
            # A voxel whose centre is half a pixel beyond the last pixel's centre is still met by its rays.
            with np.errstate(invalid="ignore"):
                inside = (pixel[..., 0] > -1) & (pixel[..., 0] < geometry.columns)
                if geometry.rows > 1:
                    inside &= (pixel[..., 1] > -1) & (pixel[..., 1] < geometry.rows)
            seen[k] += inside
    out = np.zeros(grid.shape, dtype=np.uint8)
    out[seen == 0] = UNSEEN
    out[(seen > 0) & (seen < geometry.views)] = TRUNCATED
    if missing_wedge_deg(geometry) > 0:
        out[seen > 0] |= WEDGE
    return out


def missing_wedge_deg(geometry: ScanGeometry) -> float:
    """The largest gap between the directions of the rays through the origin, as lines around z, in degrees.

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
