"""Ground control points and their observations in photos, as in OpenDroneMap's gcp_list.txt.

The first line is the coordinate system: EPSG:32611, WGS84 UTM 11N, or +proj=utm +zone=11. Each other line is one
observation: x, y and height of the point, x and y of the pixel, the photo, and the name of the point (optional).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.world import Origin
from nerfcli.errors import UserError
from nerfcli.media.geodesy import east_north_up
from nerfcli.scale.corners import Sightings

HEADER = "a first line with the coordinate system, such as EPSG:32611, then x y height pixel-x pixel-y photo [name]"

# Geographic systems, in degrees: WGS 84 with and without height, ETRS89, NAD83, NAD83(2011).
_DEGREES = {"EPSG:4326", "EPSG:4979", "EPSG:4258", "EPSG:4937", "EPSG:4269", "EPSG:6318"}
# Systems whose metres are not those of the ground: web Mercator, and coordinates from the centre of the earth.
_NOT_LEVEL = {"EPSG:3857", "EPSG:900913", "EPSG:4978"}


@dataclass(frozen=True)
class ControlPoints:
    """Ground control points.

    Args:
        places: their positions in metres east, north and up of `origin`, (3,), by name.
        pixels: their observations by name: the photo and the pixel (x, y).
        origin: in the coordinate system of the file.
    """

    places: Mapping[str, np.ndarray]
    pixels: Mapping[str, Sequence[tuple[str, np.ndarray]]]
    origin: Origin

    def sightings(self, frames: Sequence[Frame]) -> Sightings:
        """Return the observations in photos that have a pose. Upper and lower case in the names of photos are the same.

        Raises:
            UserError: a name matches several photos, or none of the photos is among the frames.
        """
        index: dict[str, list[int]] = {}
        for i, frame in enumerate(frames):
            parts = frame.name.lower().split("/")
            for start in range(len(parts)):
                index.setdefault("/".join(parts[start:]), []).append(i)
        seen: dict[str, list[tuple[int, np.ndarray]]] = {}
        for name, pixels in self.pixels.items():
            for photo, pixel in pixels:
                found = index.get(photo.lower(), [])
                if len(found) > 1:
                    raise UserError(
                        f"{len(found)} photos are named {photo}: {', '.join(frames[i].name for i in found[:3])}",
                        "give a longer part of the name in the file of control points",
                    )
                seen.setdefault(name, []).extend((i, pixel) for i in found)
        if not any(seen.values()):
            photo = next(iter(self.pixels.values()))[0][0]
            raise UserError(
                f"no photo with control points has a pose, such as {photo}",
                f"the capture has {len(frames)} photos, such as {frames[0].name}" if frames else "it has no photos",
            )
        return seen


def read_control_points(path: Path) -> ControlPoints:
    """Read control points from a file in the format of OpenDroneMap's gcp_list.txt.

    Projected coordinates are in metres; the origin is their mean, rounded down to metres. Degrees, longitude first, are
    converted to metres east, north and up of the first point. Points without a name are identified by their
    coordinates.

    Raises:
        UserError: the file cannot be read, has another format, or has a system in other units than metres or degrees.
    """
    if not path.exists():
        raise UserError(f"{path} does not exist", "give a file of control points, or gps")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read: {error}", f"expected {HEADER}") from error
    numbered = [(i, line.strip()) for i, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if not numbered:
        raise UserError(f"{path} is empty", f"expected {HEADER}")
    system = numbered[0][1]
    in_degrees = _in_degrees(system, path)
    places: dict[str, tuple[float, float, float]] = {}
    pixels: dict[str, list[tuple[str, np.ndarray]]] = {}
    for number, line in numbered[1:]:
        name, place, pixel, photo = _sighting(line, f"{path}, line {number}")
        if places.setdefault(name, place) != place:
            raise UserError(
                f"{path}, line {number}: {name} has other coordinates than before",
                "give each point its own name, and the same coordinates on all of its lines",
            )
        pixels.setdefault(name, []).append((photo, pixel))
    if not places:
        raise UserError(f"{path} has no control points", f"expected {HEADER}")
    given = np.array(list(places.values()))
    if in_degrees:
        if (np.abs(given[:, :2]) > (180, 90)).any():
            raise UserError(
                f"{path}: not all coordinates are degrees of longitude and latitude, as {system} says",
                "give the system of the coordinates in the first line; longitude comes before latitude",
            )
        metres, reference = east_north_up([(y, x, height) for x, y, height in places.values()])
    else:
        reference = tuple(np.floor(given.mean(axis=0)).tolist())
        metres = given - reference
    return ControlPoints(dict(zip(places, metres, strict=True)), pixels, Origin(system, reference, in_degrees))


def _in_degrees(system: str, path: Path) -> bool:
    """Return whether coordinates are degrees; otherwise they are metres."""
    compact = re.sub(r"\s", "", system).upper()
    if not re.match(r"EPSG:\d+$|\+PROJ=|WGS84(UTM\d+[NS])?$", compact):
        raise UserError(f"{path}: the first line is not a coordinate system: {system[:60]!r}", f"expected {HEADER}")
    if compact in _NOT_LEVEL or re.search(r"\+PROJ=(WEBMERC|GEOCENT)", compact):
        raise UserError(
            f"{path}: the metres of {system} are not those of the ground",
            "convert the coordinates to UTM, another national grid, or longitude and latitude (EPSG:4326)",
        )
    if re.search(r"\+V?UNITS=(?!M(\+|$))|\+V?TO_METER=(?!1(\.0*)?(\+|$))", compact):
        raise UserError(f"{path}: {system} is not in metres", "convert the coordinates, heights too, to metres")
    return compact in _DEGREES | {"WGS84"} or bool(re.search(r"\+PROJ=(LONGLAT|LATLONG|LONLAT|LATLON)", compact))


def _sighting(line: str, where: str) -> tuple[str, tuple[float, float, float], np.ndarray, str]:
    """Parse a line into the name and the coordinates of the point, the pixel and the photo."""
    fields = line.split()
    try:
        x, y, height, pixel_x, pixel_y = map(float, fields[:5])
        photo = fields[5]
    except (ValueError, IndexError) as error:
        raise UserError(f"{where} is not a control point: {line[:60]!r}", f"expected {HEADER}") from error
    if not np.isfinite([x, y, height, pixel_x, pixel_y]).all():
        raise UserError(
            f"{where}: not all numbers are finite", "control points need a height; remove those whose height is unknown"
        )
    name = fields[6] if len(fields) > 6 else f"{fields[0]},{fields[1]}"
    return name, (x, y, height), np.array([pixel_x, pixel_y]), photo
