"""Depth as 16-bit PNG: integer levels of a stated length, a millimetre where possible; 0 means no depth.

value = level * units_per_level, rounded to the nearest level. Nothing wraps and nothing is clipped: a depth that does
not fit raises an error before a file is written.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.render.files.depth_pictures import KEY, DepthMeta, check_map

LARGEST_LEVEL = 65535
MILLIMETRE = 1e-3


def chosen_scale(largest: float, unit: str) -> float:
    """Return the finest length of a level that fits a whole clip: 1, 2 or 5 times a power of ten, in scene units.

    In metres it is never finer than a millimetre, so that files are in millimetres whenever that fits.

    Args:
        largest: the largest depth of the clip, >= 0; 0 if there is none.
        unit: "metre" or "arbitrary".

    Raises:
        ValueError: largest is not finite.
    """
    if not 0 <= largest < math.inf:
        raise ValueError(f"largest must be finite and not negative, got {largest}")
    finest = largest / LARGEST_LEVEL
    if unit == "metre":
        finest = max(finest, MILLIMETRE)
    if finest == 0:
        return 1.0
    decade = math.floor(math.log10(finest)) - 1
    # float("2e-5") is exactly the number that people write; 2 * 10.0**-5 may be the next float.
    steps = [float(f"{digit}e{power}") for power in range(decade, decade + 4) for digit in (1, 2, 5)]
    return next(step for step in steps if step >= finest * (1 - 1e-12) and largest <= LARGEST_LEVEL * step * (1 + 1e-9))


def write_png16(path: Path, depth: np.ndarray, meta: DepthMeta, *, units_per_level: float) -> None:
    """Write a depth map as 16-bit grey PNG with its definition in the text chunk "nerfcli"; atomic.

    Args:
        depth: float32 (height, width), NaN where there is none.
        meta: the definition of the values; the scale, the invalid value and the largest rounding error are added.
        units_per_level: the length of a level in the unit of `meta`, > 0.

    Raises:
        UserError: a depth does not fit into 16 bits, is negative or so small that it would read as no depth; or the
            file cannot be written.
        ValueError: depth is not float32 (height, width), units_per_level is not positive, or meta is not of a depth.
    """
    check_map(depth)
    if not 0 < units_per_level < math.inf or meta.quantity != "depth":
        raise ValueError(f"cannot write {meta.quantity} in levels of {units_per_level}")
    levels, rounding = _levels(path, depth, units_per_level)
    bounds = {**meta.error_bounds, "rounding_max": rounding}
    stated = replace(meta, invalid="0", units_per_level=units_per_level, error_bounds=bounds)
    chunks = PngInfo()
    chunks.add_text("Comment", f"{stated.in_words()}; {scale_in_words(stated)}")
    chunks.add_text(KEY, stated.to_text())
    with atomic_path(path) as partial:
        Image.fromarray(levels).save(partial, format="PNG", pnginfo=chunks)


def scale_in_words(meta: DepthMeta) -> str:
    """Describe the levels: "one level is 1 mm, 0 means no value"."""
    if meta.units_per_level is None:
        return "NaN means no value"
    if meta.unit == "metre":
        return f"one level is {meta.units_per_level / MILLIMETRE:g} mm, 0 means no value"
    return f"one level is {meta.units_per_level:g} {meta.unit} units, 0 means no value"


def depth_of_levels(levels: np.ndarray, units_per_level: float) -> np.ndarray:
    """Return float32 depth with NaN for level 0."""
    return np.where(levels == 0, np.nan, levels * units_per_level).astype(np.float32)


def _levels(path: Path, depth: np.ndarray, units_per_level: float) -> tuple[np.ndarray, float]:
    """Return uint16 levels, and the largest rounding error in the unit of the depth."""
    valid = ~np.isnan(depth)
    exact = np.where(valid, depth, 0).astype(np.float64) / units_per_level
    levels = np.rint(exact)
    if levels.max(initial=0) > LARGEST_LEVEL:
        largest, reach = float(depth[valid].max()), LARGEST_LEVEL * units_per_level
        raise UserError(
            f"{path}: 16 bits hold depth up to {reach:.6g} at {units_per_level:g} per level, but the maximum is "
            f"{largest:.6g}",
            "use a float format (--depth-format tiff)",
        )
    if (valid & (levels < 1)).any():
        smallest = float(depth[valid].min())
        raise UserError(
            f"{path}: a depth of {smallest:.6g} would become 0 (no value) in levels of {units_per_level:g}",
            "use --depth-axis ray, or a float format (--depth-format tiff)",
        )
    rounding = float(np.abs(exact - levels).max(initial=0)) * units_per_level
    return levels.astype(np.uint16), rounding
