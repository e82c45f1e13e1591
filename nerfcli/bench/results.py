"""The results of a bench: points of time and error, their Pareto set, and the files that hold them."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli import __version__
from nerfcli.atomic import atomic_path, write_json
from nerfcli.pages import figures

BENCH = "bench.json"
COLUMNS = ("setting", "seconds", "quartiles", "repeats", "peak MB", "PSNR dB", "levels off", "steps", "fastest")
BEST = "yes"


@dataclass(frozen=True)
class Point:
    """One setting, by what differs from the default, with its time and its error.

    Args:
        seconds: median time of one picture, or of the training.
        low, high: quartiles of the repeats.
        peak_memory_bytes: None if the system does not report it.
        psnr: on held-out photos, dB.
        levels_off: root mean square difference from a converged rendering of the same field, in levels of 255; None for
            trainings, whose error is their PSNR.
    """

    name: str
    seconds: float
    low: float
    high: float
    repeats: int
    peak_memory_bytes: int | None
    psnr: float
    levels_off: float | None = None
    steps: int | None = None

    @property
    def error(self) -> float:
        """The error that is compared: smaller is better."""
        return -self.psnr if self.levels_off is None else self.levels_off


def spread(seconds: Sequence[float]) -> dict[str, Any]:
    """Return median, quartiles and number of repeats, as fields of `Point`."""
    low, median, high = (float(value) for value in np.percentile(seconds, (25, 50, 75)))
    return {"seconds": median, "low": low, "high": high, "repeats": len(seconds)}


def pareto(points: Sequence[Point]) -> set[str]:
    """Return the names of the points that no other beats in time or error without being worse in the other."""
    best, names = float("inf"), set()
    for point in sorted(points, key=lambda point: (point.seconds, point.error)):
        if point.error < best:
            best = point.error
            names.add(point.name)
    return names


def table_of(points: Sequence[Point]) -> list[tuple[str, ...]]:
    """Return the points as rows of `COLUMNS`, the fastest first."""
    chosen = pareto(points)
    return [
        (
            point.name,
            f"{point.seconds:.3g}",
            f"{point.low:.3g} to {point.high:.3g}",
            str(point.repeats),
            "-" if point.peak_memory_bytes is None else f"{point.peak_memory_bytes / 1e6:.0f}",
            f"{point.psnr:.2f}",
            "-" if point.levels_off is None else f"{point.levels_off:.2f}",
            "-" if point.steps is None else str(point.steps),
            BEST if point.name in chosen else "",
        )
        for point in sorted(points, key=lambda point: point.seconds)
    ]


def write_results(folder: Path, about: Mapping[str, Any], points: Sequence[Point], *, complete: bool) -> dict[str, Any]:
    """Write bench.csv, bench.png and, last, bench.json, each atomically; return the content of bench.json.

    `about` is what was measured, and where.

    Raises:
        UserError: a file cannot be written.
    """
    chosen = pareto(points)
    rows = [{**asdict(point), "pareto": point.name in chosen} for point in points]
    content = {"nerfcli": __version__, **about, "complete": complete, "points": rows}
    with atomic_path(folder / "bench.csv") as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*(field.name for field in fields(Point)), "pareto"])
        writer.writeheader()
        writer.writerows(rows)
    if points:
        _draw(folder / "bench.png", about, points)
    write_json(folder / BENCH, content)
    return content


def _draw(path: Path, about: Mapping[str, Any], points: Sequence[Point]) -> None:
    """Draw error against time: filled points are in the Pareto set, bars are quartiles."""
    (figure, axes), chosen = figures.new_figure(8, 5), pareto(points)
    of_rendering = points[0].levels_off is not None
    for point in points:
        height = point.levels_off if point.levels_off is not None else point.psnr
        bar = [[point.seconds - point.low], [point.high - point.seconds]]
        filled = "tab:blue" if point.name in chosen else "white"
        axes.errorbar(point.seconds, height, xerr=bar, fmt="o", color="tab:blue", markerfacecolor=filled)
        axes.annotate(point.name, (point.seconds, height), (5, 5), textcoords="offset points", fontsize=8, rotation=30)
    axes.set_xscale("log")
    if of_rendering:
        axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
    axes.margins(0.12)
    axes.set_xlabel("seconds per picture" if of_rendering else "seconds of training")
    axes.set_ylabel("rms error against a converged rendering, of 255 levels" if of_rendering else "held-out PSNR, dB")
    title = f"{Path(about['source']).name} on {about['machine']['processor']}, {about['machine']['threads']} threads"
    axes.set_title(title)
    axes.grid(alpha=0.3)
    figures.write_png(figure, path)
