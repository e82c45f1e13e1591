"""Depths of a field in the views of its photos, from which surfaces and points are made, and colours of surfaces."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import apply, from_parts, rotation_from_vector
from nerfcli.photos.colours import to_8_bit
from nerfcli.photos.loading import pinhole_frame
from nerfcli.render.coverage import DepthMap, normals_of_points, small_frame
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.render.tracing import render_rays

# Rotations panorama_from_face of the faces of a cube: front, right, back, left, up, down.
_TURNS = rotation_from_vector(
    np.pi / 2 * np.array([[0.0, 0, 0], [0, 1, 0], [0, 2, 0], [0, -1, 0], [-1, 0, 0], [1, 0, 0]])
)
# The median depth: a little light that ends before or behind a surface does not change it.
DEPTH = DepthRequest("median", "z")


@dataclass(frozen=True)
class DepthView:
    """View of a field by a pinhole camera: (H, W) float32, scene units along the optical axis, NaN where undefined.

    Args:
        rgb: (H, W, 3) sRGB on the background.
        opacity: opacity of each pixel, in [0, 1].
        depth: the requested depth, by default the median, which needs an opacity of at least 0.5.
        spread, disagreement: as in `RenderedPicture`.
        normals: (H, W, 3) unit, towards the camera, in its axes; NaN where the depths around form no surface.
    """

    frame: Frame
    rgb: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray
    spread: np.ndarray
    disagreement: np.ndarray
    normals: np.ndarray

    def points(self) -> np.ndarray:
        """Return the points (H, W, 3) in the scene's frame; NaN where there is no depth."""
        return apply(self.frame.world_from_cam, plane_rays(self.frame.camera) * self.depth[..., None])

    def distances(self) -> DepthMap:
        """Return the depths as distances along the rays."""
        return DepthMap(self.frame, self.depth * np.linalg.norm(plane_rays(self.frame.camera), axis=-1))

    def cosines(self) -> np.ndarray:
        """Return cosines (H, W) between surface normal and direction to the camera; 0 where there is no normal."""
        rays = plane_rays(self.frame.camera)
        return np.nan_to_num(-(self.normals * rays).sum(-1) / np.linalg.norm(rays, axis=-1)).clip(0.0, 1.0)


def depth_views(
    model: Model,
    frames: Sequence[Frame],
    *,
    max_size: int,
    depth: DepthRequest = DEPTH,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> list[DepthView]:
    """Render the views of frames with pinhole cameras; of a panorama, the six faces of a cube."""
    views = []
    small_frames = [small for frame in frames for small in _small_pinholes(frame, max_size)]
    for small in small_frames:
        seen = render_picture(model, small, background=model.background, depth=depth)
        assert seen.depth is not None
        assert seen.spread is not None
        assert seen.disagreement is not None
        normals = normals_of(seen.depth, small.camera)
        views.append(DepthView(small, seen.rgb, seen.opacity, seen.depth, seen.spread, seen.disagreement, normals))
        on_progress(len(views) / len(small_frames))
    return views


def _small_pinholes(frame: Frame, max_size: int) -> list[Frame]:
    """Return frames of pinhole cameras that see what a frame sees, their longer sides at most `max_size` pixels.

    The six faces of a panorama have half of this size, because their pixels are kept in memory, too.
    """
    camera, pose = frame.camera, frame.world_from_cam
    if not camera.is_spherical:
        return [small_frame(pinhole_frame(frame), max_size)]
    side = max(1, min(camera.width // 4, max_size // 2))
    face = Camera.pinhole(side, side, side / 2)  # 90 degrees
    poses = [from_parts(pose[:3, :3] @ turn, pose[:3, 3]) for turn in _TURNS]
    return [replace(frame, camera=face, world_from_cam=turned) for turned in poses]


def plane_rays(camera: Camera) -> np.ndarray:
    """Return directions (H, W, 3) with z = 1 through a pinhole camera's pixel centres, in its axes."""
    fx, fy, cx, cy = camera.params
    x, y = (np.arange(camera.width) + 0.5 - cx) / fx, (np.arange(camera.height) + 0.5 - cy) / fy
    return np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)


def normals_of(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the normals of a pinhole camera's depth map along the optical axis; see `normals_of_points`."""
    return normals_of_points(plane_rays(camera) * depth[..., None], depth)


# Viewing directions of a point without a surface.
_AXES = np.concatenate([np.eye(3), -np.eye(3)])


def surface_colours(model: Model, points: np.ndarray, normals: np.ndarray, *, voxel_size: float) -> np.ndarray:
    """Return the colours (N, 3) uint8 of surface points (N, 3), seen from outside along their unit normals (N, 3).

    The colour is that of a ray through a few voxels around the surface, excluding everything farther behind. If the
    ray is nearly transparent, it is the field's colour at the point.
    """
    to_training = model.training_from_scene
    # Rays to a surface cover three voxels before and behind it, in 24 steps.
    reach = 3.0 * voxel_size * to_training.scale
    cuts = torch.linspace(0.0, 2 * reach, 25)
    inwards = -normals @ to_training.rotation.T
    starts = to_training.apply(points) - reach * inwards
    colours, opacity = _looked_at(model, starts, inwards, cuts)
    thin = opacity < 0.1
    if thin.any():
        colours[thin] = point_colours(model, points[thin])
    return to_8_bit(colours)


def point_colours(model: Model, points: np.ndarray) -> np.ndarray:
    """Return colours (N, 3) in [0, 1] of points, averaged over six directions; 0 in unoccupied cells."""
    places = model.training_from_scene.apply(points)
    # A ray of a single interval evaluates the field only at its middle, which is the point.
    cuts = torch.tensor([0.0, 2.0])
    total = np.zeros((len(points), 3))
    for axis in _AXES:
        directions = np.broadcast_to(axis, places.shape)
        total += _looked_at(model, places - axis, directions, cuts)[0] / len(_AXES)
    return total


def _looked_at(
    model: Model, starts: np.ndarray, directions: np.ndarray, cuts: torch.Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Render rays between the first and last cut: colours (N, 3) without background, and opacities (N,)."""
    colours, opacities = [], []
    block = 2**15
    for first in range(0, len(starts), block):
        part = slice(first, first + block)
        origins, towards = (
            torch.from_numpy(np.array(values[part], dtype=np.float32)).to(model.device)
            for values in (starts, directions)
        )
        # Rendering tolerance, far below a level of 8-bit colours.
        seen = render_rays(
            model,
            origins,
            towards,
            cuts=cuts.to(origins),
            background=torch.zeros(3, device=model.device),
            tolerance=1e-4,
        )
        opacity = seen.ends.opacity
        colours.append((seen.rgb / opacity[:, None].clamp_min(1e-9)).clamp(0.0, 1.0).cpu().numpy())
        opacities.append(opacity.cpu().numpy())
    if not colours:
        return np.zeros((0, 3)), np.zeros(0)
    return np.concatenate(colours).astype(np.float64), np.concatenate(opacities).astype(np.float64)
