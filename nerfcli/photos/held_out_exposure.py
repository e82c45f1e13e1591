"""Exposures of held-out photos, without using their pixels: from EXIF, from photos taken before and after, or both."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.photos.exif import log_exposures

# Sources of a held-out photo's gains: none, as the model has no exposures; EXIF; EXIF and an offset interpolated from
# the training photos taken before and after; those training photos alone; the mean of all training photos.
SOURCES = ("none", "EXIF", "EXIF and training photos around", "training photos around", "their mean")


@dataclass(frozen=True)
class PhotoExposures:
    """What training found out about the exposures of photos that it does not use.

    Args:
        log_exposure: mean log exposure of the training photos by EXIF; None if unknown or not used.
        exif_slope: factor by which gains follow the exposures in EXIF, see `exif_slope`.
        exposures: log gains (3,) of held-out photos by name, for those whose EXIF does not give them; see
            `gains_between`.
        beyond_exif: offsets (3,) to the gains that EXIF predicts, by name; see `gains_beyond_exif`.
    """

    log_exposure: float | None = None
    exif_slope: float = 1.0
    exposures: Mapping[str, Sequence[float]] = field(default_factory=dict)
    beyond_exif: Mapping[str, Sequence[float]] = field(default_factory=dict)


def gains_between(places: np.ndarray, log_gains: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Interpolate log gains (T, 3) from photos taken before and after, or return 0, the mean, if that is better.

    A camera that adapts its exposure does so gradually, so the neighbours of a photo predict its gains. Leave-one-out
    cross-validation over the known photos decides: the sum of squared errors of interpolation has to be below that of
    the mean of all other photos.

    Args:
        places: (P,) of the photos with known gains, increasing in the order in which they were taken.
        log_gains: (P, 3) logarithms of their gains.
        wanted: (T,) places of the photos to predict.
    """
    if len(places) < 3:
        return np.zeros((len(wanted), 3))
    by_place = _left_out(lambda o: _interpolated(places[o], log_gains[o], places[~o])[0], log_gains)
    if by_place >= _left_out(lambda o: log_gains[o].mean(0), log_gains):
        return np.zeros((len(wanted), 3))
    return _interpolated(places, log_gains, wanted)


def exif_slope(places: np.ndarray, log_gains: np.ndarray, exif: np.ndarray) -> float:
    """Return the slope, from 0 to 1, of the photos' log gains over their log exposures in EXIF.

    Tone curves make it smaller than 1. Log gains follow either EXIF alone, or EXIF with an offset that is interpolated
    from the photos before and after; then the slope is that of the differences from these photos, which light and
    surfaces that change along the capture hardly affect. Leave-one-out cross-validation decides, by squared errors. The
    slope is 0 if the mean of the other photos or the photos before and after predict a photo better than both.

    Args:
        places, log_gains: see `gains_between`.
        exif: (P,) logarithms of exposures; photos without a known one are ignored.
    """
    has_exif = np.isfinite(exif)
    places, log_gains, exif = places[has_exif], log_gains[has_exif], exif[has_exif]
    if len(places) < 3:
        return 1.0

    def by_exif(others: np.ndarray) -> np.ndarray:
        slope = _slope(exif[others], log_gains[others])
        return slope * exif[~others] + (log_gains[others] - slope * exif[others, None]).mean(0)

    def by_both(others: np.ndarray) -> np.ndarray:
        slope = _local_slope(places[others], exif[others], log_gains[others])
        rest = log_gains[others] - slope * exif[others, None]
        return slope * exif[~others] + _interpolated(places[others], rest, places[~others])[0]

    proportional, both = _left_out(by_exif, log_gains), _left_out(by_both, log_gains)
    between = _left_out(lambda o: _interpolated(places[o], log_gains[o], places[~o])[0], log_gains)
    mean = _left_out(lambda o: log_gains[o].mean(0), log_gains)
    if min(proportional, both) >= min(between, mean):
        return 0.0
    return _slope(exif, log_gains) if proportional < both else _local_slope(places, exif, log_gains)


def gains_beyond_exif(
    places: np.ndarray, log_gains: np.ndarray, exif: np.ndarray, wanted: np.ndarray, *, slope: float
) -> np.ndarray:
    """Return the offsets (T, 3) to add to the log gains that EXIF predicts, slope * (exif - mean exif).

    Errors of learned gains add up along a capture, and cameras change their white balance, so the offsets are
    interpolated from the photos before and after; they are 0 where `gains_between` prefers the mean.

    Args:
        places, log_gains, wanted: see `gains_between`.
        exif: (P,) logarithms of exposures; photos without a known one are ignored.
        slope: see `exif_slope`.
    """
    has_exif = np.isfinite(exif)
    if not has_exif.any():
        return np.zeros((len(wanted), 3))
    predicted = slope * (exif[has_exif] - exif[has_exif].mean())
    return gains_between(places[has_exif], log_gains[has_exif] - predicted[:, None], wanted)


def _slope(exif: np.ndarray, log_gains: np.ndarray) -> float:
    """Return the least-squares slope of log gains (P, 3) over `exif`, one for all channels, clipped to [0, 1]."""
    return _slope_through_zero(exif - exif.mean(), log_gains)


def _slope_through_zero(exif: np.ndarray, log_gains: np.ndarray) -> float:
    """Return the slope of log gains (P, 3) over differences of `exif` (P,), clipped to [0, 1]; 0 if these are equal."""
    if not (np.abs(exif) > 1e-4).any():  # the same but for rounding: a hundredth of a stop is 0.007
        return 0.0
    return float(np.clip((exif[:, None] * log_gains).sum() / (3.0 * np.square(exif).sum()), 0.0, 1.0))


def _local_slope(places: np.ndarray, exif: np.ndarray, log_gains: np.ndarray) -> float:
    """Return the least-squares slope of the photos' differences from those before and after, clipped to [0, 1]."""
    values = np.concatenate([exif[:, None], log_gains], axis=1)
    weight = ((places[1:-1] - places[:-2]) / (places[2:] - places[:-2]))[:, None]
    off = values[1:-1] - (1.0 - weight) * values[:-2] - weight * values[2:]
    return _slope_through_zero(off[:, 0], off[:, 1:])


def _left_out(predict: Callable[[np.ndarray], np.ndarray], log_gains: np.ndarray) -> float:
    """Return the leave-one-out sum of squared errors of `predict`, which is given the mask (P,) bool of the others."""
    others = [np.arange(len(log_gains)) != left for left in range(len(log_gains))]
    return float(sum(np.square(predict(o) - log_gains[~o][0]).sum() for o in others))


def log_gains_of(frames: Sequence[Frame], known: PhotoExposures) -> np.ndarray:
    """Return the logarithms (N, 3) of the gains of photos relative to rendered pictures.

    They are from EXIF plus the photo's offset; without EXIF, from the training photos around; else 0.
    """
    by_exif = _by_exif(frames, known)
    offsets, around = _by_name(frames, known.beyond_exif), _by_name(frames, known.exposures)
    return np.where(np.isfinite(by_exif)[:, None], by_exif[:, None] + offsets, around)


def gain_sources(frames: Sequence[Frame], known: PhotoExposures) -> list[str]:
    """Return the source of each photo's gains in `log_gains_of`, one of `SOURCES`."""
    none, exif, both, around, mean = SOURCES
    if known.log_exposure is None and not known.exposures:
        return [none] * len(frames)
    has_exif = np.isfinite(_by_exif(frames, known))
    has_offset = _by_name(frames, known.beyond_exif).any(1)
    has_neighbours = _by_name(frames, known.exposures).any(1)
    return np.where(has_exif, np.where(has_offset, both, exif), np.where(has_neighbours, around, mean)).tolist()


def _by_name(frames: Sequence[Frame], log_gains: Mapping[str, Sequence[float]]) -> np.ndarray:
    """Return the log gains (N, 3) of photos, 0 for those without an entry."""
    return np.array([log_gains.get(frame.name, (0.0,) * 3) for frame in frames]).reshape(-1, 3)


def _by_exif(frames: Sequence[Frame], known: PhotoExposures) -> np.ndarray:
    """Return the log gains that EXIF predicts, (N,), NaN where it predicts none."""
    if known.log_exposure is None or known.exif_slope == 0.0:
        return np.full(len(frames), np.nan)
    return known.exif_slope * (log_exposures(frames) - known.log_exposure)


def _interpolated(places: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Interpolate values at the wanted places, (T, 3): linearly between places, constant beyond."""
    return np.stack([np.interp(wanted, places, channel) for channel in values.T], axis=-1)
