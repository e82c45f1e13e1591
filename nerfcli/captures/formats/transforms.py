"""transforms.json: the camera files of nerfstudio and instant-ngp; Blender's (NeRF) are of the same kind.

Poses in these files are world_from_cam with OpenGL axes. Pixel positions are as in COLMAP, without a half-pixel offset.
Sources: docs.nerf.studio "Data conventions"; instant-ngp docs/nerf_dataset_tips.md and scripts/colmap2nerf.py.
"""

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from nerfcli.atomic import write_json
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import MILLIMETRE, Frame, SensorDepth, Size
from nerfcli.captures.axes import opencv_pose, pose_in_axes
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.alicevision import find_alicevision
from nerfcli.captures.formats.camera_path import find_camera_path
from nerfcli.captures.formats.fields import malformed, matrix, read_json_object
from nerfcli.captures.formats.format import Format, UserInputs, find_json
from nerfcli.captures.formats.lenses import Fits
from nerfcli.captures.formats.limits import FramePoses
from nerfcli.captures.formats.photo_names import find_photos, seen_from
from nerfcli.captures.formats.photo_search import Name, folded, plain_name
from nerfcli.captures.formats.ply import read_points, write_points
from nerfcli.captures.formats.record3d import find_record3d
from nerfcli.captures.formats.run_cameras import find_run
from nerfcli.captures.formats.transforms_cameras import (
    camera_of_record,
    contradictions,
    given_size,
    lost_to_transforms,
    merged,
    record_of_camera,
)
from nerfcli.captures.formats.unsupported import lost_of_cameras, lost_parts
from nerfcli.captures.orientation import stored_size
from nerfcli.errors import UserError, several
from nerfcli.errors import listed as in_words
from nerfcli.photos.masks import find_mask

SPLITS = ("train", "val", "test")


def parse_transforms(path: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read a transforms.json, whether or not its images exist; those without a known size are `missing`.

    Poses and points stay in the file's own world. nerfstudio's applied_transform and applied_scale say how that world
    came from the original world of the poses (COLMAP's). They are not undone, since the cameras would then no longer
    match the fields that were trained on the file.
    """
    content = read_json_object(path)
    frames, missing, notes = listed_frames(path, content, records_of(path, content), images=given.images)
    points, colours, lost = _points_beside(path, content)
    return Capture(tuple(frames), points, tuple(missing), kind="transforms", colours=colours, notes=(*notes, *lost))


def losses_transforms(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that a transforms.json cannot hold. Points go into a PLY file next to it."""
    parts = lost_parts(capture, holds=("masks", "depths", "points", "colours", "splits"))
    others = sum(frame.depth is not None and frame.depth.unit != MILLIMETRE for frame in capture.frames)
    depths = (f"{several(others, 'depth map')} in another unit than millimetres",) if others else ()
    trusted = sum(frame.depth is not None and frame.depth.confidence is not None for frame in capture.frames)
    confidence = (f"the confidence of {several(trusted, 'depth map')}",) if trusted else ()
    return (*lost_of_cameras(capture, lost_to_transforms), *parts, *depths, *confidence)


def write_transforms(capture: Capture, path: Path) -> None:
    """Write a capture as nerfstudio's transforms.json (OpenGL axes); instant-ngp reads it too.

    Intrinsics are written once if all frames share them. Paths of images and masks are relative to the file's folder;
    an image whose path is unknown gets its frame's name. Points are written beside the file, as NAME_points.ply.
    """
    intrinsics = {
        camera: record_of_camera(camera) for camera in dict.fromkeys(frame.camera for frame in capture.frames)
    }
    shared = len(intrinsics) == 1
    content: dict[str, Any] = dict(next(iter(intrinsics.values()))) if shared else {}
    file_paths = [relative_path(frame, path.parent) for frame in capture.frames]
    for split in SPLITS:
        names = [text for text, frame in zip(file_paths, capture.frames, strict=True) if frame.split == split]
        if names:
            content[f"{split}_filenames"] = names
    records = []
    for file_path, frame in zip(file_paths, capture.frames, strict=True):
        record = {} if shared else dict(intrinsics[frame.camera])
        record["file_path"] = file_path
        if frame.mask is not None:
            record["mask_path"] = seen_from(path.parent, frame.mask)
        if frame.depth is not None and frame.depth.unit == MILLIMETRE:
            record["depth_file_path"] = seen_from(path.parent, frame.depth.path)
        record["transform_matrix"] = pose_in_axes(frame.world_from_cam, "opengl").tolist()
        records.append(record)
    if len(capture.points):
        cloud = path.with_name(f"{path.stem}_points.ply")
        write_points(capture, cloud)
        content["ply_file_path"] = cloud.name
    write_json(path, {**content, "frames": records})


def records_of(path: Path, content: dict[str, Any], key: str = "frames") -> list[tuple[dict[str, Any], str]]:
    """Return the entries of a list of frames, with the keys of the whole file, and their places in it."""
    records = content.get(key)
    if not isinstance(records, list) or not records or not all(isinstance(item, dict) for item in records):
        raise malformed(path, f"has no list of {key}", f'expected "{key}": [{{"file_path", "transform_matrix"}}, ...]')
    return [(merged(content, record), f"{path}: {key}[{index}]") for index, record in enumerate(records)]


def listed_frames(
    path: Path,
    content: dict[str, Any],
    listed: Sequence[tuple[dict[str, Any], str]],
    *,
    suffix: str = "",
    images: Path | None = None,
    size: Size | None = None,
    home: Path | None = None,
    folders: tuple[str, str] = ("images", "masks"),
) -> tuple[list[Frame], list[str], tuple[str, ...]]:
    """Return the frames of a file as listed, the names of images whose size is unknown, which have no frame, and notes.

    Frames with equal intrinsics share one camera. Masks that are not on disk are left out. Where the file does not give
    the size of images, they are measured. One that is not on disk gets the size of the others, if they all have the
    same; if none has one, it is an error.

    Args:
        listed: the frames, see `records_of`.
        suffix: appended to a file_path without a suffix if no such image is on disk, as the format does.
        images: the folder of the images, if they are not where the file says.
        size: of the images, if the file does not give it and none is on disk.
        home: the folder that paths are relative to; by default that of the file.
        folders: the usual names of the folders of images and masks in it.
    """
    home = home or path.parent
    sizes = [given_size(record, where) for record, where in listed]
    is_path = not any("file_path" in record for record, _ in listed)  # the views of a camera path have no photo
    texts = [
        _listed_path({"file_path": f"frame_{index:04d}"} if is_path else record, where)
        for index, (record, where) in enumerate(listed)
    ]
    found = find_photos(texts, (home,), given=images, folders=folders[:1], sizes=sizes)
    names = [
        name if PurePosixPath(name).suffix else name + (suffix if image is None else image.suffix)
        for name, image in zip(found.names, found.paths, strict=True)
    ]
    expected = [home / name if images is None else images / PurePosixPath(name).name for name in names]
    places = [image or place for place, image in zip(expected, found.paths, strict=True)]
    known = _known_sizes(sizes, places, listed[0][1], default=size)
    masks, lost_masks = _beside(path, listed, "mask_path", "mask", places=(home, folders[1]), photos=set(places))
    depths, lost_depths = _beside(
        path, listed, "depth_file_path", "depth map", places=(home, "depth"), photos=set(places)
    )
    splits = _listed_splits(path, content)
    stray = sorted(splits.keys() - set(map(plain_name, texts)))
    said = f"{several(len(stray), 'photo')} of a split of {path.name} not among its frames: {in_words(stray)}"
    cameras: dict[Camera, Camera] = {}
    fits, poses = Fits(), FramePoses()
    frames, missing, used = [], [], []
    for index, ((record, where), own_size) in enumerate(zip(listed, known, strict=True)):
        read = partial(matrix, record, "transform_matrix", (3, 4), 4, where)
        world_from_cam = poses.read(names[index], f"{where}.transform_matrix", read)
        if own_size is None:
            missing.append(names[index])
            continue
        if world_from_cam is None:
            continue
        camera, pose = camera_of_record(record, own_size, where, fits), opencv_pose(world_from_cam, "opengl")
        split, map_path = splits.get(plain_name(texts[index])), depths[index]
        depth = None if map_path is None else SensorDepth(map_path, MILLIMETRE)  # nerfstudio's default unit
        camera = cameras.setdefault(camera, camera)
        frames.append(Frame(names[index], camera, pose, places[index], masks[index], split=split, depth=depth))
        used.append((record, camera))
    lost = (*lost_masks, *lost_depths, *([said] if stray else ()))
    return frames, missing, (*found.notes, *poses.notes(), *contradictions(used), *fits.notes(), *lost)


def _beside(
    path: Path,
    listed: Sequence[tuple[dict[str, Any], str]],
    key: str,
    noun: str,
    *,
    places: tuple[Path, str],
    photos: set[Path],
) -> tuple[list[Path | None], tuple[str, ...]]:
    """Return the mask or depth map that each frame names under a key, None if it is not on disk, and what is lost.

    Args:
        noun: what it is. For a mask, its photo's name is enough, see `find_mask`.
        places: the folder that paths are relative to, and the usual name of the folder of these files in it.
        photos: none of which it can be.
    """
    texts = [record.get(key) or "" for record, _ in listed]
    for text, (_, where) in zip(texts, listed, strict=True):
        if not isinstance(text, str):
            raise malformed(where, f"{key} is {text!r:.80}", f"expected the path of a {noun} as text")
    named = sorted({text for text in texts if PurePosixPath(plain_name(text)).name})
    # A depth map named without a suffix is the .png, not the preview as .jpg beside it.
    looked_up = [text if noun == "mask" or Name.of(text).suffix else f"{text}.png" for text in named]
    found = find_photos(looked_up, (places[0],), folders=(places[1],), others=()).paths
    paths: dict[str, Path] = {}
    for name, file in zip(named, found, strict=True):
        if noun == "mask" and (file is None or file in photos):
            file = find_mask(plain_name(name), places[0])
        if file is not None and file not in photos and (noun == "mask" or _may_be_depth(file, name)):
            paths[name] = file
    lost = [name for name in named if name not in paths]
    notes = (f"{several(len(lost), noun)} named in {path.name} left out, not found: {in_words(lost)}",)
    return [paths.get(text) for text in texts], notes if lost else ()


def _may_be_depth(file: Path, listed: str) -> bool:
    """Return whether a file may be the depth map of a listed name; one with another suffix is a preview of it."""
    suffix, named = file.suffix.lower(), Name.of(listed).suffix
    same = (".tif", ".tiff")
    return suffix == named or (suffix in same and named in same) or (not named and suffix in (".png", ".pgm", *same))


def relative_path(frame: Frame, folder: Path) -> str:
    """Return a frame's image path relative to a folder, with forward slashes, or its name if it has no image."""
    return frame.name if frame.image is None else seen_from(folder, frame.image)


def _known_sizes(
    given: list[Size | None], images: list[Path], where: str, *, default: Size | None
) -> list[Size | None]:
    """Return the width and height of each frame's picture, given, measured, or the only ones known; None if unknown."""
    sizes = [
        stored_size(image) if size is None and os.path.isfile(image) else size
        for size, image in zip(given, images, strict=True)
    ]
    known = {size for size in sizes if size is not None} or ({default} if default else set[Size]())
    if not known:
        raise malformed(where, f"w and h are missing, and {images[0]} does not exist", "add the image, or w and h")
    return [next(iter(known)) if size is None and len(known) == 1 else size for size in sizes]


def _listed_path(record: dict[str, Any], where: str) -> str:
    text = record.get("file_path")
    if not isinstance(text, str) or not PurePosixPath(plain_name(text)).name:
        raise malformed(where, f"file_path is {text!r:.80}", "expected the image's path as text")
    return text


def _points_beside(path: Path, content: dict[str, Any]) -> tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """Read points (N, 3) and colours (N, 3) of the PLY file that ply_file_path names, and a note if it is not there."""
    cloud = content.get("ply_file_path")
    if cloud is None or cloud == "":
        return np.zeros((0, 3)), None, ()
    if not isinstance(cloud, str):
        raise malformed(path, f"ply_file_path is {cloud!r:.80}", "expected the path of a PLY file as text")
    name = PurePosixPath(plain_name(cloud)).name
    same = (there for there in sorted(path.parent.iterdir()) if folded(there.name) == folded(name))
    places = (path.parent / plain_name(cloud), path.parent / name, *same)
    place = next((place for place in places if place.is_file()), None)
    if place is None:
        return np.zeros((0, 3)), None, (f"{cloud}, which {path.name} names, does not exist: no points are read",)
    try:
        return *read_points(place), ()
    except UserError as error:
        raise malformed(f"{path}: ply_file_path", error.message, error.hint) from error


def _listed_splits(path: Path, content: dict[str, Any]) -> dict[str, str]:
    """Return the split of each photo, by its plain name, that nerfstudio's train_filenames and the like list."""
    splits = {}
    for split in SPLITS:
        names = content.get(f"{split}_filenames", [])
        if not isinstance(names, list) or not all(isinstance(item, str) for item in names):
            raise malformed(path, f"{split}_filenames is not a list of paths", "expected a list of file_path texts")
        splits.update({plain_name(item): split for item in names})
    return splits


def find_transforms(path: Path) -> Path | None:
    """Find transforms.json in a folder, or a JSON file of an object that is none of another format."""
    others = (find_run, find_camera_path, find_alicevision, find_record3d)
    if path.is_file() and any(find(path) is not None for find in others):
        return None
    return find_json(path, opening="{", name="transforms.json")


FORMAT = Format(
    "transforms",
    "nerfstudio, instant-ngp",
    find_transforms,
    parse_transforms,
    axes="opengl",
    open_axes=True,
    open_centre=True,
    default_name="transforms.json",
    files=("*.json", "*_points.ply"),
    write=write_transforms,
    losses=losses_transforms,
)
