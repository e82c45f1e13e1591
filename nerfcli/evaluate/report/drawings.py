"""SVG drawings for a report: training curves over seconds, and the cameras seen from above."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from nerfcli.cameras.frame import Frame

_WIDTH, _HEIGHT = 520, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 54, 10, 8, 34


@dataclass(frozen=True)
class Curve:
    """Curve of one run: colour index, label, x and y values; with `dots`, each point gets a marker."""

    colour: int
    label: str
    x: Sequence[float]
    y: Sequence[float]
    dots: bool = False


def curves(drawn: Sequence[Curve], *, y_title: str, logarithmic: bool = False) -> str:
    """Draw curves on common axes; return "" if there is nothing to draw.

    Args:
        drawn: curves; values that are not finite, or not positive on a logarithmic axis, are left out.
        y_title: title of the y axis, with the unit; x is in seconds.
    """
    points = [
        [
            (x, math.log10(y) if logarithmic else y)
            for x, y in zip(curve.x, curve.y, strict=True)
            if math.isfinite(y) and (y > 0 or not logarithmic)
        ]
        for curve in drawn
    ]
    everything = [point for one in points for point in one]
    if not everything:
        return ""
    low_x, high_x = 0.0, max(x for x, _ in everything) or 1.0
    low_y, high_y = _padded(min(y for _, y in everything), max(y for _, y in everything))

    def place(x: float, y: float) -> tuple[float, float]:
        across = _LEFT + (x - low_x) / (high_x - low_x) * (_WIDTH - _LEFT - _RIGHT)
        return across, _TOP + (high_y - y) / (high_y - low_y) * (_HEIGHT - _TOP - _BOTTOM)

    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(y_title)}">']
    for tick in _decade_ticks(low_y, high_y) if logarithmic else _ticks(low_y, high_y):
        y = place(0.0, tick)[1]
        text = _number(10.0**tick) if logarithmic else _number(tick)
        parts.append(f'<line x1="{_LEFT}" y1="{y:.1f}" x2="{_WIDTH - _RIGHT}" y2="{y:.1f}" stroke="var(--line)"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
    for tick in _ticks(low_x, high_x):
        x = place(tick, low_y)[0]
        parts.append(f'<text x="{x:.1f}" y="{_HEIGHT - 18}" text-anchor="middle">{_number(tick)}</text>')
    parts.append(f'<text x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 3}" text-anchor="end">s</text>')
    for curve, own in zip(drawn, points, strict=True):
        parts.append(_line(curve, [place(*point) for point in _thinned(own)]))
        if curve.dots:
            for x, y in own:
                across, down = place(x, y)
                value = 10.0**y if logarithmic else y
                title = f"{curve.label}: {value:.4g} at {x:.4g}"
                parts.append(
                    f'<circle class="s{curve.colour}" cx="{across:.1f}" cy="{down:.1f}" r="4">'
                    f"<title>{escape(title)}</title></circle>"
                )
    return "".join([*parts, "</svg>"])


def from_above(train: Sequence[Frame], test: Sequence[Frame]) -> str:
    """Draw positions and viewing directions of the cameras in their best-fitting plane; return "" without cameras.

    The plane is that of the two largest principal axes of the positions, so it does not depend on which way is up.
    """
    frames = [*train, *test]
    if not frames:
        return ""
    places = np.array([frame.world_from_cam[:3, 3] for frame in frames])
    sights = np.array([frame.world_from_cam[:3, 2] for frame in frames])
    centre = places.mean(0)
    axes = np.linalg.svd(places - centre, full_matrices=True)[2][:2]
    flat, towards = (places - centre) @ axes.T, sights @ axes.T
    extent = float(np.abs(flat).max()) or 1.0
    side = 300

    def pixel(point: np.ndarray) -> tuple[float, float]:
        across, down = (side / 2 + point * (0.43 * side / extent) * (1, -1)).tolist()
        return across, down

    parts = [f'<svg class="above" viewBox="0 0 {side} {side}" role="img" aria-label="cameras from above">']
    for index, frame in enumerate(frames):
        x, y = pixel(flat[index])
        end_x, end_y = pixel(flat[index] + towards[index] * (0.05 * extent / 0.43))
        kind = "train" if index < len(train) else "test"
        title = f"<title>{escape(frame.name)}, {kind}</title>"
        parts.append(
            f'<line class="{kind}" x1="{x:.1f}" y1="{y:.1f}" x2="{end_x:.1f}" y2="{end_y:.1f}"/>'
            f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="3">{title}</circle>'
        )
    return "".join([*parts, "</svg>"])


def _line(curve: Curve, places: Sequence[tuple[float, float]]) -> str:
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    return f'<polyline class="s{curve.colour}" points="{points}"><title>{escape(curve.label)}</title></polyline>'


def _thinned(points: Sequence[tuple[float, float]]) -> Sequence[tuple[float, float]]:
    """Return about 400 points, evenly spaced, including the last: more are not visible at this size."""
    step = -(-len(points) // 400)
    return points if step <= 1 else [*points[:-1:step], points[-1]]


def _padded(low: float, high: float) -> tuple[float, float]:
    margin = 0.06 * (high - low) or max(0.05 * abs(high), 1e-3)
    return low - margin, high + margin


def _ticks(low: float, high: float) -> list[float]:
    """Return about five round numbers between two values."""
    raw = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1, 2, 2.5, 5, 10) if power * factor >= raw)
    first = math.ceil(low / step)
    return [index * step for index in range(first, math.floor(high / step + 1e-9) + 1)]


def _decade_ticks(low: float, high: float) -> list[float]:
    """Return the logarithms, between two logarithms, of 1, 2 and 5 times powers of ten."""
    decades = range(math.floor(low), math.ceil(high) + 1)
    ticks = [decade + math.log10(factor) for decade in decades for factor in (1, 2, 5)]
    return [tick for tick in ticks if low <= tick <= high]


def _number(value: float) -> str:
    if abs(value) >= 10_000:
        return f"{value / 1000:.4g} k"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
