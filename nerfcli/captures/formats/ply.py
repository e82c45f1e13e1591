"""PLY files of the points of a capture, with their colours; positions are written as float64."""

from pathlib import Path

import numpy as np

from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.format import Format
from nerfcli.captures.formats.limits import plausible
from nerfcli.captures.formats.unsupported import lost_parts
from nerfcli.errors import UserError
from nerfcli.ply import read_ply_vertices, write_ply

_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the vertices of a PLY file and their colours.

    Returns:
        points (N, 3) float64; colours (N, 3) uint8, or None where vertices have none. Colours that are stored as floats
        are taken to be in [0, 1].
    """
    table = read_ply_vertices(path)
    names = table.dtype.names or ()
    hint = "expected a PLY file of vertices with x, y, z"
    if not {"x", "y", "z"} <= set(names):
        raise UserError(f"{path}: its vertices have the properties {', '.join(names) or 'none'}", hint)
    points = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=-1)
    if not plausible(points).all():
        raise UserError(f"{path}: vertex {int(np.argmin(plausible(points)))} has an invalid position", hint)
    channels = next((names_of for names_of in _COLOURS if set(names_of) <= set(names)), None)
    if channels is None:
        return points, None
    return points, np.stack([_as_bytes(path, table[name]) for name in channels], axis=-1)


def write_points(capture: Capture, path: Path) -> None:
    """Write the points of a capture, with their colours if it has any."""
    colours = () if capture.colours is None else zip(_COLOURS[0], capture.colours.T, strict=True)
    write_ply(path, {**dict(zip("xyz", capture.points.astype("<f8").T, strict=True)), **dict(colours)})


def losses_ply(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that a PLY file of points cannot hold."""
    cameras = f"{len(capture.frames)} cameras and their poses"
    return (cameras, *lost_parts(capture, holds=("points", "colours")))


def _as_bytes(path: Path, channel: np.ndarray) -> np.ndarray:
    """Return a colour channel as uint8."""
    most = 1.0 if channel.dtype.kind == "f" else 255.0
    if channel.dtype.str[1:] not in ("u1", "f4", "f8") or not ((channel >= 0) & (channel <= most)).all():
        raise UserError(f"{path}: its colours are not numbers from 0 to {most:g}", "store them as uchar or float")
    return np.round(channel.astype(np.float64) * (255.0 / most)).astype(np.uint8)


FORMAT = Format(
    "ply",
    "the points only",
    lambda path: None,
    lambda path, given: Capture((), read_points(path)[0], (), None, "ply"),
    default_name="points.ply",
    files=("*.ply",),
    lacks=("cameras", "poses"),
    write=write_points,
    losses=losses_ply,
)
