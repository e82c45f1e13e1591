"""Held-out photos, and random pixels of them: how far a field is from what was seen, and its rendering from itself."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.frame import Frame
from nerfcli.evaluate.metrics import psnr, to_8_bit
from nerfcli.evaluate.protocol import WHITE, HeldOut, as_exposed, over_white
from nerfcli.field.background import Background, colours_behind
from nerfcli.media.images import downscale
from nerfcli.render.accuracy import TIGHT, refined
from nerfcli.render.model import Model
from nerfcli.render.rays import CENTRES, pixel_rays
from nerfcli.render.tracing import TOLERANCE, render_cut_rays, uniform_cuts
from nerfcli.train.held_out_exposure import log_gains_of
from nerfcli.train.photos import downscaled_camera, load_photos
from nerfcli.train.settings import TrainSettings

SAMPLED_PIXELS = 2**14
# Every so many of the sampled pixels are rendered again with fine steps.
QUADRATURE_EVERY = 16
# Converged is what steps this many times as fine give, with next to nothing left out.
FINER = 8
_RAYS_AT_A_TIME = 4096


@dataclass(frozen=True)
class SampledPixels:
    """The same random pixels of all held-out photos, as many of each, whatever field is looked at.

    Args:
        photos: the held-out photos.
        pixels: for each, which of its pixels, counted row by row.
    """

    photos: tuple[HeldOut, ...]
    pixels: tuple[np.ndarray, ...]

    @staticmethod
    def drawn(photos: Sequence[HeldOut], *, seed: int) -> "SampledPixels":
        """`SAMPLED_PIXELS` in all, or every pixel that counts where there are fewer."""
        generator = np.random.default_rng(seed)
        wanted = -(-SAMPLED_PIXELS // len(photos))
        chosen = []
        for photo in photos:
            count = photo.pixels.shape[0] * photo.pixels.shape[1]
            usable = np.arange(count) if photo.used is None else np.flatnonzero(photo.used)
            chosen.append(np.sort(generator.choice(usable, size=min(wanted, len(usable)), replace=False)))
        return SampledPixels(tuple(photos), tuple(chosen))

    @torch.no_grad()
    def psnr(self, model: Model) -> float:
        """Mean over the photos of the PSNR on their pixels, in dB, 8 bit as in `evaluate`: an estimate of its mean."""
        cuts = uniform_cuts(model.marching)
        values = []
        for photo, pixels in zip(self.photos, self.pixels, strict=True):
            rgb, valid = _rendered(model, photo, pixels, cuts=cuts, tolerance=TOLERANCE)
            truth = over_white(photo.pixels).reshape(-1, 3)[pixels]
            if valid.any():
                values.append(psnr(to_8_bit(as_exposed(rgb, photo.log_gains)), truth, used=valid))
        return float(np.mean(values))

    @torch.no_grad()
    def quadrature(self, model: Model) -> float:
        """Root mean square of what steps `FINER` times as fine change of a colour in [0, 1], on some of the pixels."""
        cuts = uniform_cuts(model.marching)
        squares = []
        for photo, pixels in zip(self.photos, self.pixels, strict=True):
            some = pixels[::QUADRATURE_EVERY]
            usual, valid = _rendered(model, photo, some, cuts=cuts, tolerance=TOLERANCE)
            fine, _ = _rendered(model, photo, some, cuts=refined(cuts, FINER), tolerance=TIGHT)
            squares.append(np.square(usual - fine)[valid].ravel())
        return float(np.sqrt(np.concatenate(squares).mean()))


@torch.no_grad()
def distance_to_float64(model: Model, photo: HeldOut, *, seed: int, count: int) -> float:
    """Root mean square of what float64 and steps twice as fine again change of the converged colours of some pixels.

    Float64 goes through plain torch, which defines the operations: so much of the converged pictures is rounding,
    steps that are still too long, and the compiled kernels together.
    """
    total = photo.pixels.shape[0] * photo.pixels.shape[1]
    pixels = np.sort(np.random.default_rng(seed).choice(total, size=min(count, total), replace=False))
    cuts = uniform_cuts(model.stretched(1 / FINER).marching)
    rgb, valid = _rendered(model, photo, pixels, cuts=cuts, tolerance=TIGHT)
    exact, _ = _rendered(_in_float64(model), photo, pixels, cuts=refined(cuts, 2), tolerance=TIGHT**2, at_a_time=16)
    return float(np.sqrt(np.square(rgb - exact)[valid].mean()))


def held_out_photos(frames: Sequence[Frame], model: Model, *, settings: TrainSettings) -> list[HeldOut]:
    """The photos as they would be trained on, each as bright as EXIF says beside those of the model.

    Args:
        frames: with their images and masks.
        model: that they are compared with.
        settings: of a training, with its downscale.

    Raises:
        UserError: a photo cannot be read.
    """
    assert settings.downscale is not None
    masks = settings.components.masks
    photos = load_photos(frames, factor=settings.downscale, threads=settings.threads, masks=masks)
    gains = log_gains_of(frames, model).tolist()
    return [
        HeldOut(photo.frame, photo.pixels, photo.used, log_gains=tuple(gain))
        for photo, gain in zip(photos, gains, strict=True)
    ]


def smaller(photo: HeldOut, factor: float) -> HeldOut:
    """The photo with its sides divided by a factor; as it is where that is 1 or less."""
    if factor <= 1.0:
        return photo
    used = None if photo.used is None else downscale(photo.used.astype(np.uint8) * 255, factor) == 255
    frame = replace(photo.frame, camera=downscaled_camera(photo.frame.camera, factor))
    return HeldOut(frame, downscale(photo.pixels, factor), used, photo.log_gains)


def background_of(model: Model, photo: HeldOut) -> Background:
    """What is behind the field where a photo is compared with it."""
    return WHITE if photo.pixels.shape[-1] == 4 else model.background


def _in_float64(model: Model) -> Model:
    return replace(model, field=deepcopy(model.field).double())


def _rendered(
    model: Model,
    photo: HeldOut,
    pixels: np.ndarray,
    *,
    cuts: Tensor,
    tolerance: float,
    at_a_time: int = _RAYS_AT_A_TIME,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (N, 3) in [0, 1] of the centres of pixels in the field's precision, and which of them have a ray."""
    dtype = next(model.field.parameters()).dtype
    rays = pixel_rays(photo.frame, model.training_from_scene, pixels=pixels, places=CENTRES, device=model.device)
    directions, origin = rays.directions.to(dtype), rays.origin.to(dtype)
    behind = colours_behind(background_of(model, photo), directions)
    colours = [
        render_cut_rays(
            model,
            origin.expand_as(some),
            some,
            cuts=cuts.to(some),
            background=behind[begin : begin + len(some)],
            shares=(),
            tolerance=tolerance,
            cones=rays.cones[begin : begin + len(some)].to(dtype),
        ).rgb
        for begin, some in zip(range(0, len(directions), at_a_time), directions.split(at_a_time), strict=True)
    ]
    return torch.cat(colours).clamp(0.0, 1.0).cpu().numpy(), rays.valid.cpu().numpy()
