"""Points as .las and .laz, which GIS programs and point-cloud viewers read, with a description of what they are.

laspy writes and reads them, lazrs compresses .laz: `pip install 'nerfcli[las]'`.
"""

import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.media.mesh_files import KEY

SUFFIXES = (".las", ".laz")
# Of LAS 1.2, which every program reads: places and 16-bit colours.
_POINT_FORMAT, _VERSION = 2, "1.2"
# Places are whole numbers of this part of the largest extent, rounded to a power of ten: finer than any measurement,
# and far from the ends of 32 bits.
_RESOLUTION = 1e-8
_COLOURS = ("red", "green", "blue")


def las_module() -> ModuleType:
    """Return laspy.

    Raises:
        UserError: it, or what compresses .laz, is not installed.
    """
    try:
        importlib.import_module("lazrs")
        return importlib.import_module("laspy")
    except ImportError as error:
        raise UserError(".las and .laz files need laspy and lazrs", "pip install 'nerfcli[las]'") from error


def write_las(path: Path, columns: Mapping[str, np.ndarray], *, description: Mapping[str, Any]) -> None:
    """Write points, compressed if the suffix is .laz; atomic.

    Args:
        path: the folder is made if need be.
        columns: (N,) by name: x, y, z, rounded to 1e-8 of their extent; red, green, blue as uint8; the others as extra
            dimensions of their own type.
        description: plain values, in a record of the user "nerfcli".

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
    points = laspy.LasData(header)
    points.x, points.y, points.z = places.T
    for name in _COLOURS:
        setattr(points, name, columns[name].astype(np.uint16) * 257)  # 255 becomes the largest of 16 bits
    for name in extras:
        points[name] = columns[name]
    with atomic_path(path) as partial:
        points.write(partial)


def las_facts(path: Path) -> dict[str, Any]:
    """Return what the header of a .las or .laz file says, and its description.

    Raises:
        UserError: it is damaged, or laspy is not installed.
    """
    laspy = las_module()
    try:
        with laspy.open(path) as file:
            header = file.header
    except (laspy.LaspyException, OSError, ValueError, RuntimeError) as error:
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
