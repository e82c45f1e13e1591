"""Sequences of the TUM RGB-D benchmark, read only: rgb.txt, a list of "timestamp file", and groundtruth.txt.

groundtruth.txt is a trajectory, see `trajectories`, of the colour camera, by motion capture in metres; its times are
not those of the photos. No file has the camera: it is that of the benchmark for freiburg1, 2 and 3 in the folder's
name. depth.txt lists the depth maps in the same way: 16 bits, 5000 per metre, 0 is unknown, in its view.
Source: cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, "Intrinsic Camera Calibration of the Kinect".
"""

import re
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import content_lines, malformed, name_of, numbers, read_text
from nerfcli.captures.formats.format import Format
from nerfcli.captures.formats.photo_names import GIVE_CAMERA, find_photos
from nerfcli.captures.formats.timed_poses import poses_at
from nerfcli.captures.formats.trajectories import tum_poses
from nerfcli.errors import UserError, listed, several

PHOTOS, TRUTH = "rgb.txt", "groundtruth.txt"

# fx, fy, cx, cy, k1, k2, p1, p2, k3 of the colour cameras; the photos of freiburg3 are undistorted.
_CAMERAS = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633, 0.0, 0.0, 0.0),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172, 0.0, 0.0, 0.0),
    "3": (535.4, 539.2, 320.1, 247.6),
}
_SIZE = (640, 480)


def parse_tum_rgbd(folder: Path, *, camera: Camera | None = None, images: Path | None = None) -> Capture:
    """Read the photos whose time is within that of the poses; poses are interpolated to it.

    Args:
        camera: of all photos; by default that of the benchmark.
        images: a folder of the photos, in which their paths or names are looked for instead.

    Raises:
        UserError: a file is damaged (file and line are named), no photo has a pose, or the camera is not known.
    """
    camera = camera or _known_camera(folder)
    path = folder / PHOTOS
    seconds, names = [], []
    for line_number, line in content_lines(read_text(path, "expected lines of timestamp and file")):
        where = f"{path}: line {line_number}"
        time, _, file = line.strip().partition(" ")
        seconds += numbers([time], 1, where)
        names.append(name_of(file, where))
    poses = tum_poses(folder / TRUTH)
    times = np.array([float(name) for name, _ in poses])
    interpolated, is_known = poses_at(times, np.stack([pose for _, pose in poses]), np.array(seconds))
    unposed = [names[index] for index in np.flatnonzero(~is_known)]
    kept = np.flatnonzero(is_known)
    if not len(kept):
        raise malformed(str(folder / TRUTH), "has no pose at the time of a photo", "copy the whole sequence")
    listed_names = [names[index] for index in kept]
    found = find_photos(listed_names, [folder], given=images, sizes=[camera.size] * len(kept))
    frames = tuple(
        Frame(name, camera, interpolated[index], image=image or (images or folder) / name)
        for index, name, image in zip(kept, found.names, found.paths, strict=True)
    )
    notes = found.notes
    if unposed:
        notes += (f"{several(len(unposed), 'photo')} left out, as no pose is near in time: {listed(unposed)}",)
    points, source = np.zeros((0, 3)), "motion capture (TUM RGB-D)"
    return Capture(frames, points, (), None, "tum-rgbd", unit="metre", unit_source=source, notes=notes)


def _known_camera(folder: Path) -> Camera:
    sequence = re.search(r"freiburg([123])", folder.resolve().as_posix())
    if sequence is None:
        raise UserError(
            f"{folder}: a sequence of TUM RGB-D has no camera, and its name does not say which (freiburg1, 2 or 3)",
            GIVE_CAMERA,
        )
    params = _CAMERAS[sequence[1]]
    return Camera("PINHOLE" if len(params) == 4 else "FULL_OPENCV", *_SIZE, params)


def find_tum_rgbd(path: Path) -> Path | None:
    """Find the folder of a sequence, given it or its rgb.txt."""
    folder = path.parent if path.is_file() and path.name == PHOTOS else path
    return folder if all((folder / name).is_file() for name in (PHOTOS, TRUTH)) else None


FORMAT = Format(
    "tum-rgbd",
    "a sequence of TUM RGB-D",
    "rgb.txt",
    find_tum_rgbd,
    lambda path, given: parse_tum_rgbd(path, camera=given.camera, images=given.images),
    open_axes=True,
    open_centre=True,
)
