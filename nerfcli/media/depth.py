"""Depth maps on disk: floats with the convention they were made by.

A depth map without its convention is a riddle: along the ray or along the optical axis, in which unit, a mean
or a median, and what stands where nothing was hit. `DepthMeta` travels with every file.
"""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import tifffile

from nerfcli.atomic import atomic_path, write_json
from nerfcli.errors import UserError

AXES = {"ray": "along the ray", "z": "along the optical axis (z)"}


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
        if self.axis not in AXES:
            raise ValueError(f"axis must be one of {', '.join(AXES)}, got {self.axis}")


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


def _check_depth(depth: np.ndarray) -> None:
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise ValueError(f"depth must be float32 (H, W), got {depth.dtype} {depth.shape}")
