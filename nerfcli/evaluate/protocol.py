"""The evaluation of a run on its held-out photos: numbers with the name of how they were made."""

import hashlib
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.evaluate.metrics import psnr, ssim, to_8_bit
from nerfcli.field.exposure import exposed
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture

METRICS = "metrics.json"
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class HeldOut:
    """A held-out photo at the resolution of the training.

    Args:
        frame: its camera and pose.
        pixels: (H, W, 3 or 4) uint8 sRGB, straight alpha.
        used: (H, W) bool; None for all pixels.
        log_gain: logarithm of its exposure relative to the model's photos, as EXIF tells it; see `field.exposure`.
    """

    frame: Frame
    pixels: np.ndarray
    used: np.ndarray | None
    log_gain: float = 0.0


def evaluate_model(
    model: Model, held_out: Sequence[HeldOut], *, on_image: Callable[[int, int], None]
) -> dict[str, Any]:
    """PSNR and SSIM of every held-out photo and their means, with the render time beside them.

    Args:
        model: the trained model.
        held_out: the photos, at least one.
        on_image: called with (rays done, rays in all).

    Returns:
        The keys "protocol", "mean", "images" and "render" of metrics.json.

    Raises:
        UserError: nothing was held out, or a mask hides a whole photo.
    """
    if not held_out:
        raise UserError(
            "this run has no held-out photo to evaluate on",
            "the default split holds out every 8th photo; check `nerfcli info RUN` and the scene's split",
        )
    total = sum(photo.pixels.shape[0] * photo.pixels.shape[1] for photo in held_out)
    done = 0

    def on_tile(rays: int) -> None:
        nonlocal done
        done += rays
        on_image(done, total)

    images, seconds = [], []
    for photo in held_out:
        began = time.perf_counter()
        background = WHITE if photo.pixels.shape[-1] == 4 else model.background
        picture = render_picture(model, photo.frame, background=background, on_tile=on_tile)
        seconds.append(time.perf_counter() - began)
        used = picture.valid if photo.used is None else picture.valid & photo.used
        if not used.any():
            raise UserError(
                f"no pixel of {photo.frame.name} is left to compare", "check that its mask is white where pixels count"
            )
        rendered, truth = to_8_bit(_as_exposed(picture.rgb, photo.log_gain)), over_white(photo.pixels)
        images.append(
            {
                "name": photo.frame.name,
                "psnr": psnr(rendered, truth, used=used),
                "ssim": ssim(rendered, truth, used=used),
                "pixels": int(used.sum()),
                "seconds": seconds[-1],
            }
        )
    return {
        "protocol": _protocol_name(held_out),
        "mean": {key: statistics.fmean(image[key] for image in images) for key in ("psnr", "ssim")},
        "images": images,
        "render": {
            "seconds_per_image": statistics.median(seconds),
            "fastest_seconds": min(seconds),
            "slowest_seconds": max(seconds),
        },
    }


def _as_exposed(rgb: np.ndarray, log_gain: float) -> np.ndarray:
    """A picture as a photo of another exposure shows it, clipped."""
    if log_gain == 0.0:
        return rgb
    return exposed(torch.from_numpy(rgb), torch.tensor(log_gain)).clamp(0.0, 1.0).numpy()


def over_white(pixels: np.ndarray) -> np.ndarray:
    """RGBA on white as 8-bit RGB, as the published tables have it; RGB as it is."""
    if pixels.shape[-1] == 3:
        return pixels
    alpha = pixels[..., 3:].astype(np.float64) / 255.0
    return to_8_bit(pixels[..., :3] / 255.0 * alpha + 1.0 - alpha)


def _protocol_name(held_out: Sequence[HeldOut]) -> str:
    sizes = sorted({f"{photo.pixels.shape[1]}x{photo.pixels.shape[0]}" for photo in held_out})
    names = hashlib.sha256("\n".join(photo.frame.name for photo in held_out).encode()).hexdigest()[:12]
    known = ", exposures by EXIF" if any(photo.log_gain for photo in held_out) else ""
    alpha = ", RGBA on white" if any(photo.pixels.shape[-1] == 4 for photo in held_out) else ""
    return (
        f"nerfcli-1: {len(held_out)} held-out photos (names sha256 {names}) at {' '.join(sizes)}, area-averaged, "
        f"sRGB 8 bit{alpha}{known}, mean of per-image PSNR, SSIM with Gaussian window 1.5 (scikit-image)"
    )
