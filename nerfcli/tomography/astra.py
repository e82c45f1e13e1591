"""Export the geometry of a scan as ASTRA's vectors."""

from pathlib import Path

import numpy as np

from nerfcli.atomic import atomic_path, write_json
from nerfcli.errors import UserError
from nerfcli.tomography.scan import Scan

SUFFIXES = (".npy", ".txt")
_TYPES = {"cone": "cone_vec", "parallel": "parallel3d_vec"}


def write_astra(scan: Scan, path: Path) -> Path:
    """Write vectors (views x 12) as .npy or .txt, and the other parameters of `astra_create_proj_geom` as .json.

    A row holds source or direction, detector's centre, column step and row step, in the unit of the scan. ASTRA assumes
    voxels of side 1: divide all but directions by the side of a voxel.

    Returns:
        The path of the JSON.

    Raises:
        UserError: the suffix is neither .npy nor .txt, or a file cannot be written.
    """
    if path.suffix not in SUFFIXES:
        raise UserError(f"{path}: vectors are not written as {path.suffix or 'a folder'}", "name a .npy or .txt file")
    vectors = scan.geometry.vectors()
    with atomic_path(path) as partial:
        if path.suffix == ".npy":
            np.save(partial, vectors)
        else:
            np.savetxt(partial, vectors, fmt="%.17g")
    facts = path.with_suffix(".json")
    write_json(
        facts,
        {
            "type": _TYPES[scan.geometry.beam],
            "detector_rows": scan.geometry.rows,
            "detector_columns": scan.geometry.columns,
            "unit": scan.unit,
            "vectors": path.name,
            "order": "source or direction of rays (3), detector's centre (3), column to column (3), row to row (3)",
            "held_out": list(scan.held_out),
        },
    )
    return facts
