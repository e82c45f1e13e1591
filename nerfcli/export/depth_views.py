"""Depths of a field as seen by the cameras of its photos, from which surfaces and points are made."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.photos.undistorted import pinhole_of
from nerfcli.render.coverage import DepthMap
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.normals import normals_of_points
from nerfcli.render.pictures import render_picture

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
        pose = self.frame.world_from_cam
        return (plane_rays(self.frame.camera) * self.depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]

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
    """Render the views of frames with pinhole cameras.

    Args:
        frames: frames of the photos, with any lens.
        max_size: largest longer side of the pictures, pixels.
        depth: definition of the depth, along the optical axis.
    """
    views = []
    for frame in frames:
        small = replace(frame, camera=small_pinhole(frame.camera, max_size))
        seen = render_picture(model, small, background=model.background, depth=depth)
        assert seen.depth is not None
        assert seen.spread is not None
        assert seen.disagreement is not None
        normals = normals_of(seen.depth, small.camera)
        views.append(DepthView(small, seen.rgb, seen.opacity, seen.depth, seen.spread, seen.disagreement, normals))
        on_progress(len(views) / len(frames))
    return views


def small_pinhole(camera: Camera, max_size: int) -> Camera:
    """Return the pinhole camera for a lens, with a longer side of at most `max_size` pixels."""
    factor = max(1.0, max(camera.size) / max_size)
    pinhole = pinhole_of(camera)
    return pinhole.resized(max(1, round(camera.width / factor)), max(1, round(camera.height / factor)))


def spread_frames(frames: Sequence[Frame], count: int) -> list[Frame]:
    """Choose at most `count` frames, evenly spread in their order."""
    if len(frames) <= count:
        return list(frames)
    return [frames[index] for index in np.unique(np.linspace(0, len(frames) - 1, count).astype(int))]


def plane_rays(camera: Camera) -> np.ndarray:
    """Return directions (H, W, 3) with z = 1 through a pinhole camera's pixel centres, in its axes."""
    fx, fy, cx, cy = camera.params
    x, y = (np.arange(camera.width) + 0.5 - cx) / fx, (np.arange(camera.height) + 0.5 - cy) / fy
    return np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)


def normals_of(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the normals of a pinhole camera's depth map along the optical axis; see `normals_of_points`."""
    return normals_of_points(plane_rays(camera) * depth[..., None], depth)
