"""The options of `nerfcli render` that say in which files depth is written, and their readers."""

import math
from typing import Annotated

import typer

DepthFormat = Annotated[
    str,
    typer.Option(
        help="Some of tiff, exr, npy, npz (floats; exr and npz hold all outputs of a view) and png16 (16-bit levels "
        "beside floats)."
    ),
]
DepthScale = Annotated[
    str,
    typer.Option(
        help="Scene units per level of png16; auto: the finest of 1, 2, 5 times a power of ten that holds twice "
        "what 99.9 % of all pixels need (what is farther has none there), never finer than a millimetre in metres."
    ),
]


def depth_formats(text: str, *, outputs: tuple[str, ...], convention: str) -> tuple[str, ...]:
    """The formats in a comma-separated list.

    Raises:
        typer.BadParameter: an unknown one, or one that cannot hold what is asked for.
    """
    from nerfcli.export.settings import FORMATS

    hint = "--depth-format"
    chosen = tuple(dict.fromkeys(text.split(",")))
    if unknown := [name for name in chosen if name not in FORMATS]:
        raise typer.BadParameter(f"{unknown[0]!r}; choose some of {','.join(FORMATS)}", param_hint=hint)
    if "png16" in chosen and "depth" not in outputs:
        raise typer.BadParameter("png16 holds depth, which is not among the --outputs", param_hint=hint)
    if "png16" in chosen and convention == "moment":
        raise typer.BadParameter("png16 keeps 0 for no depth; the moment of an empty ray is 0", param_hint=hint)
    return chosen


def level_scale(text: str, *, formats: tuple[str, ...]) -> float | None:
    """Scene units per level; None for auto.

    Raises:
        typer.BadParameter: not a positive number, or without 16-bit files.
    """
    if text == "auto":
        return None
    if "png16" not in formats:
        raise typer.BadParameter("it is for --depth-format png16", param_hint="--depth-scale")
    try:
        scale = float(text)
    except ValueError:
        scale = math.nan
    if not 0 < scale < math.inf:
        raise typer.BadParameter(f"{text!r}; write auto or a positive number", param_hint="--depth-scale")
    return scale


def finite(value: float | None, option: str) -> None:
    """Refuse NaN and infinity, which the bounds of an option let through.

    Raises:
        typer.BadParameter: it is one of them.
    """
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is no distance or share", param_hint=option)
