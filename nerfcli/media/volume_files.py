"""Volumes, maps on a grid of voxels, as files: NPZ with all maps, NRRD with one map for imaging programs.

Arrays are indexed [x, y, z]. The centre of voxel (i, j, k) is origin + voxel_size * (i, j, k).
"""

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.media.mesh_files import KEY

META = "meta"
_TYPES = {"<f4": "float", "|u1": "uchar", "<f8": "double"}


@dataclass(frozen=True)
class Volume:
    """Maps on a grid of voxels.

    Args:
        maps: by name, (X, Y, Z) or (X, Y, Z, C).
        origin: (3,) centre of the first voxel, in the frame that the description names.
        voxel_size: distance between the centres of adjacent voxels.
    """

    maps: Mapping[str, np.ndarray]
    origin: np.ndarray
    voxel_size: float
    description: Mapping[str, Any]


def write_volume_npz(volume: Volume, path: Path) -> None:
    """Write all maps, atomically; "meta" is the description as JSON text.

    Raises:
        UserError: the file cannot be written.
    """
    meta = json.dumps(dict(volume.description), allow_nan=False)
    with atomic_path(path) as partial:
        maps: dict[str, Any] = dict(volume.maps)
        place = {"origin": np.asarray(volume.origin, np.float64), "voxel_size": np.float64(volume.voxel_size)}
        np.savez_compressed(partial, **maps, **place, meta=np.array(meta))


def write_nrrd(volume: Volume, name: str, path: Path) -> None:
    """Write one map as NRRD 5 (gzip), atomically, with the description under the key `nerfcli`.

    Raises:
        UserError: the file cannot be written.

    Source: Definition of NRRD File Format, teem.sourceforge.net/nrrd/format.html.
    """
    values = volume.maps[name]
    unit = {"metre": "m", "mm": "mm", "um": "um"}.get(str(volume.description.get("unit")), "arbitrary")
    size = f"{volume.voxel_size:.17g}"
    lines = [
        "NRRD0005",
        f"# {name} by nerfcli",
        f"type: {_TYPES[values.dtype.str]}",
        "dimension: 3",
        "space dimension: 3",
        f"sizes: {' '.join(map(str, values.shape))}",
        f"space directions: ({size},0,0) (0,{size},0) (0,0,{size})",
        f"space origin: ({','.join(f'{value:.17g}' for value in volume.origin)})",
        f'space units: "{unit}" "{unit}" "{unit}"',
        "kinds: domain domain domain",
        "centers: cell cell cell",
        "endian: little",
        "encoding: gzip",
        f"{KEY}:={json.dumps({**volume.description, 'map': name}, ensure_ascii=True, allow_nan=False)}",
        "",
        "",
    ]
    # In the file, the first axis varies fastest.
    packed = zlib.compressobj(6, zlib.DEFLATED, 31)
    body = packed.compress(np.ascontiguousarray(values.transpose(2, 1, 0)).tobytes()) + packed.flush()
    with atomic_path(path) as partial:
        partial.write_bytes("\n".join(lines).encode("ascii") + body)


def read_nrrd(path: Path) -> tuple[np.ndarray, dict[str, str]]:
    """Read a map [x, y, z] that `write_nrrd` wrote, and the fields of its header.

    Raises:
        UserError: it is another kind of file, or damaged.
    """
    data = path.read_bytes()
    head, _, body = data.partition(b"\n\n")
    fields = {}
    for line in head.decode("utf-8", errors="replace").splitlines()[1:]:
        name, found, value = line.partition(":")
        if found and not line.startswith("#"):
            fields[name] = value[1:].strip() if value.startswith("=") else value.strip()
    types = {word: code for code, word in _TYPES.items()}
    try:
        shape = tuple(int(size) for size in fields["sizes"].split())
        if not data.startswith(b"NRRD") or fields["encoding"] != "gzip":
            raise ValueError("it is not a gzip NRRD")
        values = np.frombuffer(zlib.decompress(body, 31), types[fields["type"]]).reshape(shape[::-1])
    except (KeyError, ValueError, zlib.error) as error:
        raise UserError(
            f"{path} is damaged or not an NRRD file by nerfcli, and cannot be read: {error}", "export the volume again"
        ) from error
    return values.transpose(2, 1, 0), fields


def read_volume_npz(path: Path) -> Volume | None:
    """Read the volume that `write_volume_npz` wrote; None if the archive is something else.

    Raises:
        UserError: it is damaged.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            if not {"origin", "voxel_size", META} <= set(archive.files):
                return None
            names = [name for name in archive.files if name not in ("origin", "voxel_size", META)]
            maps = {name: archive[name] for name in names}
            return Volume(maps, archive["origin"], float(archive["voxel_size"]), json.loads(str(archive[META])))
    except (OSError, ValueError, zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise UserError(f"{path} is damaged or cut short: {error}", "export it once more") from error
