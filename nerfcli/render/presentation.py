"""What needs all frames of a job, made from their files: previews in false colours with one range, and videos."""

import json
import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from nerfcli.photos.colours import levels_of
from nerfcli.photos.images import read_image, write_png
from nerfcli.render.files.depth_files import quantiles, read_map
from nerfcli.render.files.depth_pictures import AXES, KEY, UNIT_OF, DepthMeta
from nerfcli.render.files.film import write_video
from nerfcli.render.job import MEASURED, RenderJob, meaning_of
from nerfcli.version import __version__

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


def write_previews(folder: Path, job: RenderJob, meta: DepthMeta) -> dict[str, tuple[float, float]]:
    """Write a false-colour PNG beside each measured file, with one range per output.

    Args:
        folder: holds the complete files of every frame.

    Returns:
        The range of each measured output, in the unit of `meta`.

    Raises:
        UserError: a file cannot be read or written.
    """
    ranges = {}
    for output in job.settings.measured:
        meaning = meaning_of(meta, job.settings.depth, output)
        ranges[output] = _write_previews_of(output, folder, job, meaning)
    return ranges


def _write_previews_of(output: str, folder: Path, job: RenderJob, meaning: DepthMeta) -> tuple[float, float]:
    """Write the previews of one output, and return its range."""
    kept: dict[str, np.ndarray] = {}

    def read(name: str) -> np.ndarray:
        if name in kept:
            return kept[name]
        values = read_map(folder, name, meaning)
        # Maps are read three times; as many as fit into 256 MB are kept in memory.
        if (len(kept) + 1) * values.nbytes <= 2**28:
            kept[name] = values
        return values

    lo, hi = value_range(lambda: map(read, job.names), output)
    metadata = _texts(meaning) | {"range": f"{lo} {hi}", "colour map": COLOURS}

    def write(name: str) -> None:
        picture = preview(read(name), meaning, lo=lo, hi=hi)
        write_png(_picture(folder, output, name), picture, metadata=metadata)

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(write, job.names))
    return lo, hi


def write_videos(
    folder: Path,
    job: RenderJob,
    meta: DepthMeta,
    *,
    ranges: dict[str, tuple[float, float]],
    notify: Callable[[str], None],
) -> None:
    """Write the videos that were ordered, from the pictures in the folder; one picture at a time is in memory.

    Args:
        folder: holds every picture and preview.
        job: the rendering job; `job.check` has passed.
        ranges: colour ranges from `write_previews`, for the videos' comments.

    Raises:
        UserError: a video cannot be written.
    """
    settings = job.settings.video
    if settings is None:
        return
    for form in settings.formats:
        for output in job.settings.outputs:

            def pictures(output: str = output) -> Iterator[np.ndarray]:
                for name in job.names:
                    yield read_image(_picture(folder, output, name))[..., :3]

            path = folder / f"{output}.{form}"
            notify(f"encoding {path.name}, {len(job.names)} frames")
            comment = json.dumps(_comment(job, meta, output, ranges), ensure_ascii=False)
            write_video(path, pictures, fps=settings.fps, comment=comment)


def value_range(maps: Callable[[], Iterable[np.ndarray]], output: str) -> tuple[float, float]:
    """Return the range of colours of a clip: the 1st to the 99th percentile; from 0 for outputs that are not distances.

    (0, 1) for confidence, and if no pixel has a value.
    """
    # The ends of a colour range: quantiles of all valid pixels of the clip, so that a single speck does not stretch it.
    found = None if output == "confidence" else quantiles(maps, (0.01, 0.99))
    if not found:
        return 0.0, 1.0
    lo, hi = found
    return (lo if output in ("depth", "lower", "upper") else 0.0), hi


def _comment(job: RenderJob, meta: DepthMeta, output: str, ranges: dict[str, tuple[float, float]]) -> dict[str, Any]:
    """Return the description of a video for its container's comment."""
    description: dict[str, Any] = {"nerfcli": __version__, "outputs": [output], **job.provenance}
    if output in MEASURED:
        description |= meta.to_json()
        description |= {"ranges": {output: ranges[output]}, "colour_map": COLOURS}
    return description


def _picture(folder: Path, output: str, name: str) -> Path:
    return folder / output / f"{name}.png"


def _texts(meta: DepthMeta) -> dict[str, str]:
    """Return texts for a PNG: the definition for programs under one key, and its parts for people."""
    parts = {name: str(value) for name, value in asdict(meta).items() if not isinstance(value, dict) and value}
    return parts | {KEY: meta.to_text()}
