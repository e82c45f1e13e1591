"""Options of `nerfcli render`: depth and its files, steps, videos, frames and lenses."""

import math
import re
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.options import one_of, some_of

if TYPE_CHECKING:
    from nerfcli.render.depth import DepthRequest
    from nerfcli.render.outputs import VideoSettings
    from nerfcli.workflows.views import PictureOptions

Step = Annotated[
    float,
    typer.Option(
        help="Length of the steps along rays, relative to training: 2 is about twice as fast, 0.5 more exact.",
        min=0.05,
        max=20,
    ),
]
Rgba = Annotated[
    bool,
    typer.Option(
        "--rgba", help="Write colour without background, with opacity as alpha (straight; EXR premultiplied)."
    ),
]
DepthFormat = Annotated[
    str,
    typer.Option(
        help="Any of tiff, exr, npy (float32; exr holds all outputs of a view) and png16 (16-bit integers, in addition "
        "to float32)."
    ),
]


def depth_formats(text: str, *, outputs: tuple[str, ...], convention: str) -> tuple[str, ...]:
    """Return the formats in a comma-separated list.

    Raises:
        typer.BadParameter: a format is unknown, or cannot hold the requested outputs.
    """
    from nerfcli.render.outputs import FORMATS

    hint = "--depth-format"
    chosen = some_of(text, FORMATS, hint)
    if "png16" in chosen and "depth" not in outputs:
        raise typer.BadParameter("png16 is a depth format; add depth to --outputs", param_hint=hint)
    if "png16" in chosen and convention == "moment":
        raise typer.BadParameter(
            "png16 uses 0 for no depth, but the moment of an empty ray is 0; use another format", param_hint=hint
        )
    return chosen


def depth_request(
    convention: str,
    axis: str | None,
    *,
    outputs: tuple[str, ...],
    min_opacity: float,
    background_distance: float | None,
    min_views: int,
    min_parallax_deg: float,
) -> "DepthRequest":
    """Return the definition of depth that the options select; along z where no axis is given.

    Raises:
        typer.BadParameter: a value is unknown or not finite, or limits are given without depth.
    """
    from nerfcli.render.depth import AXES, CONVENTIONS, DepthRequest, is_convention

    if not is_convention(convention):
        choices = f"{', '.join(CONVENTIONS)} or quantile:Q with 0 < Q < 1"
        raise typer.BadParameter(f"{convention!r}; choose {choices}", param_hint="--depth")
    one_of(axis, AXES, "--depth-axis")
    finite(background_distance, "--background-distance")
    finite(min_opacity, "--min-opacity")
    finite(min_parallax_deg, "--min-parallax")
    if (min_views or min_parallax_deg) and "depth" not in outputs:
        hint = "--min-views" if min_views else "--min-parallax"
        raise typer.BadParameter("it removes depth; add depth to --outputs", param_hint=hint)
    return DepthRequest(convention, axis or "z", min_opacity, background_distance, min_views, min_parallax_deg)


def finite(value: float | None, option: str) -> None:
    """Refuse NaN and infinity, which the bounds of an option do not exclude.

    Raises:
        typer.BadParameter: the value is NaN or infinite.
    """
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number", param_hint=option)


def video_settings(formats: str, fps: float) -> "VideoSettings":
    """Return the videos selected by --video-format.

    Raises:
        typer.BadParameter: a format is unknown, or cannot play so many frames per second.
    """
    from nerfcli.render.files.film import ENCODERS, GIF_FASTEST_FPS
    from nerfcli.render.outputs import VideoSettings

    chosen = tuple(dict.fromkeys(formats.split(",")))
    for name in chosen:
        one_of(name, ENCODERS, "--video-format")
    if "gif" in chosen and fps > GIF_FASTEST_FPS:
        raise typer.BadParameter(
            f"{fps:g}; a gif plays at {GIF_FASTEST_FPS:g} frames per second at most", param_hint="--fps"
        )
    return VideoSettings(chosen, fps)


def frame_range(text: str) -> slice:
    """Parse --frames: START:STOP or START:STOP:STEP, counted from 0, or K/N, every N-th view from the K-th.

    START and STOP may be left out; K counts from 1, as task numbers of array jobs do.

    Raises:
        typer.BadParameter: anything else, or nothing between start and stop.
    """
    if one_of_many := re.fullmatch(r"(\d+)/(\d+)", text.strip()):
        number, count = map(int, one_of_many.groups())
        if 1 <= number <= count:
            return slice(number - 1, None, count)
    match = re.fullmatch(r"(\d*):(\d*)(?::(\d+))?", text.strip())
    start, stop, step = (int(part) if part else None for part in match.groups()) if match else (0, 0, 0)
    if match is None or step == 0 or (stop is not None and stop <= (start or 0)):
        message = f"{text!r}; write START:STOP or START:STOP:STEP, for example 100:200 or 0:120:4, or K/N, such as 1/8"
        raise typer.BadParameter(message, param_hint="--frames")
    return slice(start, stop, step)


def look_of(
    width: int | None, height: int | None, *, lens: str | None, fov_deg: float | None, crop: str | None
) -> "PictureOptions":
    """Return the picture geometry selected by --width, --height, --lens, --fov and --crop.

    Raises:
        typer.BadParameter: the lens is unknown, --fov is given without --lens, or --crop cannot be parsed.
    """
    from nerfcli.cameras.framing import LENSES
    from nerfcli.workflows.views import PictureOptions

    one_of(lens, LENSES, "--lens")
    if fov_deg is not None and lens is None:
        raise typer.BadParameter("needs --lens", param_hint="--fov")
    window = None
    if crop is not None:
        match = re.fullmatch(r"(\d+),(\d+),(\d+),(\d+)", crop.replace(" ", ""))
        if match is None:
            raise typer.BadParameter(f"{crop!r}; write X,Y,WIDTH,HEIGHT in pixels", param_hint="--crop")
        x, y, crop_width, crop_height = (int(part) for part in match.groups())
        window = (x, y, crop_width, crop_height)
    return PictureOptions(width, height, lens, fov_deg, window)
