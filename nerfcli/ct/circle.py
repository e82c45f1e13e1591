"""Circular scans as most scanners describe them: a source and a flat detector around an axis.

`Circle.geometry` turns such a description into vectors, and `circle_of` turns vectors into a description by independent
formulas.
"""

from dataclasses import dataclass, replace

import numpy as np

from nerfcli.ct.geometry import Beam, ScanGeometry, circular_cone, circular_parallel


@dataclass(frozen=True)
class Circle:
    """A circular scan around z.

    Args:
        beam: "cone" (a fan is a cone with one row) or "parallel".
        angles: (V,) angles of the source in radians, counter-clockwise seen from +z. Rows of the detector run to the
            right, seen from the source, unless `mirrored`.
        pixel_width, pixel_height: size of a detector pixel.
        rows, columns: number of pixels of the detector.
        source_origin, source_detector: distances along the normal of the detector; 0 for parallel beams.
        lateral: distance of the source to the right of the axis, seen from the source; the detector moves with it.
        column_shift, row_shift: pixels by which the detector's centre is to the right of, and below, the foot of the
            perpendicular from the source.
        tilt: rotation of the detector in radians, from columns towards rows, see `ScanGeometry.tilted`.
        mirrored: whether columns are numbered from right to left, seen from the source.
    """

    beam: Beam
    angles: tuple[float, ...]
    pixel_width: float
    pixel_height: float
    rows: int
    columns: int
    source_origin: float = 0.0
    source_detector: float = 0.0
    lateral: float = 0.0
    column_shift: float = 0.0
    row_shift: float = 0.0
    tilt: float = 0.0
    mirrored: bool = False

    def geometry(self) -> ScanGeometry:
        """Return the vectors of this scan.

        Raises:
            ValueError: see `circular_cone`.
        """
        pixels = {name: getattr(self, name) for name in ("pixel_width", "pixel_height", "rows", "columns")}
        if self.beam == "parallel":
            geometry = circular_parallel(self.angles, **pixels)
        else:
            distances = {name: getattr(self, name) for name in ("source_origin", "source_detector")}
            geometry = circular_cone(self.angles, **distances, **pixels)
        right = geometry.column_step / self.pixel_width
        moved = geometry.centre + self.lateral * right
        emitter = geometry.emitter if self.beam == "parallel" else geometry.emitter + self.lateral * right
        geometry = replace(geometry, centre=moved, emitter=emitter)
        geometry = geometry.shifted(self.column_shift, self.row_shift).tilted(self.tilt)
        return geometry.mirrored() if self.mirrored else geometry

    def scaled(self, factor: float) -> "Circle":
        """Return the same scan in a unit that is `factor` times smaller."""
        lengths = ("pixel_width", "pixel_height", "source_origin", "source_detector", "lateral")
        return replace(self, **{name: factor * getattr(self, name) for name in lengths})


def circle_of(geometry: ScanGeometry) -> tuple[Circle, float]:
    """Fit a circle to a geometry; also return its distance from the geometry.

    Returns:
        The circle, with medians over views for all but the angles; and the largest distance between its detector
        corners or source and those of the geometry, in widths of a detector pixel.
    """
    normal = np.cross(geometry.column_step, geometry.row_step)
    to_source = -geometry.emitter if geometry.beam == "parallel" else geometry.emitter - geometry.centre
    mirrored = bool(np.median((normal * to_source).sum(1)) > 0)
    turned = geometry
    if mirrored:
        geometry, normal = geometry.mirrored(), -normal
    outward = -normal / np.linalg.norm(normal, axis=1, keepdims=True)
    angles = np.unwrap(np.arctan2(outward[:, 1], outward[:, 0]))
    outward = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    right = np.stack([-np.sin(angles), np.cos(angles), np.zeros_like(angles)], axis=1)
    width = np.linalg.norm(geometry.column_step, axis=1)
    height = np.linalg.norm(geometry.row_step, axis=1)
    tilt = np.arctan2(-geometry.column_step[:, 2], (geometry.column_step * right).sum(1))
    if geometry.beam == "parallel":
        source_origin = source_detector = lateral = np.zeros(1)
        across = (geometry.centre * right).sum(1)
    else:
        source_origin = (geometry.emitter * outward).sum(1)
        source_detector = ((geometry.emitter - geometry.centre) * outward).sum(1)
        lateral = (geometry.emitter * right).sum(1)
        across = (geometry.centre * right).sum(1) - lateral
    found = Circle(
        geometry.beam,
        tuple(angles.tolist()),
        float(np.median(width)),
        float(np.median(height)),
        geometry.rows,
        geometry.columns,
        float(np.median(source_origin)),
        float(np.median(source_detector)),
        float(np.median(lateral)),
        float(np.median(across / width)),
        float(np.median(-geometry.centre[:, 2] / height)),
        float(np.median(tilt)),
        mirrored,
    )
    try:
        return found, _distance(found.geometry(), turned) / found.pixel_width
    except ValueError:  # the source is not on the outer side of the axis
        return found, float("inf")


def _distance(one: ScanGeometry, other: ScanGeometry) -> float:
    """Return the largest distance between detector corners, or sources; for parallel beams only across the rays."""
    worst = 0.0
    for along in (-0.5, 0.5):
        for down in (-0.5, 0.5):
            corners = [g.centre + along * g.columns * g.column_step + down * g.rows * g.row_step for g in (one, other)]
            apart = corners[0] - corners[1]
            if one.beam == "parallel":
                apart = apart - (apart * other.emitter).sum(1, keepdims=True) * other.emitter
            worst = max(worst, float(np.linalg.norm(apart, axis=1).max()))
    if one.beam == "cone":
        worst = max(worst, float(np.linalg.norm(one.emitter - other.emitter, axis=1).max()))
    return worst
