"""Small charts for the page, without a plotting library: bars as SVG, the match matrix as PNG."""

from collections.abc import Sequence
from html import escape

import numpy as np

from nerfcli.pages.embedded_pictures import data_uri, png_bytes

_WIDTH, _HEIGHT, _LEFT = 1040, 150, 44
# The scale of a chart is at least this wide, so that noise does not look like a finding.
_LEAST_RANGE = 1.0


def bars(names: Sequence[str], values: np.ndarray, *, marked: np.ndarray, unit: str) -> str:
    """Return an SVG chart with a bar per photo, up or down from 0; marked bars are coloured, NaN is left out."""
    measured = values[~np.isnan(values)]
    low = min(-_LEAST_RANGE / 2, float(measured.min(initial=0.0)) * 1.1)
    high = max(_LEAST_RANGE / 2, float(measured.max(initial=0.0)) * 1.1)
    step = (_WIDTH - _LEFT) / max(len(values), 1)

    def row(value: float) -> float:
        return (high - value) / (high - low) * _HEIGHT

    parts = [f'<svg viewBox="0 -8 {_WIDTH} {_HEIGHT + 16}" role="img">']
    for tick in _ticks(low, high):
        line = f'y1="{row(tick):.1f}" x2="{_WIDTH}" y2="{row(tick):.1f}" stroke="var(--line)"'
        parts.append(f'<line x1="{_LEFT}" {line}/><text x="0" y="{row(tick) + 4:.1f}">{_tick(tick)}</text>')
    for index, (name, value) in enumerate(zip(names, values, strict=True)):
        if np.isnan(value):
            continue
        top, bottom = sorted((row(float(value)), row(0.0)))
        colour = "var(--look)" if marked[index] else "var(--bar)"
        place = f'x="{_LEFT + index * step + 0.1 * step:.2f}" y="{top:.1f}" width="{min(0.8 * step, 24):.2f}"'
        title = f"<title>{escape(name)}: {value:+.2f} {unit}</title>"
        parts.append(f'<rect {place} height="{max(bottom - top, 1):.1f}" fill="{colour}">{title}</rect>')
    return "".join([*parts, "</svg>"])


def match_matrix(count: int, linked: Sequence[tuple[int, int, int]]) -> str:
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
