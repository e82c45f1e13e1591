"""The training frame: an invertible similarity that brings what the cameras look at into the unit ball.

float32 has 7 digits; in a frame of size 1 near the origin, no ray step is lost to rounding, wherever the capture is in
the world. Files keep the scene's own frame.
"""

import math

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.paths import focus_point
from nerfcli.cameras.rigid import Similarity, apply, inverse
from nerfcli.captures.capture import Capture
from nerfcli.errors import UserError
from nerfcli.render.trained_field import Marching

# Rays end at this many ball radii: contracted space reaches to infinity, but resolves nothing beyond.
FARTHEST = 300.0
NEAREST = 0.02
# Rays begin at this fraction of the nearest depth: points miss surfaces without features, such as the ground and leaves
# in front of a building, which would otherwise end up too far away; even nearer, fog that no other photo contradicts
# would remain. Bounds that come with a capture are meant to include everything. In a box, points reach up to the
# cameras. Source for bounds: load_llff.py of the code of NeRF, Mildenhall et al. 2020.
NEAR_PER_POINT, NEAR_PER_BOUND, NEAR_IN_BOX = 0.3, 0.9, 0.5
# Rays begin at most this far away: depths larger than the unit ball do not tell how near a surface may be.
MOST_NEAR = 0.5
# The radius of the unit ball is at least this fraction of the depth of a typical pixel. Around an object, camera
# distance and depth are similar, and the cameras decide.
BALL_PER_DEPTH = 0.75
# Cameras that are all closer to their mean than this fraction of the nearest depth see a scene from one side, or all
# around from one place.
NARROW_SPREAD = 0.5
# In such captures, the background begins at this multiple of the typical depth.
NARROW_BACKGROUND = 2.5
# Fewer points do not tell where a scene ends.
LEAST_POINTS = 50


def contracted_frame(scene: Capture) -> tuple[Similarity, Marching]:
    """Return the similarity to the training frame and the steps along rays, for contracted space beyond the unit ball.

    The unit ball is centred where the cameras look. Its radius is the distance of the median camera, or three quarters
    of the median depth if that is larger: in a room the walls are behind the cameras, and nearly all that the photos
    show would be in contracted space, with steps that grow as the square of the distance.

    Raises:
        UserError: no camera (see `Capture`).
    """
    depths = _typical_depths(scene)
    centre = _focus(scene, depths)
    radius = max(float(np.median(_distances(scene, centre))), 1e-12)
    if depths is not None:
        radius = max(radius, BALL_PER_DEPTH * float(np.median(depths[:, 1])))
    near = NEAREST * 5 if depths is None else _near_part(scene) * float(depths[:, 0].min()) / radius
    near = min(max(near, NEAREST), MOST_NEAR)
    similarity = Similarity(1.0 / radius, np.eye(3), -centre / radius)
    return similarity, Marching(near=near, far=FARTHEST, shortest_step=1 / 256, growth=1 / 128)


def has_narrow_baseline(scene: Capture) -> bool:
    """Return whether the cameras are close together relative to the nearest depth: see `narrow_frame`.

    False if the scene has no depths, or if its nearest depth is 0.
    """
    depths = _typical_depths(scene)
    nearest = 0.0 if depths is None else float(depths[:, 0].min())
    return nearest > 0.0 and float(_distances(scene, _middle(scene)).max()) <= NARROW_SPREAD * nearest


def narrow_frame(scene: Capture) -> tuple[Similarity, Marching, float]:
    """Return similarity and steps for forward-facing captures and panoramas, and the distance of the background.

    The unit ball is centred between the cameras and reaches to the nearest depth. Everything visible is in contracted
    space, where a position is a direction and an inverse distance: the depth of cells matches the depth resolution of
    the small parallax of these captures. NeRF uses NDC for this, Mildenhall et al. 2020, appendix C.

    Raises:
        ValueError: the scene has no depths, see `has_narrow_baseline`.
    """
    depths = _typical_depths(scene)
    if depths is None:
        raise ValueError("the scene has no depths")
    centre, radius = _middle(scene), float(depths[:, 0].min())
    similarity = Similarity(1.0 / radius, np.eye(3), -centre / radius)
    background = NARROW_BACKGROUND * float(np.median(depths[:, 1])) / radius
    return similarity, Marching(near=_near_part(scene), far=FARTHEST, shortest_step=1 / 256, growth=1 / 128), background


def object_frame(scene: Capture) -> tuple[Similarity, Marching]:
    """Return similarity and steps for photos with alpha: an object in the middle, and nothing else.

    The unit ball is the smallest that fills every camera's view, and the cube around it is the whole field.

    Raises:
        UserError: no camera (see `Capture`).
    """
    centre = _focus(scene, _typical_depths(scene))
    distances = _distances(scene, centre)
    radius = max(d * math.tan(_half_fov(f)) for d, f in zip(distances, scene.frames, strict=True))
    reach = math.sqrt(3.0)  # the cube's corners
    near = max(float(distances.min()) / radius - reach, NEAREST)
    far = float(distances.max()) / radius + reach
    similarity = Similarity(1.0 / radius, np.eye(3), -centre / radius)
    return similarity, Marching(near=near, far=far, shortest_step=2 * reach / 512, growth=0.0)


def box_frame(scene: Capture) -> tuple[Similarity, Marching]:
    """Return similarity and steps for a bounded scene without alpha: [-1, 1]^3 is the smallest cube around its points.

    Raises:
        UserError: the scene has too few points to tell where it ends.
    """
    if len(scene.points) < LEAST_POINTS:
        raise UserError(
            f"the extent of {scene.root} cannot be estimated from its {len(scene.points)} points",
            "use --contraction l2",
        )
    percentile = 0.5  # at each end, where wrong points are
    low, high = np.percentile(scene.points, (percentile, 100 - percentile), axis=0)
    centre, radius = (low + high) / 2, max(float((high - low).max()) / 2 * 1.1, 1e-12)
    reach = math.sqrt(3.0)  # the cube's corners
    depths = _typical_depths(scene)
    near = NEAREST if depths is None else max(NEAR_IN_BOX * float(depths[:, 0].min()) / radius, NEAREST)
    far = float(_distances(scene, centre).max()) / radius + reach
    similarity = Similarity(1.0 / radius, np.eye(3), -centre / radius)
    return similarity, Marching(near=near, far=far, shortest_step=2 * reach / 512, growth=0.0)


def _near_part(scene: Capture) -> float:
    """Return the fraction of the nearest depth at which rays begin."""
    return NEAR_PER_POINT if scene.depth_bounds is None else NEAR_PER_BOUND


def _middle(scene: Capture) -> np.ndarray:
    """Return the mean of the camera centres."""
    return np.mean([frame.centre for frame in scene.frames], axis=0)


def _focus(scene: Capture, depths: np.ndarray | None) -> np.ndarray:
    """Return the point that the cameras look at; `depths` as from `_typical_depths`."""
    return focus_point(scene.frames, depth_hint=None if depths is None else float(np.median(depths[:, 1])))


def _distances(scene: Capture, centre: np.ndarray) -> np.ndarray:
    """Return the distances of the cameras from a point."""
    return np.array([np.linalg.norm(frame.centre - centre) for frame in scene.frames])


def _half_fov(frame: Frame) -> float:
    """Return half of the wider field of view, in radians, at most 70 degrees: objects are not seen farther off-axis."""
    return math.radians(min(max(frame.camera.fov_deg) / 2, 70.0))


def _typical_depths(scene: Capture) -> np.ndarray | None:
    """Return the nearest and median depth that each camera sees, (n, 2), from the capture's own bounds or SfM points.

    The nearest depth is the first percentile, as a few wrong points are always closer. None if the scene has neither.
    """
    if scene.depth_bounds is not None:
        near, far = scene.depth_bounds[:, 0], scene.depth_bounds[:, 1]
        # The harmonic mean is where LLFF puts its focus: half of the disparities are on either side.
        return np.stack([near, 2.0 * near * far / (near + far)], axis=1)
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
