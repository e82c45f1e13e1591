"""HTML page of a scan's checks: findings, a projection, the sinogram of a row."""

from html import escape
from pathlib import Path
from string import Template

import numpy as np

from nerfcli.ct.checks.examine import ScanDiagnosis
from nerfcli.pages import page
from nerfcli.pages.findings import VERDICTS, Finding
from nerfcli.pages.page import data_uri, jpeg_bytes

_LONGEST_PX = 640


def write_scan_page(diagnosis: ScanDiagnosis, path: Path, *, source: Path) -> None:
    """Write the page, atomically.

    Raises:
        UserError: it cannot be written.
    """
    page.write_page(scan_page_html(diagnosis, source), path)


def refuse_foreign(path: Path, source: Path) -> None:
    """Raise unless a page of this scan may be written at a path.

    Raises:
        UserError: the path holds something else.
    """
    page.refuse_foreign(path, page.Mark("doctor", source), about="scan")


def scan_page_html(diagnosis: ScanDiagnosis, source: Path) -> str:
    """Return the page's text."""
    order = sorted(diagnosis.findings, key=lambda finding: -VERDICTS.index(finding.verdict))
    sample = diagnosis.sample
    middle = sample.integrals.shape[1] // 2
    sinogram = sample.integrals[:, middle]
    pictures = [("Sinogram", f"line integrals of row {int(sample.rows[middle])}, a line per view", sinogram)]
    if sample.scan.geometry.rows > 1:
        first = sample.scan.line_integrals(np.array([0]))[0]
        pictures.insert(0, ("First projection", "line integrals", first))
    body = _BODY.substitute(
        title=escape(source.resolve().name),
        findings="\n".join(map(_finding_html, order)),
        not_checked="".join(f"<li><b>{escape(c)}</b>: {escape(why)}</li>" for c, why in diagnosis.not_checked)
        or "<li>everything was checked</li>",
        pictures="\n".join(_picture_html(*each) for each in pictures),
    )
    return page.page_html(title=source.resolve().name, mark=page.Mark("doctor", source), style=_STYLE, body=body)


def _finding_html(finding: Finding) -> str:
    advice = f'<p class="advice">{escape(_sentence(finding.advice))}</p>' if finding.advice else ""
    return (
        f'<article class="{finding.verdict}"><h3>{escape(finding.check)}</h3>'
        f"<p>{escape(_sentence(finding.summary))}</p>{advice}"
        f'<p class="threshold">{escape(finding.threshold)}</p></article>'
    )


def _picture_html(title: str, text: str, values: np.ndarray) -> str:
    low, high = np.quantile(values, [0.005, 0.995])
    grey = np.clip((values - low) / max(float(high - low), 1e-12), 0, 1)
    levels = np.repeat((255 * grey).astype(np.uint8)[..., None], 3, axis=2)
    uri = data_uri(jpeg_bytes(levels, longest_px=_LONGEST_PX), "jpeg")
    return (
        f"<figure><img src={uri!r} alt={title!r}><figcaption><b>{escape(title)}</b> {escape(text)}, "
        f"{low:.3g} (black) to {high:.3g}</figcaption></figure>"
    )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."


_STYLE = """\
article{background:var(--card);border:1px solid var(--line);border-left:4px solid var(--good);border-radius:8px;
padding:12px 16px;margin:8px 0}
article.look{border-left-color:var(--look);background:var(--tint-look)}
article.bad{border-left-color:var(--bad);background:var(--tint-bad)}
article h3,article p{margin:2px 0}.advice{font-weight:600}.threshold,figcaption{color:var(--soft);font-size:12.5px}
figure{margin:12px 0}img{max-width:100%}
"""
_BODY = Template("""\
<div class="top"><div><h1>$title</h1><p>nerfcli doctor: an X-ray scan</p></div></div>
<h2>Findings</h2>
$findings
<h2>Not checked</h2><ul>$not_checked</ul>
<h2>What was measured</h2>
$pictures""")
