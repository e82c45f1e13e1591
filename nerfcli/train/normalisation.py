"""The training frame: an invertible similarity that brings what the cameras look at into the unit ball.

float32 has 7 digits; a scene in a frame of size 1 near the origin never loses a ray step to rounding, wherever the
capture lies in the world. Nothing on disk is moved by this.
"""

import math

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.paths import focus_point
from nerfcli.cameras.rigid import Similarity, apply, inverse
from nerfcli.render.model import Marching
from nerfcli.scene import Scene

# Contracted space ends at infinity; nothing is resolved beyond this many ball radii.
FARTHEST = 300.0
NEAREST = 0.02


def training_frame(scene: Scene, *, unbounded: bool) -> tuple[Similarity, Marching]:
    """The similarity from the scene's frame, and the steps along rays in the training frame.

    Unbounded scenes: the unit ball is centred where the cameras look and reaches to the median camera. Bounded ones
    (photos with alpha): the unit ball is the smallest that reaches out of every camera's view, and the cube around it
    is all there is.

    Raises:
        UserError: no camera (see `Scene`).
    """
    frames = scene.frames
    depths = _typical_depths(scene)
    centre = focus_point(frames, depth_hint=None if depths is None else float(np.median(depths[:, 1])))
    distances = np.array([np.linalg.norm(frame.world_from_cam[:3, 3] - centre) for frame in frames])
    if unbounded:
        radius = max(float(np.median(distances)), 1e-12)
    else:
        radius = max(d * math.tan(_half_fov(f)) for d, f in zip(distances, frames, strict=True))
    similarity = Similarity(1.0 / radius, np.eye(3), -centre / radius)
    if not unbounded:
        reach = math.sqrt(3.0)  # the cube's corners
        near = max(float(distances.min()) / radius - reach, NEAREST)
        far = float(distances.max()) / radius + reach
        return similarity, Marching(near=near, far=far, shortest_step=2 * reach / 512, growth=0.0)
    near = NEAREST * 5 if depths is None else 0.5 * float(depths[:, 0].min()) / radius
    near = min(max(near, NEAREST), 0.5)
    return similarity, Marching(near=near, far=FARTHEST, shortest_step=1 / 256, growth=1 / 128)


def _half_fov(frame: Frame) -> float:
    """Half of the wider field of view, in radians; at most 70 degrees, as what lenses see to the side is no object."""
    return math.radians(min(max(frame.camera.fov_deg) / 2, 70.0))


def _typical_depths(scene: Scene) -> np.ndarray | None:
    """(n, 2) nearest and median depth of what each camera sees, from the capture's own bounds or from SfM points.

    Nearest is the first percentile: a few wrong points are always closer. None when the scene tells neither.
    """
    if scene.depth_bounds is not None:
        near, far = scene.depth_bounds[:, 0], scene.depth_bounds[:, 1]
        # The harmonic mean is where LLFF puts its focus: half of the disparities lie on either side.
        return np.stack([near, 2.0 / (1.0 / near + 1.0 / far)], axis=1)
    rows = []
    for frame in scene.frames:
        if len(scene.points) == 0:
            break
        in_camera = apply(inverse(frame.world_from_cam), scene.points)
        in_camera = in_camera[in_camera[:, 2] > 0]
        if len(in_camera) == 0:
            continue
        pixels, valid = frame.camera.project(in_camera)
        size = np.array([frame.camera.width, frame.camera.height])
        depth = in_camera[valid & (pixels >= 0).all(1) & (pixels < size).all(1), 2]
        if len(depth) >= 10:
            rows.append(np.percentile(depth, [1, 50]))
    return np.array(rows) if rows else None
