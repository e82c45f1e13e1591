"""What needs all frames of a job, made from their files: previews in false colours with one range, and videos."""

import json
import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from nerfcli import __version__
from nerfcli.photos.colours import levels_of
from nerfcli.photos.images import read_image, write_png
from nerfcli.render.files.depth_files import quantiles, read_map
from nerfcli.render.files.depth_meta import AXES, KEY, UNIT_OF, DepthMeta
from nerfcli.render.files.film import write_video
from nerfcli.render.job import MEASURED, RenderJob, meaning_of

COLOURS = "turbo"
DISTANCES = ("depth", "lower", "upper")
# Where half of all depths lie within this fraction of the range of colours, colours follow inverse depth.
CROWDED = 0.2
_HATCH = np.array([[112, 112, 112], [160, 160, 160]], dtype=np.uint8)
_INK, _PAPER = (20, 20, 20), (255, 255, 255)
_NUM_TICKS = 5


@dataclass(frozen=True)
class ColourRange:
    """The values with the first and the last colour, low <= high, and how colours lie between them.

    Args:
        low: the value with the first colour.
        high: the value with the last colour.
        inverse: whether colours follow 1 / value, for depths of which most are near and a few far; low > 0 then.

    Raises:
        ValueError: low and high are not finite or not in order.
    """

    low: float
    high: float
    inverse: bool = False

    def __post_init__(self):
        if not -math.inf < self.low <= self.high < math.inf:
            raise ValueError(f"low <= high must be finite, got {self.low}, {self.high}")

    @classmethod
    def of_depths(cls, low: float, median: float, high: float) -> Self:
        """Return the range of depths with these quantiles; inverse if half of them would have nearly one colour."""
        return cls(low, high, inverse=low > 0.0 and median - low < CROWDED * (high - low))

    def positions(self, values: np.ndarray) -> np.ndarray:
        """Return the place of each finite value between the first colour, 0, and the last one, 1, in float64."""
        # Clipped before the division, so that a narrow range neither underflows nor overflows.
        place = np.clip(values.astype(np.float64), self.low, self.high)
        if not self.inverse:
            return (place - self.low) / (self.high - self.low or 1.0)
        return (1.0 - self.low / place) / (1.0 - self.low / self.high or 1.0)

    def at(self, position: float) -> float:
        """Return the value at a place between 0 and 1."""
        if not self.inverse:
            return self.low + position * (self.high - self.low)
        return self.low / (1.0 - position * (1.0 - self.low / self.high))


def preview(depth: np.ndarray, meta: DepthMeta, colours: ColourRange) -> np.ndarray:
    """Return a depth map in false colours (`COLOURS`: blue near, red far) with a legend below it.

    Depths outside the range have the colours of its ends, as the legend says; pixels that are not finite are hatched
    grey. A picture too narrow for the legend is centred on a wider sheet. The size depends only on the map's shape and
    the other arguments, so all previews of a video have the same size.
    """
    picture = coloured(depth, colours, COLOURS)
    suffix = " m" if meta.unit == "metre" else ""
    legend = _legend(_lines(meta, colours), suffix, colours, width=depth.shape[1])
    sheet = np.full((len(picture) + len(legend), legend.shape[1], 3), _PAPER, dtype=np.uint8)
    left = (legend.shape[1] - depth.shape[1]) // 2
    sheet[: len(picture), left : left + depth.shape[1]] = picture
    sheet[len(picture) :] = legend
    return sheet


def coloured(values: np.ndarray, colours: ColourRange, colour_map: str) -> np.ndarray:
    """Return the false colours of `preview` without the legend, uint8 RGB (height, width, 3)."""
    valid = np.isfinite(values)
    level = 255 * colours.positions(np.where(valid, values, colours.low))
    picture = levels_of(colour_map).take(np.rint(level, out=level).astype(np.uint8), axis=0)
    if not valid.all():
        rows, columns = np.nonzero(~valid)
        picture[rows, columns] = _HATCH[(rows + columns) // 4 % 2]
    return picture


@lru_cache(maxsize=8)  # all frames of a clip have the same legend
def _legend(lines: tuple[str, ...], suffix: str, colours: ColourRange, *, width: int) -> np.ndarray:
    """Draw a colour bar, numbers with a suffix and lines of text; wider than `width` if the text needs it."""
    size = min(max(round(width / 40), 12), 28)
    font = ImageFont.load_default(size)
    numbers = _tick_labels(colours, suffix)
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


def _lines(meta: DepthMeta, colours: ColourRange) -> tuple[str, ...]:
    by_inverse = "colours by 1 / depth; " if colours.inverse else ""
    unit = {"arbitrary": "arbitrary units", "metre": "metres"}.get(meta.unit, meta.unit)
    if meta.quantity in UNIT_OF:
        return meta.title, f"in {unit}; hatched: no value"
    return f"{meta.title} in {unit}", f"{AXES[meta.axis]}; {by_inverse}hatched: no value"


def _tick_labels(colours: ColourRange, suffix: str) -> list[str]:
    """Return numbers at even places with enough digits to tell them apart; the ends are marked "<=" and ">="."""
    values = [colours.at(index / (_NUM_TICKS - 1)) for index in range(_NUM_TICKS)]
    step = values[1] - values[0]
    decimals = min(max(1 - math.floor(math.log10(step)), 0), 12) if step > 0 else 3
    numbers = [f"{value:.{decimals}f}{suffix}" for value in values]
    return [f"<= {numbers[0]}", *numbers[1:-1], f">= {numbers[-1]}"]


def write_previews(folder: Path, job: RenderJob, meta: DepthMeta) -> dict[str, ColourRange]:
    """Write a false-colour PNG beside each measured file, with one range per output.

    Returns:
        The range of each measured output, in the unit of `meta`.
    """
    ranges = {}
    for output in job.settings.measured:
        meaning = meaning_of(meta, job.settings.depth, output)
        ranges[output] = _write_previews_of(output, folder, job, meaning)
    return ranges


def _write_previews_of(output: str, folder: Path, job: RenderJob, meaning: DepthMeta) -> ColourRange:
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

    colours = value_range(lambda: map(read, job.names), output)
    metadata = _texts(meaning) | {"range": json.dumps(asdict(colours)), "colour map": COLOURS}

    def write(name: str) -> None:
        picture = preview(read(name), meaning, colours)
        write_png(_picture(folder, output, name), picture, metadata=metadata)

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(write, job.names))
    return colours


def write_videos(
    folder: Path, job: RenderJob, meta: DepthMeta, *, ranges: dict[str, ColourRange], notify: Callable[[str], None]
) -> None:
    """Write the videos that were ordered, from the pictures in the folder; one picture at a time is in memory."""
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
            # Names that are not UTF-8, as in `atomic.write_json`.
            comment = comment.encode(errors="backslashreplace").decode()
            write_video(path, pictures, fps=settings.fps, comment=comment)


def value_range(maps: Callable[[], Iterable[np.ndarray]], output: str) -> ColourRange:
    """Return the colours of a clip: the 1st to the 99th percentile; from 0 for outputs that are not distances.

    0 to 1 for confidence, and if no pixel has a value.
    """
    # The ends of a colour range: quantiles of all valid pixels of the clip, so that a single speck does not stretch it.
    found = None if output == "confidence" else quantiles(maps, (0.01, 0.5, 0.99))
    if not found:
        return ColourRange(0.0, 1.0)
    low, median, high = found
    return ColourRange.of_depths(low, median, high) if output in DISTANCES else ColourRange(0.0, high)


def _comment(job: RenderJob, meta: DepthMeta, output: str, ranges: dict[str, ColourRange]) -> dict[str, Any]:
    description: dict[str, Any] = {"nerfcli": __version__, "outputs": [output], **job.provenance}
    if output in MEASURED:
        description |= meaning_of(meta, job.settings.depth, output).to_json()
        description |= {"ranges": {output: asdict(ranges[output])}, "colour_map": COLOURS}
    return description


def _picture(folder: Path, output: str, name: str) -> Path:
    return folder / output / f"{name}.png"


def _texts(meta: DepthMeta) -> dict[str, str]:
    """Return texts for a PNG: the definition for programs under one key, and its parts for people."""
    parts = {name: str(value) for name, value in asdict(meta).items() if not isinstance(value, dict) and value}
    return parts | {KEY: meta.to_text()}
