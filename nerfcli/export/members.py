"""Standard deviations of depth and colour between the members of a run, in a rendered picture."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.export.settings import BLACK, ExportSettings
from nerfcli.render.model import Model
from nerfcli.render.pictures import RenderedPicture, render_picture


def with_deviations(
    picture: RenderedPicture,
    frame: Frame,
    members: Sequence[Model],
    *,
    settings: ExportSettings,
    on_rays: Callable[[int], None],
) -> RenderedPicture:
    """Add the standard deviations of depth and colour between members that render the same frame to a picture.

    Args:
        picture: picture of the run's own field, which is not a member.
        members: at least two.
        on_rays: called with the number of rays after each tile.
    """
    seen = [
        render_picture(
            member,
            frame,
            background=BLACK if settings.rgba else member.background,
            depth=settings.depth,
            quality=settings.quality,
            on_tile=on_rays,
        )
        for member in members
    ]
    depths = np.stack([one.depth for one in seen if one.depth is not None])
    colours = np.stack([one.rgb for one in seen])
    variance = colours.astype(np.float64).var(axis=0, ddof=1).mean(axis=-1)
    return replace(
        picture,
        depth_deviation=deviation(depths),
        colour_deviation=np.where(picture.valid, np.sqrt(variance), np.nan).astype(np.float32),
    )


def deviation(values: np.ndarray) -> np.ndarray:
    """Return the standard deviation (H, W) of the members' values (M, H, W) that are not NaN, with M - 1 as divisor.

    NaN where fewer than two members have a value. Computed in float64 about the mean.
    """
    there = np.isfinite(values)
    count = there.sum(axis=0)
    mean = np.where(there, values, 0.0).sum(axis=0, dtype=np.float64) / np.maximum(count, 1)
    squares = np.where(there, values - mean, 0.0) ** 2
    spread = np.sqrt(squares.sum(axis=0) / np.maximum(count - 1, 1))
    return np.where(count > 1, spread, np.nan).astype(np.float32)
