"""A quick PSNR on a sample of held-out pixels, for waypoints; `evaluate` computes the full metrics."""

from collections.abc import Sequence

import numpy as np
import torch

from nerfcli.cameras.rigid import Similarity
from nerfcli.field.background import colours_behind
from nerfcli.field.exposure import exposed
from nerfcli.fit.losses import over_background
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.photos.pool import PixelPool
from nerfcli.photos.psnr import psnr_of
from nerfcli.photos.storage import IN_MEMORY, PhotoStorage
from nerfcli.render.model import Model
from nerfcli.render.tracing import render_rays

PIXELS = 4096
SEED = 1
# All rays at once would take half a gigabyte while space is still full of fog.
RAYS_AT_A_TIME = 512


class HeldoutPixels:
    """A fixed sample of a few thousand distinct pixels of the held-out photos, or most of them if there are fewer.

    Args:
        photos: the held-out photos.
        training_from_scene: the normalisation.
        device: for the pixels.
        colours, storage: see `PixelPool`.
    """

    def __init__(
        self,
        photos: Sequence[LoadedPhoto],
        training_from_scene: Similarity,
        device: torch.device,
        *,
        colours: np.ndarray | None = None,
        storage: PhotoStorage = IN_MEMORY,
    ):
        pool = PixelPool(photos, training_from_scene, device, colours=colours, storage=storage)
        generator = torch.Generator(device=device).manual_seed(SEED)
        numbers = pool.numbers(PIXELS, generator).unique()
        self.origins, self.directions, self.colours = pool.rays_of(numbers)[:3]
        self.cones = pool.cones[pool.photo_of(numbers)]
        self.photos = pool.photo_of(numbers)

    @torch.no_grad()
    def psnr(self, model: Model, *, log_gains: np.ndarray) -> float:
        """Return the PSNR in dB over all these pixels, clipped to [0, 1], on the model's background.

        Args:
            model: to be measured.
            log_gains: (photos, 3) of the photos relative to the model's pictures; see `held_out_exposure`.
        """
        background = colours_behind(model.background, self.directions)
        parts = zip(
            *(rays.split(RAYS_AT_A_TIME) for rays in (self.origins, self.directions, self.cones, background)),
            strict=True,
        )
        rendered = torch.cat(
            [render_rays(model, *rays, background=behind, cones=cones).rgb for *rays, cones, behind in parts]
        )
        wanted = over_background(self.colours, background)
        if log_gains.any():
            rendered = exposed(rendered, torch.as_tensor(log_gains).to(rendered)[self.photos])
        error = (rendered.clamp(0.0, 1.0) - wanted).square().mean().item()
        return psnr_of(error)
