"""Resolution of the photos of a capture."""

from collections.abc import Sequence

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity


def pixel_footprint(frames: Sequence[Frame], training_from_scene: Similarity) -> float:
    """Return the median over photos of a pixel's footprint at the centre of the training frame, in its units.

    The footprint is distance / focal length. The distance is at least 1, since cameras inside the unit ball look at
    things about one radius away.

    Args:
        frames: with the cameras of the downscaled training photos.
    """
    footprints = []
    for frame in frames:
        position = training_from_scene.apply_pose(frame.world_from_cam)[:3, 3]
        footprints.append(max(float(np.linalg.norm(position)), 1.0) / frame.camera.focal_px)
    return float(np.median(footprints))
