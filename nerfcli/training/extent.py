"""The extent of a field: the covered part of space, its contraction, the training frame, and the steps along rays.

The training frame is reached by an invertible similarity that brings what the cameras look at into the unit ball.
float32 has 7 digits; in a frame of size 1 near the origin, no ray step is lost to rounding, wherever the capture is in
the world. Files keep the scene's own frame.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.layout import focus_point
from nerfcli.cameras.rigid import Similarity, apply, inverse
from nerfcli.captures.capture import Capture
from nerfcli.errors import UserError
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.kinds import cube_side
from nerfcli.render.trained_field import Marching
from nerfcli.training.runs.components import LEARNED_BACKGROUNDS
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import SHORTEST

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
# Photos show an object and nothing else only if this part of the 3D points is around their middle; a few are wrong.
OBJECT_PART = 0.95
# Fewer points do not tell where a scene ends.
LEAST_POINTS = 50


def contracted_frame(scene: Capture) -> tuple[Similarity, Marching]:
    """Return the similarity to the training frame and the steps along rays, for contracted space beyond the unit ball.

    The unit ball is centred where the cameras look. Its radius is the distance of the median camera, or three quarters
    of the median depth if that is larger: in a room the walls are behind the cameras, and nearly all that the photos
    show would be in contracted space, with steps that grow as the square of the distance.
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
    """
    depths = _typical_depths(scene)
    if depths is None:
        raise ValueError("the scene has no depths")
    centre, radius = _middle(scene), float(depths[:, 0].min())
    similarity = Similarity(1.0 / radius, np.eye(3), -centre / radius)
    background = NARROW_BACKGROUND * float(np.median(depths[:, 1])) / radius
    return similarity, Marching(near=_near_part(scene), far=FARTHEST, shortest_step=1 / 256, growth=1 / 128), background


def object_frame(scene: Capture) -> tuple[Similarity, Marching]:
    """Return similarity and steps for an object in the middle and nothing else.

    The unit ball is the smallest that fills every camera's view, and the cube around it is the whole field.
    """
    centre, radius = _object_ball(scene)
    distances = _distances(scene, centre)
    reach = math.sqrt(3.0)  # the cube's corners
    near = max(float(distances.min()) / radius - reach, NEAREST)
    far = float(distances.max()) / radius + reach
    similarity = Similarity(1.0 / radius, np.eye(3), -centre / radius)
    return similarity, Marching(near=near, far=far, shortest_step=2 * reach / 512, growth=0.0)


def fits_object_frame(scene: Capture) -> bool:
    """Return whether the cameras look at one place from outside, and nearly all 3D points, if any, are around it."""
    centre, radius = _object_ball(scene)
    if radius < 1e-9:  # a camera that turned
        return False
    inside = np.linalg.norm(scene.points - centre, axis=1) <= radius
    return len(inside) == 0 or bool(inside.mean() >= OBJECT_PART)


def _object_ball(scene: Capture) -> tuple[np.ndarray, float]:
    """Return the centre and the radius of the smallest ball that fills every camera's view."""
    centre = _focus(scene, _typical_depths(scene))
    # Half of the wider field of view: objects are not seen farther off-axis than by 70 degrees.
    halves_deg = [min(max(frame.camera.fov_deg) / 2, 70.0) for frame in scene.frames]
    views = zip(_distances(scene, centre), halves_deg, strict=True)
    return centre, max(distance * math.tan(math.radians(half)) for distance, half in views)


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
        depths = np.linalg.norm(in_camera, axis=1) if frame.camera.is_spherical else in_camera[:, 2]
        in_camera, depths = in_camera[depths > 0], depths[depths > 0]
        if len(in_camera) == 0:
            continue
        pixels, valid = frame.camera.project(in_camera)
        size = np.array([frame.camera.width, frame.camera.height])
        depths = depths[valid & (pixels >= 0).all(1) & (pixels < size).all(1)]
        if len(depths) >= 10:
            rows.append(np.percentile(depths, [1, 50]))
    return np.array(rows) if rows else None


# Radius, in unit balls, of the ball that a learned background surrounds: anything nearer shows parallax.
BALLS_BEFORE_BACKGROUND = 1.5

_IN_WORDS = {"none": "bounded scene", "l2": "unbounded scene"}


@dataclass(frozen=True)
class Extent:
    """Extent of a field.

    Args:
        contraction: one of `kernels.CONTRACTIONS`.
        training_from_scene: the similarity to the training frame.
        marching: the steps along rays there.
        reach: distance along rays at which the last ray has left the ball that a learned background surrounds; None if
            the field is bounded.
        parallax: shift of a point in the pictures of other cameras when it moves along a ray, relative to its motion:
            about 1 where cameras surround a scene, less where they are close together.
    """

    contraction: str
    training_from_scene: Similarity
    marching: Marching
    reach: float | None = None
    parallax: float = 1.0

    def __str__(self) -> str:
        return _IN_WORDS[self.contraction]

    def to_json(self) -> dict[str, Any]:
        """Return plain values; floats survive a round trip exactly."""
        return {
            "contraction": self.contraction,
            "training_from_scene": self.training_from_scene.to_json(),
            "marching": vars(self.marching),
            "reach": self.reach,
            "parallax": self.parallax,
        }

    @staticmethod
    def from_json(content: dict[str, Any]) -> "Extent":
        """Return the extent that `to_json` described."""
        similarity = Similarity.from_json(content["training_from_scene"])
        marching = Marching(**content["marching"])
        return Extent(content["contraction"], similarity, marching, content["reach"], content["parallax"])

    def before(self, background: str, *, sky_known: bool) -> "Extent":
        """Return the extent for a kind of background, see `Components`: the field ends where a learned one begins.

        Otherwise the initial fog would hide the background for good, and the field would have to paint distant things.
        Pixels that are known to show the sky clear the fog before it: then the field keeps what is far away but not at
        infinity, such as the buildings around a square.
        """
        if background not in LEARNED_BACKGROUNDS or self.reach is None or sky_known:
            return self
        return replace(self, marching=replace(self.marching, far=min(self.marching.far, self.reach)))


def lacks_depth(scene: Capture, settings: TrainSettings, *, is_object: bool) -> bool:
    """Return whether the settings need a depth that the scene lacks, so that points must be triangulated first.

    Args:
        scene: cameras, and points or depth bounds if it has any.
        is_object: whether the photos show nothing but an object, cut out by alpha or before a plain background.
    """
    contraction = _contraction(settings, is_object)
    if contraction == "none" and is_object:
        return False
    return len(scene.points) == 0 and (scene.depth_bounds is None or contraction == "none")


def choose_extent(scene: Capture, settings: TrainSettings, *, is_object: bool) -> Extent:
    """Choose the extent for the settings; for `scene` and `is_object` see `lacks_depth`.

    Raises:
        UserError: the requested contraction is "none", and there are too few points to tell where the scene ends.
    """
    contraction = _contraction(settings, is_object)
    if contraction == "none" and is_object:
        return Extent(contraction, *object_frame(scene))
    if contraction == "none":
        return Extent(contraction, *box_frame(scene))
    if has_narrow_baseline(scene):
        return Extent(contraction, *narrow_frame(scene), parallax=NARROW_SPREAD)
    similarity, marching = contracted_frame(scene)
    farthest = max(float(np.linalg.norm(similarity.apply(frame.centre))) for frame in scene.frames)
    return Extent(contraction, similarity, marching, farthest + BALLS_BEFORE_BACKGROUND)


def _contraction(settings: TrainSettings, is_object: bool) -> str:
    return settings.contraction or ("none" if is_object else "l2")


# Detailed fields end with shorter steps, halved until they are shorter than this many cells of the finest level as seen
# from other cameras: along a ray, a surface is at least as thick as a step, which blurs its edges in their pictures.
CELLS_PER_STEP = 2.0
# Each halving costs a quarter of a training's rays.
MOST_HALVINGS = 2


class RaySteps:
    """The steps along the rays of one training: long ones first, the shortest ones from half of the budget on.

    Gradients are scaled down nearer to a camera than `nearest`: where rays begin, divided by `NEAR_PER_POINT`, at most
    1. That is the distance of the nearest 3D point if the capture has points and no bounds.
    """

    def __init__(self, extent: Extent, settings: FieldSettings, device: torch.device):
        marching = extent.marching
        self._marching, self._detailed = marching, settings.detailed
        self.nearest = min(1.0, marching.near / NEAR_PER_POINT)
        self._halved = 2 ** halvings(marching, settings, extent.parallax)
        self._edges = marching.stretched(1 / self._halved).edges().to(device, torch.float32)

    @property
    def most(self) -> int:
        """Largest number of steps of a ray."""
        return len(self._edges) - 2

    def edges(self, stride: int) -> Tensor:
        """Return the edges of the steps, see `Marching.edges`, for `StepPlan.stride`."""
        return self._edges[:: stride * self._halved or 1].contiguous()

    def render_steps(self, stride: int) -> Marching:
        """Return the steps of pictures of the field: those of the training so far, at most those of the capture.

        Pictures of detailed fields have at most half of the capture's, with which the training had more rays.
        """
        shortest = self._halved if stride == SHORTEST else 1
        return self._marching.stretched(1 / max(2, shortest)) if self._detailed else self._marching


def halvings(marching: Marching, settings: FieldSettings, parallax: float) -> int:
    """Return how often the steps of a capture are halved by the end of a field's training."""
    if not (isinstance(settings, HashFieldSettings) and settings.detailed):
        return 0
    # In contracted space, steps grow with distance as cells do; `growth` is the step at distance 1.
    step = max(marching.shortest_step, marching.growth)
    cells = parallax * step / cube_side(settings.contraction) * settings.finest
    return next((n for n in range(MOST_HALVINGS) if cells / 2**n < CELLS_PER_STEP), MOST_HALVINGS)
