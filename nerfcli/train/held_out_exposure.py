"""How held-out photos are exposed, without a look at them: as EXIF tells it, or the photos taken before and after."""

from collections.abc import Sequence

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.render.model import Model
from nerfcli.train.exif_exposure import relative_log_exposures


def gains_between(places: np.ndarray, log_gains: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(T, 3) gains of photos taken between others, interpolated along the capture; 0, the mean, where that says less.

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
    """(N, 3) logarithms of the gains of photos relative to the pictures of a model, as its training tells them; else as
    EXIF does; else 0."""
    by_exif = relative_log_exposures(frames, model.log_exposure)
    known = [model.exposures.get(frame.name, (gain,) * 3) for frame, gain in zip(frames, by_exif, strict=True)]
    return np.array(known, dtype=np.float64).reshape(-1, 3)


def _interpolated(places: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(T, 3) linear between places, constant beyond."""
    return np.stack([np.interp(wanted, places, channel) for channel in values.T], axis=-1)
