"""The volume of a reconstruction in file formats of other programs: NRRD, MetaImage, NIfTI-1, TIFF for ImageJ.

All are float32 (or uint8 for marks), little-endian, x fastest, with spacing, origin and unit. The frame
is that of the scan: x and y across the rotation axis, z along it.
"""

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from nerfcli.atomic import atomic_path
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.marks import MEANINGS, UNSEEN, marks_in_words
from nerfcli.ct.recognise import VOLUMES
from nerfcli.ct.result import load_reconstruction
from nerfcli.errors import UserError
from nerfcli.notices import Reporter
from nerfcli.output import Output

_NIFTI_HEADER = 352
_NIFTI_UNITS = {"m": 1, "mm": 2, "um": 3}
_NIFTI_TYPES = {np.dtype(np.uint8): (2, 8), np.dtype(np.float32): (16, 32)}
_NRRD_TYPES = {np.dtype(np.uint8): "uchar", np.dtype(np.float32): "float"}
_WORDS = {np.dtype(np.uint8): "MET_UCHAR", np.dtype(np.float32): "MET_FLOAT"}


@dataclass(frozen=True)
class VolumeFile:
    """Content of a volume's file.

    Args:
        values: (Z, Y, X).
        grid: position and size of the voxels.
        unit: unit of lengths; "" if the file does not state it.
        quantity: unit of the values, such as "1/mm"; "" if the file does not state it.
    """

    values: np.ndarray
    grid: VoxelGrid
    unit: str
    quantity: str


def export_scan(
    run: str | Path, output: Output = Output(), *, water: float | None = None, reporter: Reporter = Reporter()
) -> list[Path]:
    """Write the volume of a reconstruction as .nrrd, .mha, .nii or .tif, and its marks beside it.

    Voxels that no view sees are NaN. TARGET-marks has the marks of all voxels that the views do not determine, see
    `marks`; it is written only if there are any.

    Args:
        run: the folder that `train_scan` wrote.
        output: the file, whose suffix determines the format; RUN-volume.nrrd by default.
        water: attenuation of water in 1 / unit, to write Hounsfield units, 1000 (mu / water - 1); None for attenuation.

    Raises:
        UserError: there is no reconstruction, or a file exists.
    """
    target = output.beside(Path(run), f"-volume{VOLUMES[0]}")
    result = load_reconstruction(Path(run))
    marks = np.asarray(result.marks)
    values = np.where(marks & UNSEEN, np.float32(np.nan), result.volume).astype(np.float32)
    quantity = f"1/{result.unit}"
    if water is not None:
        values, quantity = (1000 * (values / np.float32(water) - 1)).astype(np.float32), "HU"
    beside = target.with_name(f"{target.stem}-marks{target.suffix}")
    output.refuse_existing(target, beside)
    write_volume(target, VolumeFile(values, result.grid, result.unit, quantity))
    written = [target]
    if marks.any():
        quantity = "marks: " + ", ".join(f"{mark} {meaning}" for mark, meaning in MEANINGS.items())
        write_volume(beside, VolumeFile(marks, result.grid, result.unit, quantity))
        written.append(beside)
        for words in marks_in_words(marks):
            reporter.note(f"{beside.name}: {words}")
    else:
        beside.unlink(missing_ok=True)  # of the volume that is replaced
    return written


def write_volume(path: Path, volume: VolumeFile) -> None:
    """Write a volume in the format of the path's suffix: .nrrd, .mha, .nii or .tif; atomic.

    Args:
        volume: float32 or uint8.

    Raises:
        UserError: the suffix is none of these, or the file cannot be written.
        ValueError: the values have another type.
    """
    if volume.values.dtype not in _WORDS:
        raise ValueError(f"volumes are float32 or uint8, not {volume.values.dtype}")
    if path.suffix.lower() not in _FORMATS:
        raise UserError(f"{path.name}: unknown volume format", f"choose one of {', '.join(VOLUMES)}")
    with atomic_path(path) as partial:
        _FORMATS[path.suffix.lower()][0](partial, volume)


def read_volume(path: Path) -> VolumeFile:
    """Read what `write_volume` wrote.

    Raises:
        UserError: it is missing, damaged, or was not written by nerfcli.
    """
    try:
        return _FORMATS[path.suffix.lower()][1](path)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}", "give a volume file") from error
    except (KeyError, ValueError, IndexError, struct.error, zlib.error) as error:
        raise UserError(
            f"{path} is damaged or not a volume written by nerfcli: {error}", "export the volume again"
        ) from error


def volume_facts(path: Path) -> dict[str, Any]:
    """Return the facts about a volume's file by name.

    Raises:
        UserError: see `read_volume`.
    """
    volume = read_volume(path)
    values, grid = volume.values, volume.grid
    known = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    span = f", {known.min():.6g} to {known.max():.6g}" if known.size else ", no numbers"
    return {
        "unit": volume.unit,
        "quantity": volume.quantity,
        "kind": "volume",
        "format": path.suffix[1:].upper(),
        "voxel_size": grid.size,
        "voxels": "x".join(map(str, reversed(grid.shape))),
        "first_centre": list(grid.first),
        "last_centre": [float(grid.axis(name)[-1]) for name in "xyz"],
        _name_of(volume): f"{values.dtype}{span}, {100 * known.size / values.size:.1f} % known",
    }


def _name_of(volume: VolumeFile) -> str:
    return "marks" if volume.values.dtype == np.uint8 else "attenuation"


def _write_nrrd(path: Path, volume: VolumeFile) -> None:
    """Write NRRD 5 (gzip), with the units and the name of the map under the key `nerfcli`.

    Source: Definition of NRRD File Format, teem.sourceforge.net/nrrd/format.html.
    """
    unit = volume.unit if volume.unit in ("mm", "um") else "arbitrary"
    size, name = f"{volume.grid.size:.17g}", _name_of(volume)
    stated = {"unit": volume.unit, "quantity": volume.quantity, "map": name}
    lines = [
        "NRRD0005",
        f"# {name} by nerfcli",
        f"type: {_NRRD_TYPES[volume.values.dtype]}",
        "dimension: 3",
        "space dimension: 3",
        f"sizes: {' '.join(map(str, reversed(volume.grid.shape)))}",
        f"space directions: ({size},0,0) (0,{size},0) (0,0,{size})",
        f"space origin: ({','.join(f'{value:.17g}' for value in volume.grid.first)})",
        f'space units: "{unit}" "{unit}" "{unit}"',
        "kinds: domain domain domain",
        "centers: cell cell cell",
        "endian: little",
        "encoding: gzip",
        f"nerfcli:={json.dumps(stated, ensure_ascii=True, allow_nan=False)}",
        "",
        "",
    ]
    packed = zlib.compressobj(6, zlib.DEFLATED, 31)
    body = packed.compress(np.ascontiguousarray(volume.values).tobytes()) + packed.flush()
    path.write_bytes("\n".join(lines).encode("ascii") + body)


def _read_nrrd(path: Path) -> VolumeFile:
    head, _, body = path.read_bytes().partition(b"\n\n")
    fields = {}
    for line in head.decode("utf-8", errors="replace").splitlines()[1:]:
        name, _, value = line.partition(":")
        fields[name] = value.removeprefix("=").strip()
    stated = json.loads(fields["nerfcli"])
    kind = {word: kind for kind, word in _NRRD_TYPES.items()}[fields["type"]]
    shape = tuple(int(count) for count in reversed(fields["sizes"].split()))
    values = np.frombuffer(zlib.decompress(body, 31), kind).reshape(shape)
    first = [float(v) for v in fields["space origin"].strip("()").split(",")]
    size = float(fields["space directions"].split(",")[0].strip("("))
    return VolumeFile(values, VoxelGrid.of(shape, first, size), stated["unit"], stated["quantity"])


def _write_mha(path: Path, volume: VolumeFile) -> None:
    z, y, x = volume.grid.shape
    size, first = volume.grid.size, volume.grid.first
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        f"Comment = {_units(volume)}",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CompressedData = False",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        f"Offset = {first[0]!r} {first[1]!r} {first[2]!r}",
        f"ElementSpacing = {size!r} {size!r} {size!r}",
        f"DimSize = {x} {y} {z}",
        f"ElementType = {_WORDS[volume.values.dtype]}",
        "ElementDataFile = LOCAL",
    ]
    path.write_bytes(("\n".join(lines) + "\n").encode("ascii") + volume.values.tobytes())


def _read_mha(path: Path) -> VolumeFile:
    content = path.read_bytes()
    end = b"ElementDataFile = LOCAL\n"
    at = content.index(end) + len(end)
    fields = dict(line.split(" = ", 1) for line in content[:at].decode("ascii").splitlines())
    kind = {"MET_UCHAR": np.dtype(np.uint8), "MET_FLOAT": np.dtype("<f4")}[fields["ElementType"]]
    x, y, z = (int(n) for n in fields["DimSize"].split())
    first = [float(v) for v in fields["Offset"].split()]
    values = np.frombuffer(content[at:], kind).reshape(z, y, x)
    grid = VoxelGrid.of(values.shape, first, float(fields["ElementSpacing"].split()[0]))
    return VolumeFile(values, grid, *_stated_units(fields["Comment"]))


def _write_nifti(path: Path, volume: VolumeFile) -> None:
    z, y, x = volume.grid.shape
    size, first = volume.grid.size, volume.grid.first
    code, bits = _NIFTI_TYPES[volume.values.dtype]
    header = bytearray(_NIFTI_HEADER)
    struct.pack_into("<i", header, 0, 348)
    struct.pack_into("<8h", header, 40, 3, x, y, z, 1, 1, 1, 1)
    struct.pack_into("<2h", header, 70, code, bits)
    struct.pack_into("<8f", header, 76, 1, size, size, size, 0, 0, 0, 0)
    struct.pack_into("<3f", header, 108, _NIFTI_HEADER, 1, 0)
    struct.pack_into("<b", header, 123, _NIFTI_UNITS.get(volume.unit, 0))
    struct.pack_into("<80s", header, 148, _units(volume).encode("ascii"))
    struct.pack_into("<2h", header, 252, 0, 1)  # no qform; sform: the scanner's frame, in the rows below
    for row in range(3):
        axis = [0.0] * 4
        axis[row], axis[3] = size, first[row]
        struct.pack_into("<4f", header, 280 + 16 * row, *axis)
    struct.pack_into("<4s", header, 344, b"n+1\0")
    path.write_bytes(header + volume.values.tobytes())


def _read_nifti(path: Path) -> VolumeFile:
    content = path.read_bytes()
    if struct.unpack_from("<i", content, 0)[0] != 348 or content[344:347] != b"n+1":
        raise ValueError("it has no header of NIfTI-1")
    x, y, z = struct.unpack_from("<3h", content, 42)
    kind = {2: np.dtype(np.uint8), 16: np.dtype("<f4")}[struct.unpack_from("<h", content, 70)[0]]
    rows = [struct.unpack_from("<4f", content, 280 + 16 * row) for row in range(3)]
    values = np.frombuffer(content[_NIFTI_HEADER:], kind).reshape(z, y, x)
    grid = VoxelGrid.of(values.shape, [row[3] for row in rows], rows[0][0])
    return VolumeFile(values, grid, *_stated_units(content[148:228].rstrip(b"\0").decode("ascii")))


def _write_tiff(path: Path, volume: VolumeFile) -> None:
    size, first = volume.grid.size, volume.grid.first
    tifffile.imwrite(
        path,
        volume.values,
        imagej=True,
        resolution=(1 / size, 1 / size),
        metadata={
            "axes": "ZYX",
            "spacing": size,
            "unit": volume.unit,
            "quantity": volume.quantity,
            "first": f"{first[0]!r} {first[1]!r} {first[2]!r}",
        },
    )


def _read_tiff(path: Path) -> VolumeFile:
    with tifffile.TiffFile(path) as tiff:
        found = tiff.imagej_metadata
        if found is None:
            raise ValueError("it has no description of ImageJ")
        values = tiff.asarray()
    values = values.reshape(-1, *values.shape[-2:])
    first = [float(v) for v in str(found["first"]).split()]
    grid = VoxelGrid.of(values.shape, first, float(found["spacing"]))
    return VolumeFile(values, grid, str(found.get("unit", "")), str(found.get("quantity", "")))


def _units(volume: VolumeFile) -> str:
    return f"unit {volume.unit or '-'} quantity {volume.quantity or '-'}"


def _stated_units(comment: str) -> tuple[str, str]:
    _, unit, _, quantity = comment.split(" ", 3)
    return unit.strip("-"), quantity.strip("-")


# Writer and reader of each suffix.
_FORMATS: dict[str, tuple[Callable[[Path, VolumeFile], None], Callable[[Path], VolumeFile]]] = {
    ".nrrd": (_write_nrrd, _read_nrrd),
    ".mha": (_write_mha, _read_mha),
    ".nii": (_write_nifti, _read_nifti),
    ".tif": (_write_tiff, _read_tiff),
    ".tiff": (_write_tiff, _read_tiff),
}
