"""Folders with geometry.json, transforms_train.json and transforms_test.json, whose pictures are transmissions.

The transforms are those of NeRF (OpenGL axes, principal point from the corner of the first pixel) with
"measurement": "transmission"; 16-bit pictures hold I / I0 with 65535 for 1. A .npy of all projections beside them may
be given instead: transmissions, or line integrals if its name contains line_integral. Test views are held out.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.formats.assemble import UNKNOWN_UNIT, ReaderOutput
from nerfcli.ct.formats.pictures import read_npy, read_stack
from nerfcli.ct.formats.statement import Statement, read_object
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.recognise import TRANSFORMS, TRANSFORMS_GEOMETRY
from nerfcli.ct.scan import Kind, described_truth
from nerfcli.errors import UserError

WHITE = 65535.0
_HINT = "expected geometry.json, transforms_train.json and transforms_test.json, with transmissions"


def read_transmission_transforms(path: Path) -> ReaderOutput:
    """Read the folder, one of its JSON files, or a .npy in it with the projections in the order of their angles."""
    folder = path if path.is_dir() else path.parent
    stated = read_object(folder / TRANSFORMS_GEOMETRY, hint=_HINT)
    frames, lens = _frames(folder)
    pitch = stated.positive("detector_pitch")
    distance = stated.positive("source_detector_distance")
    try:
        poses = np.array([frame["transform_matrix"] for frame in frames], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{folder}: transforms without numbers", "each frame has a 4 x 4 matrix of numbers") from error
    if poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
        raise UserError(f"{folder}: transforms of shape {poses.shape[1:]}", "each frame has a 4 x 4 matrix of numbers")
    right, up, back, source = (poses[:, :3, k] for k in range(4))
    columns, rows = lens.whole("w"), lens.whole("h")
    geometry = ScanGeometry("cone", source, source - distance * back, pitch * right, -pitch * up, rows, columns)
    geometry = geometry.shifted(columns / 2 - lens.number("cx"), rows / 2 - lens.number("cy"))
    values, kind, photons = _values(path, folder, frames)
    return ReaderOutput(
        *(path, "transmission-transforms", values),
        kind=kind,
        geometry=geometry,
        unit="voxel" if stated.number("voxel_size", 0.0) == 1 else UNKNOWN_UNIT,
        photons=photons,
        held_out=[view for view, frame in enumerate(frames) if frame["part"] == TRANSFORMS[1]],
        truth=_truth(folder, stated),
    )


def _frames(folder: Path) -> tuple[list[dict[str, Any]], Statement]:
    """Return the frames of both transforms in the order of their pictures' names, and the fields of the lens."""
    frames: list[dict[str, Any]] = []
    lens = None
    for name in TRANSFORMS:
        if name == TRANSFORMS[1] and not (folder / name).exists():
            continue
        content = read_object(folder / name, hint=_HINT)
        lens = lens or content
        listed = content.value("frames")
        if not isinstance(listed, list) or not listed:
            raise UserError(f"{folder / name} has no frames", _HINT)
        for frame in listed:
            if (
                not isinstance(frame, dict)
                or "transform_matrix" not in frame
                or not isinstance(frame.get("file_path"), str)
            ):
                raise UserError(f"{folder / name}: a frame lacks file_path or transform_matrix", _HINT)
            frames.append({**frame, "part": name})
    assert lens is not None
    return sorted(frames, key=lambda frame: str(frame["file_path"])), lens


def _values(path: Path, folder: Path, frames: list[dict[str, Any]]) -> tuple[np.ndarray, Kind, float | None]:
    """Return the values, their kind, and the photons that the name of a .npy states."""
    if path.suffix == ".npy":
        values = read_npy(path, hint="it is damaged: export it again")
        photons = re.search(r"I0_(\d+)", path.stem)
        kind: Kind = "line_integral" if "line_integral" in path.stem else "transmission"
        return values, kind, float(photons[1]) if photons and kind == "transmission" else None
    return read_stack([folder / str(frame["file_path"]) for frame in frames]) / WHITE, "transmission", None


def _truth(folder: Path, stated: Statement) -> dict[str, Any] | None:
    """Describe the measured volume, 8-bit values with x fastest, if its file exists."""
    name = stated.value("volume")
    found = re.search(r"(\d+)x(\d+)x(\d+)_uint8", str(name))
    if not isinstance(name, str) or not found or not (folder / name).is_file() or "mu_per_unit_value" not in stated:
        return None
    counts = [int(number) for number in found.groups()]
    size, value = stated.number("voxel_size", 1.0), stated.number("mu_per_unit_value") / 255
    return described_truth(folder / name, "zyx", counts[::-1], size=size, attenuation_per_value=value, dtype="uint8")
