"""Pictures with a scan.json that describes them, for scanners whose own format is not supported.

    {"projections": "proj/*.tif", "flats": "flats/*.tif", "darks": "darks/*.tif",
     "kind": "counts", "beam": "cone", "unit": "mm", "pixel_size": [0.2, 0.2],
     "source_origin": 410.7, "source_detector": 553.7,
     "angles_deg": {"first": 0, "step": 0.5}, "direction": "counter-clockwise"}

| key | meaning |
|---|---|
| projections | pattern of TIFF, PNG or BMP files, one TIFF of many pages, or a .npy of views x rows x columns |
| kind | counts (with flats or white_level), transmission, or line_integral |
| flats, darks | patterns, or .npy; white_level: a number instead of flats |
| beam | cone or parallel |
| unit | of lengths: mm, um, m, ... |
| pixel_size | width and height of a pixel of the detector, or one number |
| source_origin, source_detector | distances, of cone beams |
| angles_deg, angles_rad | a list; or first and step |
| direction | rotation of the source around the object, seen from above: counter-clockwise (default) or clockwise |
| mirrored | true if columns are numbered from right to left, seen from the source |
| centre_of_rotation | the column that the axis is projected to; the middle if it is not given |
| centre_row | the row that the plane of the source crosses; the middle if it is not given |
| photons | per pixel of the open beam |
| held_out | list of views, from 0 |
| truth | for a simulated scan: volume (.npy, z x y x x, around the origin), voxel_size, attenuation_per_value |
| vectors | instead of angles and distances: views x 12 numbers as ASTRA's cone_vec or parallel3d_vec |
"""

from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.formats.assemble import OpenBeam, ReaderOutput, open_beam_of
from nerfcli.ct.formats.pictures import SUFFIXES, numbered, read_npy, read_stack
from nerfcli.ct.formats.statement import Statement, angles_in_radians, millimetres, read_object
from nerfcli.ct.geometry import BEAMS, Beam, Circle, ScanGeometry, from_vectors
from nerfcli.ct.recognise import STACK
from nerfcli.ct.scan import KINDS, described_truth
from nerfcli.errors import UserError

_HINT = "a scan.json states projections, kind, beam, pixel_size, unit and angles_deg; see docs/tomography.md"
_KEYS = (
    *("projections", "flats", "darks", "white_level", "kind", "beam", "unit", "pixel_size", "source_origin"),
    *("source_detector", "angles_deg", "angles_rad", "direction", "mirrored", "centre_of_rotation", "centre_row"),
    *("photons", "held_out", "vectors", "truth", "note"),
)


def read_stated_stack(path: Path) -> ReaderOutput:
    """Read a folder with a scan.json, or the scan.json itself."""
    file = path / STACK if path.is_dir() else path
    fields = read_object(file, hint=_HINT)
    unknown = [name for name in fields.names if name not in _KEYS]
    if unknown:
        raise UserError(f"{file}: {unknown[0]!r} is not a key of scan.json", f"the keys are {', '.join(_KEYS)}")
    kind, beam = fields.one_of("kind", KINDS), fields.one_of("beam", BEAMS)
    values = _pictures(file, fields.text("projections"), "projections")
    views, rows, columns = values.shape
    factor = millimetres(fields.text("unit"), where=f"{file}: unit")
    if "vectors" in fields:
        geometry: Circle | ScanGeometry = _vectors(fields, beam, rows=rows, columns=columns)
    else:
        geometry = _circle(fields, beam, views=views, rows=rows, columns=columns)
    return ReaderOutput(
        *(path, "stack", values, kind, geometry, "mm"),
        beam=_open_beam(file, fields, values.shape) if kind == "counts" else None,
        photons=fields.positive("photons") if "photons" in fields else None,
        held_out=_held_out(fields, views),
        truth=_truth(fields, factor),
        mm=factor,
    )


def _circle(fields: Statement, beam: Beam, *, views: int, rows: int, columns: int) -> Circle:
    where = str(fields.path)
    name = "angles_rad" if "angles_rad" in fields else "angles_deg"
    stated = fields.value(name)
    if stated is None:
        raise UserError(f"{where} has no angles_deg", _HINT)
    if isinstance(stated, dict):
        steps = fields.nested(name, hint="angles are a list, or an object with first and step")
        stated = steps.number("first", 0.0) + steps.number("step") * np.arange(views)
    try:
        numbers = np.asarray(stated, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise UserError(f"{where}: {name} is not a list of numbers", _HINT) from error
    angles = angles_in_radians(numbers, views=views, unit=name.removeprefix("angles_"), where=f"{where}: {name}")
    direction = str(fields.value("direction", "counter-clockwise"))
    if direction not in ("counter-clockwise", "clockwise"):
        raise UserError(f"{where}: direction is {direction!r}", "write counter-clockwise or clockwise, seen from above")
    sides = fields.value("pixel_size")
    sides = list(sides) if isinstance(sides, list) else [sides, sides]
    if len(sides) != 2 or not all(isinstance(side, int | float) and side > 0 for side in sides):
        raise UserError(f"{where}: pixel_size is {fields.value('pixel_size')!r}", "give a width and a height above 0")
    mirrored = bool(fields.value("mirrored", False))
    middle = (columns - 1) / 2, (rows - 1) / 2
    shift = middle[0] - fields.number("centre_of_rotation", middle[0])
    return Circle(
        beam,
        tuple(((-1 if direction == "clockwise" else 1) * angles).tolist()),
        *(float(sides[0]), float(sides[1]), rows, columns),
        fields.positive("source_origin") if beam == "cone" else 0.0,
        fields.positive("source_detector") if beam == "cone" else 0.0,
        column_shift=-shift if mirrored else shift,
        row_shift=middle[1] - fields.number("centre_row", middle[1]),
        mirrored=mirrored,
    )


def _vectors(fields: Statement, beam: Beam, *, rows: int, columns: int) -> ScanGeometry:
    try:
        return from_vectors(beam, fields.value("vectors"), rows=rows, columns=columns)
    except (TypeError, ValueError) as error:
        raise UserError(f"{fields.path}: vectors: {error}", "give 12 numbers per view, as ASTRA's cone_vec") from error


def _open_beam(file: Path, fields: Statement, shape: tuple[int, ...]) -> OpenBeam:
    darks = _pictures(file, fields.text("darks"), "darks") if "darks" in fields else None
    if "flats" in fields:
        flats = _pictures(file, fields.text("flats"), "flats")
    elif "white_level" in fields:
        flats = np.full((1, *shape[1:]), fields.positive("white_level"), dtype=np.float32)
    else:
        raise UserError(f"{file}: counts without flats", "name the flats, or a white_level, or say kind transmission")
    return open_beam_of(flats, darks, projections=shape, path=file)


def _pictures(file: Path, pattern: str, what: str) -> np.ndarray:
    place = file.parent / pattern
    if place.suffix == ".npy":
        array = read_npy(place, hint=f"{file.name} names it for the {what}")
        array = array[None] if array.ndim == 2 else array
        if array.ndim != 3 or not np.issubdtype(array.dtype, np.number):
            raise UserError(f"{place} has shape {array.shape}", "expected views x rows x columns of numbers")
        return array.astype(np.float32)
    if place.is_dir():
        paths = numbered(place)
    elif place.suffix.lower() in SUFFIXES and "*" not in pattern and "?" not in pattern:
        paths = [place]
    else:
        paths = numbered(place.parent, place.name)
    if not paths:
        raise UserError(f"no {what} match {place}", f"{file.name} names them: TIFF, PNG or BMP files")
    return read_stack(paths)


def _held_out(fields: Statement, views: int) -> list[int] | None:
    stated: Any = fields.value("held_out")
    if stated is None:
        return None
    if not isinstance(stated, list) or not all(isinstance(view, int) and 0 <= view < views for view in stated):
        raise UserError(f"{fields.path}: held_out is {stated!r}", f"give a list of views from 0 to {views - 1}")
    return stated


def _truth(fields: Statement, factor: float) -> dict[str, Any] | None:
    """Describe the true volume, centred on the origin; its stated attenuation is in the inverse of the stated unit."""
    if fields.value("truth") is None:
        return None
    stated = fields.nested("truth", hint="truth has volume, voxel_size and attenuation_per_value")
    path = fields.path.parent / stated.text("volume")
    try:
        shape = np.load(path, mmap_mode="r", allow_pickle=False).shape
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} cannot be read: {error}", f"restore it, or remove truth from {fields.path.name}"
        ) from error
    if len(shape) != 3:
        raise UserError(f"{path} has shape {shape}", "a volume has three axes: z, y, x")
    size = stated.positive("voxel_size") * factor
    value = stated.positive("attenuation_per_value") / factor
    return described_truth(path, "zyx", shape, size=size, attenuation_per_value=value)
