"""What a capture consists of: frames (camera, pose, picture) and what the file that lists them knows besides."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera


@dataclass(frozen=True)
class Frame:
    """One view: its camera, where the camera stood, and the picture if there is one.

    Args:
        name: unique in its capture, with forward slashes; the image's path as its capture lists it.
        camera: refers to the picture as it is shown, EXIF orientation applied.
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
    def centre(self) -> np.ndarray:
        """The camera's centre in the world, (3,)."""
        return self.world_from_cam[:3, 3]


@dataclass(frozen=True)
class Capture:
    """What a reader returns.

    Args:
        frames: the views whose picture is on disk, in the order of the file.
        points: (N, 3) points of the surface in the world; N is 0 where the format has none.
        missing: names of images that the file lists and that are not on disk.
        depth_bounds: (frames, 2) nearest and farthest z of each view in scene units, or None.
        kind: the format: "colmap", "transforms", "blender" or "llff".
    """

    frames: tuple[Frame, ...]
    points: np.ndarray
    missing: tuple[str, ...]
    depth_bounds: np.ndarray | None
    kind: str
