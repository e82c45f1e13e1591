"""Files of splats by their suffix, and the page with a viewer and splats inside."""

import base64
import gzip
import json
import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from nerfcli.errors import UserError
from nerfcli.export.model_facts import NOT_STATED
from nerfcli.pages.page import write_page
from nerfcli.ply import description_in, ply_bytes, read_ply_header
from nerfcli.splats.gaussians import Gaussians
from nerfcli.splats.ply import read_splat_ply, splat_columns, write_splat_ply
from nerfcli.splats.spz import packed, read_spz, unpacked, write_spz

SUFFIXES = (".ply", ".spz")


def read_splats(path: Path, notify: Callable[[str], None]) -> tuple[Gaussians, dict[str, Any]]:
    """Read Gaussians from a .ply or .spz of any program, in the frame of the file, and nerfcli's description of them.

    Args:
        notify: called with a line about Gaussians that were left out.

    Returns:
        The Gaussians; the description that `write_splats` was given, empty in files of other programs.

    Raises:
        UserError: the file is missing, damaged or of another kind.
    """
    if not path.is_file():
        raise UserError(f"there is no {path}", "give a .ply or .spz of splats")
    if _suffix(path) == ".spz":
        return read_spz(path, notify)
    return read_splat_ply(path, notify), description_in(read_ply_header(path).comments)


def write_splats(
    path: Path, gaussians: Gaussians, *, description: Mapping[str, Any] | None, notify: Callable[[str], None]
) -> None:
    """Write Gaussians, atomically, as .ply or .spz by the suffix.

    Viewers expect y to point down; see `Gaussians.moved`.

    Args:
        description: unit, frame and others, as in `export.mesh_files`; in a .spz it is the comment of the gzip stream.
        notify: called with a line about values that the format cannot hold.

    Raises:
        UserError: the suffix is another, or the file cannot be written.
    """
    if _suffix(path) == ".spz":
        write_spz(path, gaussians, description, notify=notify)
    else:
        write_splat_ply(path, gaussians, description)


def splat_facts(path: Path) -> dict[str, Any]:
    """Return the facts about a file of splats as plain values, for `nerfcli info`.

    Raises:
        UserError: see `read_splats`.
    """
    gaussians, described = read_splats(path, lambda text: None)
    low, high = (np.round(np.quantile(gaussians.means, share, axis=0), 4).tolist() for share in (0.01, 0.99))
    opacities = 1.0 / (1.0 + np.exp(-gaussians.logits.astype(np.float64)))
    return {
        "kind": "splats",
        "splats": len(gaussians),
        "degree": gaussians.degree,
        "median_opacity": round(float(np.median(opacities)), 3),
        "98_percent_between": [low, high],
        **(described or {"not_stated": NOT_STATED}),
        "format": path.suffix[1:].upper(),
    }


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(
            f"{path} is no file of splats that nerfcli knows: its suffix is neither .ply nor .spz",
            "convert others: npx @playcanvas/splat-transform in.sog out.ply",
        )
    return suffix


def write_splat_page(
    path: Path,
    gaussians: Gaussians,
    *,
    title: str,
    world_from_cam: np.ndarray,
    fov_deg: float,
    background: Sequence[float],
    notify: Callable[[str], None],
) -> None:
    """Write a page with the Gaussians in the precision of .spz (see `spz.packed`), atomically.

    Args:
        gaussians: in a frame whose y points down; the viewer's horizon is level in it.
        title: plain text.
        world_from_cam: (4, 4) camera of the first view, in that frame; its roll is not kept.
        fov_deg: vertical field of view of the first view, in degrees.
        background: sRGB in [0, 1].
        notify: called with a line about values that were clipped.

    Raises:
        UserError: the file cannot be written.
    """
    here = Path(__file__).parent
    centre, forward = world_from_cam[:3, 3], world_from_cam[:3, 2]
    target = centre + _distance(gaussians, world_from_cam, fov_deg) * forward
    turned = np.array([-1.0, -1.0, 1.0])  # the viewer turns every file half around z, for y to point up
    first = {"position": (turned * centre).tolist(), "target": (turned * target).tolist(), "fov": float(fov_deg)}
    level = ", ".join(str(round(255 * value)) for value in background)
    data, note = packed(gaussians)
    shown = ply_bytes(splat_columns(unpacked(data)))
    text = Template((here / "page.html").read_text(encoding="utf-8")).substitute(
        licence=(here / "supersplat_viewer.txt").read_text(encoding="utf-8"),
        title=escape(title),
        background=f"rgb({level})",
        style=(here / "supersplat_viewer.css").read_text(encoding="utf-8"),
        first=json.dumps(first, allow_nan=False),
        colour=json.dumps([float(value) for value in background], allow_nan=False),
        viewer=base64.b64encode((here / "supersplat_viewer.js.gz").read_bytes()).decode(),
        splats=base64.b64encode(gzip.compress(shown, 6, mtime=0)).decode(),
    )
    write_page(text, path)
    if note:
        notify(f"{path}: {note}")


def _distance(gaussians: Gaussians, world_from_cam: np.ndarray, fov_deg: float) -> float:
    """Return the distance around which the view turns: the median depth in the middle of the first view."""
    x, y, z = ((gaussians.means - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]).T
    reach = math.tan(math.radians(fov_deg) / 2) / 4
    seen = (z > 0) & (gaussians.logits > 0)
    middle = seen & (np.maximum(np.abs(x), np.abs(y)) < reach * z)
    return float(np.median(z[middle])) if middle.any() else float(np.median(z[seen])) if seen.any() else 1.0
