"""Evaluation of a run on its held-out photos: metrics, and the name of the protocol that produced them."""

import hashlib
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError, listed
from nerfcli.evaluate.billboards import Billboards, GeometryComparison, GeometryEvidence
from nerfcli.evaluate.metrics import NAME as LPIPS_NAME
from nerfcli.evaluate.metrics import SMALLEST, Perceptual, as_float, colour_aligned, psnr, ssim, to_8_bit, whole_windows
from nerfcli.evaluate.novelty import novelty
from nerfcli.field.background import Background
from nerfcli.field.exposure import exposed
from nerfcli.render.pictures import Renderable, RenderedPicture

# A photo is far below the others if it lacks this many standard deviations, estimated by the median absolute deviation,
# and this many dB. In sound runs the worst photo lacks up to 2 deviations and 2 dB; where views are uneven, 5 dB.
_DEVIATIONS, _LEAST_DB = 5.0, 6.0
# Standard deviation of a normal distribution over its median absolute deviation.
_NORMAL = 1.4826
# Fewer photos do not show what is usual, and more than this fraction of them are no exceptions.
_FEWEST, _MOST = 5, 0.25


def outliers(images: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the images whose PSNR is far below the median of all, the lowest first.

    Args:
        images: with "name" and "psnr", as in metrics.json.
    """
    if len(images) < _FEWEST:
        return []
    median = statistics.median(image["psnr"] for image in images)
    deviation = _NORMAL * statistics.median(abs(image["psnr"] - median) for image in images)
    limit = median - max(_LEAST_DB, _DEVIATIONS * deviation)
    low = sorted((image for image in images if image["psnr"] < limit), key=lambda image: image["psnr"])
    return low if len(low) <= _MOST * len(images) else []


def outlier_warnings(images: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a warning that names the images far below the others; none if there are none."""
    low = outliers(images)
    if not low:
        return []
    median = statistics.median(image["psnr"] for image in images)
    names = listed([f"{image['name']} ({image['psnr']:.1f} dB)" for image in low])
    return [
        f"far below the median of {median:.1f} dB: {names}. The pose may be wrong, or the photo shows what no "
        "training photo does: nerfcli doctor SCENE checks poses, nerfcli report RUN shows the pictures"
    ]


PROTOCOL = "nerfcli-2"


@dataclass(frozen=True)
class HeldOutPhoto:
    """A held-out photo at the resolution of the training.

    Args:
        frame: its camera and pose.
        pixels: (H, W, 3 or 4) uint8 sRGB, straight alpha.
        used: (H, W) bool; None for all pixels.
        log_gains: logarithms of its gains relative to the model's pictures, from EXIF or from the training photos
            around it, never from the photo itself; see `field.exposure`.
        gains_from: the source of the gains, one of `held_out_exposure.SOURCES`.
    """

    frame: Frame
    pixels: np.ndarray
    used: np.ndarray | None
    log_gains: tuple[float, ...] = (0.0, 0.0, 0.0)
    gains_from: str = "none"


@dataclass(frozen=True)
class ComparedImages:
    """A compared pair: rendered (H, W, 3) float sRGB, the photo (H, W, 3) uint8, and the mask of counted pixels (H, W).

    on_white: whether the photo has alpha and is composited on white. There is then no colour correction: it ignores
    saturated pixels, so it could turn white into any colour.
    """

    frame: Frame
    rendered: np.ndarray
    photo: np.ndarray
    used: np.ndarray
    on_white: bool


@dataclass(frozen=True)
class Extras:
    """Optional measurements.

    Args:
        training: the training views, to measure the novelty of the held-out ones.
        perceptual: LPIPS, if available.
        billboards: a model without geometry to compare the field with.
        keep: called with each compared pair.
    """

    training: Sequence[Frame] = ()
    perceptual: Perceptual | None = None
    billboards: Billboards | None = None
    keep: Callable[[ComparedImages], None] = lambda compared: None


def evaluate_model(
    model: Renderable,
    held_out: Sequence[HeldOutPhoto],
    *,
    on_image: Callable[[int, int], None],
    extras: Extras = Extras(),
) -> dict[str, Any]:
    """Compare the model with every held-out photo: metrics per photo, means, and render time.

    Per photo: psnr, ssim and lpips of the 8-bit picture; psnr_float and ssim_float of the picture before rounding;
    *_colour_aligned after `colour_aligned`. Unknown values are None.

    Args:
        held_out: the photos, at least one.
        on_image: called with (rays done, total rays).

    Returns:
        The keys "protocol", "shape", "warnings", "mean", "images", "kinds" and "render" of metrics.json.

    Raises:
        UserError: nothing was held out, or a mask hides a whole photo.
    """
    if not held_out:
        raise UserError(
            "this run has no held-out photos to evaluate on",
            "by default every 8th photo is held out; check the split with nerfcli info RUN",
        )
    total = sum(photo.pixels.shape[0] * photo.pixels.shape[1] for photo in held_out)
    done = 0

    def on_tile(rays: int) -> None:
        nonlocal done
        done += rays
        on_image(done, total)

    views = novelty([photo.frame for photo in held_out], extras.training) if extras.training else None
    evidence = GeometryComparison(extras.billboards) if extras.billboards is not None else None
    images, seconds = [], []
    for index, photo in enumerate(held_out):
        background = background_of(model, photo)
        began = time.perf_counter()
        picture = model.render(photo.frame, background=background, on_tile=on_tile)
        seconds.append(time.perf_counter() - began)
        compared = compare(photo, picture)
        extras.keep(compared)
        if evidence is not None:
            evidence.add(compared.frame, compared.rendered, compared.photo, compared.used)
        entry: dict[str, Any] = {
            "name": photo.frame.name,
            **measured(compared, extras.perceptual),
            **_counted(photo, picture, compared),
            "exposure": {"from": photo.gains_from, "log_gains": list(photo.log_gains)},
        }
        if views is not None:
            entry["view"] = asdict(views[index])
        images.append(entry | {"seconds": seconds[-1]})
    shape = evidence.shape() if evidence is not None else None
    return {
        "protocol": _protocol_name(held_out, extras),
        "shape": asdict(shape) if shape is not None else None,
        "warnings": [*_warnings(shape, evidence), *outlier_warnings(images)],
        "mean": mean_of(images),
        "images": images,
        "kinds": _kinds(images),
        "render": {
            "seconds_per_image": statistics.median(seconds),
            "fastest_seconds": min(seconds),
            "slowest_seconds": max(seconds),
        },
    }


def _warnings(shape: GeometryEvidence | None, evidence: GeometryComparison | None) -> list[str]:
    if evidence is not None and evidence.failure is not None:
        return [f"the comparison with a model without geometry failed: {evidence.failure}"]
    return [shape.in_words()] if shape is not None and not shape.shown else []


def mean_of(images: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Return the mean over images of each metric; None if an image does not have it."""
    means: dict[str, float | None] = {}
    for key in (key for key in images[0] if key.split("_")[0] in ("psnr", "ssim", "lpips")):
        values = [image[key] for image in images if image[key] is not None]
        means[key] = statistics.fmean(values) if len(values) == len(images) else None
    return means


def background_of(model: Renderable, photo: HeldOutPhoto) -> Background:
    """Return the background of pictures that are compared with a photo: white if the photo has alpha."""
    return (1.0, 1.0, 1.0) if photo.pixels.shape[-1] == 4 else model.background


def over_white(pixels: np.ndarray) -> np.ndarray:
    """Return RGBA composited on white as 8-bit RGB, as in published tables; RGB unchanged."""
    if pixels.shape[-1] == 3:
        return pixels
    alpha = pixels[..., 3:].astype(np.float64) / 255.0
    return to_8_bit(pixels[..., :3] / 255.0 * alpha + 1.0 - alpha)


def compare(photo: HeldOutPhoto, picture: RenderedPicture) -> ComparedImages:
    """Return a held-out photo with its rendered picture, to which the photo's gains are applied.

    Raises:
        UserError: a mask hides the whole photo.
    """
    used = picture.valid if photo.used is None else picture.valid & photo.used
    if not used.any():
        raise UserError(
            f"no pixels of {photo.frame.name} are left to compare",
            "check its mask: white pixels are used, black ones are ignored",
        )
    return ComparedImages(
        photo.frame,
        as_exposed(picture.rgb, photo.log_gains),
        over_white(photo.pixels),
        used,
        photo.pixels.shape[-1] == 4,
    )


def as_exposed(rgb: np.ndarray, log_gains: tuple[float, ...]) -> np.ndarray:
    """Return a picture with a photo's gains applied, clipped; unchanged if all gains are 1."""
    if not any(log_gains):
        return rgb
    return exposed(torch.from_numpy(rgb), torch.tensor(log_gains)).clamp(0.0, 1.0).numpy()


def measured(compared: ComparedImages, perceptual: Perceptual | None) -> dict[str, float | None]:
    """Return the metrics of a compared pair, see `evaluate_model`."""
    truth, used = compared.photo, compared.used
    rounded = to_8_bit(compared.rendered)
    raw = {
        **_close(rounded, truth, used=used, suffix=""),
        "lpips": _lpips(rounded, truth, used=used, perceptual=perceptual),
        **_close(compared.rendered, truth, used=used, suffix="_float"),
    }
    if compared.on_white:
        return {**raw, "psnr_colour_aligned": None, "ssim_colour_aligned": None, "lpips_colour_aligned": None}
    corrected = to_8_bit(colour_aligned(as_float(compared.rendered), as_float(truth), used=used))
    return {
        **raw,
        **_close(corrected, truth, used=used, suffix="_colour_aligned"),
        "lpips_colour_aligned": _lpips(corrected, truth, used=used, perceptual=perceptual),
    }


def _close(picture: np.ndarray, truth: np.ndarray, *, used: np.ndarray, suffix: str) -> dict[str, float | None]:
    return {
        f"psnr{suffix}": psnr(picture, truth, used=used),
        f"ssim{suffix}": ssim(picture, truth, used=used),
    }


def _lpips(picture: np.ndarray, truth: np.ndarray, *, used: np.ndarray, perceptual: Perceptual | None) -> float | None:
    if perceptual is None or min(used.shape) < SMALLEST:
        return None
    # The network needs whole pictures: both get the photo's colours where pixels do not count.
    return perceptual(as_float(np.where(used[..., None], picture, truth)), as_float(truth))


def _counted(photo: HeldOutPhoto, picture: RenderedPicture, compared: ComparedImages) -> dict[str, int]:
    return {
        "pixels": int(compared.used.sum()),
        "masked_pixels": 0 if photo.used is None else int((~photo.used).sum()),
        "pixels_without_ray": int((~picture.valid).sum()),
        "whole_windows": int(whole_windows(compared.used).sum()),
    }


def _kinds(images: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the means over the views of each kind, interpolation and extrapolation."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for image in images:
        if "view" in image:
            groups.setdefault(image["view"]["kind"], []).append(image)
    return {kind: {"images": len(group), **mean_of(group)} for kind, group in sorted(groups.items())}


def _protocol_name(held_out: Sequence[HeldOutPhoto], extras: Extras) -> str:
    sizes = sorted({f"{photo.pixels.shape[1]}x{photo.pixels.shape[0]}" for photo in held_out})
    names = hashlib.sha256("\n".join(photo.frame.name for photo in held_out).encode()).hexdigest()[:12]
    sources = {photo.gains_from for photo in held_out} - {"none"}
    exposures = f", exposures by {' or '.join(sorted(sources))}" if sources else ""
    alpha = ", RGBA on white" if any(photo.pixels.shape[-1] == 4 for photo in held_out) else ""
    lpips = f"{LPIPS_NAME} (torchmetrics)" if extras.perceptual is not None else "no LPIPS"
    return (
        f"{PROTOCOL}: {len(held_out)} held-out photos (names sha256 {names}) at {' '.join(sizes)}, area-averaged, "
        f"sRGB 8 bit{alpha}{exposures}, mean of per-image values; PSNR; SSIM with Gaussian window 1.5, 11 x 11, of "
        f"windows inside the picture that hold no masked pixel (scikit-image); {lpips}; float: before rounding; "
        f"colour_aligned: quadratic colour correction fitted to the held-out photo (multinerf)"
    )
