"""The text files of a COLMAP model: cameras.txt, images.txt and points3D.txt.

Lines that begin with #, perhaps after spaces, are comments. Whole numbers may have decimals, as NumPy writes them. A
name in images.txt is the rest of its line, spaces included; COLMAP itself writes such names and cuts them at the first
space when it reads them (4.2.1). Source: colmap.github.io/format.html; colmap
src/colmap/scene/reconstruction_io_text.cc.
"""

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.colmap_model import ColmapImage, ColmapModel, ImageRow, images_of_rows, pose_rows, tracks
from nerfcli.captures.formats.fields import decoded
from nerfcli.captures.formats.limits import checked_camera, plausible

# Ids have 32 bits, those of points 64, of which float64 holds 53 exactly.
_MOST_ID = 2**53


def cameras_from_bytes(data: bytes) -> dict[int, Camera]:
    """Return the cameras by id. Raises ValueError or UserError where a line is damaged."""
    cameras = {}
    for line in _filled(_lines(data)):
        camera_id, model, width, height, *params = line.split()
        where = f"camera {camera_id}"
        key = _whole(camera_id)
        if key in cameras:
            raise ValueError(f"two cameras have the id {camera_id}")
        values = tuple(float(value) for value in params)
        cameras[key] = checked_camera(model.upper(), _whole(width), _whole(height), values, where=where)
    return cameras


def images_from_bytes(data: bytes) -> tuple[list[ColmapImage], tuple[str, ...]]:
    """Return the images, in the file's order, and notes. Raises ValueError where a line is damaged."""
    rows, lines = list[ImageRow](), _lines(data)[::-1]
    while lines:
        line = lines.pop()
        if not _is_filled(line):
            continue
        image_id, *pose, camera_id, name = line.strip().split(maxsplit=9)
        # The line after an image's line lists its features; it may be empty, and is missing in files written by hand.
        if len(pose) != 7:
            raise ValueError(f"the line of image {name} has {len(pose) + 3} words, expected 10")
        features = lines.pop() if lines and not _is_image(lines[-1]) else ""
        values = np.fromiter(map(float, features.split()), dtype=np.float64)
        if len(values) % 3:
            raise ValueError(f"the features of image {name} are {len(values)} numbers, expected x, y, point id of each")
        values = values.reshape(-1, 3)
        point_ids = _ids(values[:, 2], f"a point of image {name}")
        rows.append((_whole(image_id), name, _whole(camera_id), list(map(float, pose)), values[:, :2], point_ids))
    return images_of_rows(rows)


def points_from_bytes(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ids (N,), positions (N, 3) and colours (N, 3). Raises ValueError where a line is damaged."""
    lines = _filled(_lines(data))
    rows = [list(map(float, line.split(maxsplit=8)[:8])) for line in lines]
    if any(len(row) < 8 for row in rows):
        raise ValueError("a point has fewer than 8 numbers; expected id, x, y, z, r, g, b, error, track")
    table = np.array(rows, dtype=np.float64).reshape(-1, 8)
    points, colours = table[:, 1:4], table[:, 4:7]
    if not plausible(points).all():
        raise ValueError(f"a point is at {points[int(np.argmin(plausible(points)))]}")
    if not ((colours >= 0) & (colours <= 255)).all():
        raise ValueError("a point has a colour that is not between 0 and 255")
    return _ids(table[:, 0], "a point"), points.copy(), colours.astype(np.uint8)


def cameras_to_bytes(model: ColmapModel) -> bytes:
    """Return the bytes of cameras.txt."""
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines.append(f"# Number of cameras: {len(model.cameras)}")
    for camera_id, camera in model.cameras.items():
        lines.append(f"{camera_id} {camera.model} {camera.width} {camera.height} {_joined(camera.params)}")
    return _encoded(lines)


def images_to_bytes(model: ColmapModel) -> bytes:
    """Return the bytes of images.txt."""
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
        f"# Number of images: {len(model.images)}",
    ]
    for image, pose in zip(model.images, pose_rows(model).tolist(), strict=True):
        words = [""] * (3 * len(image.pixels))
        words[0::3] = map(repr, image.pixels[:, 0].tolist())
        words[1::3] = map(repr, image.pixels[:, 1].tolist())
        words[2::3] = map(str, image.point_ids.tolist())
        lines.append(f"{image.image_id} {_joined(pose)} {image.camera_id} {image.name}")
        lines.append(" ".join(words))
    return _encoded(lines)


def points_to_bytes(model: ColmapModel) -> bytes:
    """Return the bytes of points3D.txt; the tracks are those of the images' features, and errors -1 (not measured)."""
    elements, lengths = tracks(model)
    words = list(map(str, elements.ravel().tolist()))
    ends = (2 * np.cumsum(lengths)).tolist()
    lines = [
        "# 3D point list with one line of data per point:",
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
        f"# Number of points: {len(model.points)}",
    ]
    rows = zip(model.point_ids.tolist(), model.points.tolist(), model.colours.tolist(), ends, strict=True)
    start = 0
    for point_id, point, (red, green, blue), end in rows:
        lines.append(" ".join([f"{point_id} {_joined(point)} {red} {green} {blue} -1", *words[start:end]]))
        start = end
    return _encoded(lines)


def _lines(data: bytes) -> list[str]:
    # Not splitlines(), which also splits at characters that a file name may hold.
    return decoded(data).split("\n")


def _is_image(line: str) -> bool:
    """Return whether a line of images.txt has as many words as that of an image, and ends with a name."""
    try:
        float(line.rsplit(maxsplit=1)[-1])
    except ValueError:
        return len(line.split(maxsplit=9)) == 10
    except IndexError:  # an empty line
        pass
    return False


def _filled(lines: list[str]) -> list[str]:
    return list(filter(_is_filled, lines))


def _is_filled(line: str) -> bool:
    return not line.lstrip().startswith("#") and bool(line.strip())


def _whole(word: str) -> int:
    value = float(word)
    if not value.is_integer():  # neither are NaN and infinity
        raise ValueError(f"{word} is not a whole number")
    return int(value)


def _ids(values: np.ndarray, what: str) -> np.ndarray:
    if not ((np.abs(values) < _MOST_ID) & (values == np.trunc(values)) & (values >= -1)).all():  # False at NaN
        raise ValueError(f"{what} has an id that is not an integer")
    return values.astype(np.int64)


def _joined(values: "tuple[float, ...] | list[float]") -> str:
    return " ".join(map(repr, values))


def _encoded(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode("utf-8")
