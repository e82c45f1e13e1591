"""Errors of a field's depth without a true depth: stereo matching of held-out photos with the training photos.

The field has not seen the held-out photos, so the matches of their pixels in other photos are independent of its depth,
except for the poses and for the range in which depth is searched. Pixels without a match are not measured.
"""

from collections.abc import Callable, Sequence

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import apply
from nerfcli.errors import UserError
from nerfcli.matching.stereo import LONGER_SIDE_PX, dense_depths
from nerfcli.matching.tracks import Tracks
from nerfcli.render.coverage import DepthMap, coverage_and_parallax, depth_maps, sees, small_frame
from nerfcli.render.depth import DepthRequest
from nerfcli.render.depth_errors import DepthErrors
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.training.runs.run import Run


def measure_depth_errors(
    run: Run,
    model: Model,
    photo_depths: Sequence[DepthMap],
    *,
    threads: int,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> DepthErrors:
    """Compare the median depth of the held-out photos of a run with stereo matching.

    `photo_depths` are depth maps of its training photos, in their order.

    Raises:
        UserError: there are no held-out photos, or a photo cannot be read.
    """
    train, test = run.cameras.train, run.cameras.test
    if not test:
        raise UserError(
            f"{run.path} has no held-out photos, and errors of depth are measured with them",
            "train with --holdout every:8, or leave lower, upper and confidence out of --outputs",
        )
    maps = [*photo_depths, *depth_maps(model, test)]
    tracks = surface_tracks(maps)
    photos = run.photos([*train, *test])
    on_progress(0.1)
    measured = dense_depths(photos, tracks, longer_side_px=LONGER_SIDE_PX, threads=threads)
    parts = []
    matched, pixels = 0, 0
    for number, (photo, found) in enumerate(zip(photos[len(train) :], measured[len(train) :], strict=True)):
        small = small_frame(photo.frame, LONGER_SIDE_PX).camera
        matched, pixels = matched + len(found.pixels), pixels + small.width * small.height
        chosen = slice(None, None, 1 + len(found.pixels) // 20_000)
        points, median = _median_points(model, photo.frame, found.pixels[chosen])
        coverage, _ = coverage_and_parallax(photo_depths, points)
        errors = found.distances[chosen] / median - 1.0
        there = np.isfinite(errors)
        parts.append(np.stack([errors, coverage, np.full(len(errors), number)])[:, there])
        on_progress(0.7 + 0.3 * (number + 1) / len(test))
    return DepthErrors.of(*np.concatenate(parts, axis=1), matched=matched / pixels)


def surface_tracks(maps: Sequence[DepthMap]) -> Tracks:
    """Return surface points, evenly chosen from the depth maps, as tracks in the cameras that see them."""
    parts = []
    for view in maps:
        points = view.points()
        parts.append(points[:: 1 + len(points) // 200])
    points = np.concatenate(parts)
    columns = []
    for number, view in enumerate(maps):
        own = np.flatnonzero(sees(view, points))
        rays = points[own] - view.frame.centre
        columns.append((np.full(len(own), number), own, rays / np.linalg.norm(rays, axis=1, keepdims=True)))
    return Tracks(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def _median_points(model: Model, frame: Frame, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (N, 3) at the median distances of pixels (N, 2), and these distances (N,).

    They are rendered at the size of the stereo matching.
    """
    small = small_frame(frame, LONGER_SIDE_PX)
    picture = render_picture(model, small, background=model.background, depth=DepthRequest("median", "ray"))
    assert picture.depth is not None
    size = np.array([small.camera.width, small.camera.height])
    column, row = (pixels * size // (frame.camera.width, frame.camera.height)).T
    median = picture.depth[row, column].astype(np.float64)
    rays, _ = frame.camera.bearings(pixels + 0.5)
    return apply(frame.world_from_cam, rays * median[:, None]), median
