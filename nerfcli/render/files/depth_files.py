"""Depth, spread and disagreement of a picture in files of any format, each with its definition.

TIFF, NPY and 16-bit PNG hold one map each; OpenEXR holds all requested maps of a picture, and its opacity.
16-bit levels are computed last, from the floats, because all frames share the length of a level.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.render.files.depth_meta import DepthMeta, difference_of, mixed
from nerfcli.render.files.file_facts import depth_meta_of
from nerfcli.render.files.float_maps import (
    CHANNELS,
    LARGEST_LEVEL,
    chosen_scale,
    read_exr,
    read_npy,
    read_tiff,
    write_exr,
    write_npy,
    write_png16,
    write_tiff,
)
from nerfcli.render.job import EXR_FOLDER, FLOAT_FORMATS, LEVELS_FOLDER, RenderSettings, meaning_of, with_suffix
from nerfcli.render.pictures import RenderedPicture

_AXES_OF_VIEW = "OpenCV: +x right, +y down, +z forward; the top-left pixel's centre is (0.5, 0.5)"


def map_path(folder: Path, output: str, name: str, file_format: str) -> Path:
    """Return the path of a map of a picture."""
    if file_format == "png16":
        return with_suffix(folder / LEVELS_FOLDER / name, ".png")
    return with_suffix(folder / (EXR_FOLDER if file_format == "exr" else output) / name, f".{file_format}")


def frame_meta(
    meta: DepthMeta, frame: Frame, *, provenance: Mapping[str, Any], error_bounds: Mapping[str, Any]
) -> DepthMeta:
    """Return the definition of one frame's depth: `meta` with camera, provenance and rendering error."""
    view = {
        "name": frame.name,
        "camera": frame.camera.to_json(),
        "world_from_cam": frame.world_from_cam.tolist(),
        "axes": _AXES_OF_VIEW,
    }
    return replace(meta, view=view, provenance=dict(provenance), error_bounds=dict(error_bounds))


def write_maps(picture: RenderedPicture, folder: Path, name: str, *, settings: RenderSettings, meta: DepthMeta) -> None:
    """Write the maps of a picture in the float formats of `settings`; each file atomically."""
    maps = {output: _map_of(picture, output) for output in settings.measured}
    metas = {output: meaning_of(meta, settings.depth, output) for output in maps}
    for file_format in settings.float_formats:
        if file_format == "exr":
            path = map_path(folder, "", name, file_format)
            colour = {"rgb": picture.rgb} if "rgb" in settings.outputs else {}
            write_exr(path, {**colour, **maps, "opacity": picture.opacity}, _meta_of_layers(metas))
            continue
        for output, values in maps.items():
            path = map_path(folder, output, name, file_format)
            if file_format == "npy":
                write_npy(path, values, metas[output])
            else:
                write_tiff(path, values, metas[output])


def read_map(folder: Path, name: str, meaning: DepthMeta) -> np.ndarray:
    """Read a map (height, width), NaN where invalid, from the first float format that `write_maps` wrote.

    Raises:
        UserError: the file is missing or damaged, or has another definition.
    """
    path, output = _floats_of(folder, name, meaning.quantity), meaning.quantity
    found = depth_meta_of(path)
    if found is not None and path.suffix == ".exr":
        layer = found.layers.get(output, {})
        found = found.of(output, opacity_floor=layer.get("opacity_floor"), convention=layer.get("convention"))
    difference = "it does not state what its values mean" if found is None else difference_of(meaning, found)
    if difference:
        raise mixed(path, Path("the other frames"), difference)
    match path.suffix:
        case ".exr":
            return read_exr(path)[CHANNELS[output]]
        case ".npy":
            return read_npy(path)
    return read_tiff(path)


@dataclass(frozen=True)
class Levels:
    """Result of `write_levels`: the length of a level, and how many pixels of all frames exceed the last one."""

    units_per_level: float
    pixels_beyond: int


def write_levels(folder: Path, names: Sequence[str], *, meaning: DepthMeta) -> Levels:
    """Write the depth of all frames as 16-bit levels of one length, computed from the float files.

    Levels reach to twice the 99.9 % quantile of all depths, or to the largest depth if
    that is less: otherwise a few rays that end far away would make all levels coarse. Depths beyond are left out of
    these files.

    Raises:
        UserError: a depth is so small that it would read as no depth, or a file cannot be written.
    """

    def depths() -> Iterator[np.ndarray]:
        for name in names:
            yield read_map(folder, name, meaning)

    typical, largest = quantiles(depths, (0.999, 1.0)) or (0.0, 0.0)
    scale = chosen_scale(min(2.0 * typical, largest), meaning.unit)
    reach, pixels_beyond = LARGEST_LEVEL * scale * (1 + 1e-9), 0
    for name, depth in zip(names, depths(), strict=True):
        beyond = depth > reach
        pixels_beyond += int(beyond.sum())
        meta = depth_meta_of(_floats_of(folder, name, "depth")) or meaning
        bounds = {**meta.error_bounds, "pixels_beyond_levels": int(beyond.sum())}
        path = map_path(folder, "depth", name, "png16")
        held = np.where(beyond, np.float32(np.nan), depth)
        write_png16(path, held, replace(meta, layers={}, error_bounds=bounds), units_per_level=scale)
    return Levels(scale, pixels_beyond)


def _floats_of(folder: Path, name: str, output: str) -> Path:
    """Return the float file of a map; the TIFF's path if there is none."""
    paths = [map_path(folder, output, name, file_format) for file_format in FLOAT_FORMATS]
    return next((path for path in paths if path.exists()), paths[0])


def _map_of(picture: RenderedPicture, output: str) -> np.ndarray:
    values: np.ndarray | None = getattr(picture, output)
    if values is None:
        raise ValueError(f"the picture was rendered without {output}")
    return values


def _meta_of_layers(metas: Mapping[str, DepthMeta]) -> DepthMeta:
    """Return the definition of the first map, with the other maps in the same file as layers."""
    first, *others = metas.values()
    layers = {meta.quantity: {"convention": meta.convention, "opacity_floor": meta.opacity_floor} for meta in others}
    return replace(first, layers={**layers, "opacity": {"convention": "1 - transmittance"}})


# Values with the same upper 16 bits are counted together.
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
