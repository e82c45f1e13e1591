"""Depth maps on disk: floats with the convention they were made by, and coloured previews with a legend.

A depth map without its convention is a riddle: along the ray or along the optical axis, in which unit, a mean
or a median, and what stands where nothing was hit. `DepthMeta` travels with every file.
"""

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import cv2
import numpy as np
import tifffile
from PIL import Image, ImageDraw, ImageFont

from nerfcli.atomic import atomic_path, write_json
from nerfcli.errors import UserError

_AXES = {"ray": "along the ray", "z": "along the optical axis (z)"}
_LEVELS = np.arange(256, dtype=np.uint8)[None]
_TURBO = cv2.applyColorMap(_LEVELS, cv2.COLORMAP_TURBO)[0, :, ::-1]  # (256, 3) RGB
_HATCH = np.array([[112, 112, 112], [160, 160, 160]], dtype=np.uint8)
_INK, _PAPER = (20, 20, 20), (255, 255, 255)
_NUM_TICKS = 5
# More values per frame do not move a percentile that anyone could see, but cost memory over a long video.
_MAX_VALUES_PER_FRAME = 2**16


@dataclass(frozen=True)
class DepthMeta:
    """What the numbers of a depth map mean.

    Args:
        convention: which depth of the ray's distribution, for example "conditional" or "median".
        axis: "ray", distance from the camera's centre along the ray; or "z", along the optical axis.
        unit: "metre", or "arbitrary" where the scale of the scene is not known.
        opacity_floor: pixels whose opacity is below it have no depth.
        invalid: the value of pixels without depth.
        background_distance: what a ray that hits nothing counts as, where the convention needs that.

    Raises:
        ValueError: another axis.
    """

    convention: str
    axis: str
    unit: str
    opacity_floor: float
    invalid: str = "nan"
    background_distance: float | None = None

    def __post_init__(self):
        if self.axis not in _AXES:
            raise ValueError(f"axis must be one of {', '.join(_AXES)}, got {self.axis}")


def write_tiff(path: Path, depth: np.ndarray, meta: DepthMeta) -> None:
    """Write a depth map as float TIFF, losslessly compressed, `meta` as JSON in its ImageDescription; atomic.

    Args:
        path: the folder is made if need be.
        depth: float32 (height, width); every bit comes back, NaN too.
        meta: what the numbers mean.

    Raises:
        UserError: the file cannot be written.
        ValueError: depth is not float32 (height, width), or meta holds a number that is not finite.
    """
    _check_depth(depth)
    description = json.dumps(asdict(meta), allow_nan=False)  # escapes all but ASCII, as the tag demands
    with atomic_path(path) as partial:
        tifffile.imwrite(
            partial,
            depth,
            photometric="minisblack",
            compression="zlib",
            description=description,
            metadata=None,  # else tifffile appends a description of its own
        )


def read_tiff(path: Path) -> tuple[np.ndarray, DepthMeta]:
    """Read what `write_tiff` wrote: depth float32 (height, width), and what it means.

    Raises:
        UserError: missing, damaged, not a float32 map, or without a description of its convention.
    """
    try:
        with tifffile.TiffFile(path) as tiff:
            depth = tiff.pages[0].asarray()
            description = tiff.pages[0].aspage().description
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}", "give a depth TIFF") from error
    except Exception as error:  # tifffile lets through whatever its decoders raise
        raise UserError(f"{path} is damaged or no TIFF: {error}", "render the depth map again") from error
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise UserError(
            f"{path} holds {depth.dtype} {depth.shape}, not a float32 depth map",
            "give a file that nerfcli wrote",
        )
    try:
        entries = json.loads(description)
        meta = DepthMeta(**{f.name: entries[f.name] for f in fields(DepthMeta)})
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(
            f"{path} does not say what its depth means (ImageDescription: {description[:40]!r})",
            "give a file that nerfcli wrote",
        ) from error
    return depth, meta


def write_npy(path: Path, depth: np.ndarray, meta: DepthMeta) -> None:
    """Write a depth map as .npy, and `meta` beside it under the same name with .json; each file atomically.

    Raises:
        UserError: a file cannot be written.
        ValueError: depth is not float32 (height, width), or meta holds a number that is not finite.
    """
    _check_depth(depth)
    # The sidecar first: a depth map never stands without its meaning, even if the command is killed between.
    write_json(path.with_suffix(".json"), asdict(meta))
    with atomic_path(path) as partial, partial.open("wb") as file:
        np.save(file, depth)


def depth_range(depths: Iterable[np.ndarray]) -> tuple[float, float]:
    """The 1st and the 99th percentile of all finite depths, so that all frames of a video share one range.

    At most 65536 evenly spaced values of a frame are looked at. (0, 1) if there is no finite depth at all.
    """
    samples = [np.empty(0)]
    for depth in depths:
        finite = depth[np.isfinite(depth)]
        samples.append(finite[:: math.ceil(finite.size / _MAX_VALUES_PER_FRAME) or 1])
    values = np.concatenate(samples)
    if values.size == 0:
        return 0.0, 1.0
    lo, hi = np.percentile(values, (1, 99))
    return float(lo), float(hi)


def preview(depth: np.ndarray, meta: DepthMeta, *, lo: float, hi: float) -> np.ndarray:
    """Depth in the colours of turbo (blue near, red far) with a legend below it.

    Depths outside lo...hi have the colours of the ends, as the legend says; pixels that are not finite are
    hatched grey. A picture too narrow for the legend is centred on a wider sheet. The size depends on the
    shape and the other arguments alone, so that the previews of a video fit together.

    Args:
        depth: (height, width).
        meta: named in the legend.
        lo: the depth that is drawn blue, in the unit of `meta`.
        hi: the depth that is drawn red, >= lo.

    Returns:
        uint8 RGB (height + legend, at least width, 3).

    Raises:
        ValueError: lo and hi are not finite or not in order.
    """
    if not -math.inf < lo <= hi < math.inf:
        raise ValueError(f"lo <= hi must be finite, got {lo}, {hi}")
    valid = np.isfinite(depth)
    # float64, and clipped before the division: a narrow range neither underflows nor overflows.
    level = (np.where(valid, depth, lo).astype(np.float64).clip(lo, hi) - lo) / (hi - lo or 1.0)
    picture = _TURBO[np.rint(level * 255).astype(np.uint8)]
    rows, columns = np.indices(depth.shape)
    picture[~valid] = _HATCH[(rows + columns) // 4 % 2][~valid]

    legend = _legend(meta, lo=lo, hi=hi, width=depth.shape[1])
    sheet = np.full((len(picture) + len(legend), legend.shape[1], 3), _PAPER, dtype=np.uint8)
    left = (legend.shape[1] - depth.shape[1]) // 2
    sheet[: len(picture), left : left + depth.shape[1]] = picture
    sheet[len(picture) :] = legend
    return sheet


def _legend(meta: DepthMeta, *, lo: float, hi: float, width: int) -> np.ndarray:
    """Colour bar, numbers and two lines of text; wider than `width` if the text needs it."""
    size = min(max(round(width / 40), 12), 28)
    font = ImageFont.load_default(size)
    unit = {"arbitrary": "arbitrary units", "metre": "metres"}.get(meta.unit, meta.unit)
    lines = [f"{meta.convention} depth in {unit}", f"{_AXES[meta.axis]}; hatched: no value"]
    numbers = _tick_labels(lo, hi, suffix=" m" if meta.unit == "metre" else "")
    margin, line = size, round(1.4 * size)
    numbers_width = len(numbers) * max(font.getlength(f"  {text}") for text in numbers)
    text_width = max(numbers_width, *(font.getlength(text) for text in lines))
    width = max(width, math.ceil(text_width) + 2 * margin)

    sheet = Image.new("RGB", (width, size // 2 + line * (2 + len(lines)) + size // 2), _PAPER)
    bar = (width - 2 * margin, size)
    ramp = _TURBO[np.linspace(0, 255, bar[0]).round().astype(np.uint8)]
    sheet.paste(Image.fromarray(np.repeat(ramp[None], bar[1], axis=0)), (margin, size // 2))
    draw = ImageDraw.Draw(sheet)
    below = size // 2 + bar[1]
    for index, number in enumerate(numbers):
        share = index / (len(numbers) - 1)
        x = margin + share * (bar[0] - 1)
        draw.line((x, below, x, below + size // 4), fill=_INK)
        # Anchored left at the left end and right at the right end, so that no number leaves the sheet.
        draw.text((x - share * font.getlength(number), below + size // 4), number, fill=_INK, font=font)
    for index, text in enumerate(lines):
        draw.text((margin, size // 2 + line * (2 + index)), text, fill=_INK, font=font)
    return np.asarray(sheet)


def _tick_labels(lo: float, hi: float, *, suffix: str) -> list[str]:
    """Evenly spaced numbers with enough digits to tell them apart; the ends include what lies beyond them."""
    step = (hi - lo) / (_NUM_TICKS - 1)
    decimals = min(max(1 - math.floor(math.log10(step)), 0), 12) if step > 0 else 3
    numbers = [f"{lo + index * step:.{decimals}f}{suffix}" for index in range(_NUM_TICKS)]
    return [f"<= {numbers[0]}", *numbers[1:-1], f">= {numbers[-1]}"]


def _check_depth(depth: np.ndarray) -> None:
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise ValueError(f"depth must be float32 (H, W), got {depth.dtype} {depth.shape}")
