"""Bundler's model (bundle.out, v0.3) and its list of images, read only.

A camera is a line "f k1 k2", three lines of a rotation R and one of t; its axes are OpenGL's (it looks along -z, +y
up). A point X appears, in pixels from the picture's middle with y upwards, at
    P = R X + t,  p = -(P_x, P_y)/P_z,  f (1 + k1 |p|^2 + k2 |p|^4) p
so the principal point is the picture's middle, and (width/2, height/2) its top right corner. A point is a line with its
position, one with its colour, and one with its views: the count, and for each the camera, a feature's key, and x y.
Source: Noah Snavely, "Bundler v0.4 User's Manual", section "Output format and scene representation".
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.axes import opencv_pose
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.formats import lenses
from nerfcli.captures.formats.fields import check_unique_names, content_lines, malformed, name_of, numbers, read_text
from nerfcli.captures.formats.format import Format, UserInputs, by_suffix, only_file
from nerfcli.captures.formats.limits import FramePoses, without
from nerfcli.captures.formats.photo_names import find_photos
from nerfcli.captures.orientation import stored_size

BEGINS = "# Bundle file"
_HEADER = f"{BEGINS} v0.3"
_EXPECTED = f'expected a file of Bundler, which begins with "{_HEADER}"'
_LIST_EXPECTED = "expected Bundler's list of images, one name per line"

# In the list a name may be followed by a zero and the focal length in pixels that EXIF suggests.
_FOCAL_GUESS = re.compile(r"[\d.eE+-]+", re.ASCII)

Numbered = tuple[int, str]


def parse_bundler(path: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the registered cameras, the points with their colours, and where the points were seen.

    Cameras of focal length 0 are those that Bundler could not register; they give no frames. The file gives neither
    names nor sizes of the photos: names come from the list, and sizes from the photos. Photos that are not on disk are
    `missing`, and their observations are left out. The list of images is, by default, X.list.txt, which COLMAP writes
    beside X.bundle.out, or list.txt beside the file or in the folder above.
    """
    lines = _lines(path)
    num_cameras, num_points = _counts(lines, path)
    image_list = _find_list(path)
    listed = enumerate(read_text(image_list, _LIST_EXPECTED).splitlines(), start=1)
    names = [_listed(line, f"{image_list}: line {number}") for number, line in listed if line.strip()]
    if len(names) != num_cameras:
        raise malformed(path, f"has {num_cameras} cameras, but {image_list} has {len(names)} images", _LIST_EXPECTED)
    registered = [index for index in range(num_cameras) if numbers(*_line(lines, 1 + 5 * index, 3, path))[0] != 0]
    unregistered = [names[index] for index in sorted({*range(num_cameras)} - {*registered})]
    posed = [names[index] for index in registered]
    check_unique_names(posed, image_list if registered else path)
    found = find_photos(posed, (image_list.parent,), given=given.images).required(path)
    poses, frames, middles = FramePoses(), [], []
    index_of_camera = np.full(num_cameras, -1, dtype=np.int64)
    for index, name, image in zip(registered, found.names, found.paths, strict=True):
        own = lines[1 + 5 * index : 6 + 5 * index]
        pose = poses.read_inverse(name, f"{path}: line {own[1][0]}", partial(_matrix, own, path))
        if image is not None and pose is not None:
            size = stored_size(image)
            index_of_camera[index] = len(frames)
            camera = _camera(own, size, path)
            frames.append(Frame(name, camera, opencv_pose(pose, "opengl"), image=image))
            middles.append((size[0] / 2, size[1] / 2))
    points, colours, views = _points(lines[1 + 5 * num_cameras :], num_cameras, num_points, path)
    seen = _observations(views, index_of_camera, np.array(middles))
    return Capture(
        tuple(frames),
        points,
        found.missing,
        kind="bundler",
        colours=colours if num_points else None,
        observations=seen,
        notes=(*found.notes, *poses.notes(), *without(unregistered, "a pose")),
    )


def _lines(path: Path) -> list[Numbered]:
    text = read_text(path, _EXPECTED)
    if not text.startswith(BEGINS):
        raise malformed(path, f"does not begin with {BEGINS}", _EXPECTED)
    if not text.startswith(_HEADER):
        raise malformed(f"{path}: line 1", "is of an unsupported version of the format", _EXPECTED)
    return content_lines(text)


def _counts(lines: list[Numbered], path: Path) -> tuple[int, int]:
    """Return the numbers of cameras and points, after checking that they match the number of lines."""
    words, count, where = _line(lines, 0, 2, path)
    cameras, points = numbers(words, count, where)
    if not (cameras >= 0 and points >= 0 and cameras == int(cameras) and points == int(points)):
        raise malformed(where, f"announces {cameras:g} cameras and {points:g} points", "expected two whole numbers")
    if 1 + 5 * cameras + 3 * points != len(lines):
        what = f"announces {cameras:.0f} cameras and {points:.0f} points, but the file has {len(lines)} lines"
        raise malformed(where, what, "each camera has 5 lines and each point 3; the file is cut off or was changed")
    return int(cameras), int(points)


def _line(lines: list[Numbered], index: int, count: int, path: Path) -> tuple[list[str], int, str]:
    """Return the words of a line, their expected number and the line's place: the arguments of `numbers`."""
    if index >= len(lines):
        raise malformed(path, "ends too early", "the file is cut off; copy it again")
    number, line = lines[index]
    return line.split(), count, f"{path}: line {number}"


def _find_list(path: Path) -> Path:
    stem = path.name.removesuffix(".bundle.out")
    candidates = (path.parent / f"{stem}.list.txt", path.parent / "list.txt", path.parent.parent / "list.txt")
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    hint = "write one: the names of the photos in the order of the cameras, one per line"
    raise malformed(path, f"the list of images next to it is missing ({candidates[1]})", hint)


def _listed(line: str, where: str) -> str:
    words = line.rsplit(maxsplit=2)
    if len(words) == 3 and words[1] == "0" and _FOCAL_GUESS.fullmatch(words[2]):
        line = words[0]
    return name_of(line, where).removeprefix("./")


def _camera(lines: list[Numbered], size: tuple[int, int], path: Path) -> Camera:
    focal, k1, k2 = numbers(*_line(lines, 0, 3, path))
    where, middle = f"{path}: line {lines[0][0]}", (size[0] / 2, size[1] / 2)
    return lenses.brown_camera(size, (focal, focal), middle, radial=(k1, k2, 0.0), where=where)


def _matrix(lines: list[Numbered], path: Path) -> np.ndarray:
    """Return the first three rows of cam_from_world, (3, 4)."""
    rows = np.array([numbers(*_line(lines, row, 3, path)) for row in range(1, 5)])
    return np.column_stack([rows[:3], rows[3]])


def _points(
    lines: list[Numbered], num_cameras: int, num_points: int, path: Path
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (N, 3), colours (N, 3) uint8, and a row (camera, point, x, y) for each view, (M, 4)."""
    points, colours = np.empty((num_points, 3)), np.empty((num_points, 3))
    views: list[float] = []
    owners: list[int] = []
    for index in range(num_points):
        points[index] = numbers(*_line(lines, 3 * index, 3, path))
        colours[index] = numbers(*_line(lines, 3 * index + 1, 3, path))
        words, _, where = _line(lines, 3 * index + 2, 0, path)
        count = numbers(words[:1], 1, where)[0]
        if count != (len(words) - 1) / 4:
            hint = "expected 4 for each view"
            raise malformed(where, f"announces {count:g} views, but has {len(words) - 1} numbers", hint)
        views += numbers(words[1:], len(words) - 1, where)
        owners += [index] * int(count)
    table = np.array(views, dtype=np.float64).reshape(-1, 4)
    table[:, 1] = owners
    valid = (table[:, 0] >= 0) & (table[:, 0] < num_cameras) & (table[:, 0] == np.floor(table[:, 0]))
    if not valid.all():
        where = _line(lines, 3 * owners[int(np.argmin(valid))] + 2, 0, path)[2]
        raise malformed(where, "a view refers to a camera that does not exist", f"expected 0 to {num_cameras - 1}")
    return points, np.clip(np.rint(colours), 0, 255).astype(np.uint8), table


def _observations(views: np.ndarray, index_of_camera: np.ndarray, middles: np.ndarray) -> Observations | None:
    """Return the views of photos on disk, in pixels with y downwards and the origin at the top left corner."""
    if not len(views):
        return None
    frame_index = index_of_camera[views[:, 0].astype(np.int64)]
    kept = frame_index >= 0
    frame_index, views = frame_index[kept], views[kept]
    pixels = middles[frame_index] + views[:, 2:] * (1.0, -1.0)
    return Observations(frame_index, views[:, 1].astype(np.int64), pixels)


def find_bundler(path: Path) -> Path | None:
    """Find a file .out, Bundler's own in a folder, or the only one in it that begins as a file of Bundler does."""
    return by_suffix(".out", "bundle.out", "bundle/bundle.out")(path) or only_file(path, "*.out", BEGINS)


FORMAT = Format("bundler", "Bundler", find_bundler, parse_bundler, axes="opengl")
