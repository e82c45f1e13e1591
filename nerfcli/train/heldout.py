"""A quick look at held-out pixels during training; the full numbers are the business of `evaluate`."""

import math
from collections.abc import Sequence

import torch

from nerfcli.cameras.rigid import Similarity
from nerfcli.render.model import Model
from nerfcli.render.tracing import render_rays
from nerfcli.train.losses import over_background
from nerfcli.train.photos import Photo, PixelPool

PIXELS = 4096
SEED = 1


class HeldoutPixels:
    """The same few thousand random pixels of the held-out photos, whenever it is asked."""

    def __init__(self, photos: Sequence[Photo], training_from_scene: Similarity, device: torch.device):
        pool = PixelPool(photos, training_from_scene, device)
        generator = torch.Generator(device=device).manual_seed(SEED)
        self.origins, self.directions, self.colours, _ = pool.draw(PIXELS, generator)

    @torch.no_grad()
    def psnr(self, model: Model) -> float:
        """PSNR in dB over these pixels together, clipped to [0, 1], on the model's background."""
        background = self.colours.new_tensor(model.background)
        rendered = render_rays(model, self.origins, self.directions, background=background).rgb
        wanted = over_background(self.colours, background.expand(len(self.colours), 3))
        error = (rendered.clamp(0.0, 1.0) - wanted).square().mean().item()
        return -10.0 * math.log10(max(error, 1e-12))
