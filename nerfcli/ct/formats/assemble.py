"""Build a scan from the output of a reader and the user's options: check values, mark dead pixels.

Flats and darks are averaged to the open beam, with the photons per detector value where they tell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.captures.holdout import names_held_out
from nerfcli.ct.formats.statement import ScanOptions, millimetres
from nerfcli.ct.geometry import Circle, ScanGeometry
from nerfcli.ct.likelihood import MEDIAN_DEVIATION
from nerfcli.ct.scan import Kind, Scan, held_out_views
from nerfcli.errors import UserError, several

# A frame's pixel that is further from the median over frames than this many robust deviations is left out.
OUTLIER = 5.0
# A pixel below this fraction of the median open beam is dead.
DEAD_BELOW = 0.05
# Least number of pixels for an estimate of the noise of flats.
_ENOUGH = 200


@dataclass(frozen=True)
class OpenBeam:
    """The beam without an object.

    Args:
        values: (1, rows, columns) float32 detector values minus the dark ones; 1 where the pixel is not usable.
        dark: (1, rows, columns) float32 values without beam; None where there are none.
        usable: (1, rows, columns) bool.
        photons_per_value: number of photons per detector value; None if the flats do not determine it.
    """

    values: np.ndarray
    dark: np.ndarray | None
    usable: np.ndarray
    photons_per_value: float | None


def open_beam_of(flats: np.ndarray, darks: np.ndarray | None, *, projections: tuple[int, ...], path: Path) -> OpenBeam:
    """Average flats and darks.

    Each pixel is the mean over frames without outliers (gamma quanta that hit the camera, a frame taken with the
    object in the beam). Photons per value are mean / variance of the flats, where both are sums over all pixels, the
    drift of whole frames is divided out, and the variance of the darks is subtracted.

    Args:
        flats: (frames, rows, columns) detector values.
        darks: likewise, or None.
        projections: shape of the projections of the scan at `path`.

    Raises:
        UserError: they have not the size of the projections, or the flats are all 0, or darker than the darks.
    """
    for name, frames in (("flats", flats), ("darks", darks)):
        if frames is not None and frames.shape[1:] != projections[1:]:
            raise UserError(
                f"{path}: {name} of {frames.shape[2]} x {frames.shape[1]} pixels, projections of "
                f"{projections[2]} x {projections[1]}",
                "flats and darks come from the detector of the projections: crop them the same way",
            )
    flat = robust_mean(flats)
    dark = None if darks is None or len(darks) == 0 else robust_mean(darks)
    beam = flat if dark is None else flat - dark
    finite = np.isfinite(beam)
    middle = float(np.median(beam[finite])) if finite.any() else 0.0
    if not middle > 0:
        above = "" if dark is None else " above the darks"
        raise UserError(
            f"the flats have a median of {middle:g}{above}: no pixel sees the beam",
            "flats are frames with the beam on and without the object; check that they are not swapped with the darks",
        )
    usable = finite & (beam > DEAD_BELOW * middle)
    if len(flats) >= 4:  # a stuck pixel has the same value in all frames
        usable &= np.ptp(flats, axis=0) > 0 if np.ptp(flats, axis=0).any() else True
    photons = _photons_per_value(flats, darks, beam, usable)
    return OpenBeam(
        np.where(usable, beam, 1).astype(np.float32)[None],
        None if dark is None else np.where(np.isfinite(dark), dark, 0).astype(np.float32)[None],
        usable[None],
        photons,
    )


def robust_mean(frames: np.ndarray) -> np.ndarray:
    """Return the mean over frames, (rows, columns) float64, without outliers if there are at least three frames."""
    frames = np.asarray(frames, dtype=np.float64)
    if len(frames) < 3:
        return frames.mean(0)
    # Whole frames may be brighter or darker; this is divided out before outliers are looked for.
    scale = np.median(frames.reshape(len(frames), -1), axis=1)
    middle = float(np.median(scale))
    level = np.where((scale > 0) & (middle > 0), scale / middle if middle > 0 else 1.0, 1.0)
    frames = frames / level[:, None, None]
    centre = np.median(frames, axis=0)
    apart = np.abs(frames - centre)
    # Few frames give a poor estimate of a pixel's own deviation: the median over all pixels is its lower bound.
    deviation = np.median(apart, axis=0) / MEDIAN_DEVIATION
    deviation = np.maximum(deviation, float(np.nanmedian(deviation)))
    kept = apart <= OUTLIER * deviation + 1e-12 * np.abs(centre)
    return np.where(kept, frames, 0).sum(0) / np.maximum(kept.sum(0), 1)


def _photons_per_value(
    flats: np.ndarray, darks: np.ndarray | None, beam: np.ndarray, usable: np.ndarray
) -> float | None:
    if len(flats) < 3 or usable.sum() < _ENOUGH:
        return None
    variance, kept = _variance(np.asarray(flats, dtype=np.float64)[:, usable], divided=True)
    if darks is not None and len(darks) >= 3:
        of_dark, good = _variance(np.asarray(darks, dtype=np.float64)[:, usable], divided=False)
        variance, kept = variance - of_dark, kept & good
    total = float(variance[kept].sum())
    return float(beam[usable][kept].sum()) / total if total > 0 else None


def _variance(frames: np.ndarray, *, divided: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the variance per pixel over frames, with their drift divided out or not, and the mask of normal pixels."""
    if divided:
        level = np.median(frames, axis=1, keepdims=True)
        frames = frames * (np.median(level) / np.where(level > 0, level, 1))
    variance = frames.var(axis=0, ddof=1)
    # The variance of pure noise, estimated from n frames, is below 1 + 8 sqrt(2 / (n - 1)) times the true one.
    limit = float(np.median(variance)) * (1 + 8 * np.sqrt(2 / (len(frames) - 1)))
    return variance, variance <= limit


# A scan with a smaller fraction of finite values than this is refused.
LEAST_FINITE = 0.5
# Largest plausible transmission, and largest line integral that a detector can measure.
MOST_TRANSMISSION, MOST_INTEGRAL = 3.0, 30.0
# Range of plausible pixel sides in mm; outside of it, the unit must be wrong.
PIXEL_MM = (1e-6, 20.0)
UNKNOWN_UNIT = "unit"
_EMPTY = "the projections are empty: export them again"


@dataclass(frozen=True)
class ReaderOutput:
    """Output of a reader.

    Args:
        path: the file or folder, for errors.
        form: name of the format.
        values: (V, rows, columns).
        kind: type of the values.
        geometry: a circle where the format states one, else vectors.
        unit: unit of lengths of the scan, such as "mm" or `UNKNOWN_UNIT`.
        beam: the open beam, for counts.
        photons: number of photons per pixel of the open beam, if stated.
        held_out: views that the format holds out; None if it does not state any.
        notes: notes for the user.
        truth: the true volume of a simulated scan, see `described_truth`.
        mm: millimetres per unit of length of `geometry`; 1 if the file states no unit, None if it states no lengths.
    """

    path: Path
    form: str
    values: np.ndarray
    kind: Kind
    geometry: Circle | ScanGeometry
    unit: str
    beam: OpenBeam | None = None
    photons: float | None = None
    held_out: Sequence[int] | None = None
    notes: Sequence[str] = ()
    truth: Mapping[str, Any] | None = None
    mm: float | None = 1.0


def scan_of(found: ReaderOutput, given: ScanOptions) -> Scan:
    """Build the scan.

    Raises:
        UserError: views and geometry do not fit together, values are implausible, or the user's options do not fit.
    """
    notes = list(found.notes)
    values = _checked(found)
    unit, scale = _unit(found, given)
    try:
        with np.errstate(over="raise", divide="raise", invalid="raise"):
            placed = found.geometry.geometry() if isinstance(found.geometry, Circle) else found.geometry
            geometry = placed.scaled(scale)
    except FloatingPointError as error:
        raise UserError(
            f"{found.path}: distances or sizes are too large or too small", "correct the numbers or their unit"
        ) from error
    if given.mirrored:
        geometry = geometry.mirrored()
    if values.shape != (geometry.views, geometry.rows, geometry.columns):
        views, rows, columns = values.shape
        raise UserError(
            f"{found.path}: {views} projections of {columns} x {rows} pixels for {geometry.views} angles and a "
            f"detector of {geometry.columns} x {geometry.rows}",
            "projections, angles and detector size of one scan belong together: check that no file is missing",
        )
    pixel = float(np.linalg.norm(geometry.column_step[0]))
    if unit == "mm" and not PIXEL_MM[0] <= pixel <= PIXEL_MM[1]:
        raise UserError(
            f"{found.path}: a pixel of {pixel:g} mm",
            f"between {PIXEL_MM[0]:g} and {PIXEL_MM[1]:g} mm are possible; set the unit with nerfcli ct convert --unit",
        )
    if given.centre_column is not None:
        geometry = _with_centre(geometry, given.centre_column)
    values, usable = _usable(found, values, notes)
    photons = _photons(found, given)
    history = {
        "format": found.form,
        "source": str(found.path),
        **({} if found.truth is None else {"truth": found.truth}),
        "notes": notes,
    }
    beam = found.beam
    return Scan(
        geometry,
        found.kind,
        values,
        None if beam is None else beam.values,
        None if beam is None else beam.dark,
        photons,
        usable,
        _held_out(found, given, len(values)),
        unit,
        history,
    )


def _checked(found: ReaderOutput) -> np.ndarray:
    """Return the values as float32; raise if they are implausible for their kind."""
    values = np.asarray(found.values, dtype=np.float32)
    if values.ndim != 3 or 0 in values.shape:
        raise UserError(
            f"{found.path}: projections of shape {values.shape}", "expected views x rows x columns, none of them 0"
        )
    if len(values) < 2:
        raise UserError(f"{found.path} has one projection", "a reconstruction needs views from several angles")
    finite = np.isfinite(values)
    fraction = float(finite.mean())
    if fraction < LEAST_FINITE:
        raise UserError(
            f"{found.path}: only {100 * fraction:.0f} % of the values are finite",
            "the file is damaged: export it again",
        )
    high = float(np.quantile(values[finite][:: max(1, int(finite.sum()) // 1_000_000)], 0.999))
    if found.kind == "transmission" and high > MOST_TRANSMISSION:
        raise UserError(
            f"{found.path}: transmissions up to {high:.4g}, where 1 is the open beam",
            "these look like detector values: give flats or the white level, or divide by them",
        )
    if found.kind == "line_integral" and high > MOST_INTEGRAL:
        raise UserError(
            f"{found.path}: line integrals up to {high:.4g}, which no photon would pass",
            "these look like detector values, or a unit was applied twice",
        )
    if float(np.ptp(values[finite])) == 0:
        raise UserError(f"{found.path}: all values are {values[finite][0]:g}", _EMPTY)
    return values


def _unit(found: ReaderOutput, given: ScanOptions) -> tuple[str, float]:
    """Return the scan's unit of lengths, mm if the user gave one, and the factor on those of the reader's geometry."""
    if given.unit is None:
        return found.unit, found.mm or 1.0
    if found.mm is None:
        raise UserError(
            f"{found.path} states no pixel size, to which --unit {given.unit} would apply",
            "store the size in the file as x_pixel_size, or leave out --unit: lengths are then in pixels",
        )
    return "mm", millimetres(given.unit, where="--unit")


def _with_centre(geometry: ScanGeometry, column: float) -> ScanGeometry:
    if not -geometry.columns < column < 2 * geometry.columns:
        raise UserError(
            f"--centre-of-rotation {column:g} is far outside the {geometry.columns} columns",
            "give the column that the axis is projected to, 0 for the first pixel's centre",
        )
    return geometry.shifted(axis_column(geometry) - column)


def axis_column(geometry: ScanGeometry) -> float:
    """Return the column onto which the origin is projected, median over views: the centre of rotation."""
    origin = np.zeros((1, 3))
    return float(np.median([geometry.pixel_of(view, origin)[0, 0] for view in range(geometry.views)]))


def _usable(found: ReaderOutput, values: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the values with neutral numbers where they are not finite, and the mask of usable ones."""
    finite = np.isfinite(values)
    usable = None if found.beam is None or found.beam.usable.all() else found.beam.usable
    if usable is not None:
        notes.append(f"{several(int((~usable).sum()), 'dead pixel')} left out")
    # Empty frames come from a shutter that stayed shut, or were never written.
    empty = (
        (np.ptp(np.where(finite, values, 0), axis=(1, 2)) == 0) if values[0].size > 1 else np.zeros(len(values), bool)
    )
    if empty.all():
        raise UserError(f"{found.path}: all projections are empty", _EMPTY)
    if empty.any():
        notes.append(
            f"{several(int(empty.sum()), 'empty projection')} left out; the first is number {int(np.argmax(empty))}"
        )
    if not finite.all():
        notes.append(f"{several(int((~finite).sum()), 'non-finite value')} left out")
        neutral = {"counts": 0.0, "transmission": 1.0, "line_integral": 0.0}[found.kind]
        values = np.where(finite, values, np.float32(neutral))
    if not finite.all() or empty.any():
        good = finite & ~empty[:, None, None]
        usable = good if usable is None else good & usable
    return values, usable


def _photons(found: ReaderOutput, given: ScanOptions) -> float | None:
    """Return the photons per detector value for counts, else per transmission of 1."""
    if given.photons is not None:
        if not (np.isfinite(given.photons) and given.photons > 0):
            raise UserError(
                f"--photons {given.photons:g} is not a number of photons",
                "give the photons per pixel of the open beam, above 0",
            )
        if found.kind == "line_integral":
            raise UserError(
                "--photons does not apply to line integrals: their noise is no longer that of counting",
                "leave it out, or convert transmissions or counts",
            )
    photons = found.photons if given.photons is None else given.photons
    if found.beam is None:
        return photons
    if photons is None:
        return found.beam.photons_per_value
    return photons / float(np.median(found.beam.values[found.beam.usable]))


def _held_out(found: ReaderOutput, given: ScanOptions, views: int) -> tuple[int, ...]:
    if given.holdout is not None:
        names = [f"{view:05d}" for view in range(views)]
        return tuple(sorted(int(name) for name in names_held_out(given.holdout, names)))
    if found.held_out is None:
        return held_out_views(views)
    return tuple(sorted({int(view) for view in found.held_out}))
