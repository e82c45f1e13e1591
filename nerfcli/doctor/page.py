"""Examine a capture; the diagnosis as one self-contained HTML page: findings, thumbnails, charts, the match matrix."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from markupsafe import Markup

from nerfcli.captures.calibration import read_calibration
from nerfcli.doctor.examination import Diagnosis, ExaminedCapture, estimated_seconds, examine
from nerfcli.doctor.quality import BLURRED, STOPS_LOOK
from nerfcli.errors import duration, several
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.pages import figures, page
from nerfcli.pages.findings import BAD, GOOD, LOOK, VERDICTS, worst
from nerfcli.pages.page import data_uri, picture_rule, png_bytes

_WORDS = {GOOD: "good", LOOK: "worth a look", BAD: "fix this first"}


def page_html(diagnosis: Diagnosis) -> str:
    """Return the page's text."""
    photos, findings = diagnosis.photos, diagnosis.findings
    order = sorted(findings, key=lambda finding: -VERDICTS.index(finding.verdict))
    counts = {which: sum(finding.verdict == which for finding in order) for which in VERDICTS}
    concerned = [[f for f in findings if photo.name in f.names and f.verdict != GOOD] for photo in photos]
    folder = diagnosis.subject.path.resolve()
    title = f"{folder.parent.name}/{folder.name}" if folder.name in ("images", "photos") else folder.name
    body = page.rendered(
        "doctor.html",
        title=title,
        kind=diagnosis.subject.kind,
        count=several(len(photos), "photo"),
        verdict=diagnosis.verdict,
        words=_WORDS[diagnosis.verdict],
        counts=", ".join(f"{counts[which]} {which}" for which in (BAD, LOOK, GOOD) if counts[which]),
        findings=order,
        not_checked=diagnosis.not_checked,
        number={photo.name: index for index, photo in enumerate(photos)},
        charts=list(_charts(diagnosis)) if len(photos) > 1 else [],
        all_photos=[(p.name, worst(f.verdict for f in own), own) for p, own in zip(photos, concerned, strict=True)],
    )
    # Pictures are in rules of the style, so that a photo shown twice is stored once.
    rules = (picture_rule(f"p{index}", data_uri(photo.thumbnail, "jpeg")) for index, photo in enumerate(photos))
    thumbnails = "\n".join(rules)
    return page.page_html(
        title=title,
        mark=page.Mark("doctor", diagnosis.subject.path),
        style=f"{page.asset('doctor.css')}{thumbnails}\n",
        body=body,
    )


def _charts(diagnosis: Diagnosis) -> Iterator[tuple[str, str, Markup]]:
    """Yield title, explanation and drawing."""
    names, missing, brighter = [p.name for p in diagnosis.photos], diagnosis.missing_detail, diagnosis.exposure_stops
    yield (
        "Relative detail",
        "Each bar is a photo, ordered by name. Below 0 it shows less detail than the others; coloured below "
        f"{-BLURRED:g} (half an octave is a blur of about 1 px at 1600 px).",
        figures.svg(figures.bars(names, -missing, marked=missing > BLURRED, unit="octaves")),
    )
    yield (
        "Relative brightness",
        "Brightness of the same points relative to the other photos, in stops.",
        figures.svg(figures.bars(names, brighter, marked=np.abs(brighter) > STOPS_LOOK / 2, unit="stops")),
    )
    yield (
        "Which photos match",
        "Rows and columns are photos, ordered by name; stronger colours mean more matches. An even band along "
        "the diagonal is a walk, a corner far from it a closed loop, separate blocks are disconnected parts.",
        _match_matrix(len(names), [(pair.first, pair.second, pair.inliers) for pair in diagnosis.pairs if pair.linked]),
    )


def _match_matrix(count: int, linked: Sequence[tuple[int, int, int]]) -> Markup:
    """Return an image of count x count cells, stronger for more matches, from `linked` tuples (i, j, matches)."""
    strength = np.zeros((count, count))
    for i, j, matches in linked:
        strength[i, j] = strength[j, i] = min(1.0, np.log2(matches / 16) / 5)
    np.fill_diagonal(strength, 0.12)
    paper, ink = np.array([237, 240, 243.0]), np.array([25, 74, 122.0])
    picture = np.rint(paper + strength[..., None] * (ink - paper)).astype(np.uint8)
    cell = max(1, 520 // count)
    data = png_bytes(np.kron(picture, np.ones((cell, cell, 1), np.uint8)))
    return Markup('<img class="matrix" alt="matches" src="{}">').format(data_uri(data, "png"))


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
    target = output.beside(capture.path, "-doctor.html")
    page.claim_page(output, target, page.Mark("doctor", capture.path), about="capture")
    count, threads = len(capture.sources), resources.cores
    reporter.note(f"{capture.path}: {count} photos, about {duration(estimated_seconds(count, threads))}")
    own_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # photos and pairs are processed in parallel; OpenCV's threads would only wait for each other
    try:
        diagnosis = examine(capture, threads=threads, progress=reporter.progress, calibration=calibration)
    finally:
        cv2.setNumThreads(own_threads)
    page.write_page(page_html(diagnosis), target)
    return diagnosis
