"""Render one frame of a job with all that is asked for, write its files, and note it as complete."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.field.background import Background, SphereBackground
from nerfcli.photos.images import write_png
from nerfcli.render.accuracy import IN_WORDS as ERROR_IN_WORDS
from nerfcli.render.accuracy import truncation_bounds
from nerfcli.render.coverage import DepthMap, coverage_and_parallax
from nerfcli.render.depth import DepthRequest
from nerfcli.render.depth_errors import DepthErrors
from nerfcli.render.files.depth_files import frame_meta, write_maps
from nerfcli.render.files.depth_pictures import DepthMeta, limits_in_words
from nerfcli.render.job import RenderJob, with_suffix
from nerfcli.render.outputs import BLACK, ExportSettings, depth_meta
from nerfcli.render.pictures import RenderedPicture, straight_rgba
from nerfcli.render.renderable import Renderable
from nerfcli.render.tracing import TOLERANCE
from nerfcli.render.unfinished import UnfinishedFrames
from nerfcli.version import __version__


def with_coverage(
    picture: RenderedPicture, frame: Frame, *, axis: str, photo_depths: Sequence[DepthMap]
) -> RenderedPicture:
    """Return the picture with coverage and parallax of the points at its median depth.

    Args:
        picture: a picture with median depth.
        photo_depths: depth maps of all training photos.
    """
    assert picture.median is not None
    rays, _ = frame.camera.pixel_bearings()
    if axis == "z":
        ahead = rays[:, 2] > 0
        rays = rays / np.where(ahead, rays[:, 2], 1.0)[:, None]
    pose = frame.world_from_cam
    points = (rays * picture.median.reshape(-1, 1)) @ pose[:3, :3].T + pose[:3, 3]
    coverage, parallax = coverage_and_parallax(photo_depths, points)
    shape = picture.median.shape
    return replace(picture, coverage=coverage.reshape(shape), parallax=parallax.reshape(shape))


def with_measured_errors(picture: RenderedPicture, errors: DepthErrors) -> RenderedPicture:
    """Add an interval of depth and a confidence in each pixel to a picture that has median and coverage."""
    assert picture.median is not None
    assert picture.coverage is not None
    lower, upper = errors.bounds(picture.median, picture.coverage)
    confidence = errors.confidence(picture.coverage)
    return replace(picture, lower=lower, upper=upper, confidence=confidence)


def without_unseen_depth(picture: RenderedPicture, request: DepthRequest) -> tuple[RenderedPicture, dict[str, Any]]:
    """Return the picture without depth where coverage or parallax is too small, and the numbers of pixels.

    Returns:
        The picture; "pixels_with_depth" before and "pixels_removed", or nothing if no limit is set.
    """
    if not (request.min_views or request.min_parallax_deg):
        return picture, {}
    assert picture.depth is not None
    assert picture.coverage is not None
    assert picture.parallax is not None
    # NaN, where there is no surface, counts as not seen.
    seen = (picture.coverage >= request.min_views) & (picture.parallax >= request.min_parallax_deg)
    had = np.isfinite(picture.depth)
    depth = np.where(seen, picture.depth, np.float32(np.nan))
    return replace(picture, depth=depth), {
        "pixels_with_depth": int(had.sum()),
        "pixels_removed": int((had & ~seen).sum()),
    }


def removed_in_words(request: DepthRequest, facts: Sequence[Mapping[str, Any]]) -> str:
    """Describe how much depth was removed from pictures, by their facts; empty if no limit is set."""
    had = sum(of_picture.get("pixels_with_depth", 0) for of_picture in facts)
    if not had:
        return ""
    removed = sum(of_picture["pixels_removed"] for of_picture in facts)
    limits = limits_in_words(request.min_views, request.min_parallax_deg)
    return f"depth removed at {100 * removed / had:.1f} % of the pixels that had one: {limits}"


def _write_outputs(
    picture: RenderedPicture,
    folder: Path,
    name: str,
    *,
    settings: ExportSettings,
    meta: DepthMeta,
    background: Background,
) -> list[Path]:
    """Write the outputs of a picture, as folder/OUTPUT/name.SUFFIX, each file atomically, and return the files."""
    written = []
    if "rgb" in settings.outputs:
        written.append(with_suffix(folder / "rgb" / name, ".png"))
        behind = "learned, by direction" if isinstance(background, SphereBackground) else str(background)
        behind = "none: straight alpha" if settings.rgba else behind
        error = {f"error {name}": str(value) for name, value in meta.error_bounds.items()}
        metadata = {"colour": "sRGB", "background": behind, **error, "nerfcli": __version__}
        write_png(written[-1], _to_bytes(picture.rgb), metadata=metadata)
    if "opacity" in settings.outputs:
        written.append(with_suffix(folder / "opacity" / name, ".png"))
        metadata = {"quantity": "opacity: 0 transparent, 255 opaque", "nerfcli": __version__}
        write_png(written[-1], np.repeat(_to_bytes(picture.opacity)[..., None], 3, axis=-1), metadata=metadata)
    return written + (write_maps(picture, folder, name, settings=settings, meta=meta) if settings.measured else [])


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.round(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)


def render_frame(
    model: Renderable, job: RenderJob, index: int, *, unfinished: UnfinishedFrames, on_rays: Callable[[int], None]
) -> None:
    """Render a frame and write its files to the unfinished folder.

    The files depend only on the model and the job, not on other frames or on threads.

    Raises:
        UserError: a file cannot be written.
    """
    frame, name, settings = job.frames[index], job.names[index], job.settings
    wanted = settings.depth if settings.measured else None
    background = BLACK if settings.rgba else model.background
    picture = model.render(frame, background=background, depth=wanted, on_tile=on_rays)
    if settings.rgba:
        picture = replace(picture, rgb=straight_rgba(picture))
    removed = {}
    if settings.needs_visibility:
        picture = with_coverage(picture, frame, axis=settings.depth.axis, photo_depths=job.photo_depths)
        if job.depth_errors is not None:
            picture = with_measured_errors(picture, job.depth_errors)
        picture, removed = without_unseen_depth(picture, settings.depth)
    facts = truncation_bounds(picture, TOLERANCE) | model.measured_error(frame, depth=wanted)
    bounds = {**facts, "meaning": ERROR_IN_WORDS}
    meta = frame_meta(depth_meta(model, settings.depth), frame, provenance=job.provenance, error_bounds=bounds)
    files = _write_outputs(picture, unfinished.folder, name, settings=settings, meta=meta, background=model.background)
    unfinished.note(name, files, facts=facts | removed)
