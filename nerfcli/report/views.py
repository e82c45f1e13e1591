"""Held-out photos beside what runs render of them: picture, error and depth, each as 8-bit colours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.evaluate.metrics import psnr, ssim, to_8_bit
from nerfcli.evaluate.protocol import HeldOut, over_white
from nerfcli.media.colour_maps import levels_of
from nerfcli.media.preview import coloured
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.report.facts import RunFacts
from nerfcli.train.photos import load_photos

# Mean absolute difference of the channels that has the last colour of error maps, sRGB in [0, 1].
ERROR_RANGE = 0.2
ERROR_COLOURS, DEPTH_COLOURS = "viridis", "turbo"
# Of all valid depths of a run, the shares at the ends of its range of colours.
_RANGE_PERCENT = (1, 99)
_WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Seen:
    """What a run renders of a held-out photo.

    Args:
        name: of the photo.
        photo, picture, error, depth: (H, W, 3) uint8 sRGB; RGBA photos on white.
        psnr, ssim: between picture and photo over the pixels that count, as in `evaluate`.
        with_depth: share of the pixels that have a depth.
    """

    name: str
    photo: np.ndarray
    picture: np.ndarray
    error: np.ndarray
    depth: np.ndarray
    psnr: float
    ssim: float
    with_depth: float


@dataclass(frozen=True)
class Look:
    """All that a run renders, and the range of depths that its colours span, in the unit of the scene."""

    views: tuple[Seen, ...]
    depth_range: tuple[float, float]


def held_out_of(run: RunFacts, count: int, *, threads: int) -> list[HeldOut]:
    """At most `count` held-out photos of a run as it was trained on, chosen by `spread_evenly`.

    Photos whose mask leaves nothing to compare are left out.

    Raises:
        UserError: a photo cannot be read.
    """
    quality = {image["name"]: image["psnr"] for image in (run.metrics or {}).get("images", [])}
    chosen = set(spread_evenly([frame.name for frame in run.frames["test"]], count, quality=quality))
    frames = [frame for frame in run.frames["test"] if frame.name in chosen]
    photos = load_photos(frames, factor=run.config["settings"]["downscale"], threads=threads)
    return [
        HeldOut(photo.frame, photo.pixels, photo.used) for photo in photos if photo.used is None or photo.used.any()
    ]


def look_at(
    model: Model, held_out: Sequence[HeldOut], *, depth: DepthRequest, on_share: Callable[[float], None]
) -> Look:
    """Render held-out photos of a run.

    Args:
        model: the trained model.
        held_out: the photos, whose masks leave pixels to compare.
        depth: which depth to show; the same range of colours for all photos.
        on_share: called with how much of it is done, in [0, 1].
    """
    pictures = []
    for photo in held_out:
        background = _WHITE if photo.pixels.shape[-1] == 4 else model.background
        pictures.append(render_picture(model, photo.frame, background=background, depth=depth))
        on_share(len(pictures) / len(held_out))
    depths = [picture.depth for picture in pictures if picture.depth is not None]
    valid = np.concatenate([values[np.isfinite(values)] for values in depths]) if depths else np.empty(0)
    low, high = np.percentile(valid, _RANGE_PERCENT).tolist() if len(valid) else (0.0, 1.0)
    views = []
    for photo, picture, values in zip(held_out, pictures, depths, strict=True):
        used = picture.valid if photo.used is None else picture.valid & photo.used
        truth, rendered = over_white(photo.pixels), to_8_bit(picture.rgb)
        views.append(
            Seen(
                name=photo.frame.name,
                photo=truth,
                picture=rendered,
                error=error_map(rendered, truth, used=used),
                depth=coloured(values, lo=low, hi=high, colour_map=DEPTH_COLOURS),
                psnr=psnr(rendered, truth, used=used),
                ssim=ssim(rendered, truth, used=used),
                with_depth=float(np.isfinite(values).mean()),
            )
        )
    return Look(tuple(views), (low, high))


def error_map(picture: np.ndarray, photo: np.ndarray, *, used: np.ndarray) -> np.ndarray:
    """Mean absolute difference of the channels in colours, the last from `ERROR_RANGE` on; grey where none counts.

    Args:
        picture, photo: (H, W, 3) uint8.
        used: (H, W) bool.

    Returns:
        (H, W, 3) uint8.
    """
    difference = np.abs(picture.astype(np.float64) - photo).mean(-1) / 255.0
    level = np.rint(np.clip(difference / ERROR_RANGE, 0.0, 1.0) * 255.0).astype(np.uint8)
    colours = levels_of(ERROR_COLOURS)[level]
    colours[~used] = 128
    return colours


def spread_evenly(names: Sequence[str], count: int, *, quality: dict[str, float]) -> list[str]:
    """At most `count` of the names, in their order: the worst, the best, and evenly between by rank of quality.

    Args:
        names: of held-out photos.
        count: >= 0.
        quality: PSNR by name where it is known; where it is not of all, the names are spread by their order.
    """
    if len(names) <= count:
        return list(names)
    if count == 0:
        return []
    ranked = sorted(names, key=lambda name: quality[name]) if all(name in quality for name in names) else list(names)
    ranks = np.rint(np.linspace(0, len(ranked) - 1, count)).astype(int)
    chosen = {ranked[rank] for rank in ranks}
    return [name for name in names if name in chosen]
