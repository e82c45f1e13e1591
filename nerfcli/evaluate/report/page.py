"""The report page: capture, poses, training, renderings of held-out photos, and speed."""

from collections.abc import Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from string import Template

import numpy as np

from nerfcli.atomic import digest
from nerfcli.evaluate.report.drawings import Curve, curves, from_above
from nerfcli.evaluate.report.run_facts import RunFacts, captures_of, mismatches_of, scenes_of, warnings_of
from nerfcli.evaluate.report.tables import (
    capture_html,
    last_logged,
    ledger_html,
    measured,
    numbers_html,
    photos_html,
    registered,
    selection_html,
    settings_html,
)
from nerfcli.evaluate.report.views import (
    COVERAGE_COLOURS,
    COVERAGE_RANGE,
    ERROR_COLOURS,
    ERROR_RANGE,
    HeldOutRenderings,
    coverage_picture,
    depth_range,
)
from nerfcli.pages import page
from nerfcli.pages.page import data_uri, fitted, jpeg_bytes
from nerfcli.photos.colours import levels_of
from nerfcli.render.depth import DepthRequest
from nerfcli.render.files.depth_pictures import DepthMeta
from nerfcli.render.presentation import coloured
from nerfcli.version import __version__

_COLUMNS = (
    ("photos", lambda run: str(len(run.frames.train) + len(run.frames.test))),
    ("poses found", registered),
    ("PSNR, dB", measured(lambda found: found.mean.psnr, "{:.2f}")),
    ("SSIM", measured(lambda found: found.mean.ssim, "{:.4f}")),
    ("training, s", last_logged("seconds", "{:.1f}")),
    ("s per picture", measured(lambda found: found.seconds_per_image, "{:.2f}")),
    ("warnings", lambda run: str(sum(1 for _ in warnings_of(run)))),
)


def overview_html(runs: Sequence[RunFacts], looks: Sequence[Sequence[HeldOutRenderings]]) -> str:
    """Format a table with a row for each run; its thumbnail is the photo with the median PSNR beside its rendering."""
    headings = "".join(f"<th{_aligned(name)}><button>{name}</button></th>" for name in ("run", *dict(_COLUMNS)))
    rows = "".join(
        f"<tr><td>{_thumbnails(look)}</td><td>{escape(run.label)}</td>"
        + "".join(f"<td class=number>{escape(read(run))}</td>" for _, read in _COLUMNS)
        + "</tr>"
        for run, look in zip(runs, looks, strict=True)
    )
    table = f"<table class=sortable><thead><tr><th></th>{headings}</tr></thead><tbody>{rows}</tbody></table>"
    return f'<h2>Captures</h2><p>Click a heading to sort.</p><div class="wide">{table}</div>'


def _aligned(name: str) -> str:
    return "" if name == "run" else " class=number"


def _thumbnails(look: Sequence[HeldOutRenderings]) -> str:
    if not look:
        return ""
    view = sorted(look, key=lambda view: view.metrics.psnr)[len(look) // 2]
    both = np.hstack([fitted(view.photo, 120), fitted(view.picture, 120)])
    source = data_uri(jpeg_bytes(both), "jpeg")
    return f'<img class="thumbnail" alt="{escape(view.name)} and its rendering" src="{source}">'


# With more runs than this, curves share colours.
COLOURS = 6
DEPTH_COLOURS = "turbo"
_MEGA = 1e6


def mark_of(runs: Sequence[Path]) -> page.Mark:
    """Return the mark of a report on these runs."""
    return page.Mark("report", Path("|".join(str(run.resolve()) for run in runs)))


def origin_of(runs: Sequence[RunFacts], hashes: Sequence[str], *, views: int, depth: DepthRequest) -> str:
    """Return a digest of everything a page is made from: fields, metrics, logs, settings, and display options.

    Args:
        hashes: digests of their fields.
        views, depth: number of held-out photos to show, and the depth that is shown.
    """
    facts = [
        [run.label, run.config.to_json(), run.log, run.metrics and run.metrics.to_json(), run.poses] for run in runs
    ]
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
    body = _BODY.substitute(
        title=escape(title),
        count="a run" if len(runs) == 1 else f"{len(runs)} runs",
        warnings=_warnings_html(runs),
        overview=overview_html(runs, looks) if len(captures_of(runs)) > 1 else "",
        numbers=numbers_html(runs),
        views=_views_html(runs, looks, ranges),
        legends=_legends_html(runs, ranges, depths),
        curves=_curves_html(runs),
        photos=photos_html(runs),
        capture=capture_html(runs),
        cameras=_cameras_html(runs),
        selection=selection_html(runs),
        ledger=ledger_html(runs),
        settings=settings_html(runs),
    )
    style = page.asset("compare.css") + _STYLE
    script = page.asset("compare.js") + page.asset("sort.js")
    mark = mark_of([run.path for run in runs])
    return page.page_html(title=title, mark=mark, style=style, body=body, script=script, origin=origin)


def _warnings_html(runs: Sequence[RunFacts]) -> str:
    rows = [("comparison", text) for text in mismatches_of(runs)]
    for run in runs:
        of = f"{run.label}: " if len(runs) > 1 else ""
        rows += [(stage, of + text) for stage, text in warnings_of(run)]
    items = "".join(f"<li><b>{escape(stage)}</b> {escape(text)}</li>" for stage, text in rows)
    return f'<ul class="warned">{items}</ul>' if rows else "<p>No warnings.</p>"


def _structure(view: HeldOutRenderings) -> str:
    return "not known" if view.metrics.ssim is None else f"{view.metrics.ssim:.3f}"


def _depth_ranges(runs: Sequence[RunFacts], looks: Sequence[Sequence[HeldOutRenderings]]) -> list[tuple[float, float]]:
    """Return the depth range of each run's colour scale, which all runs of a scene share."""
    scenes = scenes_of(runs)
    return [
        depth_range([view for other, look in zip(scenes, looks, strict=True) if other == scene for view in look])
        for scene in scenes
    ]


def _views_html(
    runs: Sequence[RunFacts], looks: Sequence[Sequence[HeldOutRenderings]], ranges: Sequence[tuple[float, float]]
) -> str:
    layers, figures = [], []
    shown = [
        (capture, name)
        for capture in captures_of(runs)
        for name in dict.fromkeys(view.name for index in capture for view in looks[index])
    ]
    for capture, name in shown:
        seen = [(runs[i], view, ranges[i]) for i in capture for view in looks[i] if view.name == name]
        first = seen[0][1]
        height, width = first.photo.shape[:2]
        facts = "; ".join(
            f"{run.label + ': ' if len(runs) > 1 else ''}{view.metrics.psnr:.2f} dB, SSIM {_structure(view)}, "
            f"depth in {100 * view.with_depth:.0f} % of the pixels"
            for run, view, _ in seen
        )
        figures.append(
            f'<figure class="compare" data-view="{len(layers)}">'
            f"<figcaption><b>{escape(name)}</b> {escape(facts)}</figcaption>"
            f'<div class="stage" style="aspect-ratio:{width}/{height}"><img alt=""><img alt="">'
            '<div class="line"></div></div><input type="range" min="0" max="100" value="50" aria-label="border">'
            '<div class="layers"><select aria-label="left"></select><select aria-label="right"></select></div></figure>'
        )
        layers.append(_layers(first, seen, alone=len(runs) == 1))
    if not figures:
        return "<p>No held-out photos.</p>"
    noscript = "<noscript><p>The pictures need JavaScript; nothing is loaded from the network.</p></noscript>"
    return f'{noscript}<div class="views">{"".join(figures)}</div>{page.data_element("views", layers)}'


def _layers(
    first: HeldOutRenderings, seen: Sequence[tuple[RunFacts, HeldOutRenderings, tuple[float, float]]], *, alone: bool
) -> list[dict[str, str]]:
    """Return the layers of a photo: itself, then the renderings, errors, depths and coverage of all runs."""

    def layer(kind: str, run: RunFacts, picture: np.ndarray) -> dict[str, str]:
        return _layer(kind if alone else f"{run.label}: {kind}", picture)

    depths = [(run, coloured(view.depth, lo=low, hi=high, colour_map=DEPTH_COLOURS)) for run, view, (low, high) in seen]
    return [
        _layer("photo", first.photo),
        *(layer("rendered", run, view.picture) for run, view, _ in seen),
        *(layer("error", run, view.error) for run, view, _ in seen),
        *(layer("depth", run, picture) for run, picture in depths),
        *(layer("coverage", run, coverage_picture(view.coverage)) for run, view, _ in seen),
    ]


def _layer(label: str, picture: np.ndarray) -> dict[str, str]:
    return {"label": label, "uri": data_uri(jpeg_bytes(picture, longest_px=800), "jpeg")}


def _legends_html(runs: Sequence[RunFacts], ranges: Sequence[tuple[float, float]], depths: Sequence[DepthMeta]) -> str:
    rows = [_legend("error", ERROR_COLOURS, "0", f">= {ERROR_RANGE:g}", "mean absolute difference of sRGB in [0, 1]")]
    meanings = [(limits, depth.in_words()) for limits, depth in zip(ranges, depths, strict=True)]
    for (low, high), words in dict.fromkeys(meanings):
        of = [run.label for run, meaning in zip(runs, meanings, strict=True) if meaning == ((low, high), words)]
        name = "depth" if len(of) == len(runs) else f"depth, {', '.join(of)}"
        rows.append(_legend(name, DEPTH_COLOURS, f"<= {low:.3g}", f">= {high:.3g}", words))
    rows.append(_coverage_legend())
    return "".join(rows)


def _coverage_legend() -> str:
    words = "training photos that see the surface; hatched: no surface"
    return _legend("coverage", COVERAGE_COLOURS, "0", f">= {COVERAGE_RANGE}", words)


def _legend(name: str, colour_map: str, low: str, high: str, text: str) -> str:
    stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in levels_of(colour_map)[::15].tolist())
    return (
        f'<p class="legend"><b>{escape(name)}</b> {escape(low)} '
        f'<span style="background:linear-gradient(90deg,{stops})"></span> {escape(high)}; {escape(text)}</p>'
    )


def _curves_html(runs: Sequence[RunFacts]) -> str:
    def drawn(key: str, *, scale: float = 1.0, dots: bool = False) -> list[Curve]:
        found = []
        for index, run in enumerate(runs):
            points = [
                (entry["seconds"], value) for entry in run.log if isinstance(value := entry.get(key), int | float)
            ]
            x, y = [seconds for seconds, _ in points], [value / scale for _, value in points]
            found.append(Curve(index % COLOURS, run.label, x, y, dots))
        return found

    charts = (
        ("PSNR of held-out pixels, dB", curves(drawn("heldout_psnr", dots=True), y_title="dB")),
        ("Loss", curves(drawn("loss"), y_title="loss", logarithmic=True)),
        ("Samples per second, M", curves(drawn("samples_per_second", scale=_MEGA), y_title="M/s")),
        ("Peak memory, MB", curves(drawn("peak_memory_bytes", scale=_MEGA), y_title="MB")),
    )
    key = "".join(
        f'<span><i class="s{index % COLOURS}"></i>{escape(run.label)}</span>' for index, run in enumerate(runs)
    )
    sections = "".join(f'<section class="chart"><h3>{title}</h3>{chart}</section>' for title, chart in charts if chart)
    if not sections:
        return "<p>The training log is empty.</p>"
    return (f'<p class="key">{key}</p>' if len(runs) > 1 else "") + f'<div class="charts pairs">{sections}</div>'


def _cameras_html(runs: Sequence[RunFacts]) -> str:
    """Draw the cameras of every scene, each scene once."""
    drawn: dict[str, str] = {}
    for run, scene in zip(runs, scenes_of(runs), strict=True):
        drawn.setdefault(scene, from_above(run.frames.train, run.frames.test))
    return "".join(f'<section class="chart">{drawing}</section>' for drawing in drawn.values() if drawing)


_STYLE = """\
.sortable button{all:unset;cursor:pointer}.sortable button:focus-visible{outline:2px solid var(--bar)}
[aria-sort=ascending] button::after{content:" \\2191"}[aria-sort=descending] button::after{content:" \\2193"}
.thumbnail{display:block;max-width:240px;border-radius:3px}
.warned li{margin:2px 0}.warned b{color:var(--look);margin-right:6px}
.pairs{grid-template-columns:repeat(auto-fill,minmax(min(100%,420px),1fr))}
.chart polyline{fill:none;stroke-width:1.6;stroke-linejoin:round}
.s0{stroke:#3b7dd8;fill:#3b7dd8;background:#3b7dd8}.s1{stroke:#d9822b;fill:#d9822b;background:#d9822b}
.s2{stroke:#2c9a66;fill:#2c9a66;background:#2c9a66}.s3{stroke:#b6479b;fill:#b6479b;background:#b6479b}
.s4{stroke:#7b61c9;fill:#7b61c9;background:#7b61c9}.s5{stroke:#8c8c35;fill:#8c8c35;background:#8c8c35}
.key span{margin-right:18px}.key i{display:inline-block;width:12px;height:12px;border-radius:3px;margin-right:6px}
.legend{font-size:13px;color:var(--soft);margin:8px 0}.legend b{color:var(--ink)}
.legend span{display:inline-block;width:140px;height:10px;border-radius:3px;vertical-align:middle;margin:0 4px}
.above{max-width:420px}.above .train{stroke:var(--bar);fill:var(--bar)}.above .test{stroke:var(--look);fill:var(--look)}
"""

_BODY = Template("""\
<div class="top"><div><h1>$title</h1><p>nerfcli report on $count</p></div></div>
$overview
<h2>Numbers</h2>
$numbers
<h2>Warnings</h2>
$warnings
<h2>Held-out photos</h2>
<p>Drag the slider; the lists below each picture choose what is shown on its left and right.</p>
$views
$legends
<h2>Training</h2>
$curves
<h2>Metrics per held-out photo</h2>
$photos
<h2>Use of held-out photos by stage</h2>
$ledger
$selection
<h2>Capture and poses</h2>
$capture
<h2>Cameras</h2>
<p>Projected onto their best-fitting plane; lines show viewing directions. Held-out photos are marked.</p>
<div class="charts pairs">$cameras</div>
<h2>Settings and versions</h2>
$settings
<footer>Pictures are compared as sRGB in 8 bit. Maps of depth, error and coverage were rendered for
this page.</footer>""")
