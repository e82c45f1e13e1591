"""Bruker SkyScan scanners: a .log file beside 16-bit projections that are already corrected by flats.

The log states the pixel size at the object. "Rotation Direction=CC" turns the object counter-clockwise, so that the
source moves clockwise around it; columns run from right to left seen from the source, as in ASTRA's reader.
"""

from pathlib import Path

import numpy as np

from nerfcli.ct.formats.assemble import ReaderOutput
from nerfcli.ct.formats.pictures import read_stack, stated_projections
from nerfcli.ct.formats.statement import Statement, angles_in_radians, read_lines
from nerfcli.ct.geometry import Circle
from nerfcli.errors import UserError

_HINT = "a SkyScan .log has Object to Source (mm), Image Pixel Size (um), Rotation Step (deg) and Number of Files"
# Pictures that are not projections: reconstructed slices, the preview, the extra views for the check of movement.
_OTHERS = r"(_rec|_spr|_arc|_TS)\w*\.\w+$"
# Distance of the source, in widths of the detector at the object, beyond which the beam counts as parallel.
_PARALLEL = 1000.0


def read_skyscan(path: Path) -> ReaderOutput:
    """Read a .log file with its projections."""
    fields = read_lines(path, hint=_HINT)
    step = fields.number("Rotation Step (deg)")
    to_object = fields.positive("Object to Source (mm)")
    at_object = fields.positive("Image Pixel Size (um)") * 1e-3
    if fields.text("Flat Field Correction", "ON").upper() == "OFF":
        raise UserError(
            f"{path}: Flat Field Correction=OFF, so the open beam is unknown",
            "correct the projections with flats in the scanner's program, or describe them in a scan.json with flats",
        )
    count, prefix = fields.whole("Number of Files"), fields.text("Filename Prefix", path.stem)
    # Some scanners also count a last file that repeats the first angle, which may be missing.
    values = read_stack(stated_projections(path, path.parent, prefix, [count, count - 1], without=_OTHERS))
    views, rows, columns = values.shape
    for name, size in (("Number Of Rows", rows), ("Number Of Columns", columns)):
        if name in fields and fields.whole(name) != size:
            raise UserError(
                f"{path}: {name} is {fields.whole(name)}, the projections have {size}",
                "the projections were cut or binned after the scan: correct the log, including its pixel size",
            )
    to_detector = fields.positive("Camera to Source (mm)") if "Camera to Source (mm)" in fields else to_object
    pixel = at_object * to_detector / to_object
    start = fields.number("Scanning Start Angle", 0.0)
    sign = -1 if fields.text("Rotation Direction", "CC").upper() == "CC" else 1
    angles = angles_in_radians(start + step * np.arange(views), views=views, unit="degrees", where=str(path))
    # The row that the plane of the source crosses, counted from the first one.
    line = fields.number("Optical Axis (line)", (rows - 1) / 2)
    circle = Circle(
        "cone",
        tuple((sign * angles + np.pi / 2).tolist()),
        *(pixel, pixel, rows, columns, to_object, to_detector),
        row_shift=(rows - 1) / 2 - line,
        mirrored=True,
    )
    if to_object > _PARALLEL * columns * at_object:
        circle = Circle("parallel", circle.angles, at_object, at_object, rows, columns, mirrored=True)
    notes = []
    if fields.number("Postalignment", 0.0) != 0:
        notes.append(
            f"the log has a postalignment of {fields.number('Postalignment'):g} pixels, which is ignored: "
            "ct doctor and ct train estimate the centre of rotation"
        )
    white = _white(fields, values, notes)
    return ReaderOutput(path, "skyscan", values / white, "transmission", circle, "mm", notes=notes)


def _white(fields: Statement, values: np.ndarray, notes: list[str]) -> float:
    """Return the detector value of the open beam."""
    if "Reference Intensity" in fields:
        return fields.positive("Reference Intensity")
    depth = fields.number("Depth (bits)", 16 if float(values.max()) > 255 else 8)
    if not 1 <= depth <= 32:
        raise UserError(f"{fields.path}: Depth (bits) is {depth:g}", "a detector has 8 to 16 bits: correct the log")
    notes.append(f"the log has no Reference Intensity: the largest {depth:g}-bit value is taken for the open beam")
    return 2.0**depth - 1
