"""Exposures of photos from EXIF."""

import math
from collections.abc import Sequence

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.photos.exif import read_exif


def log_exposures(frames: Sequence[Frame]) -> np.ndarray:
    """Return the logarithms (n,) of the photos' exposures, comparable with each other; NaN where EXIF lacks them.

    exposure = shutter time * ISO speed / f-number^2, to which the linear light of a photo is proportional

    Source: ISO 2720:1974; EXIF 2.32 (CIPA DC-008), tags ExposureTime, PhotographicSensitivity and FNumber.
    """
    return np.array([_log_exposure(frame) for frame in frames], dtype=np.float64)


def mean_log_exposure(frames: Sequence[Frame]) -> float | None:
    """Return the mean of `log_exposures` over photos with a known exposure; None without any."""
    exposures = [value for value in log_exposures(frames) if math.isfinite(value)]
    return math.fsum(exposures) / len(exposures) if exposures else None


def relative_log_exposures(frames: Sequence[Frame], reference: float | None) -> np.ndarray:
    """Return `log_exposures` minus `reference`; 0 where either is unknown."""
    if reference is None:
        return np.zeros(len(frames))
    return np.nan_to_num(log_exposures(frames) - reference, nan=0.0)


def _log_exposure(frame: Frame) -> float:
    if frame.image is None:
        return math.nan
    exif = read_exif(frame.image)
    if exif.exposure_seconds is None or exif.iso is None or exif.f_number is None:
        return math.nan
    return math.log(exif.exposure_seconds * exif.iso / exif.f_number**2)
