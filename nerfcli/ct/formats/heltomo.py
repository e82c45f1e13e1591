"""MATLAB files of HelTomo (University of Helsinki, with the Helsinki Tomography Challenge): fan beams, line integrals.

Angles follow ASTRA: at angle 0 the source is at -y, and it moves counter-clockwise. HelTomo's reconstructions are in
units of one effective pixel; here lengths are in mm, so that attenuation is in 1/mm.
"""

from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.circle import Circle
from nerfcli.ct.formats.assemble import ReaderOutput, scan_of
from nerfcli.ct.formats.statement import ScanOptions, angles_in_radians, millimetres
from nerfcli.ct.scan import Scan
from nerfcli.errors import UserError

_HINT = "expected a struct CtData with sinogram and parameters, as HelTomo writes it"


def read_heltomo(path: Path, given: ScanOptions = ScanOptions()) -> Scan:
    """Read a .mat file with a struct of sinogram and parameters.

    Raises:
        UserError: it cannot be read or is another .mat file.
    """
    name, data = _struct(path)
    parameters = data.parameters
    sinogram = np.asarray(data.sinogram, dtype=np.float32)
    if sinogram.ndim != 2:
        raise UserError(f"{path}: the sinogram in {name} has shape {sinogram.shape}", "expected views x columns")
    unit = millimetres(str(getattr(parameters, "distanceUnit", "mm")), where=f"{path}: distanceUnit")
    angles = angles_in_radians(
        np.atleast_1d(_field(parameters, "angles", path)),
        views=len(sinogram),
        unit="degrees",
        where=f"{path}: angles",
    )
    columns = sinogram.shape[1]
    stated = int(getattr(parameters, "numDetectorsPost", columns))
    if stated != columns:
        raise UserError(
            f"{path}: {columns} columns, but numDetectorsPost is {stated}",
            "the sinogram was cropped: correct one of them",
        )
    pixel = unit * _number(parameters, "pixelSizePost", path)
    circle = Circle(
        "cone",
        tuple((angles - np.pi / 2).tolist()),
        pixel,
        pixel,
        1,
        columns,
        unit * _number(parameters, "distanceSourceOrigin", path),
        unit * _number(parameters, "distanceSourceDetector", path),
    )
    project = str(getattr(parameters, "projectName", path.stem))
    return scan_of(
        ReaderOutput(
            path,
            "heltomo",
            sinogram[:, None],
            "line_integral",
            circle,
            "mm",
            history={"project": project},
            stated_mm=unit,
        ),
        given,
    )


def _struct(path: Path) -> tuple[str, Any]:
    import scipy.io

    try:
        content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist", "give the path of a .mat file") from error
    except Exception as error:  # loadmat raises what its parser meets: ValueError, TypeError, zlib.error, ...
        raise UserError(f"{path} cannot be read as a MATLAB file: {error}", _HINT) from error
    for name, value in content.items():
        if hasattr(value, "sinogram") and hasattr(value, "parameters"):
            return name, value
    names = ", ".join(name for name in content if not name.startswith("__")) or "nothing"
    raise UserError(f"{path} holds {names}, and no sinogram with its parameters", _HINT)


def _field(parameters: Any, name: str, path: Path) -> Any:
    if not hasattr(parameters, name):
        raise UserError(f"{path}: parameters have no {name}", _HINT)
    return getattr(parameters, name)


def _number(parameters: Any, name: str, path: Path) -> float:
    value = _field(parameters, name, path)
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if not (np.isfinite(number) and number > 0):
        raise UserError(f"{path}: {name} is {value!r}", "expected a length above 0")
    return number
