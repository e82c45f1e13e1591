"""Examine a capture; the diagnosis as one self-contained HTML page: findings, thumbnails, charts, the match matrix."""

import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from string import Template

import cv2
import numpy as np

from nerfcli.captures.calibration import read_calibration
from nerfcli.doctor.examination import Diagnosis, ExaminedCapture, estimated_seconds, examine
from nerfcli.doctor.quality import BLURRED, STOPS_LOOK
from nerfcli.errors import duration, several
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.pages.findings import BAD, GOOD, LOOK, VERDICTS, Finding, worst
from nerfcli.pages.page import Mark, claim_page, data_uri, picture_rule, png_bytes, write_page
from nerfcli.pages.page import page_html as whole_page

_WORDS = {GOOD: "good", LOOK: "worth a look", BAD: "fix this first"}


def page_html(diagnosis: Diagnosis) -> str:
    """Return the page's text."""
    photos, verdict = diagnosis.photos, diagnosis.verdict
    number = {photo.name: index for index, photo in enumerate(photos)}
    order = sorted(diagnosis.findings, key=lambda finding: -VERDICTS.index(finding.verdict))
    counts = {which: sum(finding.verdict == which for finding in order) for which in VERDICTS}
    body = _BODY.substitute(
        title=escape(_title(diagnosis.subject.path)),
        kind=diagnosis.subject.kind,
        count=several(len(photos), "photo"),
        verdict=verdict,
        words=_WORDS[verdict],
        counts=", ".join(f"{counts[which]} {which}" for which in (BAD, LOOK, GOOD) if counts[which]),
        findings="\n".join(_finding_html(finding, number) for finding in order),
        not_checked="".join(
            f"<li><b>{escape(check)}</b>: {escape(reason)}</li>" for check, reason in diagnosis.not_checked
        )
        or "<li>everything was checked</li>",
        charts=_charts_html(diagnosis),
        grid="\n".join(_photo_html(index, diagnosis) for index in range(len(photos))),
    )
    # Pictures are in rules of the style, so that a photo shown twice is stored once.
    rules = (picture_rule(f"p{index}", data_uri(photo.thumbnail, "jpeg")) for index, photo in enumerate(photos))
    thumbnails = "\n".join(rules)
    return whole_page(
        title=_title(diagnosis.subject.path),
        mark=Mark("doctor", diagnosis.subject.path),
        style=f"{_STYLE}{thumbnails}\n",
        body=body,
    )


def _title(capture: Path) -> str:
    folder = capture.resolve()
    return f"{folder.parent.name}/{folder.name}" if folder.name in ("images", "photos") else folder.name


def _finding_html(finding: Finding, number: dict[str, int]) -> str:
    pictured, rest = finding.photos[:12], finding.photos[12:]
    shown = "".join(_figure(number.get(name), name, what, link=True) for name, what in pictured)
    more = ""
    if rest:
        names = "".join(f"<li>{escape(name)} <span>{escape(what)}</span></li>" for name, what in rest)
        more = f"<details><summary>{several(len(rest), 'more photo')}</summary><ul>{names}</ul></details>"
    advice = f'<p class="advice">{escape(_sentence(finding.advice))}</p>' if finding.advice else ""
    photos = f'<div class="row">{shown}</div>{more}' if shown else ""
    return (
        f'<article class="{finding.verdict}"><header><span class="dot"></span><h3>{escape(finding.check)}</h3>'
        f"<p>{escape(_sentence(finding.summary))}</p></header>{advice}{photos}"
        f'<p class="threshold">{escape(finding.threshold)}</p></article>'
    )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."


def _figure(index: int | None, name: str, what: str, *, link: bool) -> str:
    picture = '<span class="picture none"></span>' if index is None else f'<span class="picture p{index}"></span>'
    if link and index is not None:
        picture = f'<a href="#photo{index}">{picture}</a>'
    short = re.split(r"[/\\]", name)[-1]
    return (
        f'<figure><div class="frame">{picture}</div>'
        f'<figcaption title="{escape(name)}"><b>{escape(short)}</b> {escape(what)}</figcaption></figure>'
    )


def _photo_html(index: int, diagnosis: Diagnosis) -> str:
    photo = diagnosis.photos[index]
    concerned = [finding for finding in diagnosis.findings if photo.name in finding.names and finding.verdict != GOOD]
    state = worst(finding.verdict for finding in concerned)
    badges = " ".join(f'<span class="badge {f.verdict}">{escape(f.check)}</span>' for f in concerned)
    figure = _figure(index, photo.name, "", link=False)
    return f'<div class="photo {state}" id="photo{index}">{figure}{badges}</div>'


def _charts_html(diagnosis: Diagnosis) -> str:
    photos, missing, brighter = diagnosis.photos, diagnosis.missing_detail, diagnosis.exposure_stops
    if len(photos) < 2:
        return ""
    names = [photo.name for photo in photos]
    linked = [(pair.first, pair.second, pair.inliers) for pair in diagnosis.pairs if pair.linked]
    charts = [
        (
            "Relative detail",
            "Each bar is a photo, ordered by name. Below 0 it shows less detail than the others; coloured below "
            f"{-BLURRED:g} (half an octave is a blur of about 1 px at 1600 px).",
            _bars(names, -missing, marked=missing > BLURRED, unit="octaves"),
        ),
        (
            "Relative brightness",
            "Brightness of the same points relative to the other photos, in stops.",
            _bars(names, brighter, marked=np.abs(brighter) > STOPS_LOOK / 2, unit="stops"),
        ),
        (
            "Which photos match",
            "Rows and columns are photos, ordered by name; stronger colours mean more matches. An even band along "
            "the diagonal is a walk, a corner far from it a closed loop, separate blocks are disconnected parts.",
            _match_matrix(len(photos), linked),
        ),
    ]
    return "".join(
        f'<section class="chart"><h3>{title}</h3><p>{text}</p>{chart}</section>' for title, text, chart in charts
    )


def _bars(names: Sequence[str], values: np.ndarray, *, marked: np.ndarray, unit: str) -> str:
    """Return an SVG chart with a bar per photo, up or down from 0; marked bars are coloured, NaN is left out."""
    measured = values[~np.isnan(values)]
    # The scale is at least 1 wide, so that noise does not look like a finding.
    low = min(-0.5, float(measured.min(initial=0.0)) * 1.1)
    high = max(0.5, float(measured.max(initial=0.0)) * 1.1)
    width, height, left = 1040, 150, 44
    step = (width - left) / max(len(values), 1)

    def row(value: float) -> float:
        return (high - value) / (high - low) * height

    parts = [f'<svg viewBox="0 -8 {width} {height + 16}" role="img">']
    for tick in _ticks(low, high):
        line = f'y1="{row(tick):.1f}" x2="{width}" y2="{row(tick):.1f}" stroke="var(--line)"'
        parts.append(f'<line x1="{left}" {line}/><text x="0" y="{row(tick) + 4:.1f}">{_tick(tick)}</text>')
    for index, (name, value) in enumerate(zip(names, values, strict=True)):
        if np.isnan(value):
            continue
        top, bottom = sorted((row(float(value)), row(0.0)))
        colour = "var(--look)" if marked[index] else "var(--bar)"
        place = f'x="{left + index * step + 0.1 * step:.2f}" y="{top:.1f}" width="{min(0.8 * step, 24):.2f}"'
        title = f"<title>{escape(name)}: {value:+.2f} {unit}</title>"
        parts.append(f'<rect {place} height="{max(bottom - top, 1):.1f}" fill="{colour}">{title}</rect>')
    return "".join([*parts, "</svg>"])


def _match_matrix(count: int, linked: Sequence[tuple[int, int, int]]) -> str:
    """Return an image of count x count cells, stronger for more matches, from `linked` tuples (i, j, matches)."""
    strength = np.zeros((count, count))
    for i, j, matches in linked:
        strength[i, j] = strength[j, i] = min(1.0, np.log2(matches / 16) / 5)
    np.fill_diagonal(strength, 0.12)
    paper, ink = np.array([237, 240, 243.0]), np.array([25, 74, 122.0])
    picture = np.rint(paper + strength[..., None] * (ink - paper)).astype(np.uint8)
    cell = max(1, 520 // count)
    data = png_bytes(np.kron(picture, np.ones((cell, cell, 1), np.uint8)))
    return f'<img class="matrix" alt="matches" src="{data_uri(data, "png")}">'


def _tick(value: float) -> str:
    return f"{value:+g}" if value else "0"


def _ticks(low: float, high: float) -> list[float]:
    step = 0.5 if high - low <= 3 else 1.0 if high - low <= 8 else 4.0
    return [float(tick) for tick in np.arange(np.ceil(low / step), high / step + 1e-9) * step]


_STYLE = """\
article{background:var(--card);border:1px solid var(--line);border-left:4px solid var(--good);border-radius:8px;
padding:12px 16px;margin:8px 0}
article.look{border-left-color:var(--look);background:var(--tint-look)}
article.bad{border-left-color:var(--bad);background:var(--tint-bad)}
article header{display:grid;grid-template-columns:12px 140px 1fr;gap:10px;align-items:baseline}
article header p{margin:0}.dot{width:10px;height:10px;border-radius:50%;background:var(--good)}
.look .dot{background:var(--look)}.bad .dot{background:var(--bad)}
.advice{margin:6px 0 0 172px;font-weight:600}
.threshold{margin:4px 0 0 172px;color:var(--soft);font-size:12.5px}
.row{display:flex;flex-wrap:wrap;gap:10px;margin:10px 0 2px 172px}
details{margin:4px 0 0 172px;font-size:13px}details ul{columns:3 220px;padding-left:18px}details span{color:var(--soft)}
figure{margin:0;width:132px}.frame{height:100px;background:var(--line);border-radius:6px;overflow:hidden}
.picture{display:block;width:100%;height:100%;background-size:contain;background-repeat:no-repeat;background-position:center}
.none{background:repeating-linear-gradient(45deg,var(--line) 0 8px,transparent 8px 16px)}
figcaption{font-size:12px;line-height:1.35;margin-top:4px;color:var(--soft);overflow-wrap:anywhere}
figcaption b{color:var(--ink);font-weight:600;display:block}
.matrix{width:min(100%,520px);image-rendering:pixelated;border-radius:4px}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(140px,1fr));gap:14px}
.photo{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:8px}
.photo figure{width:100%}.photo.look{border-color:var(--look)}.photo.bad{border-color:var(--bad)}
.photo:target{outline:3px solid var(--look)}
.badge{display:inline-block;font-size:11px;border-radius:4px;padding:0 6px;margin-top:4px;color:#fff;
background:var(--look)}
.badge.bad{background:var(--bad)}
@media (max-width:640px){.advice,.threshold,.row,details{margin-left:0}article header{grid-template-columns:12px 1fr}
article header p{grid-column:1/-1}}
"""

_BODY = Template("""\
<div class="top"><div><h1>$title</h1><p>nerfcli doctor: $kind, $count; checks: $counts</p></div>
<span class="pill $verdict">$words</span></div>
<h2>Findings</h2>
$findings
<h2>Not checked</h2><ul>$not_checked</ul>
<h2>Photo by photo</h2>
<div class="charts">$charts</div>
<h2>All photos</h2>
<div class="grid">$grid</div>
<footer>Photos were checked at 1600 px and matched at 800 px. Blur that vanishes at that size, camera movement along the
line of sight, and objects moving towards or away from the camera are not detected; repeated patterns may look like
matches.</footer>""")


def examine_capture(
    capture: ExaminedCapture,
    output: Output = Output(),
    intrinsics: Path | None = None,
    *,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> Diagnosis:
    """Examine a capture and write its page.

    Args:
        capture: a folder of photos, or a scene; see `find_subject`.
        output: the page, CAPTURE-doctor.html by default.
        intrinsics: a file with the intrinsics of the cameras, if they are known.

    Raises:
        UserError: see `read_calibration` and `claim_page`.
    """
    calibration = None if intrinsics is None else read_calibration(intrinsics, images=capture.path)
    page = output.beside(capture.path, "-doctor.html")
    claim_page(output, page, Mark("doctor", capture.path), about="capture")
    count, threads = len(capture.sources), resources.cores
    reporter.note(f"{capture.path}: {count} photos, about {duration(estimated_seconds(count, threads))}")
    cv2.setNumThreads(1)  # photos and pairs are processed in parallel; OpenCV's threads would only wait for each other
    diagnosis = examine(capture, threads=threads, progress=reporter.progress, calibration=calibration)
    write_page(page_html(diagnosis), page)
    return diagnosis
