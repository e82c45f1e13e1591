"""Held-out photos, loaded as for the training; their pairs with rendered pictures, compared and saved.

Saved pairs have the layout of nerfbaselines, for evaluation with other programs:

predictions/color/NAME.png         the rendered picture, 8 bit sRGB
predictions/gt-color/NAME.png      the photo as it was compared: upright, averaged to the size of the training
predictions/mask/NAME.png          255 where pixels count; only where some do not
predictions/color-float/NAME.npy   the rendered picture before rounding, float32; only on request
"""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.evaluate.billboards import Billboards, reduction
from nerfcli.field.background import Background
from nerfcli.field.exposure import changed_in_front, exposed
from nerfcli.photos.colours import over_white, to_8_bit
from nerfcli.photos.held_out_exposure import gain_sources, log_gains_of
from nerfcli.photos.images import write_png
from nerfcli.photos.loading import LoadedPhoto, downscaled_camera, is_transparent, load_photo
from nerfcli.render.pictures import Renderable, RenderedPicture
from nerfcli.training.runs.run import Run


@dataclass(frozen=True)
class HeldOutPhoto(LoadedPhoto):
    """A held-out photo at the resolution of the training.

    Args:
        log_gains: logarithms of its gains relative to rendered pictures, from EXIF or from the training photos
            around it, never from the photo itself; see `field.exposure`.
        gains_from: the source of the gains, one of `held_out_exposure.SOURCES`.
    """

    log_gains: tuple[float, ...] = (0.0, 0.0, 0.0)
    gains_from: str = "none"

    @property
    def is_hidden(self) -> bool:
        """Whether its mask leaves nothing of it to compare."""
        return self.used is not None and not self.used.any()


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


_CHECK_MASKS = "check the masks: white pixels are used, black ones are ignored"


def background_of(model: Renderable, photo: HeldOutPhoto) -> Background:
    """Return the background of pictures that are compared with a photo: white if the photo has alpha."""
    return (1.0, 1.0, 1.0) if photo.pixels.shape[-1] == 4 else model.background


def paired(photo: HeldOutPhoto, picture: RenderedPicture) -> ComparedImages:
    """Return a held-out photo with its rendered picture, to which the photo's gains are applied.

    Raises:
        UserError: none of its pixels has a ray and is not masked.
    """
    used = picture.valid if photo.used is None else picture.valid & photo.used
    if not used.any():
        raise UserError(f"no pixels of {photo.frame.name} are left to compare", _CHECK_MASKS)
    return ComparedImages(
        photo.frame,
        as_exposed(photo, picture.rgb, picture.opacity),
        over_white(photo.pixels),
        used,
        photo.pixels.shape[-1] == 4,
    )


def as_exposed(photo: HeldOutPhoto, rgb: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Return colours (..., 3) with a photo's gains applied, clipped; unchanged if all gains are 1.

    Args:
        rgb: on the background of the photo's picture; gains do not apply to the white behind a photo with alpha.
        opacity: (...,).
    """
    if not any(photo.log_gains):
        return rgb
    colours, log_gains = torch.from_numpy(rgb), torch.tensor(photo.log_gains)
    if photo.pixels.shape[-1] == 4:
        passing = 1.0 - torch.from_numpy(opacity)[..., None]
        shown = changed_in_front(colours, lambda own: exposed(own, log_gains), transmittance=passing, behind=1.0)
    else:
        shown = exposed(colours, log_gains)
    return shown.clamp(0.0, 1.0).numpy()


def held_out_photos(run: Run, frames: Sequence[Frame], *, left_out_by: Run | None = None) -> list[HeldOutPhoto]:
    """Load held-out photos of a run as for its training, each with its gains, from EXIF or from its neighbours.

    Args:
        left_out_by: a run whose pixels that were left out do not count, instead of those of this run.

    Raises:
        UserError: a photo cannot be read.
    """
    photos, known = (left_out_by or run).photos(frames), run.cameras.exposures
    gains = zip(log_gains_of(frames, known).tolist(), gain_sources(frames, known), strict=True)
    found = []
    for photo, (log_gains, source) in zip(photos, gains, strict=True):
        # Alpha that is opaque is dropped from each: a transparent pixel of one photo puts no other one on white.
        pixels = photo.pixels if is_transparent(photo.pixels) else photo.pixels[..., :3]
        found.append(HeldOutPhoto(photo.frame, pixels, photo.used, tuple(log_gains), source))
    return found


def without_hidden(photos: Sequence[HeldOutPhoto]) -> list[HeldOutPhoto]:
    """Return the photos that are not hidden.

    Raises:
        UserError: masks hide all photos.
    """
    seen = [photo for photo in photos if not photo.is_hidden]
    if not seen:
        raise UserError("no pixels of the photos are left to compare", _CHECK_MASKS)
    return seen


def training_billboards(run: Run, *, notify: Callable[[str], None]) -> Billboards | None:
    """Build the billboards of a run's training photos; None, with a line for the user, if a photo cannot be read."""
    factor, masks = run.config.downscale, run.components.masks

    def loaded(frame: Frame) -> LoadedPhoto:
        trained = replace(frame, camera=downscaled_camera(frame.camera, factor))
        return load_photo(frame, factor * reduction(trained), masks)

    try:
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            photos = list(pool.map(loaded, run.cameras.train))
    except UserError as error:
        notify(f"no comparison with a model without geometry: {error}")
        return None
    return Billboards([photo.frame for photo in photos], [over_white(photo.pixels) for photo in photos])


PREDICTIONS = "predictions"
INFO = "info.json"
# Choices: 8-bit pictures only, or unrounded ones, too.
KINDS = ("png", "float")


def save_compared(folder: Path, stem: str, compared: ComparedImages, *, kind: str) -> None:
    """Write the 8-bit picture, the photo and, where pixels are left out, the mask, in folders of predictions.

    `stem` is the name of the files and may have subfolders; `kind` is one of `KINDS`.
    """
    write_png(folder / "color" / f"{stem}.png", to_8_bit(compared.rendered))
    write_png(folder / "gt-color" / f"{stem}.png", compared.photo)
    if not compared.used.all():
        write_png(folder / "mask" / f"{stem}.png", compared.used.astype(np.uint8) * 255)
    if kind == "float":
        path = folder / "color-float" / f"{stem}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, compared.rendered.astype(np.float32))


def predictions_are_there(folder: Path, kind: str, *, checkpoint: str) -> bool:
    """Return whether predictions of this checkpoint are saved, including unrounded ones if `kind` is "float"."""
    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return info.get("checkpoint_sha256") == checkpoint and kind in (info.get("kind"), "png")
