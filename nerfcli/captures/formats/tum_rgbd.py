"""Sequences of the TUM RGB-D benchmark, read only: rgb.txt, a list of "timestamp file", and groundtruth.txt.

groundtruth.txt is a trajectory, see `trajectories`, of the colour camera, by motion capture in metres; its times are
not those of the photos. The camera is in calibration.txt or calib.txt, fx, fy, cx, cy and at most k1, k2, p1, p2, k3,
as in ETH3D's sequences; else that of the benchmark for freiburg1, 2 and 3 in the folder's name. depth.txt lists the
depth maps in the same way: 16 bits, 5000 per metre, 0 is unknown, in the colour camera's view.
Source: cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, "Intrinsic Camera Calibration of the Kinect";
eth3d.net/slam_documentation; princeton-vl/DROID-SLAM README.md, "Run on your own data".
"""

import re
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame, SensorDepth
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import lenses
from nerfcli.captures.formats.fields import check_unique_names, name_of, numbers, read_text
from nerfcli.captures.formats.format import Format, UserInputs, folder_with
from nerfcli.captures.formats.photo_names import GIVE_CAMERA, find_photos
from nerfcli.captures.formats.trajectories import MOST_AWAY_SECONDS, photos_at, timed_rows, tum_poses
from nerfcli.captures.orientation import stored_size
from nerfcli.errors import UserError

PHOTOS, DEPTHS, TRUTH = "rgb.txt", "depth.txt", "groundtruth.txt"
# Metres of a level in depth maps.
_UNIT = 1 / 5000

# fx, fy, cx, cy, k1, k2, p1, p2, k3 of the colour cameras; the photos of freiburg3 are undistorted.
_KINECTS = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": (535.4, 539.2, 320.1, 247.6),
}
_KINECT_SIZE = (640, 480)
_CALIBRATIONS = ("calibration.txt", "calib.txt")


def parse_tum_rgbd(folder: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the photos whose time is within that of the poses; poses are interpolated to it.

    A camera that the user gives replaces the sequence's own.
    """
    path = folder / PHOTOS
    seconds, names = _files_in_time(path)
    check_unique_names(names, path)
    poses, lost = tum_poses(folder / TRUTH)
    times, bodies = [float(name) for name, _ in poses], np.stack([pose for _, pose in poses])
    kept, interpolated, unposed = photos_at(names, seconds, times, bodies, where=str(folder / TRUTH))
    found = find_photos([names[index] for index in kept], [folder], given=given.images)
    there = [image for image in found.paths if image is not None]
    size = stored_size(there[0]) if there else _KINECT_SIZE
    camera = _own_camera(folder, size) if given.camera is None else given.camera.resized(*size)
    depths = _depths(folder, seconds)
    frames = tuple(
        Frame(name, camera, pose, image=place or folder / name, depth=depths[index])
        for index, pose, name, place in zip(kept, interpolated, found.names, found.places, strict=True)
    )
    source, notes = "motion capture (TUM RGB-D)", (*found.notes, *lost, *unposed)
    return Capture(frames, kind="tum-rgbd", unit="metre", unit_source=source, notes=notes)


def _files_in_time(path: Path) -> tuple[list[float], list[str]]:
    """Return the times and the files that a list names."""
    rows = timed_rows(path, "expected lines of timestamp and file")
    seconds = [numbers(cells[:1], 1, where)[0] for cells, where in rows]
    return seconds, [name_of(" ".join(cells[1:]), where) for cells, where in rows]


def _depths(folder: Path, seconds: list[float]) -> list[SensorDepth | None]:
    """Return the depth map that was taken with the photo of each time; None where there is none."""
    path = folder / DEPTHS
    times, names = _files_in_time(path) if path.is_file() else ([], [])

    def nearest(time: float) -> SensorDepth | None:
        away = np.abs(np.subtract(times, time))
        index = int(away.argmin())
        return SensorDepth.found(folder / names[index], unit=_UNIT) if away[index] <= MOST_AWAY_SECONDS else None

    return [nearest(time) if names else None for time in seconds]


def _own_camera(folder: Path, size: tuple[int, int]) -> Camera:
    """Return the camera in the folder, which is for the photos' size, or that of the benchmark."""
    path = next((folder / name for name in _CALIBRATIONS if (folder / name).is_file()), None)
    sequence = re.search(r"freiburg([123])", folder.resolve().as_posix())
    if path is not None:
        words = read_text(path, "expected fx, fy, cx, cy").split()
        where, params = str(path), tuple(numbers(words[:9], min(max(len(words), 4), 9), str(path)))
    elif sequence is not None:
        where, params, size = str(folder), _KINECTS[sequence[1]], _KINECT_SIZE
    else:
        what = f"{folder}: a sequence of TUM RGB-D without {_CALIBRATIONS[0]}, and not of freiburg1, 2 or 3"
        raise UserError(what, GIVE_CAMERA)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (*params, *[0.0] * (9 - len(params)))
    return lenses.brown_camera(size, (fx, fy), (cx, cy), radial=(k1, k2, k3), tangential=(p1, p2), where=where)


FORMAT = Format(
    "tum-rgbd",
    "a sequence of TUM RGB-D",
    folder_with(PHOTOS, TRUTH),
    parse_tum_rgbd,
    open_axes=True,
    open_centre=True,
    takes_camera=True,
)
