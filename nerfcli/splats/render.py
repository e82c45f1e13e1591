"""Splats as a scene that can be rendered; cameras as the kernels of splats take them, any lens as a table."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from scipy.ndimage import spline_filter

from nerfcli import kernels
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError
from nerfcli.field.background import Background, SphereBackground
from nerfcli.kernels.interface import SplatView
from nerfcli.kernels.numba_cpu.splat_compositing import OPAQUE
from nerfcli.kernels.numba_cpu.splats import render_splats, splat_depths
from nerfcli.render.depth import DepthRequest, fractions
from nerfcli.render.pictures import RenderedPicture, depth_maps_of
from nerfcli.splats.gaussians import Gaussians, rows_of

# Coefficients across the picture. Error of a pixel: 1e-6 px for photos, 1e-3 px at 130 degrees.
ACROSS = 96
# Coefficients beyond the picture on each side. The spline's condition at the border decays by 0.27 a coefficient.
_BORDER = 12
# Sizes of the picture beyond its edge up to which the exact lens is tabulated.
_BEYOND = 0.5
# Largest shift of a principal point, in sizes of the picture, for which the table of the centred lens is used.
_SHIFTED = 0.05
# A picture point with larger stereographic coordinates is more than 160 degrees from the optical axis.
_LARGEST = 5.6


def splat_view(frame: Frame, *, splats_from_scene: Similarity, near: float) -> SplatView:
    """Return the camera of a frame, in the frame of the splats.

    Args:
        splats_from_scene: to the frame of the splats.
        near: distance below which Gaussians are left out, in that frame.
    """
    pose = splats_from_scene.apply_pose(frame.world_from_cam)
    rotation = np.ascontiguousarray(pose[:3, :3].T)
    table, first, step = _table_of(frame.camera)
    return SplatView(
        rotation, -rotation @ pose[:3, 3], frame.camera.width, frame.camera.height, float(near), table, first, step
    )


def _table_of(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `lens_table`, made once for all photos of a lens whose principal points differ a little.

    The splines sum to 1, so a shift of the picture is a shift of all coefficients.
    """
    middle = camera.centred()
    shift = np.array(camera.principal_point) - np.array(middle.principal_point)
    if (np.abs(shift) > _SHIFTED * np.array(camera.size)).any():
        return lens_table(camera)
    table, first, step = lens_table(middle)
    return (table + shift[:, None, None] if shift.any() else table), first, step


@lru_cache(maxsize=1024)
def lens_table(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the table of a lens, with the first coefficient's position and the step; see `SplatView`.

    Raises:
        UserError: the picture is a whole sphere.
    """
    if camera.is_spherical:
        raise UserError(
            "splats cannot be fitted to or rendered as 360 degree pictures",
            "use views with another lens: nerfcli render --lens pinhole or fisheye",
        )
    low, high = _extent(camera)
    step = (high - low) / (ACROSS - 1)
    first = low - _BORDER * step
    places = [first[axis] + step[axis] * np.arange(ACROSS + 2 * _BORDER) for axis in (0, 1)]
    s = np.stack(np.meshgrid(*places), axis=-1).reshape(-1, 2)
    pixels = _extended(camera, s).reshape(len(places[1]), len(places[0]), 2)
    table = np.stack([spline_filter(pixels[..., axis], order=3, mode="mirror") for axis in (0, 1)])
    return np.ascontiguousarray(table), first, step


def _extent(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and largest stereographic coordinates (2,) of the picture and a little beyond."""
    across, down = np.linspace(-0.2, 1.2, 57) * camera.width, np.linspace(-0.2, 1.2, 57) * camera.height
    directions, valid = camera.bearings(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    s = directions[valid][:, :2] / np.maximum(1.0 + directions[valid][:, 2:], 1e-6)
    s = s[np.abs(s).max(axis=1) < _LARGEST]
    return s.min(axis=0), s.max(axis=0)


def _extended(camera: Camera, s: np.ndarray) -> np.ndarray:
    """Return the pixels of stereographic coordinates (N, 2), continued linearly where the lens model ends.

    The model also counts as ended where the pixel is far beyond the picture, so that splines stay well behaved.
    """
    inside, outside = _is_known(camera, s).astype(np.float64), np.ones(len(s))
    for _ in range(30):
        middle = (inside + outside) / 2
        good = _is_known(camera, s * middle[:, None])
        inside, outside = np.where(good, middle, inside), np.where(good, outside, middle)
    nearest = s * inside[:, None]
    points, by_s = _points(nearest)
    pixels, _ = camera.project(points)
    jacobian, _, _ = camera.project_jacobian(points)
    return pixels + np.einsum("nij,njk,nk->ni", jacobian, by_s, s - nearest)


def _is_known(camera: Camera, s: np.ndarray) -> np.ndarray:
    """Return whether the lens projects stereographic coordinates (N, 2) into the picture or near it; (N,) bool."""
    pixels, valid = camera.project(_points(s)[0])
    size = np.array(camera.size)
    return valid & (np.abs(pixels - size / 2) <= (0.5 + _BEYOND) * size).all(axis=1)


def _points(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors (N, 3) with stereographic coordinates (N, 2), and their derivatives (N, 3, 2)."""
    square = (s**2).sum(axis=1)
    points = np.stack([2 * s[:, 0], 2 * s[:, 1], 1 - square], axis=-1) / (1 + square)[:, None]
    by_s = np.zeros((len(s), 3, 2))
    by_s[:, 0, 0] = by_s[:, 1, 1] = 2
    by_s[:, 2] = -2 * s
    by_s -= points[:, :, None] * (2 * s)[:, None, :]
    return points, by_s / (1 + square)[:, None, None]


# Gaussians nearer to a camera than this fraction of the scene's extent are left out, as by the near plane of viewers.
NEAR = 0.02


@dataclass(frozen=True)
class SplatScene:
    """Gaussians in the scene's frame, with what rendering needs to know."""

    gaussians: Gaussians
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unit: str = "arbitrary"
    unit_source: str | None = None

    @property
    def thread_safe(self) -> bool:
        """Whether several threads may render it at the same time."""
        return kernels.thread_safe()

    @cached_property
    def rows(self) -> np.ndarray:
        """The Gaussians as rows, see `rows_of`."""
        return rows_of(self.gaussians)

    @cached_property
    def near(self) -> float:
        """Distance below which Gaussians are left out."""
        return near_of(self.gaussians.means)

    def measured_error(self, frame: Frame, *, depth: DepthRequest | None) -> dict[str, float]:
        """Return nothing: splats are composited one by one, without steps whose length could matter."""
        return {}

    def render(
        self,
        frame: Frame,
        *,
        background: Background | None = None,
        depth: DepthRequest | None = None,
        on_tile: Callable[[int], None] = lambda rays: None,
    ) -> RenderedPicture:
        """Render a frame of the scene; the same bits for any number of threads.

        Depths are those of a field whose light ends at the means of the Gaussians.

        Args:
            background: sRGB, instead of that of the scene.
        """
        behind = self.background if background is None or isinstance(background, SphereBackground) else background
        view = splat_view(frame, splats_from_scene=Similarity.identity(), near=self.near)
        seen = render_splats(self.rows, view, np.asarray(behind))
        valid, cosines = _rays_of(frame.camera)
        shape = seen.transmittance.shape
        error = np.where(seen.transmittance <= OPAQUE, seen.transmittance, 0.0).astype(np.float32)
        on_tile(valid.size)
        maps = []
        if depth is not None:
            along, there = torch.from_numpy(cosines), torch.from_numpy(valid)
            found = depth_maps_of(depth, splat_depths(seen, fractions(depth)), cosines=along, unit=1.0, valid=there)
            maps = [values.numpy().reshape(shape) for values in found]
        rgb, opacity = np.clip(seen.image, 0.0, 1.0), 1.0 - seen.transmittance
        return RenderedPicture(rgb, opacity, error, valid.reshape(shape), *maps)


@lru_cache(maxsize=8)  # inverting a lens takes longer than rendering a picture
def _rays_of(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each pixel has a ray, and the cosine of its angle to the optical axis, (H * W,) float32."""
    bearings, valid = camera.pixel_bearings()
    return valid, bearings[:, 2].astype(np.float32)


def near_of(means: np.ndarray) -> float:
    """Return the near distance for Gaussians with these means (N, 3): `NEAR` times their median extent."""
    if not len(means):
        return 0.0
    middle = np.median(means, axis=0)
    return NEAR * float(np.median(np.linalg.norm(means - middle, axis=1)))
