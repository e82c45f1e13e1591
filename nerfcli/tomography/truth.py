"""The true volume of a simulated scan."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.errors import UserError
from nerfcli.tomography.grid import VoxelGrid


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
        elif path.suffix == ".npy":
            volume = np.load(path, allow_pickle=False)
        else:
            from nerfcli.tomography.formats.naf import load_plain

            volume = np.asarray(load_plain(path)["image"])
    except (OSError, ValueError, KeyError) as error:
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
    first = tuple(float(value) for value in stated["first"])
    return VoxelGrid((shape[0], shape[1], shape[2]), (first[0], first[1], first[2]), float(stated["size"])), volume
