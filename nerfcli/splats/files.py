"""Files of splats by their suffix."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.errors import UserError
from nerfcli.export.model_facts import NOT_STATED
from nerfcli.ply import description_in, read_ply_header
from nerfcli.splats.gaussians import Gaussians
from nerfcli.splats.ply import read_splat_ply, write_splat_ply
from nerfcli.splats.spz import read_spz, write_spz

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
