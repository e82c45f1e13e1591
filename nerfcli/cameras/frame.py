"""Data of a capture: frames (camera, pose, picture), which are found by name, points and other content of its file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.errors import UserError

# Width and height in pixels.
Size = tuple[int, int]


@dataclass(frozen=True)
class Frame:
    """One view: its camera and pose, and its picture if there is one.

    Args:
        name: unique in its capture, with forward slashes; the image's path as its capture lists it.
        camera: refers to the upright picture, EXIF orientation applied; see `Capture.pixels` for the exception.
        world_from_cam: (4, 4) rigid, OpenCV axes, float64.
        image: the picture's file; None for the frames of a camera path.
        mask: the mask's file: black where the picture is not to be used.
        split: "train", "test" or "val" where the capture's format fixes one, else None.
    """

    name: str
    camera: Camera
    world_from_cam: np.ndarray
    image: Path | None = None
    mask: Path | None = None
    split: str | None = None

    @property
    def has_photo(self) -> bool:
        """True if its picture is on disk."""
        return self.image is not None and self.image.is_file()

    @property
    def centre(self) -> np.ndarray:
        """The camera's centre in the world, (3,)."""
        return self.world_from_cam[:3, 3]


@dataclass(frozen=True)
class Observations:
    """Observations of points: one row per 2D feature of a frame.

    Args:
        frame_index: (M,) int64, of the frame.
        point_index: (M,) int64, of the point; -1 for a feature without one.
        pixels: (M, 2) float64 positions in the frame's picture, pixel centres at 0.5.
    """

    frame_index: np.ndarray
    point_index: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True)
class Capture:
    """A capture as a file describes it.

    Args:
        frames: the views, in the order of the file; readers of scenes return only those whose picture is on disk.
        points: (N, 3) points of the surface in the world; N is 0 where the format has none.
        missing: names of images that the file lists and that are not on disk.
        depth_bounds: (frames, 2) nearest and farthest z of each view in scene units, or None.
        kind: the format: "colmap", "transforms", "blender", "llff", ...
        colours: (N, 3) uint8 sRGB of the points, or None.
        observations: where the points were seen, or None.
        unit: of length: "arbitrary" or "metre".
        unit_source: how the metric scale was found, as text for people; None if unknown.
        pixels: which pixels of a photo with an EXIF orientation its camera refers to: "stored", as nearly all programs
            read them, or "upright", as the photo is displayed.
        rescaled: number of photos whose intrinsics were given for another size, by (that size, the photo's size),
            each (width, height).
    """

    frames: tuple[Frame, ...]
    points: np.ndarray
    missing: tuple[str, ...]
    depth_bounds: np.ndarray | None
    kind: str
    colours: np.ndarray | None = None
    observations: Observations | None = None
    unit: str = "arbitrary"
    unit_source: str | None = None
    pixels: str = "stored"
    rescaled: Mapping[tuple[Size, Size], int] = field(default_factory=dict)


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
