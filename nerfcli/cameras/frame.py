"""Frames: a camera, its pose and its picture; found by name, or chosen evenly."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TypeVar

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.errors import UserError

MILLIMETRE = 1e-3
Item = TypeVar("Item")
# Width and height in pixels.
Size = tuple[int, int]


@dataclass(frozen=True)
class SensorDepth:
    """A depth map that a sensor took with a photo: z along the optical axis, of about the same view, at any resolution.

    Args:
        path: the file, see `photos.sensor_depth`.
        unit: of its numbers, in metres; training scales them to the scene.
        confidence: a file of the same size with levels from 0, the least, to 2 or 255; None if there is none.
    """

    path: Path
    unit: float = 1.0
    confidence: Path | None = None

    @classmethod
    def found(cls, *paths: Path, unit: float = 1.0, confidence: Path | None = None) -> "SensorDepth | None":
        """Return the first of these maps that is on disk, with its confidence if that is; None without one."""
        path = next(filter(os.path.isfile, paths), None)  # names may be too long for Path.is_file
        if path is None:
            return None
        return cls(path, unit, confidence if confidence is not None and confidence.is_file() else None)


@dataclass(frozen=True)
class Frame:
    """One view: its camera and pose, and its picture if there is one.

    Args:
        name: unique in its capture, with forward slashes; the image's path as its capture lists it.
        camera: refers to the upright picture, EXIF orientation applied; see `captures.capture.Capture` for the
            exception.
        world_from_cam: (4, 4) rigid, OpenCV axes, float64.
        image: the picture's file; None for the frames of a camera path.
        mask: the mask's file: black where the picture is not to be used.
        depth: the depth map of a sensor; None if there is none.
        split: "train", "test" or "val" where the capture's format fixes one, else None.
    """

    name: str
    camera: Camera
    world_from_cam: np.ndarray
    image: Path | None = None
    mask: Path | None = None
    split: str | None = None
    depth: SensorDepth | None = None

    @property
    def has_photo(self) -> bool:
        """True if its picture is on disk."""
        # Not Path.is_file, which raises where a name is too long for the file system.
        return self.image is not None and os.path.isfile(self.image)

    @property
    def centre(self) -> np.ndarray:
        """The camera's centre in the world, (3,)."""
        return self.world_from_cam[:3, 3]

    def in_camera(self, points: np.ndarray) -> np.ndarray:
        """Return points (N, 3), or one point (3,), of the world in the camera's axes."""
        return rigid.apply(rigid.inverse(self.world_from_cam), points)


def frames_named(frames: Sequence[Frame], names: Sequence[str]) -> tuple[Frame, ...]:
    """Return the frames with the given names, in the order of the names; a frame may be repeated.

    A name is a frame's full name, or its last parts if they match only one frame: photo.jpg or photo for
    images/photo.jpg.

    Raises:
        UserError: no frame matches a name (the error lists similar names), or several do.
    """
    whole = {frame.name: frame for frame in frames}
    endings: dict[str, list[Frame]] = {}
    for frame in frames:
        parts = frame.name.split("/")
        stem = parts[-1].rpartition(".")[0]
        for start in range(len(parts)):
            endings.setdefault("/".join(parts[start:]), []).append(frame)
            if stem:
                endings.setdefault("/".join([*parts[start:-1], stem]), []).append(frame)
    return tuple(_named(name, whole, endings) for name in names)


def _named(name: str, whole: dict[str, Frame], endings: dict[str, list[Frame]]) -> Frame:
    if name in whole:
        return whole[name]
    found = endings.get(name, [])
    if len(found) == 1:
        return found[0]
    if found:
        several = ", ".join(frame.name for frame in found[:3])
        raise UserError(f"{len(found)} images match {name}: {several}", "give a longer part of the name")
    near = get_close_matches(name, whole, n=3, cutoff=0.5) or list(whole)[:3]
    raise UserError(f"no image is named {name!r}", f"there are {len(whole)}, such as {', '.join(near)}")


def chosen_evenly(items: Sequence[Item], count: int) -> list[Item]:
    """Choose at most `count` frames or other items, evenly spread in their order, from the first to the last."""
    return [items[index] for index in np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).astype(int))]
