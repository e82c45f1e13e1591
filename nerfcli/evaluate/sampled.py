"""Evaluation on random pixels of held-out photos: a cheap estimate of `evaluate` on whole photos."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from nerfcli.evaluate.metrics import compare
from nerfcli.evaluate.photos import HeldOutPhoto, as_exposed, background_of, without_hidden
from nerfcli.evaluate.protocol import PROTOCOL
from nerfcli.field.background import colours_behind
from nerfcli.photos.colours import over_white
from nerfcli.render.model import Model
from nerfcli.render.pictures import Renderable
from nerfcli.render.tracing import pixel_rays, render_rays

SAMPLED_PIXELS = 2**14
# Rays that are rendered at a time.
_RAYS = 4096


@dataclass(frozen=True)
class SampledPixels:
    """Random pixels of held-out photos, equally many of each, and the same for every field that is measured.

    photos: those of which masks leave something. pixels: for each, the indices of its pixels, counted row by row.
    """

    photos: tuple[HeldOutPhoto, ...]
    pixels: tuple[np.ndarray, ...]

    @staticmethod
    def drawn(photos: Sequence[HeldOutPhoto], *, seed: int) -> "SampledPixels":
        """Draw `SAMPLED_PIXELS` in total, equally many per photo, or all of a photo's usable pixels if it has fewer.

        Raises:
            UserError: masks hide all photos.
        """
        photos = without_hidden(photos)
        generator = np.random.default_rng(seed)
        wanted = -(-SAMPLED_PIXELS // len(photos))
        chosen = []
        for photo in photos:
            count = photo.pixels.shape[0] * photo.pixels.shape[1]
            usable = np.arange(count) if photo.used is None else np.flatnonzero(photo.used)
            chosen.append(np.sort(generator.choice(usable, size=min(wanted, len(usable)), replace=False)))
        return SampledPixels(tuple(photos), tuple(chosen))

    def protocol(self) -> str:
        """Describe the measurement."""
        sizes = sorted({f"{photo.pixels.shape[1]}x{photo.pixels.shape[0]}" for photo in self.photos})
        return (
            f"{PROTOCOL}, sampled: {sum(map(len, self.pixels))} random pixels of {len(self.photos)} held-out photos at "
            f"{' '.join(sizes)}, sRGB 8 bit, mean over photos; PSNR"
        )

    @torch.no_grad()
    def psnr(self, model: Model) -> float:
        """Return the mean over photos of the PSNR on their pixels, in dB, 8 bit, to estimate the mean of `evaluate`."""
        return self._psnr(lambda photo, pixels: _render_sampled(model, photo, pixels))

    def psnr_of_pictures(self, model: Renderable) -> float:
        """Return the same of a model whose whole pictures take less time than these pixels of a field."""

        def render(photo: HeldOutPhoto, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            picture = model.render(photo.frame, background=background_of(model, photo))
            return picture.rgb.reshape(-1, 3)[pixels], picture.opacity.ravel()[pixels], picture.valid.ravel()[pixels]

        return self._psnr(render)

    def _psnr(self, render: Callable[[HeldOutPhoto, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]) -> float:
        """Return the mean PSNR of what a function renders: see `_render_sampled`."""
        values = []
        for photo, pixels in zip(self.photos, self.pixels, strict=True):
            rgb, opacity, valid = render(photo, pixels)
            truth = over_white(photo.pixels).reshape(-1, 3)[pixels]
            if valid.any():
                values.append(compare(as_exposed(photo, rgb, opacity), truth, used=valid).psnr)
        return float(np.mean(values))


def _render_sampled(model: Model, photo: HeldOutPhoto, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours (N, 3) in [0, 1] at pixel centres, in the field's precision, opacities, and which have a ray."""
    dtype = next(model.field.parameters()).dtype
    rays = pixel_rays(photo.frame, model.training_from_scene, pixels=pixels, device=model.device)
    directions, origin = rays.directions.to(dtype), rays.origin.to(dtype)
    behind = colours_behind(background_of(model, photo), directions)
    seen = (
        render_rays(
            model,
            origin.expand_as(some),
            some,
            background=behind[begin : begin + len(some)],
            cones=rays.cones[begin : begin + len(some)].to(dtype),
            keep_intervals=False,
        )
        for begin, some in zip(range(0, len(directions), _RAYS), directions.split(_RAYS), strict=True)
    )
    rgb, opacity = map(torch.cat, zip(*((one.rgb, one.ends.opacity) for one in seen), strict=True))
    return rgb.clamp(0.0, 1.0).cpu().numpy(), opacity.cpu().numpy(), rays.valid.cpu().numpy()
