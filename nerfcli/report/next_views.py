"""The page that shows what the photos of a run cover, and where to take further ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.pages import page
from nerfcli.pages.embedded_pictures import data_uri, jpeg_bytes
from nerfcli.report.drawings import from_above
from nerfcli.report.page import ABOVE_STYLE, LEGEND_STYLE, coverage_legend
from nerfcli.report.views import coverage_picture

_PICTURE_PX = 480


@dataclass(frozen=True)
class NextView:
    """A view from which a further photo should be taken.

    Args:
        frame: its camera and pose.
        gain: fraction of the surface that it would be the first or second photo to see.
        picture: (H, W, 3) uint8 sRGB, rendered from there.
        coverage: (h, w) number of photos that see the surface; NaN where there is none.
    """

    frame: Frame
    gain: float
    picture: np.ndarray
    coverage: np.ndarray


def next_views_html(
    run: Path,
    *,
    photos: Sequence[Frame],
    fractions: Mapping[str, float],
    seen_twice: tuple[float, float],
    views: Sequence[NextView],
) -> str:
    """Return the page's text.

    Args:
        run: the folder; its name is the title.
        photos: the training photos.
        fractions: of the surface, by the number of photos that see it.
        seen_twice: fraction of the surface that at least two photos see, before and after adding the views.
        views: best first.
    """
    before, after = seen_twice
    body = _BODY.substitute(
        title=escape(run.resolve().name),
        photos=len(photos),
        rows="".join(
            f'<tr><td>{escape(name)}</td><td class="number">{100 * fraction:.1f} %</td></tr>'
            for name, fraction in fractions.items()
        ),
        seen=f"Two photos or more see {100 * before:.1f} % of the surface, with the views below {100 * after:.1f} %."
        if views
        else f"Two photos or more see {100 * before:.1f} % of the surface, and no further view would add to it.",
        views="".join(map(_view_html, views)),
        legend=coverage_legend() if views else "",
        above=from_above(photos, [view.frame for view in views]),
    )
    style = LEGEND_STYLE + ABOVE_STYLE + _STYLE
    return page.page_html(title=f"{run.resolve().name}: next views", mark=mark_of(run), style=style, body=body)


def mark_of(run: Path) -> page.Mark:
    """Return the mark of a run's page of next views."""
    return page.Mark("next-views", run)


def _view_html(view: NextView) -> str:
    position = ", ".join(f"{value:.3g}" for value in view.frame.centre)
    pictures = "".join(
        f'<img alt="{alt}" src="{data_uri(jpeg_bytes(picture, longest_px=_PICTURE_PX), "jpeg")}">'
        for alt, picture in (("rendered", view.picture), ("coverage", coverage_picture(view.coverage)))
    )
    return (
        f"<figure><figcaption><b>{escape(view.frame.name)}</b> at {escape(position)}; first or second to see "
        f'{100 * view.gain:.1f} % of the surface</figcaption><div class="pair">{pictures}</div></figure>'
    )


_STYLE = """\
.views{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,420px),1fr));gap:16px}
figure{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:12px;margin:0}
figcaption{font-size:13px;color:var(--soft);margin-bottom:8px}figcaption b{color:var(--ink)}
.pair{display:grid;grid-template-columns:1fr 1fr;gap:8px}.pair img{width:100%;border-radius:4px}
.narrow{max-width:420px}
"""

_BODY = Template("""\
<div class="top"><div><h1>$title</h1><p>What its $photos training photos have seen, and where to take further ones</p>
</div></div>
<h2>Surface by number of photos that see it</h2>
<div class="wide narrow"><table><tbody>$rows</tbody></table></div>
<p>$seen</p>
<h2>Next views</h2>
$legend
<div class="views">$views</div>
<h2>Cameras</h2>
<p>Projected onto their best-fitting plane; lines show viewing directions. The next views are marked.</p>
<div class="chart narrow">$above</div>
<footer>The camera path beside this page holds the same views: nerfcli render RUN --cameras cameras.json</footer>""")
