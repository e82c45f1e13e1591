"""A scene folder of nerfcli, as a capture: the COLMAP model sparse/0, and scene.json, nerfcli's own file beside it.

scene.json states where the photos are, the split, masks, depth maps of a sensor and the unit of length.
"""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli import __version__
from nerfcli.atomic import write_json
from nerfcli.cameras.frame import SensorDepth
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.colmap import MODEL_FILES, parse_colmap, read_model, write_colmap_binary
from nerfcli.captures.formats.fields import malformed, read_json_object
from nerfcli.captures.formats.format import Format, UserInputs, folder_with
from nerfcli.captures.formats.photo_names import seen_from, with_photos
from nerfcli.captures.formats.photo_search import Name
from nerfcli.captures.holdout import default_split
from nerfcli.captures.orientation import UPRIGHT
from nerfcli.errors import UserError, in_shell
from nerfcli.photos.masks import find_mask

SCENE_FILE = "scene.json"
MODEL_FOLDER = "sparse/0"
POSES_REPORT = "poses_report.json"
SCENE_VERSION = 1
UNITS = ("arbitrary", "metre")
UNUSED = "unused"


def save(
    scene_dir: Path,
    *,
    image_folder: Path,
    provenance: dict[str, Any],
    unit: str = "arbitrary",
    unit_source: str | None = None,
    masks: Path | Mapping[str, Path] | None = None,
    depths: Mapping[str, SensorDepth] | None = None,
    split: Mapping[str, str | None] | None = None,
    depth_bounds: Mapping[str, tuple[float, float]] | None = None,
) -> None:
    """Write scene.json beside the COLMAP model in scene_dir/sparse/0, and fix the held-out split.

    Args:
        scene_dir: contains sparse/0, whose cameras refer to upright photos (EXIF orientation applied).
        image_folder: the photos; stored relative to the scene folder, so that both can be moved together.
        provenance: plain values: versions, command, settings.
        unit: "arbitrary" or "metre".
        unit_source: source of the metric scale.
        masks: a folder of masks, named as in `photos.masks.find_mask`; or masks by the name of the photo.
        depths: depth maps of a sensor by the name of the photo.
        split: "train", "test", "val" or None (unused) by the name of the photo; by default every 8th is held out.
        depth_bounds: nearest and farthest z by name, in scene units, if they are known without points.
    """
    model = read_model(scene_dir / MODEL_FOLDER)
    points = model.points
    if split is None:
        parts = {"test": sorted(default_split([image.name for image in model.images]))}
    else:
        kinds = (("test", "test"), ("val", "val"), (UNUSED, None))
        parts = {part: sorted(name for name, of in split.items() if of == kind) for part, kind in kinds}
        parts = {part: names for part, names in parts.items() if names or part == "test"}
    if isinstance(masks, Path):
        mask_entry: Any = seen_from(scene_dir, masks.resolve())
    else:
        mask_entry = {name: seen_from(scene_dir, mask.resolve()) for name, mask in (masks or {}).items()} or None
    content = {
        "version": SCENE_VERSION,
        "image_folder": seen_from(scene_dir, image_folder.resolve()),
        "model": MODEL_FOLDER,
        "split": parts,
        "masks": mask_entry,
        **({"depths": {name: _depth_entry(depth, scene_dir) for name, depth in depths.items()}} if depths else {}),
        "unit": unit,
        "unit_source": unit_source,
        "frame_from_world": None,
        "bounds": {
            "points_min": points.min(axis=0).tolist() if len(points) else None,
            "points_max": points.max(axis=0).tolist() if len(points) else None,
        },
        **({"depth_bounds": {name: list(pair) for name, pair in depth_bounds.items()}} if depth_bounds else {}),
        "provenance": provenance,
    }
    write_json(scene_dir / SCENE_FILE, content)


def _text(content: dict[str, Any], key: str, path: Path) -> str:
    value = content.get(key)
    if not isinstance(value, str) or not value:
        raise UserError(f"{path}: {key} is {value!r}", "expected text; nerfcli poses writes this file")
    return value


def _listed_splits(content: dict[str, Any], path: Path) -> dict[str, str | None]:
    """Return the split of the frames that are not for training; None for those that the split leaves out."""
    listed = content.get("split")
    splits: dict[str, str | None] = {}
    for part in ("test", "val", UNUSED):  # a photo in several counts for the first
        names = listed.get(part, None if part == "test" else []) if isinstance(listed, dict) else None
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            what = f"{path}: split.{part} is not a list of image names"
            raise UserError(what, 'expected "split": {"test": ["a.jpg", ...]}')
        splits = dict.fromkeys(names, None if part == UNUSED else part) | splits
    return splits


def _listed_masks(content: dict[str, Any], path: Path, place: Callable[[str], Path]) -> Path | dict[str, Path]:
    """Return the folder of the masks, or the mask of each photo that has one."""
    masks = content.get("masks")
    if isinstance(masks, dict):
        return {name: place(_text(masks, name, path)) for name in masks}
    return {} if masks is None else place(_text(content, "masks", path))


def _mask_of(name: str, masks: Path | Mapping[str, Path], path: Path) -> Path | None:
    if isinstance(masks, Path):
        return find_mask(name, masks)
    mask = masks.get(name)
    if mask is not None and not mask.is_file():
        hint = "restore it, or remove it from the file"
        raise UserError(f"{path}: {mask}, the mask of {name}, does not exist", hint)
    return mask


def _depth_entry(depth: SensorDepth, folder: Path) -> dict[str, Any]:
    """Return a depth map as an entry of scene.json."""
    confidence = None if depth.confidence is None else seen_from(folder, depth.confidence.resolve())
    return {"path": seen_from(folder, depth.path.resolve()), "unit": depth.unit, "confidence": confidence}


def _listed_depths(content: dict[str, Any], path: Path, place: Callable[[str], Path]) -> dict[str, SensorDepth]:
    listed = content.get("depths") or {}
    try:
        return {
            name: SensorDepth(
                place(one["path"]), float(one["unit"]), None if one["confidence"] is None else place(one["confidence"])
            )
            for name, one in dict(listed).items()
        }
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        hint = 'expected {"a.jpg": {"path": "a.png", "unit": 0.001, "confidence": null}, ...}'
        raise malformed(path, "depths are not the depth maps of photos", hint) from error


def _listed_bounds(content: dict[str, Any], path: Path) -> dict[str, tuple[float, float]]:
    listed = content.get("depth_bounds") or {}
    try:
        bounds = {name: (float(near), float(far)) for name, (near, far) in dict(listed).items()}
    except (TypeError, ValueError, OverflowError) as error:
        hint = 'expected {"a.jpg": [near, far], ...}'
        raise malformed(path, "depth_bounds are not pairs of numbers", hint) from error
    for name, (near, far) in bounds.items():
        if not 0 < near < far < math.inf:
            raise UserError(f"{path}: depth_bounds of {name} are {near:g} and {far:g}", "expected 0 < near < far")
    return bounds


def parse_scene(root: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the scene in a folder, with the photos of another folder if one is given."""
    path = root / SCENE_FILE
    content = read_json_object(path)
    if content.get("measurement") == "transmission":
        raise UserError(f"{root} is an X-ray scan, not a scene of photos", f"use nerfcli ct train {in_shell(root)}")
    if content.get("version") != SCENE_VERSION:
        what = f"unknown version {content.get('version')!r}, expected {SCENE_VERSION}"
        raise malformed(path, what, "update nerfcli, or estimate the poses again with nerfcli poses")

    def place(text: str) -> Path:
        return Path(os.path.normpath(root.resolve() / text))

    image_folder, model, unit = (_text(content, key, path) for key in ("image_folder", "model", "unit"))
    if unit not in UNITS:
        raise UserError(f"{path}: unit is {unit!r}", f"expected {' or '.join(UNITS)}")
    masks, splits = _listed_masks(content, path, place), _listed_splits(content, path)
    depths, bounds = _listed_depths(content, path, place), _listed_bounds(content, path)
    photos = place(image_folder)
    there = given.images or (photos if photos.is_dir() else None)
    capture = with_photos(parse_colmap(root / model), root, given=there)
    frames = tuple(
        replace(
            f,
            image=f.image or photos / f.name,
            mask=_mask_of(f.name, masks, path),
            split=splits.get(f.name, "train"),
            depth=depths.get(f.name),
        )
        for f in capture.frames
    )
    known = [bounds[frame.name] for frame in frames if frame.name in bounds]
    source, provenance = content.get("unit_source"), content.get("provenance")
    return replace(
        capture,
        frames=frames,
        unit=unit,
        unit_source=source if isinstance(source, str) else None,
        depth_bounds=np.array(known) if len(known) == len(frames) else None,
        pixels=UPRIGHT,
        provenance=provenance if isinstance(provenance, dict) else {},
    )


def losses_scene(capture: Capture) -> tuple[str, ...]:
    """List the contents of a capture that a scene folder cannot hold.

    In a scene, the names of photos are paths relative to one folder; photos with other names are renamed. Listed photos
    without a file are reported when the scene is loaded.
    """
    _, names = _named(capture)
    renamed = sum(_is_other(frame.name, name) for frame, name in zip(capture.frames, names, strict=True))
    return (f"the names of {renamed} photos, which become paths relative to one folder",) if renamed else ()


def _is_other(listed: str, name: str) -> bool:
    """Return whether a name is not the end of a listed one, but for what `find_photos` ignores, such as a suffix."""
    old, new = Name.of(listed), Name.of(name)
    end = old.folders[len(old.folders) - len(new.folders) :]
    return end != new.folders or set(old.stems).isdisjoint(new.stems)


def write_scene(capture: Capture, folder: Path) -> None:
    """Write a capture, whose cameras are for upright photos, as a scene into a folder.

    Masks are listed one by one. A split in the capture is kept; otherwise every 8th photo that is there is held out.
    The capture's provenance is recorded beside the command and the version.
    """
    image_folder, names = _named(capture)
    capture = replace(
        capture, frames=tuple(replace(frame, name=name) for frame, name in zip(capture.frames, names, strict=True))
    )
    write_colmap_binary(capture, folder / MODEL_FOLDER)
    bounds = None
    if capture.depth_bounds is not None:
        pairs = capture.depth_bounds.tolist()
        bounds = {frame.name: (near, far) for frame, (near, far) in zip(capture.frames, pairs, strict=True)}
    split = {frame.name: frame.split for frame in capture.frames}
    if not {"test", "val"} & set(split.values()):
        held_out = default_split(frame.name for frame in capture.frames if frame.has_photo)
        split = {name: "test" if name in held_out else "train" for name in split}
    save(
        folder,
        image_folder=image_folder,
        provenance={"command": "convert", "from": capture.kind, "nerfcli": __version__, **capture.provenance},
        unit=capture.unit,
        unit_source=capture.unit_source,
        masks={frame.name: frame.mask for frame in capture.frames if frame.mask is not None},
        depths={frame.name: frame.depth for frame in capture.frames if frame.depth is not None},
        split=split,
        depth_bounds=bounds,
    )


def _named(capture: Capture) -> tuple[Path, list[str]]:
    """Return a folder of the photos, from which the frames' names lead to them if possible, and their names in it.

    Photos that are not on disk keep the names of their frames.
    """
    images = {}
    for frame in capture.frames:
        if frame.image is None:
            hint = "give the photo folder with --images, or convert to another format"
            raise UserError(f"{frame.name} has no photo, which a scene requires", hint)
        images[frame.name] = os.path.abspath(frame.image)
    names = [frame.name for frame in capture.frames]
    images = {frame.name: images[frame.name] for frame in capture.frames if frame.has_photo} or images
    name, image = next(iter(images.items()))
    if image.replace(os.sep, "/").endswith("/" + name):
        root = Path(image).parents[len(name.split("/")) - 1]
        if all(os.path.normpath(root / name) == image for name, image in images.items()):
            return root, names
    try:
        root = Path(os.path.commonpath([os.path.dirname(image) for image in images.values()]))
    except ValueError as error:  # on several drives
        raise UserError("the photos are on several drives", "put them into one folder") from error
    inside = {name: Path(image).relative_to(root).as_posix() for name, image in images.items()}
    return root, [inside.get(name, name) for name in names]


FORMAT = Format(
    "nerfcli",
    "a scene folder",
    folder_with(SCENE_FILE),
    parse_scene,
    # All files of a model, as its folder is replaced; and the report, as one of other poses must not stay.
    files=(SCENE_FILE, *(f"{MODEL_FOLDER}/{name}" for name in MODEL_FILES), POSES_REPORT),
    is_unordered=True,
    has_split=True,
    write=write_scene,
    losses=losses_scene,
)
