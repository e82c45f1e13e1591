"""Blender captures of NeRF's synthetic scenes: transforms_train.json, transforms_val.json and transforms_test.json.

Each file holds one horizontal field of view (camera_angle_x, radians) and the poses of its views; pixels are square,
the principal point is the middle, and the picture's size is that of the PNG file, whose suffix file_path leaves out.
Source: bmild/nerf load_blender.py.
"""

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from nerfcli.atomic import write_json
from nerfcli.cameras.frame import Frame
from nerfcli.captures.axes import pose_in_axes
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import check_unique_names, malformed, read_json_object, shown
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.transforms import SPLITS, listed_frames, records_of, relative_path
from nerfcli.captures.formats.unsupported import lost_of_cameras, lost_parts, lost_to_pinhole, refuse_spherical
from nerfcli.errors import UserError, listed

# Of the files that list a view, the first one's split counts: a view that is trained on cannot be held out.
_PRIORITY = ("train", "test", "val")
# A number with six significant digits differs by up to this fraction from the same one with more.
_ROUNDING = 1e-5


def parse_blender(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read all views of a Blender capture, from the file of every split that exists.

    An image that is not on disk gets the size of the other images in its file; if there are none, that of the given
    camera or of the first image. A view in several files belongs to the first of train, test and val.
    """
    frames, missing, notes = list[Frame](), list[str](), list[str]()
    for split in SPLITS:
        path = _file(folder, split)
        if path.exists():
            size = given.camera.size if given.camera else frames[0].camera.size if frames else None
            content = read_json_object(path)
            records = records_of(path, content)
            views, unknown, said = listed_frames(path, content, records, suffix=".png", images=given.images, size=size)
            check_unique_names((frame.name for frame in views), path)
            frames += [replace(frame, split=split) for frame in views]
            missing += unknown
            notes += said
    if not frames:
        raise UserError(f"{_file(folder, 'train')}: No such file", "give a folder of transforms_{train,val,test}.json")
    kept = _used_once(frames, folder)
    repeated = [name for name, count in Counter(frame.name for frame in frames).items() if count > 1]
    if repeated:
        notes.append(f"listed in several files: {listed(repeated)}; used as of the first of train, test and val")
    return Capture(tuple(kept), missing=tuple(missing), kind="blender", notes=tuple(notes))


def _used_once(frames: list[Frame], folder: Path) -> list[Frame]:
    """Return the frames without those that a file of higher priority lists as well, which must be the same views."""
    kept = dict[str, Frame]()
    farthest = max(float(np.abs(frame.centre).max()) for frame in frames)
    tolerance = _ROUNDING * np.array([1.0, 1.0, 1.0, farthest])  # of the columns of a pose
    for frame in sorted(frames, key=lambda frame: _PRIORITY.index(frame.split or "train")):
        first = kept.setdefault(frame.name, frame)
        moved = (np.abs(first.world_from_cam - frame.world_from_cam) > tolerance).any()
        if moved or not math.isclose(_angle(first), _angle(frame), rel_tol=_ROUNDING):
            off = "poses" if moved else "fields of view"
            files = f"transforms_{first.split}.json and transforms_{frame.split}.json"
            what = f"image {shown(frame.name)} is listed with different {off} in {files}"
            raise malformed(folder, what, "remove one of its two entries")
    return [frame for frame in frames if kept[frame.name] is frame]


def losses_blender(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that Blender files cannot hold.

    The files do not give picture sizes, so the size of a frame without an image is lost. Frames without a split go to
    train.
    """
    sizes = sum(frame.image is None for frame in capture.frames)
    lost = lost_of_cameras(capture, lost_to_pinhole)
    off = sum(len(frames) - _most_common_angle(frames)[1] for frames in _by_split(capture).values())
    lost += [f"the field of view of {off} frames (one per file)"] if off else []
    lost += [f"the picture's size of {sizes} frames"] if sizes else []
    return (*lost, *lost_parts(capture, holds=("splits",)))


def write_blender(capture: Capture, folder: Path) -> None:
    """Write a capture as transforms_{train,val,test}.json, for the splits that it has.

    Frames without a split are written to train. The angle of a file is the one that most of its frames have.
    """
    refuse_spherical(capture, "field of view")
    for split, frames in _by_split(capture).items():
        records = [
            {
                "file_path": _file_path(frame, folder),
                "transform_matrix": pose_in_axes(frame.world_from_cam, "opengl").tolist(),
            }
            for frame in frames
        ]
        write_json(_file(folder, split), {"camera_angle_x": _most_common_angle(frames)[0], "frames": records})


def _file(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def _by_split(capture: Capture) -> dict[str, list[Frame]]:
    by_split = {split: [f for f in capture.frames if (f.split or "train") == split] for split in SPLITS}
    return {split: frames for split, frames in by_split.items() if frames}


def _file_path(frame: Frame, folder: Path) -> str:
    """Return the image's path as NeRF's own loader expects it: without .png, which it appends."""
    path = PurePosixPath(relative_path(frame, folder))
    text = str(path.with_suffix("")) if path.suffix == ".png" else str(path)
    return text if text.startswith(("/", "../")) else f"./{text}"


def _angle(frame: Frame) -> float:
    """Return the horizontal field of view of a frame in radians, as if its principal point were in the middle."""
    return 2 * math.atan(frame.camera.width / 2 / frame.camera.focal_lengths[0])


def _most_common_angle(frames: list[Frame]) -> tuple[float, int]:
    """Return the angle that most frames have, and how many do."""
    return Counter(map(_angle, frames)).most_common(1)[0]


def find_blender(path: Path) -> Path | None:
    """Find a folder with a file of the Blender scenes."""
    return path if any(_file(path, split).is_file() for split in SPLITS) else None


FORMAT = Format(
    "blender",
    "NeRF's synthetic scenes",
    find_blender,
    parse_blender,
    axes="opengl",
    open_axes=True,
    files=("transforms_train.json", "transforms_val.json", "transforms_test.json"),
    lacks=("points",),
    unused_splits=("val",),  # views for choosing settings
    listed_by=lambda frame: SPLITS.index(frame.split or "train"),
    write=write_blender,
    losses=losses_blender,
)
