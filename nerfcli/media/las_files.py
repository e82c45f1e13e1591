"""Points as .las and .laz files, for GIS programs and point-cloud viewers, with a description of their values.

laspy writes and reads them, lazrs compresses .laz: `pip install 'nerfcli[las]'`.
"""

import importlib
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.media.geotiff import KEYS, TEXT, geo_keys
from nerfcli.media.mesh_files import KEY

SUFFIXES = (".las", ".laz")
# LAS 1.2, which every program reads; its point format 2 has coordinates and 16-bit colours.
_POINT_FORMAT, _VERSION = 2, "1.2"
# Coordinates are integer multiples of this fraction of the largest extent, rounded up to a power of ten: finer than any
# measurement, and far from overflowing 32 bits.
_RESOLUTION = 1e-8
_COLOURS = ("red", "green", "blue")


def las_module() -> ModuleType:
    """Return laspy.

    Raises:
        UserError: laspy, or lazrs, which compresses .laz, is not installed.
    """
    try:
        importlib.import_module("lazrs")
        return importlib.import_module("laspy")
    except ImportError as error:
        raise UserError(".las and .laz files need laspy and lazrs", "pip install 'nerfcli[las]'") from error


def write_las(
    path: Path,
    columns: Mapping[str, np.ndarray],
    *,
    description: Mapping[str, Any],
    system: tuple[str, int | None] | None = None,
) -> None:
    """Write points, compressed if the suffix is .laz; atomic.

    Args:
        columns: arrays (N,) by name: x, y, z, rounded to between 1e-8 and 1e-7 of the largest extent; red, green, blue,
            uint8; all others become extra dimensions with their own dtype.
        description: plain values, stored as JSON in a variable-length record of the user "nerfcli".
        system: name and EPSG code of the projected coordinate system that x, y and z are in; None for none.

    Raises:
        UserError: the file cannot be written, or laspy is not installed.
    """
    laspy = las_module()
    places = np.stack([columns[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version=_VERSION)
    header.generating_software = KEY
    extent = float(np.ptp(places, axis=0).max(initial=0.0)) or 1.0
    header.scales = np.full(3, 10.0 ** np.ceil(np.log10(_RESOLUTION * extent)))
    header.offsets = np.round(places.min(axis=0, initial=np.inf)) if len(places) else np.zeros(3)
    extras = [name for name in columns if name not in ("x", "y", "z", *_COLOURS)]
    header.add_extra_dims([laspy.ExtraBytesParams(name, columns[name].dtype) for name in extras])
    text = json.dumps(dict(description), allow_nan=False).encode()
    header.vlrs.append(laspy.VLR(user_id=KEY, record_id=1, description="what the points are", record_data=text))
    if system is not None:
        directory, words = geo_keys(system[1], system[0], in_degrees=False)
        for record, data in ((KEYS, np.array(directory, "<u2").tobytes()), (TEXT, words.encode() + b"\0")):
            header.vlrs.append(laspy.VLR(user_id="LASF_Projection", record_id=record, record_data=data))
    points = laspy.LasData(header)
    points.x, points.y, points.z = places.T
    for name in _COLOURS:
        setattr(points, name, columns[name].astype(np.uint16) * 257)  # 255 becomes 65535
    for name in extras:
        points[name] = columns[name]
    with atomic_path(path) as partial:
        points.write(partial)


def las_facts(path: Path) -> dict[str, Any]:
    """Return the facts in the header of a .las or .laz file, with its description, if its last point can be read.

    Raises:
        UserError: the file is damaged, or laspy is not installed.
    """
    laspy = las_module()
    try:
        _check_records(path)
        with laspy.open(path) as file:
            header = file.header
            if header.point_count:  # the last point is there only if the file is whole
                file.seek(header.point_count - 1)
                if len(file.read_points(1)) != 1:
                    raise ValueError(f"its header says {header.point_count} points")
    except (laspy.LaspyException, OSError, ValueError, RuntimeError, ArithmeticError, struct.error) as error:
        raise UserError(f"{path} is damaged or not a LAS file: {error}", "copy or export it once more") from error
    described = next((vlr.record_data for vlr in header.vlrs if vlr.user_id == KEY), b"{}")
    return json.loads(described) | {
        "kind": "points",
        "format": f"{path.suffix[1:].upper()} {header.version}, point format {header.point_format.id}",
        "vertices": header.point_count,
        "properties": " ".join(header.point_format.dimension_names),
        "low": header.mins.tolist(),
        "high": header.maxs.tolist(),
    }


def _check_records(path: Path) -> None:
    """Refuse counts that the file cannot hold: of records, laspy reads for hours; of chunks, lazrs ends the process."""
    size = path.stat().st_size
    with path.open("rb") as file:
        start, records = struct.unpack("<II", file.read(104)[96:])
        if records * 54 > size:  # the size of a record without content
            raise ValueError(f"its header says {records} variable-length records")
        if path.suffix.lower() == ".laz":
            file.seek(start)
            (table,) = struct.unpack("<q", file.read(8))
            if table > 0:
                file.seek(table)
                _, chunks = struct.unpack("<II", file.read(8))
                if chunks > size:
                    raise ValueError(f"its table says {chunks} chunks")
