"""scene.json, nerfcli's own file beside a COLMAP model: where the photos are, the split, masks, the unit of length."""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.formats.fields import read_json_object
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError

SCENE_FILE = "scene.json"
SCENE_VERSION = 1
UNITS = ("arbitrary", "metre")
UNUSED = "unused"

FindMask = Callable[[str, Path], Path | None]


@dataclass(frozen=True)
class Description:
    """Content of a scene.json.

    Args:
        image_folder: folder of the photos, which the names of the model's images are relative to; need not exist.
        model_dir: the COLMAP model, whose cameras refer to upright photos.
        unit, unit_source: as in `Scene`.
        listed: names of frames by their use: "test", "val", or "unused" for those that the split leaves out.
        masks: the folder of the masks, or the mask of each photo that has one.
        depth_bounds: nearest and farthest z by the name of the frame, in scene units; empty where they are not known.
        provenance: how the scene was made: command, settings, versions; empty if unknown.
    """

    path: Path
    image_folder: Path
    model_dir: Path
    unit: str
    unit_source: str | None
    listed: Mapping[str, frozenset[str]]
    masks: Path | Mapping[str, Path] | None
    depth_bounds: Mapping[str, tuple[float, float]]
    provenance: Mapping[str, Any]

    def described(self, frames: Sequence[Frame], find_mask: FindMask) -> tuple[Frame, ...]:
        """Return the frames of the model with their masks and splits; the split of unused frames is None."""
        return tuple(replace(f, mask=self._mask_of(f.name, find_mask), split=self._split_of(f.name)) for f in frames)

    def bounds_of(self, frames: Sequence[Frame]) -> np.ndarray | None:
        """Return the nearest and farthest z of frames, (frames, 2), if the file gives them for all of the frames."""
        if not self.depth_bounds or not all(frame.name in self.depth_bounds for frame in frames):
            return None
        return np.array([self.depth_bounds[frame.name] for frame in frames]).reshape(-1, 2)

    def _mask_of(self, name: str, find_mask: FindMask) -> Path | None:
        if self.masks is None or isinstance(self.masks, Path):
            return None if self.masks is None else find_mask(name, self.masks)
        mask = self.masks.get(name)
        if mask is not None and not mask.is_file():
            raise UserError(
                f"{self.path}: {mask}, the mask of {name}, does not exist", "restore it, or remove it from the file"
            )
        return mask

    def _split_of(self, name: str) -> str | None:
        part = next((part for part, names in self.listed.items() if name in names), "train")
        return None if part == UNUSED else part


def read_description(root: Path) -> Description:
    """Read the scene.json of a folder, whether or not its photos exist.

    Raises:
        UserError: it is missing, of another version, or malformed; the key is named.
    """
    path = root / SCENE_FILE
    content = read_json_object(path)
    if content.get("measurement") == "transmission":
        raise UserError(
            f"{root} is an X-ray scan, not a scene of photos",
            "use convert, doctor, info or train with it, and evaluate, render or export with its run",
        )
    if content.get("version") != SCENE_VERSION:
        raise UserError(
            f"{path}: unknown version {content.get('version')!r}, expected {SCENE_VERSION}",
            "update nerfcli, or estimate the poses again with nerfcli poses",
        )

    def place(text: str) -> Path:
        return Path(os.path.normpath(root.resolve() / text))

    image_folder = place(_text(content, "image_folder", path))
    model_dir = root / _text(content, "model", path)
    unit = _text(content, "unit", path)
    if unit not in UNITS:
        raise UserError(f"{path}: unit is {unit!r}", f"expected {' or '.join(UNITS)}")
    source, masks = content.get("unit_source"), content.get("masks")
    provenance = content.get("provenance")
    if isinstance(masks, dict):
        masks = {name: place(_text(masks, name, path)) for name in masks}
    elif masks is not None:
        masks = place(_text(content, "masks", path))
    return Description(
        path=path,
        image_folder=image_folder,
        model_dir=model_dir,
        unit=unit,
        unit_source=source if isinstance(source, str) else None,
        listed=_listed_names(content, path),
        masks=masks,
        depth_bounds=_listed_bounds(content, path),
        provenance=provenance if isinstance(provenance, dict) else {},
    )


def _text(content: dict[str, Any], key: str, path: Path) -> str:
    value = content.get(key)
    if not isinstance(value, str) or not value:
        raise UserError(f"{path}: {key} is {value!r}", "expected text; nerfcli poses writes this file")
    return value


def _listed_names(content: dict[str, Any], path: Path) -> dict[str, frozenset[str]]:
    """Return the names under "test", "val" and "unused" of the split; only "test" is required."""
    split = content.get("split")
    names: dict[str, frozenset[str]] = {}
    for part in ("test", "val", UNUSED):
        listed = split.get(part, None if part == "test" else []) if isinstance(split, dict) else None
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            what = f"{path}: split.{part} is not a list of image names"
            raise UserError(what, 'expected "split": {"test": ["a.jpg", ...]}')
        names[part] = frozenset(listed)
    return names


def _listed_bounds(content: dict[str, Any], path: Path) -> dict[str, tuple[float, float]]:
    listed = content.get("depth_bounds") or {}
    try:
        bounds = {name: (float(near), float(far)) for name, (near, far) in dict(listed).items()}
    except (TypeError, ValueError) as error:
        raise UserError(
            f"{path}: depth_bounds are not pairs of numbers", 'expected {"a.jpg": [near, far], ...}'
        ) from error
    for name, (near, far) in bounds.items():
        if not 0 < near < far < math.inf:
            raise UserError(f"{path}: depth_bounds of {name} are {near:g} and {far:g}", "expected 0 < near < far")
    return bounds
