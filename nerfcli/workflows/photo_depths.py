"""Depth maps of training photos and errors of depth: computed once per field and kept in the run."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError, several
from nerfcli.evaluate.depth_errors import measure_depth_errors
from nerfcli.media.masks import read_mask
from nerfcli.render.depth_errors import STRATA, DepthErrors
from nerfcli.render.model import Model
from nerfcli.render.visibility import MAX_SIZE, DepthMap, depth_maps
from nerfcli.runs.photo_depths import (
    photo_depths_digest,
    read_depth_errors,
    read_photo_depths,
    write_depth_errors,
    write_photo_depths,
)
from nerfcli.runs.run import Run
from nerfcli.workflows.notices import Notify

# Fraction of held-out pixels that must be matched for reliable intervals. Measured: with 60 % matched, 89 % of the
# depths are inside 90 % intervals; with 3.5 %, 69 %.
LEAST_MATCHED = 0.2


def photo_depths(
    run: Run, model: Model, *, on_progress: Callable[[float], None], notify: Notify
) -> tuple[DepthMap, ...]:
    """Return the depth maps of all training photos, read from the run if they were saved for this field.

    Args:
        model: its model, with the step lengths of the training.
    """
    frames = run.cameras.train
    expected = photo_depths_digest(model.sha256, frames, max_size=MAX_SIZE)
    kept = read_photo_depths(run.path, frames, max_size=MAX_SIZE, expected=expected)
    if kept is not None:
        return tuple(kept)
    maps = depth_maps(model, frames, max_size=MAX_SIZE, on_progress=on_progress)
    if run.components.masks == "ignore":
        maps = [
            view if frame.mask is None else _without_masked(view, frame, notify)
            for view, frame in zip(maps, frames, strict=True)
        ]
    try:
        write_photo_depths(run.path, maps, digest=expected)
    except UserError as error:  # runs in read-only folders can be rendered, too
        notify(f"the depths of the training photos are not kept: {error.message}")
    return tuple(maps)


def depth_errors(
    run: Run,
    model: Model,
    photos: Sequence[DepthMap],
    *,
    threads: int,
    on_progress: Callable[[float], None],
    notify: Notify,
) -> DepthErrors:
    """Return the errors of the field's depth, read from the run if they were saved for this field.

    Raises:
        UserError: see `measure_depth_errors`.
    """
    expected = photo_depths_digest(model.sha256, [*run.cameras.train, *run.cameras.test], max_size=MAX_SIZE)
    errors = read_depth_errors(run.path, expected=expected)
    if errors is None:
        errors = measure_depth_errors(run, model, photos, threads=threads, on_progress=on_progress)
        try:
            write_depth_errors(run.path, errors, digest=expected)
        except UserError as error:
            notify(f"the errors of depth are not kept: {error.message}")
    for least, pixels, quantiles in zip(STRATA, errors.pixels, errors.quantiles, strict=True):
        if np.isnan(quantiles).any():
            seen = several(least, "photo sees", "photos see")
            notify(f"no intervals or confidence where {seen} the surface: only {pixels} pixels were measured")
    notify(
        f"errors of depth measured at {100.0 * errors.matched:.1f} % of the pixels of {errors.photos} held-out photos"
    )
    if errors.matched < LEAST_MATCHED:
        notify("what cannot be matched is usually worse: expect more errors than intervals and confidence say")
    return errors


def _without_masked(view: DepthMap, frame: Frame, notify: Notify) -> DepthMap:
    """Return the depth map with NaN where the mask excludes the photo's pixels."""
    assert frame.mask is not None
    assert frame.image is not None
    try:
        mask = read_mask(frame.mask, frame.image)
    except UserError as error:  # the photos of a run may be gone
        notify(f"{frame.name} counts without its mask: {error.message}")
        return view
    height, width = view.distances.shape
    used = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA) >= 128
    return DepthMap(view.frame, np.where(used, view.distances, np.float32(np.nan)))
