"""Trajectories of the TUM and KITTI benchmarks: poses without cameras, pictures or points.

TUM: a line "timestamp tx ty tz qx qy qz qw" for each pose. KITTI: a line with the first three rows of a 4x4 matrix, row
by row; its frames are identified only by their order in the file, in six digits as KITTI names its pictures. Both are
world_from_cam with OpenCV axes.
Sources: cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats; cvlibs.net/datasets/kitti, odometry devkit, readme.txt.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nerfcli.atomic import atomic_path
from nerfcli.cameras import rigid
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import Row, malformed, matrix_of, numbers, opened, read_rows, shown
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.limits import FramePoses, without
from nerfcli.captures.formats.photo_names import GIVE_CAMERA, with_photos
from nerfcli.captures.formats.unsupported import lost_of_cameras, lost_parts
from nerfcli.errors import UserError

_TUM_EXPECTED = "expected lines of timestamp tx ty tz qx qy qz qw"
_KITTI_EXPECTED = "expected lines of 12 numbers, the first three rows of a 4x4 matrix"

# Names and poses `world_from_cam`, and notes.
Poses = tuple[list[tuple[str, np.ndarray]], tuple[str, ...]]

_NUMBER = re.compile(r"[+-]?\d{1,20}(\.\d{0,20})?([eE][+-]?\d{1,2})?", re.ASCII)
_PICTURE = re.compile(r"\.(png|jpe?g|tiff?|bmp|webp)$", re.IGNORECASE)


def losses_tum(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that a TUM trajectory cannot hold."""
    return _losses(capture, named=_timestamps(capture) == [frame.name for frame in capture.frames])


def losses_kitti(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that a KITTI trajectory cannot hold."""
    return _losses(capture, named=all(frame.name == _indexed(i) for i, frame in enumerate(capture.frames)))


def write_tum(capture: Capture, path: Path) -> None:
    """Write a capture's poses in the TUM format, with full precision.

    The timestamps are the frames' names where all of them are different numbers, without the suffix of a picture
    ("1305031102.175304.png"); else the frames' indices.
    """
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    poses = np.stack([frame.world_from_cam for frame in capture.frames])
    wxyz = rigid.quaternion_from_rotation(poses[:, :3, :3])
    rows = np.concatenate([poses[:, :3, 3], wxyz[:, [1, 2, 3, 0]]], axis=1)
    for timestamp, row in zip(_timestamps(capture), rows.tolist(), strict=True):
        lines.append(" ".join([timestamp, *map(repr, row)]))
    _write(lines, path)


def write_kitti(capture: Capture, path: Path) -> None:
    """Write a capture's poses in the KITTI format, with full precision."""
    rows = [frame.world_from_cam[:3].ravel().tolist() for frame in capture.frames]
    _write([" ".join(map(repr, row)) for row in rows], path)


def _parsed(path: Path, given: UserInputs, read: Callable[[Path], Poses], *, kind: str) -> Capture:
    """Read a trajectory, whose frames have the given camera, since the file has none."""
    if given.camera is None:
        raise UserError(f"{path}: a {kind.upper()} trajectory contains poses but no camera", GIVE_CAMERA)
    poses, notes = read(path)
    frames = tuple(Frame(name, given.camera, world_from_cam) for name, world_from_cam in poses)
    return with_photos(Capture(frames, kind=kind, notes=notes), given=given.images)


def timed_rows(path: Path, expected: str) -> list[Row]:
    """Return what `read_rows` returns, without a line of names that has lost its "#"."""
    return [row for row in read_rows(path, expected) if not row.cells[0].lower().startswith("timestamp")]


def tum_poses(path: Path) -> Poses:
    """Read the timestamps and poses `world_from_cam` of a trajectory in the TUM format, and what was left out."""
    usable, poses = FramePoses(), []
    for cells, where in timed_rows(path, _TUM_EXPECTED):
        if len(cells) != 8:
            raise malformed(where, f"has {len(cells)} numbers", "expected 8")
        if not _NUMBER.fullmatch(cells[0]):
            raise malformed(where, f"its timestamp is {shown(cells[0])}", "expected seconds, such as 1305031102.1753")
        read = partial(numbers, [*cells[4:], *cells[1:4]], 7, where)
        poses.append((cells[0], usable.read_quaternion(cells[0], where, read)))
    return _usable(poses, usable, path, _TUM_EXPECTED)


def _kitti_poses(path: Path) -> Poses:
    usable, poses = FramePoses(), []
    for index, (cells, where) in enumerate(read_rows(path, _KITTI_EXPECTED)):
        poses.append((_indexed(index), usable.read(_indexed(index), where, partial(matrix_of, cells, 3, 4, where))))
    return _usable(poses, usable, path, _KITTI_EXPECTED)


def _usable(poses: list[tuple[str, np.ndarray | None]], usable: FramePoses, path: Path, expected: str) -> Poses:
    if not poses:
        raise malformed(path, "has no pose", expected)
    return [(name, pose) for name, pose in poses if pose is not None], usable.notes()


def _indexed(index: int) -> str:
    return f"{index:06d}"


def _timestamps(capture: Capture) -> list[str]:
    """Return the frames' names without the suffix of a picture where all are different numbers, else their indices."""
    stems = [_PICTURE.sub("", frame.name.rsplit("/", 1)[-1]) for frame in capture.frames]
    if all(map(_NUMBER.fullmatch, stems)) and len(set(stems)) == len(stems):
        return stems
    return [str(index) for index in range(len(stems))]


def _losses(capture: Capture, *, named: bool) -> tuple[str, ...]:
    names = [] if named else [f"names of {len(capture.frames)} frames"]
    return (*lost_of_cameras(capture, lambda _: ["intrinsics"]), *names, *lost_parts(capture, holds=()))


def _write(lines: list[str], path: Path) -> None:
    with atomic_path(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")


def find_lines(path: Path, *, columns: int) -> Path | None:
    """Find a text file whose first line that is neither empty nor a comment has `columns` words."""
    if not path.is_file() or path.suffix.lower() != ".txt":
        return None
    with opened(path) as stream:
        for _ in range(1000):
            line = stream.readline(10_000)
            if line.strip() and not line.lstrip().startswith("#"):
                return path if len(line.split()) == columns else None
    return None


TUM = Format(
    "tum",
    "a trajectory of the TUM RGB-D benchmark",
    lambda path: find_lines(path, columns=8),
    lambda path, given: _parsed(path, given, tum_poses, kind="tum"),
    open_axes=True,
    default_name="trajectory.txt",
    files=("*.txt",),
    lacks=("cameras", "points"),
    takes_camera=True,
    write=write_tum,
    losses=losses_tum,
)


KITTI = replace(
    TUM,
    name="kitti",
    of="a trajectory of the KITTI odometry benchmark",
    find=lambda path: find_lines(path, columns=12),
    read=lambda path, given: _parsed(path, given, _kitti_poses, kind="kitti"),
    default_name="poses.txt",
    write=write_kitti,
    losses=losses_kitti,
)


# Poses are interpolated between two that are at most this far apart; trackers and motion capture run at 30 to 200 Hz.
MOST_GAP_SECONDS = 0.1
# A single pose counts for a photo within this time, as in associate.py of the TUM RGB-D benchmark.
MOST_AWAY_SECONDS = 0.02


def poses_at(seconds: np.ndarray, world_from_body: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate poses: positions along a line, rotations at constant speed about one axis.

    Args:
        seconds: (N,) times of the poses, N > 0, in any order.
        world_from_body: (N, 4, 4).
        wanted: (M,) times.

    Returns:
        The poses (M, 4, 4) and whether each is known (M,). A pose measured at just this time is returned bit for bit;
        the pose at a time that none is near is the nearest one, and not known.
    """
    order = np.argsort(seconds, kind="stable")
    seconds, poses = seconds[order], world_from_body[order]
    after = np.searchsorted(seconds, wanted)
    lower, upper = np.maximum(after - 1, 0), np.minimum(after, len(seconds) - 1)
    nearest = np.where(wanted - seconds[lower] < seconds[upper] - wanted, lower, upper)
    result = poses[nearest]
    gap = seconds[upper] - seconds[lower]
    away = np.abs(wanted - seconds[nearest])
    is_between = (gap > 0) & (gap <= MOST_GAP_SECONDS) & (away > 0)
    low, high = poses[lower[is_between]], poses[upper[is_between]]
    weight = ((wanted - seconds[lower]) / np.where(gap > 0, gap, 1))[is_between, None]
    turn = Rotation.from_matrix(np.swapaxes(low[:, :3, :3], 1, 2) @ high[:, :3, :3]).as_rotvec()
    rotations = low[:, :3, :3] @ Rotation.from_rotvec(weight * turn).as_matrix()
    result[is_between] = rigid.from_parts(rotations, (1 - weight) * low[:, :3, 3] + weight * high[:, :3, 3])
    return result, is_between | (away <= MOST_AWAY_SECONDS)


def photos_at(
    names: Sequence[str], seconds: Sequence[float], times: Sequence[float], world_from_body: np.ndarray, *, where: str
) -> tuple[list[int], np.ndarray, tuple[str, ...]]:
    """Return the numbers of the photos with a pose at their time, these poses (N, 4, 4), and a note on the others.

    Raises:
        UserError: no photo has one; `where` is the file of the poses.
    """
    poses, is_known = poses_at(np.array(times), world_from_body, np.array(seconds))
    if not is_known.any():
        raise malformed(where, "has no pose at the time of a photo", "copy the whole sequence")
    unposed = [names[index] for index in np.flatnonzero(~is_known).tolist()]
    return np.flatnonzero(is_known).tolist(), poses[is_known], without(unposed, "a pose near in time")
