"""Figures of pages and results: drawn by matplotlib, in the pages as SVG that takes its colours from their style."""

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from nerfcli.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Of curves, one for each run; more runs than colours share them.
COLOURS = ("#3b7dd8", "#d9822b", "#2c9a66", "#b6479b", "#7b61c9", "#8c8c35")
# Colours of the style of pages, which depend on the reader's light or dark mode, and what is drawn in their place.
_STYLED = {"#5b6672": "var(--soft)", "#b7791f": "var(--look)", "#7d93ab": "var(--bar)", "#e2e6eb": "var(--line)"}
SOFT, LOOK, BAR, LINE = _STYLED


@dataclass(frozen=True)
class Curve:
    """Curve of one run: colour index, label, x and y values; with `dots`, each point gets a marker."""

    colour: int
    label: str
    x: Sequence[float]
    y: Sequence[float]
    dots: bool = False


def new_figure(width: float, height: float) -> "tuple[Figure, Axes]":
    """Return a figure of a size in inches, and its axes; matplotlib is imported on first use, which takes 0.5 s."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def write_png(figure: "Figure", path: Path) -> None:
    """Write a figure, atomically."""
    with atomic_path(path) as partial:
        figure.savefig(partial, format="png")


def svg(figure: "Figure", *, width: str = "100%") -> Markup:
    """Return a figure as an SVG element, `width` in CSS; what has the gid "title: TEXT" shows TEXT when pointed at."""
    from matplotlib import rc_context

    written = io.StringIO()
    # Without a salt, names inside would differ from page to page.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "nerfcli"}):
        figure.savefig(written, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator")))
    text = written.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"|(?<=<svg) height="[^"]*"| width="[^"]*pt"| height="[^"]*pt"', "", text)
    text = re.sub(r'<g id="title: ([^"]*)">', r"<g><title>\1</title>", text)
    text = re.sub(r' id="(?:figure|axes|patch|matplotlib\.axis|[xy]tick|text|line2d|LineCollection)_\d+"', "", text)
    for drawn, styled in _STYLED.items():
        text = text.replace(drawn, styled)
    return Markup(text.replace("<svg", f'<svg role="img" style="width:{width}"', 1).strip())


def titled(text: str) -> str:
    """Return the gid of what shows a text when pointed at; matplotlib escapes it."""
    return f"title: {text}"


def curves(drawn: Sequence[Curve], *, y_title: str, logarithmic: bool = False) -> "Figure | None":
    """Draw curves over seconds; return None if there is nothing to draw.

    Values that are not finite, or not positive on a logarithmic axis, are left out. `y_title` has the unit.
    """
    kept = []
    for curve in drawn:
        pairs = zip(curve.x, curve.y, strict=True)
        points = [(x, y) for x, y in pairs if math.isfinite(y) and (y > 0 or not logarithmic)]
        if points:
            kept.append((curve, _thinned(points)))
    if not kept:
        return None
    figure, axes = new_figure(5.2, 2.3)
    for curve, points in kept:
        x, y = zip(*points, strict=True)
        (line,) = axes.plot(x, y, color=COLOURS[curve.colour % len(COLOURS)], linewidth=1.6)
        line.set_gid(titled(curve.label))
        for point in points if curve.dots else ():
            (dot,) = axes.plot(*point, "o", color=COLOURS[curve.colour % len(COLOURS)], markersize=5)
            dot.set_gid(titled(f"{curve.label}: {point[1]:.4g} at {point[0]:.4g} s"))
    if logarithmic:
        axes.set_yscale("log", subs=(2, 5))
        for set_formatter in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
            set_formatter("{x:g}")
    axes.set_xlim(left=0.0)
    axes.set_xlabel("s")
    axes.set_ylabel(y_title)
    axes.grid(axis="y", which="both", color=LINE)
    return plain(figure, axes)


def bars(names: Sequence[str], values: np.ndarray, *, marked: np.ndarray, unit: str) -> "Figure":
    """Draw a bar per photo, up or down from 0; marked bars are coloured, NaN is left out."""
    figure, axes = new_figure(10.4, 1.7)
    places, colours = np.arange(len(values)), np.where(marked, LOOK, BAR)
    drawn = axes.bar(places, np.nan_to_num(values), width=min(0.8, 0.024 * len(values)), color=colours)
    for bar, name, value in zip(drawn, names, values, strict=True):
        bar.set_gid(titled(f"{name}: {value:+.2f} {unit}"))
    # The scale is at least 1 wide, so that noise does not look like a finding.
    measured = values[~np.isnan(values)]
    axes.set_ylim(min(-0.5, 1.1 * measured.min(initial=0.0)), max(0.5, 1.1 * measured.max(initial=0.0)))
    axes.set_xlim(-0.7, len(values) - 0.3)
    axes.set_xticks([])
    axes.set_ylabel(unit)
    axes.grid(axis="y", color=LINE)
    axes.set_axisbelow(True)
    return plain(figure, axes)


def arrows(places: np.ndarray, towards: np.ndarray, titles: Sequence[str], *, marked: np.ndarray) -> "Figure":
    """Draw points (N, 2) in a plane with short lines along `towards` (N, 2); marked ones are coloured."""
    from matplotlib.collections import LineCollection

    (figure, axes), colours = new_figure(3.2, 3.2), np.where(marked, LOOK, BAR).tolist()
    length = 0.12 * (float(np.abs(places).max()) or 1.0)
    axes.add_collection(LineCollection(list(np.stack([places, places + length * towards], axis=1)), colors=colours))
    for place, title, colour in zip(places, titles, colours, strict=True):
        (dot,) = axes.plot(*place, "o", color=colour, markersize=4)
        dot.set_gid(titled(title))
    axes.set_aspect("equal")
    axes.axis("off")
    return figure


def plain(figure: "Figure", axes: "Axes") -> "Figure":
    """Leave out the frame, and give ticks and titles the colour of secondary text."""
    axes.spines[:].set_visible(False)
    axes.tick_params(which="both", length=0, labelsize=9, labelcolor=SOFT)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(color=SOFT, fontsize=9)
    return figure


def _thinned(points: Sequence[tuple[float, float]]) -> Sequence[tuple[float, float]]:
    """Return about 400 points, evenly spaced, including the last: more are not visible at this size."""
    step = -(-len(points) // 400)
    return points if step <= 1 else [*points[:-1:step], points[-1]]
