"""Nikon (X-Tek) scanners: a .xtekct file beside 16-bit projections, cone beam, no flats but a white level.

As in the Core Imaging Library, the object turns clockwise seen from above, so that the source moves counter-clockwise
around it; columns run from right to left seen from the source. Angles come from AngularStep; those recorded in
*_ctdata.txt or .ang are used instead if they agree with it to half a step, or if there is no AngularStep.
"""

import re
from pathlib import Path

import numpy as np

from nerfcli.ct.formats.assemble import ReaderOutput
from nerfcli.ct.formats.pictures import read_stack, stated_projections
from nerfcli.ct.formats.statement import Statement, angles_in_radians, read_lines
from nerfcli.ct.geometry import Circle
from nerfcli.errors import UserError

_HINT = "a .xtekct file has SrcToObject, SrcToDetector, DetectorPixelsX, DetectorPixelSizeX, WhiteLevel and Projections"


def read_nikon(path: Path) -> ReaderOutput:
    """Read a .xtekct file with its projections."""
    fields = read_lines(path, hint=_HINT)
    views = fields.whole("Projections")
    columns, rows = fields.whole("DetectorPixelsX"), fields.whole("DetectorPixelsY")
    pixel = fields.positive("DetectorPixelSizeX"), fields.positive("DetectorPixelSizeY")
    to_object, to_detector = fields.positive("SrcToObject"), fields.positive("SrcToDetector")
    white = fields.positive("WhiteLevel")
    notes: list[str] = []
    recorded = _recorded_angles(path, views)
    turned = _angles(fields, views, recorded, notes)
    # Top and bottom of the axis on the detector, in mm towards higher columns.
    top, bottom = fields.number("CentreOfRotationTop", 0.0), fields.number("CentreOfRotationBottom", 0.0)
    lateral = (top + bottom) / 2 * to_object / to_detector
    if "ObjectOffsetX" in fields:
        lateral = fields.number("ObjectOffsetX")
    lean = float(np.arctan2(top - bottom, rows * pixel[1]))
    if "ObjectRoll" in fields:
        lean = -float(np.radians(fields.number("ObjectRoll")))
    circle = Circle(
        "cone",
        tuple((turned - 1.5 * np.pi).tolist()),
        *pixel,
        rows,
        columns,
        to_object,
        to_detector,
        # Columns run to the left: an axis at higher columns is to the left of the source.
        lateral=lateral * float(np.cos(lean)),
        tilt=lean,
        mirrored=True,
    )
    values = read_stack(_projections(path, fields, views))
    return ReaderOutput(path, "nikon", values / white, "transmission", circle, "mm", notes=notes)


def _angles(fields: Statement, views: int, recorded: np.ndarray | None, notes: list[str]) -> np.ndarray:
    """Return the angles of the stage (V,) in radians, including the initial angle."""
    where = f"{fields.path}: angles"
    first = fields.number("InitialAngle", 0.0)
    step = fields.number("AngularStep", 0.0)
    if step == 0:
        if recorded is None:
            raise UserError(
                f"{fields.path} has no AngularStep, and there is no list of angles beside it",
                "put the scanner's _ctdata.txt or .ang file there, or write AngularStep in degrees",
            )
        return angles_in_radians(first + recorded, views=views, unit="degrees", where=where)
    turned: np.ndarray = step * np.arange(views)
    if recorded is not None:
        measured: np.ndarray = recorded - recorded[0]
        if float(measured @ turned) < 0:
            measured = -measured
        apart = float(np.abs(measured - turned).max())
        if apart <= abs(step) / 2:
            turned = measured
        else:
            notes.append(f"recorded angles are up to {apart:.3g} degrees off AngularStep, whose angles are used")
    return angles_in_radians(first + turned, views=views, unit="degrees", where=where)


def _recorded_angles(path: Path, views: int) -> np.ndarray | None:
    """Return the angles in degrees from a _ctdata.txt or .ang file beside the .xtekct; None if there is none."""
    beside = [path.with_name(f"{path.stem}_ctdata.txt"), path.with_name("_ctdata.txt"), path.with_suffix(".ang")]
    place = next((place for place in beside if place.is_file()), None)
    if place is None:
        return None
    lines = place.read_bytes().decode("latin-1").splitlines()
    found = [re.match(r"\s*(\d+)\s*:?\s+(-?\d+(?:\.\d*)?)", line) for line in lines]
    # The first lines are a header, one of which may begin with two numbers; projections are numbered 1, 2, 3, ...
    angles = [float(match[2]) for match in found if match]
    numbers = [int(match[1]) for match in found if match]
    begin = next((k for k in range(len(numbers)) if numbers[k : k + 2] == [1, 2]), None)
    angles = [] if begin is None else angles[begin:]
    if len(angles) != views:
        raise UserError(
            f"{place} lists {len(angles)} angles for {views} projections",
            f"each projection needs its angle; without {place.name} the angles of AngularStep are used",
        )
    return np.array(angles)


def _projections(path: Path, fields: Statement, views: int) -> list[Path]:
    folder = path.parent
    name = fields.text("InputFolderName", "").replace("\\", "/").strip("/")
    if name and (path.parent / name).is_dir():
        folder = path.parent / name
    return stated_projections(path, folder, fields.text("Name", path.stem), [views])
