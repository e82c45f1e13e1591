"""Read and write a nerfcli scene as a capture, sparse/0 and scene.json as `nerfcli poses` writes them; read a model."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from nerfcli import __version__, scene
from nerfcli.cameras.formats.colmap import parse_colmap, write_colmap_binary
from nerfcli.cameras.formats.llff import IMAGE_FOLDERS
from nerfcli.cameras.formats.scene_json import read_description
from nerfcli.cameras.frame import Capture
from nerfcli.convert.stored_pixels import UPRIGHT
from nerfcli.errors import UserError
from nerfcli.media.masks import find_mask

SCENE_FILES = (scene.SCENE_FILE, *(f"{scene.MODEL_FOLDER}/{name}.bin" for name in ("cameras", "images", "points3D")))


def parse_scene(path: Path, *, images: Path | None = None) -> Capture:
    """Read the scene in a folder, with the photos of another folder if one is given.

    Raises:
        UserError: scene.json or the model is damaged.
    """
    described = read_description(path)
    capture = parse_colmap(described.model_dir, images or described.image_folder)
    frames = described.described(capture.frames, find_mask)
    return replace(
        capture,
        frames=frames,
        unit=described.unit,
        unit_source=described.unit_source,
        depth_bounds=described.bounds_of(frames),
        pixels=UPRIGHT,
    )


def losses_scene(capture: Capture) -> tuple[str, ...]:
    """List the contents of a capture that a scene folder cannot hold.

    In a scene, the names of photos are paths relative to one folder; photos with other names are renamed. Listed photos
    without a file are reported when the scene is loaded.
    """
    _, names = _named(capture)
    renamed = sum(frame.name != name for frame, name in zip(capture.frames, names, strict=True))
    return (f"the names of {renamed} photos, which become paths relative to one folder",) if renamed else ()


def write_scene(capture: Capture, folder: Path, *, provenance: Mapping[str, Any] | None = None) -> None:
    """Write a capture, whose cameras are for upright photos, as a scene into a folder.

    Masks are listed one by one. A split in the capture is kept; otherwise every 8th photo is held out.

    Args:
        provenance: further entries of the provenance in scene.json, besides the command and the version.

    Raises:
        UserError: a frame has no photo, no photo is on disk, or the folder cannot be written.
    """
    image_folder, names = _named(capture)
    if not any(frame.has_photo for frame in capture.frames):
        raise UserError(
            f"none of the {len(capture.frames)} photos exists, such as {capture.frames[0].image}",
            "a scene needs its photos; give their folder with --images",
        )
    capture = replace(
        capture, frames=tuple(replace(frame, name=name) for frame, name in zip(capture.frames, names, strict=True))
    )
    write_colmap_binary(capture, folder / scene.MODEL_FOLDER)
    bounds = None
    if capture.depth_bounds is not None:
        pairs = capture.depth_bounds.tolist()
        bounds = {frame.name: (near, far) for frame, (near, far) in zip(capture.frames, pairs, strict=True)}
    scene.save(
        folder,
        image_folder=image_folder,
        provenance={"command": "convert", "from": capture.kind, "nerfcli": __version__, **(provenance or {})},
        unit=capture.unit,
        unit_source=capture.unit_source,
        masks={frame.name: frame.mask for frame in capture.frames if frame.mask is not None},
        split=_split({frame.name: frame.split for frame in capture.frames}),
        depth_bounds=bounds,
    )


def _split(splits: dict[str, str | None]) -> dict[str, str | None]:
    """Return the split of each name: the capture's own if it holds photos out, else every 8th name is held out."""
    if "test" in splits.values() or "val" in splits.values():
        return splits
    held_out = scene.default_split(splits)
    return {name: "test" if name in held_out else "train" for name in splits}


def _named(capture: Capture) -> tuple[Path, list[str]]:
    """Return a folder of the photos, from which the frames' names lead to them if possible, and their names in it."""
    images = []
    for frame in capture.frames:
        if frame.image is None:
            raise UserError(
                f"{frame.name} has no photo, which a scene requires",
                "give the photo folder with --images, or convert to another format",
            )
        images.append(os.path.abspath(frame.image))
    names = [frame.name for frame in capture.frames]
    first = names[0].split("/")
    if images[0].replace(os.sep, "/").endswith("/" + names[0]):
        root = Path(images[0]).parents[len(first) - 1]
        if all(os.path.normpath(root / name) == image for name, image in zip(names, images, strict=True)):
            return root, names
    try:
        root = Path(os.path.commonpath([os.path.dirname(image) for image in images]))
    except ValueError as error:  # on several drives
        raise UserError("the photos are on several drives", "put them into one folder") from error
    return root, [Path(image).relative_to(root).as_posix() for image in images]


def parse_model(path: Path, *, images: Path | None = None) -> Capture:
    """Read a COLMAP model, with its photos in the first folder in which its names lead to one.

    The folders tried are the given one (`images`); or images/ and the like in the model's folder or up to three folders
    above it, then these folders themselves.
    """
    capture = parse_colmap(path)
    homes = (path, *path.resolve().parents[:3])
    folders = [home / name for home in homes for name in IMAGE_FOLDERS if (home / name).is_dir()]
    places = [images] if images is not None else [*folders, *homes]
    leading = [place for place in places if any((place / frame.name).is_file() for frame in capture.frames[:100])]
    place = next(iter([*leading, *folders]), None)
    if place is None:
        return capture
    return replace(capture, frames=tuple(replace(frame, image=place / frame.name) for frame in capture.frames))
