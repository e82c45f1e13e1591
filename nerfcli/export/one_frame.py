"""Render one frame of an order, write its files, and note it as complete."""

from collections.abc import Callable
from dataclasses import replace

from nerfcli.export.depth_files import frame_meta
from nerfcli.export.members import with_deviations
from nerfcli.export.order import Order
from nerfcli.export.picture_files import write_picture
from nerfcli.export.settings import BLACK, depth_meta
from nerfcli.export.unfinished import UnfinishedFrames
from nerfcli.export.visibility import with_measured_errors, with_visibility, without_unseen_depth
from nerfcli.render.accuracy import IN_WORDS as ERROR_IN_WORDS
from nerfcli.render.accuracy import measure_error, truncation_bounds
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture, straight_rgba


def render_frame(
    model: Model, order: Order, index: int, *, unfinished: UnfinishedFrames, on_rays: Callable[[int], None]
) -> None:
    """Render a frame and write its files to the unfinished folder.

    The files depend only on the model and the order, not on other frames or on the process that renders them.

    Args:
        on_rays: called with the number of rays after each tile.

    Raises:
        UserError: a file cannot be written.
    """
    frame, name, settings = order.frames[index], order.names[index], order.settings
    wanted = settings.depth if settings.measured else None
    background = BLACK if settings.rgba else model.background
    picture = render_picture(
        model, frame, background=background, depth=wanted, quality=settings.quality, on_tile=on_rays
    )
    if settings.rgba:
        picture = replace(picture, rgb=straight_rgba(picture))
    if order.members:
        picture = with_deviations(picture, frame, order.members, settings=settings, on_rays=on_rays)
    removed = {}
    if settings.needs_visibility:
        picture = with_visibility(picture, frame, axis=settings.depth.axis, photo_depths=order.photo_depths)
        if order.depth_errors is not None:
            picture = with_measured_errors(picture, order.depth_errors, settings.depth)
        picture, removed = without_unseen_depth(picture, settings.depth)
    tolerance = settings.quality.tolerance
    measured = measure_error(model, frame, depth=wanted, tolerance=tolerance)
    facts = truncation_bounds(picture, tolerance) | measured.to_json()
    bounds = {**facts, "meaning": ERROR_IN_WORDS}
    meta = frame_meta(depth_meta(model, settings.depth), frame, provenance=order.provenance, error_bounds=bounds)
    files = write_picture(picture, unfinished.folder, name, settings=settings, meta=meta, background=model.background)
    unfinished.note(name, files, facts=facts | removed)
