"""Sequences of the EuRoC MAV dataset, in the layout that its authors call ASL, read only: mav0/ with cam0, cam1, ...

mav0/cam0/data.csv is a table of times in nanoseconds and files in mav0/cam0/data; mav0/cam0/sensor.yaml has T_BS,
body_from_cam row by row with OpenCV axes, resolution, intrinsics fu, fv, cu, cv and distortion in OpenCV's order.
mav0/state_groundtruth_estimate0/data.csv: time, position and quaternion w, x, y, z of world_from_body, in metres, the
world's z axis up. Kalibr counts pixels from the centre of the first one; the numbers are kept as they are.
Source: Burri et al. 2016, The EuRoC micro aerial vehicle datasets, section 5; ethz-asl/kalibr wiki, "Yaml formats".
"""

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import lenses
from nerfcli.captures.formats.fields import malformed, matrix_of, name_of, numbers, read_rows, read_text, shown, size_of
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.limits import FramePoses, rigid_pose
from nerfcli.captures.formats.photo_names import with_photos
from nerfcli.captures.formats.trajectories import photos_at
from nerfcli.errors import several

HOME, TRUTH = "mav0", "state_groundtruth_estimate0"
_TRUTHS = (TRUTH, "mocap0")  # the latter of TUM VI, in the same layout
_BROWN = ("radial-tangential", "radtan", "plumb_bob", "none")
_FISHEYE = ("equidistant", "equi")
_EXPECTED = "expected a file of a EuRoC sequence"


def parse_euroc(home: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the photos of all cameras in mav0 whose time is within that of the poses; poses are interpolated to it."""
    truth = next(path for name in _TRUTHS if (path := home / name / "data.csv").is_file())
    times, bodies, lost = _bodies(truth)
    names, seconds, views = [], [], []
    for folder in sorted(path.parent for path in home.glob("cam*/data.csv")):
        view = _sensor(folder / "sensor.yaml")
        for cells, where in read_rows(folder / "data.csv", _EXPECTED, separator=","):
            names.append(f"{folder.name}/data/{name_of(','.join(cells[1:]), where)}")
            seconds.append((_nanoseconds(cells[0], where) - times[0]) / 1e9)
            views.append(view)
    body_seconds = [(time - times[0]) / 1e9 for time in times]
    kept, poses, unposed = photos_at(names, seconds, body_seconds, bodies, where=str(truth))
    frames = tuple(
        Frame(names[index], views[index][0], pose @ views[index][1]) for index, pose in zip(kept, poses, strict=True)
    )
    source = f"motion capture ({truth.parent.name})"
    notes = (*lost, *unposed)
    capture = Capture(frames, kind="euroc", unit="metre", unit_source=source, notes=notes)
    return with_photos(capture, home, given=given.images)


def _bodies(path: Path) -> tuple[list[int], np.ndarray, tuple[str, ...]]:
    """Return the times in nanoseconds and the poses world_from_body (N, 4, 4), and a note on what was left out."""
    times, poses, usable = [], [], FramePoses()
    for cells, where in read_rows(path, _EXPECTED, separator=","):
        xyzw_position = [*cells[5:8], *cells[4:5], *cells[1:4]]
        pose = usable.read_quaternion(cells[0], where, partial(numbers, xyzw_position, 7, where))
        if pose is not None:
            times.append(_nanoseconds(cells[0], where))
            poses.append(pose)
    notes = usable.notes()
    if not times:
        raise malformed(path, "has no pose", _EXPECTED)
    return times, np.stack(poses), notes


def _nanoseconds(word: str, where: str) -> int:
    text = word.strip()
    if not re.fullmatch(r"\d{1,20}", text, re.ASCII):
        raise malformed(where, f"its time is {shown(text)}", "expected nanoseconds")
    return int(text)


def _sensor(path: Path) -> tuple[Camera, np.ndarray]:
    """Return the camera and body_from_cam of a sensor.yaml."""
    where = str(path)
    text = "\n".join(line.partition("#")[0] for line in read_text(path, _EXPECTED).splitlines())
    words = _words(text, r"T_BS\s*:[^\]]*?\bdata", f"{where}: T_BS")
    body_from_cam = rigid_pose(matrix_of(words, 4, 4, f"{where}: T_BS"), f"{where}: T_BS")
    width, height = _numbers(text, "resolution", 2, where)
    size = size_of(width, height, where)
    fx, fy, cx, cy = _numbers(text, "intrinsics", 4, where)
    model = _word(text, "camera_model", "pinhole")
    kind = _word(text, "distortion_model", "none")
    terms = _words(text, r"^\s*distortion_coeff\w*", f"{where}: distortion_coefficients") if kind != "none" else []
    values = numbers(terms, len(terms), f"{where}: distortion_coefficients")
    if model != "pinhole" or kind not in (*_BROWN, *_FISHEYE) or len(values) not in ((0, 4, 5), (4,))[kind in _FISHEYE]:
        what = f"camera_model is {shown(model)}, distortion_model {shown(kind)} with {several(len(values), 'term')}"
        raise malformed(where, what, "expected pinhole with radial-tangential (k1, k2, p1, p2) or equidistant")
    if kind in _FISHEYE:
        return lenses.fisheye_camera(size, (fx, fy), (cx, cy), radial=values, where=where), body_from_cam
    k1, k2, p1, p2, k3 = values + [0.0] * (5 - len(values))
    lens = lenses.brown_camera(size, (fx, fy), (cx, cy), radial=(k1, k2, k3), tangential=(p1, p2), where=where)
    return lens, body_from_cam


def _words(text: str, before: str, where: str) -> list[str]:
    """Return the entries of the list in brackets after a key, which is a pattern."""
    found = re.search(rf"{before}\s*:\s*\[([^\]]*)\]", text, re.MULTILINE)
    if found is None:
        raise malformed(where, "is missing", "expected a list of numbers in brackets")
    return [word for word in re.split(r"[,\s]+", found[1]) if word]


def _numbers(text: str, key: str, count: int, where: str) -> Sequence[float]:
    return numbers(_words(text, rf"^\s*{key}", f"{where}: {key}"), count, f"{where}: {key}")


def _word(text: str, key: str, default: str) -> str:
    found = re.search(rf"^\s*{key}\s*:\s*[\"']?([\w-]+)", text, re.MULTILINE)
    return found[1].lower() if found else default


def find_euroc(path: Path) -> Path | None:
    """Find the folder mav0 of a sequence, given the sequence, mav0 itself or a file in it."""
    folder = path.parent.parent if path.is_file() and path.name in ("data.csv", "sensor.yaml") else path
    home = folder / HOME if (folder / HOME).is_dir() else folder
    has_poses = any((home / name / "data.csv").is_file() for name in _TRUTHS)
    return home if has_poses and any(home.glob("cam*/sensor.yaml")) else None


FORMAT = Format("euroc", "a sequence of EuRoC MAV", find_euroc, parse_euroc, open_centre=True)
