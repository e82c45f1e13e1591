"""Depth maps of training photos and errors of depth: computed once per field and kept in the run.

RUN/photo_depths.npz and RUN/depth_errors.json have the digest of what they depend on, because computing them takes
seconds.
"""

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from nerfcli.atomic import atomic_path, digest, read_sealed, write_sealed
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError, several
from nerfcli.evaluate.depth_errors import measure_depth_errors
from nerfcli.notices import Notify, Reporter
from nerfcli.photos.images import read_image
from nerfcli.photos.masks import read_mask
from nerfcli.render.coverage import MAX_SIZE, STEEPEST_DEG, DepthMap, depth_maps, small_frame
from nerfcli.render.depth_errors import LEAST_PHOTOS, LEAST_PIXELS, STRATA, DepthErrors
from nerfcli.render.model import Model
from nerfcli.training.runs.files import DEPTH_ERRORS, PHOTO_DEPTHS, left_out_mask
from nerfcli.training.runs.run import Run
from nerfcli.workflows.splats import file_digest

FORMAT, ERRORS_FORMAT = "nerfcli photo depths 2", "nerfcli depth errors 1"
# Fraction of held-out pixels that must be matched for reliable intervals. Measured: with 60 % matched, 89 % of the
# depths are inside 90 % intervals; with 3.5 %, 69 %.
LEAST_MATCHED = 0.2


def photo_depths(
    run: Run, model: Model, reporter: Reporter, *, begin: float = 0.0, end: float = 1.0
) -> tuple[DepthMap, ...]:
    """Return the depth maps of all training photos, read from the run if they were saved for this field.

    Args:
        model: its model, with the step lengths of the training.
        begin, end: fractions of the progress at which they are begun and done.
    """
    frames = run.cameras.train
    expected = _digest(model.sha256, frames)
    kept = _read_photo_depths(run.path, frames, expected=expected)
    if kept is not None:
        return kept
    on_progress = reporter.part(begin, end, "depths of the training photos")
    maps = depth_maps(model, frames, max_size=MAX_SIZE, on_progress=on_progress)
    maps = [_as_used(view, run, frame, reporter.note) for view, frame in zip(maps, frames, strict=True)]
    try:
        _write_photo_depths(run.path, maps, digest=expected)
    except UserError as error:  # runs in read-only folders can be rendered, too
        reporter.note(f"the depths of the training photos are not kept: {error.message}")
    return tuple(maps)


def depth_errors(run: Run, model: Model, photos: Sequence[DepthMap], *, reporter: Reporter) -> DepthErrors:
    """Return the errors of the field's depth, read from the run if they were saved for this field."""
    expected = _digest(model.sha256, [*run.cameras.train, *run.cameras.test])
    errors = _read_depth_errors(run.path, expected=expected)
    if errors is None:
        on_progress = reporter.part(0.0, 1.0, "depth of the held-out photos")
        errors = measure_depth_errors(run, model, photos, threads=torch.get_num_threads(), on_progress=on_progress)
        try:
            write_sealed(run.path / DEPTH_ERRORS, {"format": ERRORS_FORMAT, "digest": expected, **errors.to_json()})
        except UserError as error:
            reporter.note(f"the errors of depth are not kept: {error.message}")
    for least, pixels, quantiles in zip(STRATA, errors.pixels, errors.quantiles, strict=True):
        if np.isnan(quantiles).any():
            seen = several(least, "photo sees", "photos see")
            reporter.note(
                f"no intervals or confidence where {seen} the surface: {pixels} pixels were measured, "
                f"and {LEAST_PIXELS} are needed, in {LEAST_PHOTOS} held-out photos"
            )
    reporter.note(
        f"errors of depth measured at {100.0 * errors.matched:.1f} % of the pixels of {errors.photos} held-out photos"
    )
    if errors.matched < LEAST_MATCHED:
        reporter.note("what cannot be matched is usually worse: expect larger errors than intervals and confidence say")
    return errors


def _as_used(view: DepthMap, run: Run, frame: Frame, notify: Notify) -> DepthMap:
    """Return the depth map with NaN at the pixels of the photo that its mask excludes or the training has left out."""
    left_out = left_out_mask(run.path, frame.name)
    masks = [read_image(left_out)[..., 0]] if left_out.exists() else []
    if frame.mask is not None and frame.image is not None and run.components.masks == "ignore":
        try:
            masks.append(read_mask(frame.mask, frame.image))
        except UserError as error:  # the photos of a run may be gone
            notify(f"the mask of {frame.name} is ignored: {error.message}")
    distances = view.distances
    for mask in masks:
        used = cv2.resize(mask, distances.shape[::-1], interpolation=cv2.INTER_AREA) >= 128
        distances = np.where(used, distances, np.float32(np.nan))
    return DepthMap(view.frame, distances)


def _digest(field_sha256: str | None, frames: Sequence[Frame]) -> str:
    """Return the hash of everything that the maps depend on: the field, the cameras and masks of the photos, the size.

    A mask that is not there, or whose photo is not, counts as none: once it is back, the maps are made again.
    """
    cameras = [[frame.name, frame.camera.to_json(), frame.world_from_cam.tolist()] for frame in frames]
    there = [
        frame.mask if frame.mask is not None and frame.mask.is_file() and frame.has_photo else None for frame in frames
    ]
    masks = [mask and file_digest(mask) for mask in there]
    return digest([FORMAT, field_sha256, cameras, masks, MAX_SIZE, STEEPEST_DEG])


def _read_photo_depths(run: Path, frames: Sequence[Frame], *, expected: str) -> tuple[DepthMap, ...] | None:
    """Return the stored maps; None if they are missing, damaged, or have another digest: they are rendered again."""
    try:
        # Opened here, because NumPy does not close a file that it cannot read.
        with (run / PHOTO_DEPTHS).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            if str(archive["digest"]) != expected:
                return None
            return tuple(DepthMap(small_frame(frame, MAX_SIZE), archive[str(i)]) for i, frame in enumerate(frames))
    except (OSError, ValueError, LookupError, EOFError, zipfile.BadZipFile, zlib.error):
        return None


def _write_photo_depths(run: Path, maps: Sequence[DepthMap], *, digest: str) -> None:
    arrays = {str(index): view.distances for index, view in enumerate(maps)}
    with atomic_path(run / PHOTO_DEPTHS) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays, digest=np.array(digest))


def _read_depth_errors(run: Path, *, expected: str) -> DepthErrors | None:
    """Return the stored errors; None if they are missing, damaged, or have another digest: they are measured again."""
    try:
        content = read_sealed(run / DEPTH_ERRORS)
        if (content["format"], content["digest"], content["strata"]) != (ERRORS_FORMAT, expected, list(STRATA)):
            return None
        return DepthErrors.from_json(content)
    except (OSError, ValueError, LookupError, TypeError):
        return None
