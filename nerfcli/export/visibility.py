"""Coverage, parallax and measured errors of a rendered picture; depth removed where too few photos see the surface."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.media.depth_pictures import limits_in_words
from nerfcli.render.depth import DepthRequest
from nerfcli.render.depth_errors import DepthErrors
from nerfcli.render.pictures import RenderedPicture
from nerfcli.render.visibility import DepthMap, coverage_and_parallax


def with_visibility(
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


def with_measured_errors(picture: RenderedPicture, errors: DepthErrors, request: DepthRequest) -> RenderedPicture:
    """Add an interval of depth and a confidence in each pixel to a picture that has median and coverage."""
    assert picture.median is not None
    assert picture.coverage is not None
    lower, upper = errors.bounds(picture.median, picture.coverage, level=request.level)
    confidence = errors.confidence(picture.coverage, tolerance=request.depth_tolerance)
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
