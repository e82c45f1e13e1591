"""GeoTIFF: pictures with north up, whose position and coordinate system are in tags that GIS programs read.

Source: OGC 19-008r4, OGC GeoTIFF Standard 1.1.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from nerfcli.atomic import atomic_path
from nerfcli.media.file_facts import DAMAGED, damaged

_TILE_PX = 256
# Tags: ModelPixelScale, ModelTiepoint, GeoKeyDirectory, GeoAsciiParams, and GDAL's value of undefined pixels.
_SCALE, _TIEPOINT, KEYS, TEXT, _NO_DATA = 33550, 33922, 34735, 34737, 42113
_DOUBLE, _SHORT, _ASCII = 12, 3, 2
# Keys and values: the model is projected, geographic (degrees) or defined by the user; pixels are areas.
_MODEL, _RASTER, _CITATION, _GEOGRAPHIC, _PROJECTED = 1024, 1025, 1026, 2048, 3072
_IS_PROJECTED, _IS_GEOGRAPHIC, _IS_OWN, _IS_AREA = 1, 2, 32767, 1


@dataclass(frozen=True)
class MapPlace:
    """Position of a picture in a coordinate system.

    Args:
        corner: x and y, or longitude and latitude, of the outer corner of the top left pixel.
        pixel: width and height of a pixel, > 0, in the same unit.
        epsg: code of the coordinate system; None if it has none.
        in_degrees: whether that system is geographic, in degrees.
    """

    corner: tuple[float, float]
    pixel: tuple[float, float]
    epsg: int | None
    in_degrees: bool
    system: str


def geo_keys(epsg: int | None, system: str, *, in_degrees: bool) -> tuple[list[int], str]:
    """Return the values of the tags `KEYS` and `TEXT`, which LAS files have too, for a coordinate system."""
    text = system.encode("ascii", "replace").decode() + "|"
    model = _IS_OWN if epsg is None else _IS_GEOGRAPHIC if in_degrees else _IS_PROJECTED
    keys = [(_MODEL, 0, 1, model), (_RASTER, 0, 1, _IS_AREA), (_CITATION, TEXT, len(text), 0)]
    if epsg is not None:
        keys.append((_GEOGRAPHIC if in_degrees else _PROJECTED, 0, 1, epsg))
    return [1, 1, 1, len(keys), *(value for key in keys for value in key)], text


def write_geotiff(path: Path, values: np.ndarray, place: MapPlace, *, description: Mapping[str, Any]) -> None:
    """Write a picture, atomically.

    Args:
        values: (H, W, 4) uint8 sRGB with straight alpha, or (H, W) float32, NaN where undefined.
        place: its position; row 0 is in the north.
        description: plain values, for the ImageDescription as JSON.

    Raises:
        UserError: the file cannot be written.
    """
    directory, text = geo_keys(place.epsg, place.system, in_degrees=place.in_degrees)
    tags = [
        (_SCALE, _DOUBLE, 3, (*place.pixel, 0.0), True),
        (_TIEPOINT, _DOUBLE, 6, (0.0, 0.0, 0.0, *place.corner, 0.0), True),
        (KEYS, _SHORT, len(directory), directory, True),
        (TEXT, _ASCII, len(text) + 1, text, True),
    ]
    colours = values.ndim == 3
    if not colours:
        tags.append((_NO_DATA, _ASCII, 4, "nan", True))
    with atomic_path(path) as partial:
        tifffile.imwrite(
            partial,
            values,
            photometric="rgb" if colours else "minisblack",
            extrasamples=["unassalpha"] if colours else None,
            compression="zlib",
            tile=(_TILE_PX, _TILE_PX),
            extratags=tags,
            description=json.dumps(dict(description), ensure_ascii=True, allow_nan=False),
            metadata=None,
        )


def map_facts(path: Path) -> dict[str, Any] | None:
    """Return the facts about a GeoTIFF by name; None for a TIFF without a position.

    Keys: kind ("map"), format, width, height, system, epsg, corner (x, y of the upper left one), pixel (width, height),
    and its description.

    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        with tifffile.TiffFile(path) as tiff:
            tags, page = tiff.geotiff_metadata, tiff.pages[0].aspage()
            width, height, text = page.imagewidth, page.imagelength, page.description
        if tags is None or "ModelTiepoint" not in tags:
            return None
        entries = json.loads(text) if text.startswith("{") else {}
        code = tags.get("ProjectedCSTypeGeoKey", tags.get("GeographicTypeGeoKey"))
        return {
            "kind": "map",
            "format": "GeoTIFF",
            "width": width,
            "height": height,
            "system": tags.get("GTCitationGeoKey"),
            "epsg": None if code is None else int(code),
            "corner": [float(value) for value in tags["ModelTiepoint"][3:5]],
            "pixel": [float(value) for value in tags["ModelPixelScale"][:2]],
            **(entries if isinstance(entries, dict) else {}),
        }
    except DAMAGED as error:
        raise damaged(path, error) from error
