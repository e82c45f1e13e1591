"""Downscaled held-out photos, and the distance of a rendering of their pixels from a converged one."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch

from nerfcli.evaluate.protocol import HeldOutPhoto
from nerfcli.evaluate.sampled import SampledPixels, render_sampled
from nerfcli.media.images import downscale
from nerfcli.photos.loading import downscaled_camera
from nerfcli.render.accuracy import TIGHT, refined
from nerfcli.render.model import Model
from nerfcli.render.tracing import TOLERANCE, uniform_cuts

# One in this many sampled pixels is rendered again with fine steps.
QUADRATURE_EVERY = 16
# A rendering counts as converged with steps this many times as fine, and next to nothing left out by the early stop.
FINER = 8


@torch.no_grad()
def quadrature(sample: SampledPixels, model: Model) -> float:
    """Return the rms change of a colour in [0, 1] with steps `FINER` times as fine, on some of the pixels."""
    cuts = uniform_cuts(model.marching)
    squares = []
    for photo, pixels in zip(sample.photos, sample.pixels, strict=True):
        some = pixels[::QUADRATURE_EVERY]
        usual, valid = render_sampled(model, photo, some, cuts=cuts, tolerance=TOLERANCE)
        fine, _ = render_sampled(model, photo, some, cuts=refined(cuts, FINER), tolerance=TIGHT)
        squares.append(np.square(usual - fine)[valid].ravel())
    return float(np.sqrt(np.concatenate(squares).mean()))


@torch.no_grad()
def distance_to_float64(model: Model, photo: HeldOutPhoto, *, count: int) -> float:
    """Return the rms change of converged colours, at some pixels, with float64 and steps twice as fine again.

    Float64 runs in plain torch, which defines the operations: the result is the total error of converged pictures from
    rounding, steps that are still too long, and the compiled kernels.
    """
    total = photo.pixels.shape[0] * photo.pixels.shape[1]
    pixels = np.sort(np.random.default_rng(0).choice(total, size=min(count, total), replace=False))
    cuts = uniform_cuts(model.stretched(1 / FINER).marching)
    rgb, valid = render_sampled(model, photo, pixels, cuts=cuts, tolerance=TIGHT)
    exact, _ = render_sampled(
        _in_float64(model), photo, pixels, cuts=refined(cuts, 2), tolerance=TIGHT**2, at_a_time=16
    )
    return float(np.sqrt(np.square(rgb - exact)[valid].mean()))


def smaller(photo: HeldOutPhoto, factor: float) -> HeldOutPhoto:
    """Return the photo with its sides divided by a factor; unchanged if the factor is 1 or less."""
    if factor <= 1.0:
        return photo
    used = None if photo.used is None else downscale(photo.used.astype(np.uint8) * 255, factor) == 255
    frame = replace(photo.frame, camera=downscaled_camera(photo.frame.camera, factor))
    return replace(photo, frame=frame, pixels=downscale(photo.pixels, factor), used=used)


def _in_float64(model: Model) -> Model:
    return replace(model, field=deepcopy(model.field).double())
