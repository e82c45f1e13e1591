"""MATLAB files of HelTomo (University of Helsinki, with the Helsinki Tomography Challenge): fan beams, line integrals.

Angles follow ASTRA: at angle 0 the source is at -y, and it moves counter-clockwise. HelTomo's reconstructions are in
units of one effective pixel; here lengths are in mm, so that attenuation is in 1/mm.
"""

from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.formats.assemble import ReaderOutput
from nerfcli.ct.formats.statement import Statement, angles_in_radians, millimetres
from nerfcli.ct.geometry import Circle
from nerfcli.errors import UserError

_HINT = "expected a struct CtData with sinogram and parameters, as HelTomo writes it"


def read_heltomo(path: Path) -> ReaderOutput:
    """Read a .mat file with a struct of sinogram and parameters."""
    name, data = _struct(path)
    fields = Statement(path, vars(data.parameters), hint=_HINT)
    sinogram = np.asarray(data.sinogram, dtype=np.float32)
    if sinogram.ndim != 2:
        raise UserError(f"{path}: the sinogram in {name} has shape {sinogram.shape}", "expected views x columns")
    unit = millimetres(fields.text("distanceUnit", "mm"), where=f"{path}: distanceUnit")
    if "angles" not in fields:
        raise UserError(f"{path} has no angles", _HINT)
    stated_angles = np.atleast_1d(fields.value("angles"))
    angles = angles_in_radians(stated_angles, views=len(sinogram), unit="degrees", where=f"{path}: angles")
    columns = sinogram.shape[1]
    stated = int(fields.value("numDetectorsPost", columns))
    if stated != columns:
        raise UserError(
            f"{path}: {columns} columns, but numDetectorsPost is {stated}",
            "the sinogram was cropped: correct one of them",
        )
    pixel = fields.positive("pixelSizePost")
    origin, detector = (fields.positive(f"distanceSource{to}") for to in ("Origin", "Detector"))
    circle = Circle("cone", tuple((angles - np.pi / 2).tolist()), pixel, pixel, 1, columns, origin, detector)
    return ReaderOutput(path, "heltomo", sinogram[:, None], "line_integral", circle, "mm", mm=unit)


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
