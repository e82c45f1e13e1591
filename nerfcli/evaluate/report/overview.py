"""Table of runs on several captures: one row each with a photo beside its rendering, sortable by column."""

from collections.abc import Sequence
from html import escape

import numpy as np

from nerfcli.evaluate.report.run_facts import RunFacts, warnings_of
from nerfcli.evaluate.report.tables import last_logged, metric, registered, render_time
from nerfcli.evaluate.report.views import HeldOutRenderings
from nerfcli.pages.page import data_uri, fitted, jpeg_bytes

_COLUMNS = (
    ("photos", lambda run: str(len(run.frames.train) + len(run.frames.test))),
    ("poses found", registered),
    ("PSNR, dB", metric("psnr", "{:.2f}")),
    ("SSIM", metric("ssim", "{:.4f}")),
    ("training, s", last_logged("seconds", "{:.1f}")),
    ("s per picture", render_time("{:.2f}")),
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
    view = sorted(look, key=lambda view: view.psnr)[len(look) // 2]
    both = np.hstack([fitted(view.photo, 120), fitted(view.picture, 120)])
    source = data_uri(jpeg_bytes(both), "jpeg")
    return f'<img class="thumbnail" alt="{escape(view.name)} and its rendering" src="{source}">'
