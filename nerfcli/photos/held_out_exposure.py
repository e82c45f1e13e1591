"""Exposures of held-out photos, without using their pixels: from EXIF, or from photos taken before and after."""

from collections.abc import Sequence

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.photos.exif_exposure import log_exposures
from nerfcli.render.model import Model


def gains_between(places: np.ndarray, log_gains: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Interpolate (T, 3) gains along the capture for photos between others; 0, the mean, where that is a better guess.

    A camera that adapts to what it sees does so from photo to photo: then the neighbours of a photo tell its gains.
    Whether they do is seen by leaving out each known photo in turn: the squared differences to what its neighbours tell
    have to be below those to the mean of all others.

    Args:
        places: (P,) of the photos whose gains are known, in the order in which they were taken, increasing.
        log_gains: (P, 3) theirs.
        wanted: (T,) places of other photos.
    """
    count = len(places)
    if count < 3:
        return np.zeros((len(wanted), 3))
    others = [np.arange(count) != left for left in range(count)]
    told = np.array([_interpolated(places[o], log_gains[o], places[~o])[0] for o in others])
    mean = np.array([log_gains[o].mean(0) for o in others])
    if np.square(told - log_gains).sum() >= np.square(mean - log_gains).sum():
        return np.zeros((len(wanted), 3))
    return _interpolated(places, log_gains, wanted)


def log_gains_of(frames: Sequence[Frame], model: Model) -> np.ndarray:
    """(N, 3) logarithms of the gains of photos relative to the pictures of a model, as EXIF tells them; where it does
    not, as the training does; else 0."""
    if model.log_exposure is None:
        by_exif = np.full(len(frames), np.nan)
    else:
        by_exif = log_exposures(frames) - model.log_exposure
    by_training = np.array([model.exposures.get(frame.name, (0.0,) * 3) for frame in frames]).reshape(-1, 3)
    return np.where(np.isfinite(by_exif)[:, None], by_exif[:, None], by_training)


def _interpolated(places: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(T, 3) linear between places, constant beyond."""
    return np.stack([np.interp(wanted, places, channel) for channel in values.T], axis=-1)
