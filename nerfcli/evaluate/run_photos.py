"""Photos of a run, loaded as for its training: the held-out ones, and the training photos on billboards."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.evaluate.billboards import Billboards, reduction
from nerfcli.evaluate.protocol import HeldOutPhoto, over_white
from nerfcli.photos.loading import downscaled_camera, load_photos
from nerfcli.render.held_out_exposure import gain_sources, log_gains_of
from nerfcli.render.model import Model
from nerfcli.training.runs.run import Run, RunConfig


def held_out_photos(
    frames: Sequence[Frame], model: Model, *, downscale: int, masks: str, threads: int
) -> list[HeldOutPhoto]:
    """Load photos as for training, each with its gains relative to the model, from EXIF or from its neighbours.

    Args:
        frames: with their images and masks.
        model: the model that they are compared with.
        downscale: the factor of the training.
        masks: the meaning of black in masks, see `Components`.

    Raises:
        UserError: a photo cannot be read.
    """
    photos = load_photos(frames, factor=downscale, threads=threads, masks=masks)
    exposed = zip(photos, log_gains_of(frames, model).tolist(), gain_sources(frames, model), strict=True)
    return [
        HeldOutPhoto(photo.frame, photo.pixels, photo.used, log_gains=tuple(gains), gains_from=source)
        for photo, gains, source in exposed
    ]


def held_out_photos_of(config: RunConfig, frames: Sequence[Frame], model: Model, *, threads: int) -> list[HeldOutPhoto]:
    """Load held-out photos of a run; see `held_out_photos`."""
    masks = config.components.masks
    return held_out_photos(frames, model, downscale=config.downscale, masks=masks, threads=threads)


def training_billboards(run: Run, *, notify: Callable[[str], None]) -> Billboards | None:
    """Build the billboards of a run's training photos; None, with a line for the user, if a photo cannot be read."""
    factor, masks = run.config.downscale, run.components.masks
    small, cameras = [], []
    try:
        for frame in run.cameras.train:
            trained = replace(frame, camera=downscaled_camera(frame.camera, factor))
            (photo,) = load_photos([frame], factor=factor * reduction(trained), threads=1, masks=masks)
            cameras.append(photo.frame)
            small.append(over_white(photo.pixels))
    except UserError as error:
        notify(f"no comparison with a model without geometry: {error}")
        return None
    return Billboards(cameras, small)
