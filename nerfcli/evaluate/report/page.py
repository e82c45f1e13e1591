"""The report page: capture, poses, training, renderings of held-out photos, and speed."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from nerfcli import __version__
from nerfcli.atomic import digest
from nerfcli.cameras.frame import Frame
from nerfcli.evaluate.report.run_facts import RunFacts, captures_of, mismatches_of, scenes_of, warnings_of
from nerfcli.evaluate.report.tables import (
    CAPTURE,
    NUMBERS,
    as_number,
    columns_table,
    last_logged,
    ledger_table,
    measured,
    photo_tables,
    registered,
    selection_table,
    settings_table,
)
from nerfcli.evaluate.report.views import (
    COVERAGE_COLOURS,
    COVERAGE_RANGE,
    ERROR_COLOURS,
    ERROR_RANGE,
    HeldOutRenderings,
    depth_range,
)
from nerfcli.pages import figures, page
from nerfcli.pages.page import data_uri, jpeg_bytes
from nerfcli.photos.colours import levels_of
from nerfcli.photos.images import reduced
from nerfcli.render.depth import DepthRequest
from nerfcli.render.files.depth_meta import DepthMeta
from nerfcli.render.presentation import ColourRange, coloured

DEPTH_COLOURS = "turbo"
_MEGA = 1e6
_COLUMNS: tuple[tuple[str, Callable[[RunFacts], str]], ...] = (
    ("photos", lambda run: str(len(run.frames.train) + len(run.frames.test))),
    ("poses found", registered),
    ("PSNR, dB", measured(lambda found: found.mean.psnr, "{:.2f}")),
    ("SSIM", measured(lambda found: found.mean.ssim, "{:.4f}")),
    ("training, s", last_logged("seconds", "{:.1f}")),
    ("s per picture", measured(lambda found: found.seconds_per_image, "{:.2f}")),
    ("warnings", lambda run: str(sum(1 for _ in warnings_of(run)))),
)


def mark_of(runs: Sequence[Path]) -> page.Mark:
    """Return the mark of a report on these runs."""
    return page.Mark("report", Path("|".join(str(run.resolve()) for run in runs)))


def origin_of(runs: Sequence[RunFacts], hashes: Sequence[str], *, views: int, depth: DepthRequest) -> str:
    """Return a digest of all that a page is made from: fields, by their `hashes`, metrics, logs, settings, options."""
    facts = [[r.label, r.config.to_json(), r.log, r.metrics and r.metrics.to_json(), r.poses] for r in runs]
    return digest([__version__, list(hashes), facts, views, asdict(depth)])


def page_html(
    runs: Sequence[RunFacts],
    looks: Sequence[Sequence[HeldOutRenderings]],
    *,
    depths: Sequence[DepthMeta],
    origin: str | None = None,
) -> str:
    """Return the page's text.

    Args:
        runs: at least one.
        looks: renderings of held-out photos by each run; runs of a capture show the same photos.
        depths: meaning of each run's depths.
        origin: see `origin_of`.
    """
    ranges = _depth_ranges(runs, looks)
    title = " against ".join(run.label for run in runs) if len(runs) < 4 else f"{len(runs)} runs"
    views, layers = _views(runs, looks, ranges)
    body = page.rendered(
        "report.html",
        title=title,
        count="a run" if len(runs) == 1 else f"{len(runs)} runs",
        runs=[(run.label, figures.COLOURS[index % len(figures.COLOURS)]) for index, run in enumerate(runs)],
        warnings=_warnings(runs),
        overview=_overview(runs, looks) if len(captures_of(runs)) > 1 else None,
        numbers=columns_table(runs, NUMBERS),
        protocols=list(dict.fromkeys(run.metrics.protocol for run in runs if run.metrics)),
        views=views,
        layers=page.data_element("views", layers),
        legends=list(_legends(runs, ranges, depths)),
        charts=list(_charts(runs)),
        photos=photo_tables(runs),
        capture=columns_table(runs, CAPTURE),
        cameras=_cameras(runs),
        selection=selection_table(runs),
        ledger=ledger_table(runs),
        settings=settings_table(runs),
    )
    style = page.asset("compare.css") + page.asset("report.css")
    script = page.asset("compare.js") + page.asset("sort.js")
    mark = mark_of([run.path for run in runs])
    return page.page_html(title=title, mark=mark, style=style, body=body, script=script, origin=origin)


def _overview(runs: Sequence[RunFacts], looks: Sequence[Sequence[HeldOutRenderings]]) -> dict[str, Any]:
    """Return columns, and a row for each run; its thumbnail is the photo with the median PSNR and its rendering."""
    rows = [
        (_thumbnail(look), (run.label, *(read(run) for _, read in _COLUMNS)))
        for run, look in zip(runs, looks, strict=True)
    ]
    return {"columns": ("run", *dict(_COLUMNS)), "rows": rows}


def _thumbnail(look: Sequence[HeldOutRenderings]) -> tuple[str, str] | None:
    if not look:
        return None
    view = sorted(look, key=lambda view: view.metrics.psnr)[len(look) // 2]
    both = np.hstack([reduced(view.photo, 120), reduced(view.picture, 120)])
    return view.name, data_uri(jpeg_bytes(both), "jpeg")


def _warnings(runs: Sequence[RunFacts]) -> list[tuple[str, str]]:
    """Return (stage, text) of all warnings."""
    rows = [("comparison", text) for text in mismatches_of(runs)]
    for run in runs:
        of = f"{run.label}: " if len(runs) > 1 else ""
        rows += [(stage, of + text) for stage, text in warnings_of(run)]
    return rows


def _depth_ranges(runs: Sequence[RunFacts], looks: Sequence[Sequence[HeldOutRenderings]]) -> list[ColourRange]:
    """Return the depth range of each run's colour scale, which all runs of a scene share."""
    scenes = scenes_of(runs)
    return [
        depth_range([view for other, look in zip(scenes, looks, strict=True) if other == scene for view in look])
        for scene in scenes
    ]


def _views(
    runs: Sequence[RunFacts], looks: Sequence[Sequence[HeldOutRenderings]], ranges: Sequence[ColourRange]
) -> tuple[list[dict[str, Any]], list[list[dict[str, str]]]]:
    """Return what is said about each held-out photo, and its layers."""
    layers, shown = [], []
    pairs = [
        (capture, name)
        for capture in captures_of(runs)
        for name in dict.fromkeys(view.name for index in capture for view in looks[index])
    ]
    for capture, name in pairs:
        seen = [(runs[i], view, ranges[i]) for i in capture for view in looks[i] if view.name == name]
        first = seen[0][1]
        height, width = first.photo.shape[:2]
        facts = "; ".join(
            f"{run.label + ': ' if len(runs) > 1 else ''}{view.metrics.psnr:.2f} dB, SSIM "
            f"{as_number(view.metrics.ssim, 3) or 'not known'}, depth in {100 * view.with_depth:.0f} % of the pixels"
            for run, view, _ in seen
        )
        shown.append({"name": name, "facts": facts, "width": width, "height": height})
        layers.append(_layers(first, seen, alone=len(runs) == 1))
    return shown, layers


def _layers(
    first: HeldOutRenderings, seen: Sequence[tuple[RunFacts, HeldOutRenderings, ColourRange]], *, alone: bool
) -> list[dict[str, str]]:
    """Return the layers of a photo: itself, then the renderings, errors, depths and coverage of all runs."""

    def layer(kind: str, run: RunFacts, picture: np.ndarray) -> dict[str, str]:
        return _layer(kind if alone else f"{run.label}: {kind}", picture)

    counts = ColourRange(0.0, float(COVERAGE_RANGE))
    return [
        _layer("photo", first.photo),
        *(layer("rendered", run, view.picture) for run, view, _ in seen),
        *(layer("error", run, view.error) for run, view, _ in seen),
        *(layer("depth", run, coloured(view.depth, colours, DEPTH_COLOURS)) for run, view, colours in seen),
        *(layer("coverage", run, coloured(view.coverage, counts, COVERAGE_COLOURS)) for run, view, _ in seen),
    ]


def _layer(label: str, picture: np.ndarray) -> dict[str, str]:
    return {"label": label, "uri": data_uri(jpeg_bytes(reduced(picture, 800)), "jpeg")}


def _legends(
    runs: Sequence[RunFacts], ranges: Sequence[ColourRange], depths: Sequence[DepthMeta]
) -> Iterator[dict[str, str]]:
    yield _legend("error", ERROR_COLOURS, "0", f">= {ERROR_RANGE:g}", "mean absolute difference of sRGB in [0, 1]")
    meanings = [(limits, depth.in_words()) for limits, depth in zip(ranges, depths, strict=True)]
    for colours, words in dict.fromkeys(meanings):
        of = [run.label for run, meaning in zip(runs, meanings, strict=True) if meaning == (colours, words)]
        by_inverse = "; colours by 1 / depth" if colours.inverse else ""
        name = "depth" if len(of) == len(runs) else f"depth, {', '.join(of)}"
        yield _legend(name, DEPTH_COLOURS, f"<= {colours.low:.3g}", f">= {colours.high:.3g}", words + by_inverse)
    words = "training photos that see the surface; hatched: no surface"
    yield _legend("coverage", COVERAGE_COLOURS, "0", f">= {COVERAGE_RANGE}", words)


def _legend(name: str, colour_map: str, low: str, high: str, text: str) -> dict[str, str]:
    stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in levels_of(colour_map)[::15].tolist())
    return {"name": name, "stops": stops, "low": low, "high": high, "text": text}


def _charts(runs: Sequence[RunFacts]) -> Iterator[tuple[str, Markup]]:
    """Yield title and drawing of each logged number over the seconds of the training."""
    for title, key, scale, y_title in (
        ("PSNR of held-out pixels, dB", "heldout_psnr", 1.0, "dB"),
        ("Loss", "loss", 1.0, "loss"),
        ("Samples per second, M", "samples_per_second", _MEGA, "M/s"),
        ("Peak memory, MB", "peak_memory_bytes", _MEGA, "MB"),
    ):
        drawn = []
        for index, run in enumerate(runs):
            points = [(entry["seconds"], x) for entry in run.log if isinstance(x := entry.get(key), int | float)]
            x, y = [seconds for seconds, _ in points], [value / scale for _, value in points]
            drawn.append(figures.Curve(index, run.label, x, y, dots=key == "heldout_psnr"))
        figure = figures.curves(drawn, y_title=y_title, logarithmic=key == "loss")
        if figure is not None:
            yield title, figures.svg(figure)


def _cameras(runs: Sequence[RunFacts]) -> list[Markup]:
    """Draw the cameras of every scene, each scene once."""
    scenes = {scene: run.frames for run, scene in zip(reversed(runs), reversed(scenes_of(runs)), strict=True)}
    every = [frames for frames in reversed(scenes.values()) if (*frames.train, *frames.test)]
    return [figures.svg(from_above(frames.train, frames.test), width="min(100%,420px)") for frames in every]


def from_above(train: Sequence[Frame], test: Sequence[Frame]) -> "figures.Figure":
    """Draw positions and viewing directions of the cameras in their best-fitting plane.

    The plane is that of the two largest principal axes of the positions, so it does not depend on which way is up.
    """
    frames = [*train, *test]
    places = np.array([frame.world_from_cam[:3, 3] for frame in frames])
    sights = np.array([frame.world_from_cam[:3, 2] for frame in frames])
    centre = places.mean(0)
    axes = np.linalg.svd(places - centre, full_matrices=True)[2][:2]
    held_out = np.arange(len(frames)) >= len(train)
    titles = [f"{f.name}, {'test' if out else 'train'}" for f, out in zip(frames, held_out, strict=True)]
    return figures.arrows((places - centre) @ axes.T, sights @ axes.T, titles, marked=held_out)
