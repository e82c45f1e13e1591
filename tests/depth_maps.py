"""Depth maps, their metadata, and the writers of all formats with one signature."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerfcli.render.files.depth_meta import DepthMeta
from nerfcli.render.files.float_maps import write_exr, write_npy, write_png16, write_tiff

META = DepthMeta("conditional", "ray", "arbitrary", 0.5)
FULL_META = DepthMeta(
    convention="background",
    axis="z",
    unit="metre",
    opacity_floor=1 / 3,
    background_distance=12.25,
    unit_source="GPS, ± 0.3 %",
    error_bounds={"truncation_max": 1e-5, "words": "bounds the rendering"},
    view={"name": "Küche 北.jpg", "camera": {"model": "PINHOLE", "width": 53, "height": 37, "params": [50.0, 1 / 3]}},
    provenance={"run": "kitchen", "field_sha256": "ab" * 32},
)


def plain_depth() -> np.ndarray:
    """Return depths between 0.5 and 60, of which a tenth are NaN."""
    generator = np.random.default_rng(1)
    depth = generator.uniform(0.5, 60.0, (37, 53)).astype(np.float32)
    depth[generator.random(depth.shape) < 0.1] = np.nan
    return depth


def write_exr_of(path: Path, depth: np.ndarray, meta: DepthMeta) -> None:
    write_exr(path, {"depth": depth}, meta)


def write_png_of(path: Path, depth: np.ndarray, meta: DepthMeta) -> None:
    write_png16(path, depth, meta, units_per_level=1e-3)


Writer = Callable[[Path, np.ndarray, DepthMeta], None]
FLOATS: dict[str, Writer] = {".tiff": write_tiff, ".exr": write_exr_of, ".npy": write_npy}
ALL: dict[str, Writer] = {**FLOATS, ".png": write_png_of}
