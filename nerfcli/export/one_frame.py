"""One frame of an order: rendered, written, and noted as complete."""

from collections.abc import Callable

from nerfcli.export.depth_files import frame_meta
from nerfcli.export.order import Order
from nerfcli.export.picture_files import write_picture
from nerfcli.export.settings import depth_meta
from nerfcli.export.unfinished import Unfinished
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture


def render_frame(
    model: Model, order: Order, index: int, *, unfinished: Unfinished, on_rays: Callable[[int], None]
) -> None:
    """Render a frame and leave its files in the unfinished folder.

    The files depend on the model and the order alone: not on other frames, and not on which process renders them.

    Args:
        model: the trained model.
        order: what is to be rendered.
        index: which of its frames.
        unfinished: where the frames of the order gather.
        on_rays: called with the number of rays after each tile.

    Raises:
        UserError: a file cannot be written.
    """
    frame, name, settings = order.frames[index], order.names[index], order.settings
    wanted = settings.depth if settings.measured else None
    picture = render_picture(model, frame, background=model.background, depth=wanted, on_tile=on_rays)
    facts = {"truncation_of_colour_max": float(picture.truncation_error.max())}
    meta = frame_meta(depth_meta(model, settings.depth), frame, provenance=order.provenance, error_bounds=facts)
    files = write_picture(picture, unfinished.folder, name, settings=settings, meta=meta, background=model.background)
    unfinished.note(name, files, facts=facts)
