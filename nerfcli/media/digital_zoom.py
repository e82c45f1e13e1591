"""Digital zoom in EXIF: the camera enlarges the middle of the sensor, so that the focal length in pixels grows.

The focal length in millimetres is that of the lens alone. Its 35 mm equivalent includes digital zoom in the photos of
some phones (Apple), and leaves it out in those of others (Samsung). Photos by one lens with several zooms tell which.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from nerfcli.media.exif import Exif

# Zooms that differ by less say nothing about the 35 mm equivalent, which is rounded to millimetres.
_LEAST_RANGE = 1.05


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
