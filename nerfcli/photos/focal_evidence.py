"""Focal length from EXIF, in pixels, and whether it applies to the file.

EXIF describes the picture as the camera took it. A program that crops or resizes the photo usually copies EXIF, so the
size that it records is compared with the file's. Resizing keeps the focal length relative to the picture; cropping
makes it longer by an unknown factor, unless one side shows that the crop was not resized.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

from nerfcli.photos.exif import Exif

# Diagonal of 36 x 24 mm film. CIPA DCG-001 defines the 35 mm equivalent by the diagonal; for a picture of 3:2 that is
# the same as by the width.
_FILM_DIAGONAL_MM = 43.27
# Sides that agree within this are the same after rounding; JPEGs are also trimmed to whole blocks of 8 pixels.
_SAME_SIDE = 0.003
_ROUNDING_PX = 1.5
# Ratios of the longer to the shorter side of camera pictures; another shape without a recorded size means a crop.
_CAMERA_SHAPES = (5 / 4, 4 / 3, 3 / 2, 16 / 9)
_SAME_SHAPE = 0.01
# Zooms that differ by less say nothing about the 35 mm equivalent, which is rounded to millimetres.
_LEAST_RANGE = 1.05


@dataclass(frozen=True)
class FocalEvidence:
    """The focal length of a file according to its EXIF.

    Args:
        focal_px: None if EXIF does not state it. If it does not hold, the value for the largest crop that fits: a lower
            bound of the true focal length and a starting point.
        holds: whether nothing in EXIF contradicts the focal length.
        doubt: the contradiction; "" if there is none.
        whole_px: (longer, shorter) side of the picture as the camera took it, at the file's scale.
    """

    focal_px: float | None
    holds: bool
    doubt: str
    whole_px: tuple[float, float]


def usual_focal_px(width: int, height: int) -> float:
    """Return the initial focal length if nothing is known about it, as in COLMAP."""
    return 1.2 * max(width, height)


def focal_evidence(exif: Exif) -> FocalEvidence:
    """Return the focal length of a photo from EXIF, and whether it applies to the file as it is.

    It is computed from the 35 mm equivalent and the diagonal; without an equivalent, from the focal length in mm and
    the sensor's resolution, which refers to pixels of the recorded size even if the file was resized.
    """
    file_px = (float(max(exif.width, exif.height)), float(min(exif.width, exif.height)))
    if exif.focal_mm is None and exif.focal_35mm is None:
        return FocalEvidence(None, True, "", file_px)
    whole_px, doubt = _whole(file_px, exif.taken_px)
    focal_px = _focal_px(exif, whole_px)
    if focal_px is None:
        return FocalEvidence(None, not doubt, doubt, whole_px)
    # Between a fisheye and a strong telephoto lens, relative to the picture's longer side.
    shortest, longest = (fraction * whole_px[0] for fraction in (0.25, 40.0))
    if not shortest <= focal_px <= longest:
        doubt = f"EXIF gives a focal length of {focal_px / whole_px[0]:.3g} times the longer side, which is implausible"
        return FocalEvidence(None, False, doubt, whole_px)
    return FocalEvidence(focal_px, not doubt, doubt, whole_px)


def _whole(file_px: tuple[float, float], taken_px: tuple[int, int] | None) -> tuple[tuple[float, float], str]:
    """Return the (longer, shorter) side of the uncropped picture at the file's scale, and why the scale is in doubt."""
    longer, shorter = file_px
    size = f"{longer:.0f}x{shorter:.0f}"
    if taken_px is None:
        shape = longer / shorter
        if any(abs(shape / usual - 1) < _SAME_SHAPE for usual in _CAMERA_SHAPES):
            return file_px, ""
        return file_px, f"an unusual size of {size} pixels: probably cropped after the shot"
    taken_longer, taken_shorter = max(taken_px), min(taken_px)
    scales = longer / taken_longer, shorter / taken_shorter
    if _same(shorter, taken_shorter * scales[0]) or _same(longer, taken_longer * scales[1]):
        return file_px, ""
    whole = (float(taken_longer), float(taken_shorter))
    if any(_same(side, taken) for side, taken in zip(file_px, whole, strict=True)):
        return whole, ""  # one side is unchanged: the other one was cropped, and nothing was resized
    scale = max(scales)
    doubt = f"EXIF is for {taken_longer}x{taken_shorter} pixels, but the file has {size}: cropped after the shot"
    return (scale * taken_longer, scale * taken_shorter), doubt


def _focal_px(exif: Exif, whole_px: tuple[float, float]) -> float | None:
    if exif.focal_35mm is not None:
        return exif.focal_35mm / _FILM_DIAGONAL_MM * math.hypot(*whole_px)
    if exif.focal_mm is None or exif.sensor_px_per_mm is None or exif.taken_px is None:
        return None
    taken_longer = max(exif.taken_px)
    sensor_mm = taken_longer / exif.sensor_px_per_mm
    # Widths of camera sensors, from small phones to medium format.
    if not 2.5 <= sensor_mm <= 60.0:
        return None  # the resolution refers to another size than the recorded one
    return exif.focal_mm * exif.sensor_px_per_mm * whole_px[0] / taken_longer


def _same(side: float, other: float) -> bool:
    return abs(side - other) <= max(_ROUNDING_PX, _SAME_SIDE * other)


def same_focal(focal: float | None, earlier: list[float]) -> float | None:
    """Return the first of the earlier focal lengths that counts as the same; without one, add and return this one."""
    if focal is None:
        return None
    for other in earlier:
        if abs(math.log(focal / other)) < 0.02:  # autofocus moves them a little
            return other
    earlier.append(focal)
    return focal


def with_digital_zoom(exifs: Sequence[Exif]) -> list[Exif]:
    """Return EXIF of a capture's photos with focal lengths that include the digital zoom.

    Where all photos by a lens have the same zoom, its 35 mm equivalent stays as it is.
    """
    by_lens = defaultdict(list)
    for exif in exifs:
        by_lens[_lens(exif)].append(exif)
    left_out = {lens for lens, members in by_lens.items() if _leaves_zoom_out(members)}
    return [_zoomed(exif, equivalent=_lens(exif) in left_out) for exif in exifs]


def _lens(exif: Exif) -> tuple[object, ...]:
    return exif.make, exif.model, exif.lens, exif.focal_mm


def _leaves_zoom_out(members: Sequence[Exif]) -> bool:
    """Return whether the 35 mm equivalent of a lens stays the same where its digital zoom changes."""
    found = [(exif.digital_zoom, exif.focal_35mm) for exif in members if exif.digital_zoom and exif.focal_35mm]
    if not found:
        return False
    zooms, equivalents = zip(*found, strict=True)
    zoom_range, range_35mm = (max(values) / min(values) for values in (zooms, equivalents))
    return zoom_range >= _LEAST_RANGE and math.log(range_35mm) < math.log(zoom_range) / 2


def _zoomed(exif: Exif, *, equivalent: bool) -> Exif:
    zoom = exif.digital_zoom or 1.0
    return replace(
        exif,
        focal_mm=exif.focal_mm and exif.focal_mm * zoom,
        focal_35mm=exif.focal_35mm and exif.focal_35mm * (zoom if equivalent else 1.0),
    )
