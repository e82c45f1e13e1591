"""Geometry of a scan: one description for parallel, fan and cone beams.

Each view states where its rays come from, the detector's centre, and the two vectors from a pixel to its neighbours.
These are ASTRA's vectors (`parallel3d_vec`, `cone_vec`); every other description of a scan is converted into them. The
object is fixed, and its frame is that of the volume: lengths in the scan's unit, z along the usual rotation axis.

Most scanners describe a circular scan: a source and a flat detector around an axis. `Circle.geometry` turns such a
description into vectors.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

Beam = Literal["cone", "parallel"]
BEAMS: tuple[Beam, ...] = ("cone", "parallel")
# Largest deviation of a source from a circle around z, as a fraction of its radius.
CIRCULAR = 1e-3


@dataclass(frozen=True)
class ScanGeometry:
    """The rays of a scan. A fan beam is a cone beam whose detector has one row.

    Args:
        beam: whether rays meet in a point ("cone") or are parallel.
        emitter: (V, 3) float64 position of the source ("cone"), or unit direction of the rays ("parallel").
        centre: (V, 3) centre of the detector.
        column_step: (V, 3) vector from a pixel to the next one in its row.
        row_step: (V, 3) vector from a pixel to the one below it.
        rows, columns: number of pixels of the detector.

    Raises:
        ValueError: the shapes disagree, or a number is not finite.
    """

    beam: Beam
    emitter: np.ndarray
    centre: np.ndarray
    column_step: np.ndarray
    row_step: np.ndarray
    rows: int
    columns: int

    def __post_init__(self) -> None:
        shape = np.shape(self.emitter)
        for name in ("emitter", "centre", "column_step", "row_step"):
            value = getattr(self, name)
            if value.shape != shape or value.ndim != 2 or value.shape[1] != 3:
                raise ValueError(f"{name} has shape {value.shape}, emitter {shape}: expected (views, 3)")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} has numbers that are not finite")
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"a detector of {self.columns} x {self.rows} pixels")

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.emitter)

    def select(self, views: ArrayLike) -> "ScanGeometry":
        """Return the same scan with some of its views, given by their indices."""
        index = np.asarray(views)
        vectors = ("emitter", "centre", "column_step", "row_step")
        return replace(self, **{name: getattr(self, name)[index] for name in vectors})

    def binned(self, factor: int) -> "ScanGeometry":
        """Return the scan with detector pixels `factor` times as large.

        Leftover rows and columns at the end are cut off. With fewer than `factor` rows, rows are not binned.
        """
        row_factor = factor if self.rows >= factor else 1
        rows, columns = self.rows // row_factor, max(self.columns // factor, 1)
        # The centre moves when the last rows and columns are cut off.
        moved_rows = (rows * row_factor - self.rows) / 2
        moved_columns = (columns * factor - self.columns) / 2
        return replace(
            self,
            centre=self.centre + moved_columns * self.column_step + moved_rows * self.row_step,
            column_step=self.column_step * factor,
            row_step=self.row_step * row_factor,
            rows=rows,
            columns=columns,
        )

    def shifted(self, columns: float, rows: float = 0.0) -> "ScanGeometry":
        """Return the scan with its detector moved by `columns` and `rows` pixels, as by a wrong centre of rotation."""
        return replace(self, centre=self.centre + columns * self.column_step + rows * self.row_step)

    def tilted(self, angle: float) -> "ScanGeometry":
        """Return the scan with its detector turned in its plane about its centre, in radians, from columns to rows."""
        width = np.linalg.norm(self.column_step, axis=1, keepdims=True)
        height = np.linalg.norm(self.row_step, axis=1, keepdims=True)
        along, down = self.column_step / width, self.row_step / height
        cos, sin = np.cos(angle), np.sin(angle)
        return replace(
            self, column_step=width * (cos * along + sin * down), row_step=height * (cos * down - sin * along)
        )

    def corrected(self, centre: float, tilt: float) -> "ScanGeometry":
        """Return the scan with its detector moved by `centre` columns and turned by `tilt` radians."""
        shifted = self.shifted(centre) if centre else self
        return shifted.tilted(tilt) if tilt else shifted

    def scaled(self, factor: float) -> "ScanGeometry":
        """Return the same scan in a unit that is `factor` times smaller."""
        emitter = self.emitter if self.beam == "parallel" else factor * self.emitter
        lengths = {name: factor * getattr(self, name) for name in ("centre", "column_step", "row_step")}
        return replace(self, emitter=emitter, **lengths)

    def mirrored(self) -> "ScanGeometry":
        """Return the scan with the detector's columns numbered from the other side."""
        return replace(self, column_step=-self.column_step)

    def rays(self, views: ArrayLike | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return origins and unit directions of the rays through the centres of all pixels.

        Args:
            views: indices of the views; all if not given.

        Returns:
            Two arrays (views, rows, columns, 3), float64. The origin of a parallel ray is its point closest to the
            frame's origin.
        """
        index = np.arange(self.views) if views is None else np.asarray(views)
        view = index[:, None, None]
        along = (np.arange(self.columns) - (self.columns - 1) / 2)[:, None]
        down = (np.arange(self.rows)[:, None] - (self.rows - 1) / 2)[..., None]
        pixels = self.centre[view] + down * self.row_step[view] + along * self.column_step[view]
        emitter = np.broadcast_to(self.emitter[view], pixels.shape)
        if self.beam == "parallel":
            foot = pixels - (pixels * emitter).sum(-1, keepdims=True) * emitter
            return foot, emitter.copy()
        along_ray = pixels - emitter
        return emitter.copy(), along_ray / np.linalg.norm(along_ray, axis=-1, keepdims=True)

    def pixel_of(self, view: int, points: np.ndarray) -> np.ndarray:
        """Project points into a view: return (N, 2) column and row, with 0 at the centre of the first pixel.

        Formula: the intersection of the ray through the point with the detector's plane, in pixels. Points in the plane
        through the source that is parallel to the detector give numbers that are not finite.

        Args:
            points: (N, 3).
        """
        normal = np.cross(self.column_step[view], self.row_step[view])
        centre, emitter = self.centre[view], self.emitter[view]
        if self.beam == "parallel":
            direction = np.broadcast_to(emitter, points.shape)
        else:
            direction = points - emitter
        with np.errstate(divide="ignore", invalid="ignore"):
            length = ((centre - points) @ normal) / (direction @ normal)
            hit = points + length[:, None] * direction - centre
        steps = np.stack([self.column_step[view], self.row_step[view]], axis=1)  # (3, 2)
        pixel = hit @ np.linalg.pinv(steps).T
        return pixel + np.array([(self.columns - 1) / 2, (self.rows - 1) / 2])

    @property
    def magnification(self) -> np.ndarray:
        """(V,) magnification on the detector of an object at the frame's origin."""
        if self.beam == "parallel":
            return np.ones(self.views)
        normal = np.cross(self.column_step, self.row_step)
        to_detector = ((self.centre - self.emitter) * normal).sum(1)
        to_origin = -(self.emitter * normal).sum(1)
        return to_detector / to_origin

    @property
    def pixel_at_origin(self) -> tuple[float, float]:
        """Height and width of a pixel at the frame's origin, in the scan's unit: medians over views."""
        height = np.linalg.norm(self.row_step, axis=1) / self.magnification
        width = np.linalg.norm(self.column_step, axis=1) / self.magnification
        return float(np.median(height)), float(np.median(width))

    @property
    def is_circular(self) -> bool:
        """Whether the source is on a circle around z, which is infinitely large for parallel beams."""
        distances = np.linalg.norm(self.emitter, axis=1)
        radius = float(np.median(distances))
        off = max(np.abs(self.emitter[:, 2]).max(), np.abs(distances - radius).max())
        return bool(off < CIRCULAR * radius)

    def vectors(self) -> np.ndarray:
        """Return ASTRA's vectors (V, 12): source or direction, detector's centre, column step, row step."""
        return np.concatenate([self.emitter, self.centre, self.column_step, self.row_step], axis=1)


def from_vectors(beam: Beam, vectors: ArrayLike, *, rows: int, columns: int) -> ScanGeometry:
    """Return the geometry of ASTRA's (V, 12) vectors; directions of a parallel beam may have any length.

    Raises:
        ValueError: the vectors are not (V, 12) or not finite, or a direction is 0.
    """
    array = np.asarray(vectors, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 12:
        raise ValueError(f"vectors have shape {array.shape}: expected (views, 12)")
    emitter, centre, column_step, row_step = (array[:, i : i + 3].copy() for i in (0, 3, 6, 9))
    if beam == "parallel":
        length = np.linalg.norm(emitter, axis=1, keepdims=True)
        if not (length > 0).all():
            raise ValueError("a direction of the parallel beam is 0")
        emitter = emitter / length
    return ScanGeometry(beam, emitter, centre, column_step, row_step, rows, columns)


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

        The source of a view with angle a is at (cos a, sin a, 0) * source_origin, the detector on the other side of the
        origin. Seen from the source, columns run to the right and rows down, with +z up. Parallel beams are those of a
        source infinitely far away.

        Raises:
            ValueError: a distance of a cone beam is not above 0.
        """
        angle = np.asarray(self.angles, dtype=np.float64)
        cos, sin, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
        outward, right = np.stack([cos, sin, zero], axis=1), np.stack([-sin, cos, zero], axis=1)
        if self.beam == "parallel":
            emitter, centre = -outward, np.zeros_like(outward)
        else:
            if not (self.source_origin > 0 and self.source_detector > 0):
                raise ValueError(
                    f"source_origin {self.source_origin} and source_detector {self.source_detector} must be above 0"
                )
            emitter = self.source_origin * outward + self.lateral * right
            centre = (self.source_origin - self.source_detector) * outward
        steps = self.pixel_width * right, self.pixel_height * np.stack([zero, zero, zero - 1], axis=1)
        geometry = ScanGeometry(self.beam, emitter, centre + self.lateral * right, *steps, self.rows, self.columns)
        geometry = geometry.shifted(self.column_shift, self.row_shift).tilted(self.tilt)
        return geometry.mirrored() if self.mirrored else geometry
