"""Differences between refined cameras and those of the scene."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import vector_from_rotation


def camera_moves(before: Sequence[Frame], after: Sequence[Frame], *, radius: float) -> dict[str, Any]:
    """Return the median and the largest change of the cameras of photos.

    Args:
        before, after: the same photos in the same order, at least one.
        radius: radius of the scene, in its units.

    Returns:
        "rotation_deg", "translation_percent" (of the radius) and "focal_percent", each with "median" and "max".
    """
    given, refined = (np.array([frame.world_from_cam for frame in frames]) for frames in (before, after))
    turns = np.linalg.norm(vector_from_rotation(np.swapaxes(given[:, :3, :3], 1, 2) @ refined[:, :3, :3]), axis=1)
    moves = np.linalg.norm(refined[:, :3, 3] - given[:, :3, 3], axis=1)
    focal = [abs(b.camera.focal_px / a.camera.focal_px - 1) for a, b in zip(before, after, strict=True)]
    columns = {
        "rotation_deg": np.degrees(turns),
        "translation_percent": 100 * moves / radius,
        "focal_percent": 100 * np.array(focal),
    }
    return {
        name: {"median": round(float(np.median(values)), 4), "max": round(float(values.max()), 4)}
        for name, values in columns.items()
    }
