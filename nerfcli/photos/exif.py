"""EXIF of photos: what it says about the camera, its lens, the exposure, the time and place of the shot."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from numbers import Rational
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags

from nerfcli.cameras.frame import Frame
from nerfcli.photos.images import exif_entries, number_of_pages, opened, orientation_of, upright_size

# Values of EXIF's FocalPlaneResolutionUnit; 4 and 5 are not standard, but some cameras write them.
_RESOLUTION_UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


@dataclass(frozen=True)
class Exif:
    """EXIF data of a photo; entries that are missing or implausible are None.

    focal_35mm is the equivalent focal length on 36 x 24 mm film. orientation is 1...8, 1 where absent.
    width and height are those of the upright picture. gps is (latitude_deg, longitude_deg, altitude in metres
    or None), north and east positive. taken is the time of the shot in seconds of the camera's own clock, comparable
    between photos of one camera. taken_px is the (width, height) that EXIF records for the picture, as the camera
    stored it; sensor_px_per_mm is the number of its pixels per millimetre of the sensor. digital_zoom is 1 or more, see
    `focal_evidence.with_digital_zoom`. pages: of the file, of which the largest is the photo.
    """

    width: int
    height: int
    orientation: int = 1
    make: str | None = None
    model: str | None = None
    lens: str | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None
    exposure_seconds: float | None = None
    iso: float | None = None
    gps: tuple[float, float, float | None] | None = None
    taken: float | None = None
    f_number: float | None = None
    taken_px: tuple[int, int] | None = None
    sensor_px_per_mm: float | None = None
    digital_zoom: float | None = None
    pages: int = 1


def read_exif(path: Path) -> Exif:
    """Read the EXIF entries that describe the camera. Odd or damaged entries count as absent.

    Raises:
        UserError: see `read_image`; damage after the header is not detected.
    """
    with opened(path) as image:
        width, height = upright_size(image)
        main = exif_entries(image, None)
        camera = exif_entries(image, ExifTags.IFD.Exif)
        gps = exif_entries(image, ExifTags.IFD.GPSInfo)
        orientation, pages = orientation_of(image), number_of_pages(image)
    return Exif(
        make=_text(main.get(ExifTags.Base.Make)),
        model=_text(main.get(ExifTags.Base.Model)),
        lens=_text(camera.get(ExifTags.Base.LensModel)),
        focal_mm=_positive(camera.get(ExifTags.Base.FocalLength)),
        focal_35mm=_positive(camera.get(ExifTags.Base.FocalLengthIn35mmFilm)),
        orientation=orientation,
        width=width,
        height=height,
        exposure_seconds=_positive(camera.get(ExifTags.Base.ExposureTime)),
        iso=_positive(camera.get(ExifTags.Base.ISOSpeedRatings)),
        gps=_position(gps),
        taken=_clock(camera.get(ExifTags.Base.DateTimeOriginal), camera.get(ExifTags.Base.SubsecTimeOriginal)),
        f_number=_positive(camera.get(ExifTags.Base.FNumber)),
        taken_px=_recorded_size(camera),
        sensor_px_per_mm=_sensor_resolution(camera),
        digital_zoom=_zoom(camera.get(ExifTags.Base.DigitalZoomRatio)),
        pages=pages,
    )


def _text(value: Any) -> str | None:
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    return (value.replace("\0", " ").strip() or None) if isinstance(value, str) else None


def _number(value: Any) -> float | None:
    """Return a finite number from a number or rational, or from the first of several; None if there is none."""
    if isinstance(value, tuple) and value:
        return _number(value[0])
    if not isinstance(value, (int, float, Rational)):
        return None
    try:
        number = float(value)
    except ArithmeticError:  # a zero denominator, or too large
        return None
    return number if math.isfinite(number) else None


def _positive(value: Any) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None


def _zoom(value: Any) -> float | None:
    zoom = _number(value)
    return zoom if zoom is not None and 1 <= zoom <= 100.0 else None


def _recorded_size(camera: dict[int, Any]) -> tuple[int, int] | None:
    width = _positive(camera.get(ExifTags.Base.ExifImageWidth))
    height = _positive(camera.get(ExifTags.Base.ExifImageHeight))
    if width is None or height is None or min(width, height) < 1:
        return None
    return int(width), int(height)


def _sensor_resolution(camera: dict[int, Any]) -> float | None:
    resolution = _positive(camera.get(ExifTags.Base.FocalPlaneXResolution))
    unit_mm = _RESOLUTION_UNITS_MM.get(camera.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    return resolution / unit_mm if resolution and unit_mm else None


def _clock(value: Any, fraction: Any) -> float | None:
    """Return seconds of the camera's clock from its local time, ignoring its time zone, and the decimal digits."""
    digits = _text(fraction)
    try:
        local = datetime.strptime(_text(value) or "", "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    return local.timestamp() + (float(f"0.{digits}") if digits and digits.isdecimal() and digits.isascii() else 0.0)


def _position(gps: dict[int, Any]) -> tuple[float, float, float | None] | None:
    latitude = _degrees(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef), limit=90)
    longitude = _degrees(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef), limit=180)
    if latitude is None or longitude is None or latitude == longitude == 0:  # written by some before they have a fix
        return None
    altitude = _number(gps.get(ExifTags.GPS.GPSAltitude))
    if altitude is not None and gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01"):
        altitude = -altitude  # below sea level
    return latitude, longitude, altitude


def _degrees(value: Any, hemisphere: Any, *, limit: float) -> float | None:
    """Return degrees from (degrees, minutes, seconds) and the letter of the hemisphere."""
    if not isinstance(value, tuple) or len(value) != 3:
        return None
    parts = [_number(part) for part in value]
    if None in parts:
        return None
    magnitude = sum(part / unit for part, unit in zip(parts, (1, 60, 3600), strict=True) if part is not None)
    if not 0 <= magnitude <= limit:
        return None
    return -magnitude if _text(hemisphere) in ("S", "W") else magnitude


def log_exposures(frames: Sequence[Frame]) -> np.ndarray:
    """Return the logarithms (n,) of the photos' exposures, comparable with each other; NaN where EXIF lacks them.

    exposure = shutter time * ISO speed / f-number^2, to which the linear light of a photo is proportional

    Source: ISO 2720:1974; EXIF 2.32 (CIPA DC-008), tags ExposureTime, PhotographicSensitivity and FNumber.
    """
    return np.array([_log_exposure(frame) for frame in frames], dtype=np.float64)


def mean_log_exposure(exposures: np.ndarray) -> float | None:
    """Return the mean of `log_exposures` over photos with a known exposure; None without any."""
    known = exposures[np.isfinite(exposures)]
    return math.fsum(known) / len(known) if len(known) else None


def relative_log_exposures(exposures: np.ndarray, reference: float | None) -> np.ndarray:
    """Return `log_exposures` minus `reference`; 0 where either is unknown."""
    if reference is None:
        return np.zeros(len(exposures))
    return np.nan_to_num(exposures - reference, nan=0.0)


def _log_exposure(frame: Frame) -> float:
    if frame.image is None:
        return math.nan
    exif = read_exif(frame.image)
    if exif.exposure_seconds is None or exif.iso is None or exif.f_number is None:
        return math.nan
    return math.log(exif.exposure_seconds * exif.iso / exif.f_number**2)
