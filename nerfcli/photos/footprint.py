"""Resolution of the photos of a capture."""

from collections.abc import Sequence

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity


def pixel_footprint(frames: Sequence[Frame], training_from_scene: Similarity) -> float:
    """Return the footprint of a pixel of the median photo at the centre of the training frame, in its units.

    distance / focal length, the distance at least 1: what cameras inside the unit ball look at is about its radius
    away.

    Args:
        frames: with the cameras of the photos as they are trained on, downscaled ones.
        training_from_scene: the normalisation.
    """
    footprints = []
    for frame in frames:
        position = training_from_scene.apply_pose(frame.world_from_cam)[:3, 3]
        footprints.append(max(float(np.linalg.norm(position)), 1.0) / frame.camera.focal_px)
    return float(np.median(footprints))
