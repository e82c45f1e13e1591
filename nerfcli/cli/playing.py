"""What the options of `nerfcli render` about videos, frames and processes say."""

import math
import re
from collections.abc import Collection
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from nerfcli.export.settings import VideoSettings


def video_settings(
    formats: str, *, layout: str, direction: str, fps: float, crf: int | None, loop: int | None
) -> "VideoSettings":
    """The videos that --video-format and its companions ask for.

    Raises:
        typer.BadParameter: a value that does not exist, or does not fit the formats.
    """
    from nerfcli.export.settings import DIRECTIONS, LAYOUTS, VideoSettings
    from nerfcli.media.video import FORMATS, GIF_FASTEST_FPS

    chosen = tuple(dict.fromkeys(formats.split(",")))
    for name in chosen:
        one_of(name, FORMATS, "--video-format")
    one_of(layout, LAYOUTS, "--video-layout")
    one_of(direction, DIRECTIONS, "--direction")
    if "gif" in chosen and fps > GIF_FASTEST_FPS:
        raise typer.BadParameter(f"{fps:g}; players show a gif at {GIF_FASTEST_FPS:g} at most", param_hint="--fps")
    if crf is not None:
        scaled = [name for name in chosen if FORMATS[name].crf is not None]
        if not scaled:
            raise typer.BadParameter("a gif has no scale of quality; leave it out", param_hint="--crf")
        for name in scaled:
            if crf > FORMATS[name].worst_crf:
                raise typer.BadParameter(f"{crf}; {name} ends at {FORMATS[name].worst_crf}", param_hint="--crf")
    if loop == 0 and chosen != ("gif",):
        raise typer.BadParameter("0; a gif alone can be told to play for ever", param_hint="--loop")
    return VideoSettings(formats=chosen, layout=layout, direction=direction, fps=fps, crf=crf, plays=loop)


def colour_range_of(text: str | None, *, outputs: tuple[str, ...]) -> tuple[float, float] | None:
    """LOW:HIGH; None where nothing is said.

    Raises:
        typer.BadParameter: anything else, or no depth is asked for.
    """
    if text is None:
        return None
    if "depth" not in outputs:
        raise typer.BadParameter("it is of depth, which is not among the --outputs", param_hint="--colour-range")
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        low = high = math.nan
    if not -math.inf < low < high < math.inf:
        message = f"{text!r}; write LOW:HIGH in scene units, for example 0.5:4"
        raise typer.BadParameter(message, param_hint="--colour-range")
    return low, high


def frame_range(text: str) -> slice:
    """START:STOP or START:STOP:STEP; START and STOP may be left out.

    Raises:
        typer.BadParameter: anything else, or nothing between start and stop.
    """
    match = re.fullmatch(r"(\d*):(\d*)(?::(\d+))?", text.strip())
    start, stop, step = (int(part) if part else None for part in match.groups()) if match else (0, 0, 0)
    if match is None or step == 0 or (stop is not None and stop <= (start or 0)):
        message = f"{text!r}; write START:STOP or START:STOP:STEP, for example 100:200 or 0:120:4"
        raise typer.BadParameter(message, param_hint="--frames")
    return slice(start, stop, step)


def one_of(value: str, known: Collection[str], option: str) -> None:
    """Refuse a word that an option does not know.

    Raises:
        typer.BadParameter: value is not among `known`.
    """
    if value not in known:
        raise typer.BadParameter(f"{value!r}; choose one of {', '.join(known)}", param_hint=option)
