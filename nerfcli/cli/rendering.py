"""The options of `nerfcli render` that say how much work goes into a picture, and their readers."""

from fractions import Fraction
from typing import Annotated

import typer

MOST_SAMPLES = 256

Tolerance = Annotated[
    str,
    typer.Option(
        help="What a channel of a colour may miss because rays stop early, as 1/255 or 0.001; the bound that was "
        "reached is in the files. It is about the rendering of the field, not about the field."
    ),
]
Step = Annotated[
    float,
    typer.Option(
        help="Length of the steps along rays, in those of the training: 2 is faster, 0.5 nearer to the field.",
        min=1 / 64,
        max=64,
    ),
]
SamplesPerPixel = Annotated[
    int,
    typer.Option(help="Rays of a pixel, against jagged edges; depth is that of all together.", min=1, max=MOST_SAMPLES),
]
Rgba = Annotated[
    bool,
    typer.Option("--rgba", help="Colours without background and the opacity as alpha (straight; EXR premultiplied)."),
]


def tolerance_of(text: str) -> float:
    """A number or a fraction above 0 and at most 1.

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
