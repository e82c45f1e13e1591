"""Pictures and depth of Gaussian splats."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import torch

from nerfcli import kernels
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.field.background import Background, SphereBackground
from nerfcli.kernels.numba_cpu.splat_compositing import OPAQUE
from nerfcli.kernels.numba_cpu.splats import render_splats, splat_depths
from nerfcli.render.depth import DepthRequest, fractions
from nerfcli.render.pictures import RenderedPicture, depth_maps_of
from nerfcli.splats.gaussians import Gaussians, rows_of
from nerfcli.splats.views import splat_view

# Gaussians nearer to a camera than this fraction of the scene's extent are left out, as by the near plane of viewers.
NEAR = 0.02


@dataclass(frozen=True)
class SplatScene:
    """Gaussians in the scene's frame, with what rendering needs to know.

    Args:
        gaussians: in the scene's frame.
        background: sRGB behind the Gaussians.
        unit: "arbitrary" or "metre".
        unit_source: how the metre is known; None where unknown.
    """

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
        on_tile: Callable[[int], None] | None = None,
    ) -> RenderedPicture:
        """Render a frame of the scene; the same bits for any number of threads.

        Depths are those of a field whose light ends at the means of the Gaussians.

        Args:
            background: sRGB, instead of that of the scene.
            depth: the depth to compute along with the colour; None for none.
            on_tile: called with the number of pixels when they are done.

        Raises:
            UserError: the picture is a whole sphere.
        """
        behind = self.background if background is None or isinstance(background, SphereBackground) else background
        view = splat_view(frame, splats_from_scene=Similarity.identity(), near=self.near)
        seen = render_splats(self.rows, view, np.asarray(behind))
        valid, cosines = _rays_of(frame.camera)
        shape = seen.transmittance.shape
        error = np.where(seen.transmittance <= OPAQUE, seen.transmittance, 0.0).astype(np.float32)
        picture = RenderedPicture(
            np.clip(seen.image, 0.0, 1.0), 1.0 - seen.transmittance, None, None, None, None, error, valid.reshape(shape)
        )
        if on_tile is not None:
            on_tile(valid.size)
        if depth is not None:
            ends = splat_depths(seen, fractions(depth))
            found = depth_maps_of(
                depth,
                ends,
                cosines=torch.from_numpy(cosines),
                unit=1.0,
                valid=torch.from_numpy(valid),
                background_distance=depth.background_distance or 0.0,
            )
            names = ("depth", "spread", "disagreement", "median")
            maps = {name: values.numpy().reshape(shape) for name, values in zip(names, found, strict=True)}
            picture = replace(picture, **maps)
        return picture


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
