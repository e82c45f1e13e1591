"""The volume of a reconstruction in file formats of other programs: NRRD, MetaImage, NIfTI-1, TIFF for ImageJ.

All are float32 (or uint8 for marks), little-endian, x fastest, with spacing, origin and unit. The frame
is that of the scan: x and y across the rotation axis, z along it.
"""

import gzip
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from nerfcli.atomic import atomic_path
from nerfcli.ct.grid import MEANINGS, UNSEEN, VoxelGrid, marks_in_words
from nerfcli.ct.recognise import VOLUMES
from nerfcli.ct.result import load_reconstruction
from nerfcli.errors import UserError
from nerfcli.notices import Reporter
from nerfcli.output import Output

_NIFTI_HEADER = 352
_NIFTI_UNITS = {"m": 1, "mm": 2, "um": 3}
# Content and types of volumes: the name of the map, the types of NRRD and MetaImage, code and bits of NIfTI.
_TYPES = {
    np.dtype(np.uint8): ("marks", "uchar", "MET_UCHAR", (2, 8)),
    np.dtype(np.float32): ("attenuation", "float", "MET_FLOAT", (16, 32)),
}


@dataclass(frozen=True)
class VolumeFile:
    """Content of a volume's file.

    Args:
        values: (Z, Y, X).
        grid: position and size of the voxels.
        unit: unit of lengths.
        quantity: unit of the values, such as "1/mm".
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
    `grid.marks`; it is written only if there are any.

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
    """Write a volume, of float32 or uint8, in the format of the path's suffix: .nrrd, .mha, .nii or .tif; atomic.

    Raises:
        UserError: the suffix is none of these, or the file cannot be written.
    """
    if path.suffix.lower() not in _WRITERS:
        raise UserError(f"{path.name}: unknown volume format", f"choose one of {', '.join(VOLUMES)}")
    with atomic_path(path) as partial:
        _WRITERS[path.suffix.lower()](partial, volume)


def _write_nrrd(path: Path, volume: VolumeFile) -> None:
    """Write NRRD 5 (gzip), with the units and the name of the map under the key `nerfcli`.

    Source: Definition of NRRD File Format, teem.sourceforge.net/nrrd/format.html.
    """
    unit = volume.unit if volume.unit in ("mm", "um") else "arbitrary"
    size, (name, kind, *_) = f"{volume.grid.size:.17g}", _TYPES[volume.values.dtype]
    stated = {"unit": volume.unit, "quantity": volume.quantity, "map": name}
    lines = [
        "NRRD0005",
        f"# {name} by nerfcli",
        f"type: {kind}",
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
    path.write_bytes("\n".join(lines).encode("ascii") + gzip.compress(volume.values.tobytes(), 6, mtime=0))


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
        f"ElementType = {_TYPES[volume.values.dtype][2]}",
        "ElementDataFile = LOCAL",
    ]
    path.write_bytes(("\n".join(lines) + "\n").encode("ascii") + volume.values.tobytes())


def _write_nifti(path: Path, volume: VolumeFile) -> None:
    z, y, x = volume.grid.shape
    size, first = volume.grid.size, volume.grid.first
    header = bytearray(_NIFTI_HEADER)
    struct.pack_into("<i", header, 0, 348)
    struct.pack_into("<8h", header, 40, 3, x, y, z, 1, 1, 1, 1)
    struct.pack_into("<2h", header, 70, *_TYPES[volume.values.dtype][3])
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


def _units(volume: VolumeFile) -> str:
    return f"unit {volume.unit} quantity {volume.quantity}"


_WRITERS: dict[str, Callable[[Path, VolumeFile], None]] = {
    ".nrrd": _write_nrrd,
    ".mha": _write_mha,
    ".nii": _write_nifti,
    ".tif": _write_tiff,
    ".tiff": _write_tiff,
}
