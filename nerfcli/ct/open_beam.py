"""The open beam from flats and darks: averages, dead pixels, photons per detector value."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerfcli.errors import UserError

# A frame's pixel that is further from the median over frames than this many robust deviations is left out.
OUTLIER = 5.0
# A pixel below this fraction of the median open beam is dead.
DEAD_BELOW = 0.05
# Median of |x - median| of a normal distribution, as a fraction of its standard deviation.
MEDIAN_DEVIATION = 0.6745
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
