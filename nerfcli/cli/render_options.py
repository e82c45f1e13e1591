"""Options of `nerfcli render`: depth files, rendering quality, videos, frames and lenses."""

import math
import re
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.options import one_of, some_of

if TYPE_CHECKING:
    from nerfcli.export.settings import VideoSettings
    from nerfcli.workflows.views import PictureOptions

MOST_SAMPLES = 256

Tolerance = Annotated[
    str,
    typer.Option(
        help="Maximum error of a colour channel due to early stopping of rays, such as 1/255 or 0.001. It concerns the "
        "rendering, not how accurate the field is."
    ),
]
Step = Annotated[
    float,
    typer.Option(
        help="Step length along rays relative to training: 2 is faster, 0.5 more accurate.",
        min=1 / 64,
        max=64,
    ),
]
SamplesPerPixel = Annotated[
    int,
    typer.Option(help="Rays per pixel, for antialiasing; depth uses all of them together.", min=1, max=MOST_SAMPLES),
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
DepthScale = Annotated[
    str,
    typer.Option(
        help="Scene units per level of png16; auto: the finest of 1, 2, 5 times a power of ten that covers twice the "
        "99.9th percentile of depth, but at least a millimetre in metric scenes."
    ),
]


def depth_formats(text: str, *, outputs: tuple[str, ...], convention: str) -> tuple[str, ...]:
    """Return the formats in a comma-separated list.

    Raises:
        typer.BadParameter: a format is unknown, or cannot hold the requested outputs.
    """
    from nerfcli.export.settings import FORMATS

    hint = "--depth-format"
    chosen = some_of(text, FORMATS, hint)
    if "png16" in chosen and "depth" not in outputs:
        raise typer.BadParameter("png16 is a depth format; add depth to --outputs", param_hint=hint)
    if "png16" in chosen and convention == "moment":
        raise typer.BadParameter(
            "png16 uses 0 for no depth, but the moment of an empty ray is 0; use another format", param_hint=hint
        )
    return chosen


def level_scale(text: str, *, formats: tuple[str, ...]) -> float | None:
    """Parse --depth-scale: scene units per level; None for auto.

    Raises:
        typer.BadParameter: not a positive number, or png16 is not one of the formats.
    """
    if text == "auto":
        return None
    if "png16" not in formats:
        raise typer.BadParameter("only used with --depth-format png16", param_hint="--depth-scale")
    try:
        scale = float(text)
    except ValueError:
        scale = math.nan
    if not 0 < scale < math.inf:
        raise typer.BadParameter(f"{text!r}; write auto or a positive number", param_hint="--depth-scale")
    return scale


def finite(value: float | None, option: str) -> None:
    """Refuse NaN and infinity, which the bounds of an option do not exclude.

    Raises:
        typer.BadParameter: the value is NaN or infinite.
    """
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number", param_hint=option)


def tolerance_of(text: str) -> float:
    """Parse --tolerance: a number or a fraction from 1e-9 to 1.

    Raises:
        typer.BadParameter: anything else.
    """
    try:
        value = float(Fraction(text.strip()))
    except (ValueError, ZeroDivisionError, OverflowError):
        value = -1.0
    if not 1e-9 <= value <= 1:
        raise typer.BadParameter(
            f"{text!r}; write a fraction like 1/255 or a number, from 1e-9 to 1", param_hint="--tolerance"
        )
    return value


def video_settings(formats: str, fps: float) -> "VideoSettings":
    """Return the videos selected by --video-format.

    Raises:
        typer.BadParameter: a format is unknown, or cannot play so many frames per second.
    """
    from nerfcli.export.settings import VideoSettings
    from nerfcli.media.video import ENCODERS, GIF_FASTEST_FPS

    chosen = tuple(dict.fromkeys(formats.split(",")))
    for name in chosen:
        one_of(name, ENCODERS, "--video-format")
    if "gif" in chosen and fps > GIF_FASTEST_FPS:
        raise typer.BadParameter(
            f"{fps:g}; a gif plays at {GIF_FASTEST_FPS:g} frames per second at most", param_hint="--fps"
        )
    return VideoSettings(chosen, fps)


def colour_range_of(text: str | None, *, outputs: tuple[str, ...]) -> tuple[float, float] | None:
    """Parse LOW:HIGH; None if not given.

    Raises:
        typer.BadParameter: anything else, or no depth is requested.
    """
    if text is None:
        return None
    if "depth" not in outputs:
        raise typer.BadParameter("is for depth; add depth to --outputs", param_hint="--colour-range")
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        low = high = math.nan
    if not -math.inf < low < high < math.inf:
        message = f"{text!r}; write LOW:HIGH in scene units, for example 0.5:4"
        raise typer.BadParameter(message, param_hint="--colour-range")
    return low, high


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
