"""Previews of depth maps: false colours over a range of depths, with a legend that names convention, axis and unit."""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from nerfcli.photos.colours import levels_of
from nerfcli.render.files.depth_pictures import AXES, UNIT_OF, DepthMeta

_HALF = 2**16


def quantiles(maps: Callable[[], Iterable[np.ndarray]], fractions: Sequence[float]) -> list[float]:
    """Return exact quantiles of all finite values of many arrays, in memory that does not depend on their number.

    Floats are ordered by their bits. The first pass counts all values by their upper 16 bits; the second pass counts
    the values in the bins that contain a quantile by their lower 16 bits.

    Args:
        maps: returns the arrays, float32 of any shape; called twice, and must return the same both times.
        fractions: in [0, 1].

    Returns:
        For each fraction, the smallest value that at least this fraction of all values does not exceed; an empty list
        if there is no finite value.
    """
    upper_counts = np.zeros(_HALF, dtype=np.int64)
    for values in maps():
        upper_counts += np.bincount(_ordered(values) >> 16, minlength=_HALF)
    total = int(upper_counts.sum())
    if total == 0:
        return []
    ranks = [min(max(int(np.ceil(fraction * total)) - 1, 0), total - 1) for fraction in fractions]
    below = np.cumsum(upper_counts)
    uppers = [int(np.searchsorted(below, rank, side="right")) for rank in ranks]
    lower_counts = {upper: np.zeros(_HALF, dtype=np.int64) for upper in uppers}
    for values in maps():
        keys = _ordered(values)
        for upper, counts in lower_counts.items():
            counts += np.bincount(keys[keys >> 16 == upper] & (_HALF - 1), minlength=_HALF)
    found = []
    for rank, upper in zip(ranks, uppers, strict=True):
        within = rank - int(below[upper] - upper_counts[upper])
        lower = int(np.searchsorted(np.cumsum(lower_counts[upper]), within, side="right"))
        found.append(_value(upper * _HALF + lower))
    return found


def _ordered(values: np.ndarray) -> np.ndarray:
    """Return the finite values as uint32 in the same order; the bits of negative floats are inverted."""
    bits = np.ascontiguousarray(values[np.isfinite(values)], dtype=np.float32).view(np.uint32)
    return np.where(bits >> 31 == 1, ~bits, bits | np.uint32(1 << 31))


def _value(key: int) -> float:
    bits = key ^ (1 << 31) if key >> 31 else ~key & 0xFFFFFFFF
    return float(np.array(bits, dtype=np.uint32).view(np.float32))


COLOURS = "turbo"
_HATCH = np.array([[112, 112, 112], [160, 160, 160]], dtype=np.uint8)
_INK, _PAPER = (20, 20, 20), (255, 255, 255)
_NUM_TICKS = 5


def preview(depth: np.ndarray, meta: DepthMeta, *, lo: float, hi: float) -> np.ndarray:
    """Return a depth map in false colours (`COLOURS`: blue near, red far) with a legend below it.

    Depths outside lo...hi have the colours of the ends, as the legend says; pixels that are not finite are hatched
    grey. A picture too narrow for the legend is centred on a wider sheet. The size depends only on the map's shape and
    the other arguments, so all previews of a video have the same size.

    Args:
        depth: (height, width).
        lo: the depth with the first colour, in the unit of `meta`.
        hi: the depth with the last colour, >= lo.

    Returns:
        uint8 RGB (height + legend, at least width, 3).

    Raises:
        ValueError: lo and hi are not finite or not in order.
    """
    picture = coloured(depth, lo=lo, hi=hi, colour_map=COLOURS)
    suffix = " m" if meta.unit == "metre" else ""
    legend = _legend(_lines(meta), suffix, lo=lo, hi=hi, width=depth.shape[1])
    sheet = np.full((len(picture) + len(legend), legend.shape[1], 3), _PAPER, dtype=np.uint8)
    left = (legend.shape[1] - depth.shape[1]) // 2
    sheet[: len(picture), left : left + depth.shape[1]] = picture
    sheet[len(picture) :] = legend
    return sheet


def coloured(depth: np.ndarray, *, lo: float, hi: float, colour_map: str) -> np.ndarray:
    """Return the false colours of `preview` without the legend, uint8 RGB (height, width, 3).

    Arguments and errors are those of `preview`, and one of `colours.COLOUR_MAPS`.
    """
    if not -math.inf < lo <= hi < math.inf:
        raise ValueError(f"lo <= hi must be finite, got {lo}, {hi}")
    valid = np.isfinite(depth)
    # In float64 and clipped before the division, so that a narrow range neither underflows nor overflows.
    level = np.where(valid, depth, lo).astype(np.float64)
    np.clip(level, lo, hi, out=level)
    level -= lo
    level /= hi - lo or 1.0
    level *= 255
    picture = levels_of(colour_map).take(np.rint(level, out=level).astype(np.uint8), axis=0)
    if not valid.all():
        rows, columns = np.nonzero(~valid)
        picture[rows, columns] = _HATCH[(rows + columns) // 4 % 2]
    return picture


@lru_cache(maxsize=8)  # all frames of a clip have the same legend
def _legend(lines: tuple[str, ...], suffix: str, *, lo: float, hi: float, width: int) -> np.ndarray:
    """Draw a colour bar, numbers with a suffix and lines of text; wider than `width` if the text needs it."""
    size = min(max(round(width / 40), 12), 28)
    font = ImageFont.load_default(size)
    numbers = _tick_labels(lo, hi, suffix=suffix)
    margin, line = size, round(1.4 * size)
    numbers_width = len(numbers) * max(font.getlength(f"  {text}") for text in numbers)
    text_width = max(numbers_width, *(font.getlength(text) for text in lines))
    width = max(width, math.ceil(text_width) + 2 * margin)

    sheet = Image.new("RGB", (width, size // 2 + line * (2 + len(lines)) + size // 2), _PAPER)
    bar = (width - 2 * margin, size)
    ramp = levels_of(COLOURS)[np.linspace(0, 255, bar[0]).round().astype(np.uint8)]
    sheet.paste(Image.fromarray(np.repeat(ramp[None], bar[1], axis=0)), (margin, size // 2))
    draw = ImageDraw.Draw(sheet)
    below = size // 2 + bar[1]
    for index, number in enumerate(numbers):
        fraction = index / (len(numbers) - 1)
        x = margin + fraction * (bar[0] - 1)
        draw.line((x, below, x, below + size // 4), fill=_INK)
        # Anchored left at the left end and right at the right end, so that no number leaves the sheet.
        draw.text((x - fraction * font.getlength(number), below + size // 4), number, fill=_INK, font=font)
    for index, text in enumerate(lines):
        draw.text((margin, size // 2 + line * (2 + index)), text, fill=_INK, font=font)
    return np.asarray(sheet)


def _lines(meta: DepthMeta) -> tuple[str, ...]:
    """Return the lines of the legend that describe the values."""
    unit = {"arbitrary": "arbitrary units", "metre": "metres"}.get(meta.unit, meta.unit)
    if meta.quantity in UNIT_OF:
        return meta.title, f"in {unit}; hatched: no value"
    return f"{meta.title} in {unit}", f"{AXES[meta.axis]}; hatched: no value"


def _tick_labels(lo: float, hi: float, *, suffix: str) -> list[str]:
    """Return evenly spaced numbers with enough digits to tell them apart; the ends are marked "<=" and ">="."""
    step = (hi - lo) / (_NUM_TICKS - 1)
    decimals = min(max(1 - math.floor(math.log10(step)), 0), 12) if step > 0 else 3
    numbers = [f"{lo + index * step:.{decimals}f}{suffix}" for index in range(_NUM_TICKS)]
    return [f"<= {numbers[0]}", *numbers[1:-1], f">= {numbers[-1]}"]
