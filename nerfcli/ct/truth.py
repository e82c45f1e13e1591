"""The true volume of a simulated scan."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.grid import VoxelGrid
from nerfcli.errors import UserError


def described_truth(
    path: Path,
    layout: str,
    shape: Sequence[int],
    *,
    size: float,
    attenuation_per_value: float,
    first: Sequence[float] | None = None,
    dtype: str | None = None,
) -> dict[str, Any]:
    """Return the entry "truth" of a scan's history, from which `load_truth` loads the true volume.

    Args:
        path: the file: a .npy, or plain numbers of type `dtype`.
        layout: order of the axes in the file, "zyx" or "xyz".
        shape: number of voxels (z, y, x).
        size: side of a voxel, in the scan's unit.
        attenuation_per_value: in the inverse of the scan's unit.
        first: (x, y, z) centre of the first voxel; by default, the volume is centred on the origin.
    """
    return {
        "path": str(path.absolute()),
        "layout": layout,
        **({} if dtype is None else {"dtype": dtype}),
        "shape": list(shape),
        "first": [-(count - 1) / 2 * size for count in reversed(shape)] if first is None else list(first),
        "size": size,
        "attenuation_per_value": attenuation_per_value,
    }


def load_truth(history: Mapping[str, Any]) -> tuple[VoxelGrid, np.ndarray] | None:
    """Load the true volume that a scan's history refers to.

    Returns:
        Its grid and (Z, Y, X) float32 attenuation in the inverse of the scan's unit; None if the history has none.

    Raises:
        UserError: its file cannot be read, or has another shape.
    """
    stated = history.get("truth")
    if not isinstance(stated, Mapping):
        return None
    path = Path(stated["path"])
    shape = tuple(int(count) for count in stated["shape"])
    try:
        if "dtype" in stated:
            volume = np.fromfile(path, dtype=stated["dtype"])
        else:
            volume = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise UserError(
            f"the true volume {path} cannot be read: {error}",
            "restore it, or convert the scan again without it",
        ) from error
    if volume.size != np.prod(shape):
        raise UserError(
            f"{path} has {volume.size} values, expected {shape}", "it is not the volume that the scan was made of"
        )
    if stated["layout"] == "xyz":
        volume = volume.reshape(shape[::-1]).transpose(2, 1, 0)
    volume = volume.reshape(shape).astype(np.float32) * np.float32(stated["attenuation_per_value"])
    return VoxelGrid.of(shape, [float(value) for value in stated["first"]], float(stated["size"])), volume
