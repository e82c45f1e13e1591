"""Read a written file back, and project through its lenses, with code other than the writer's and the parser's.

Nothing here comes from `cameras`: COLMAP models are read by pycolmap, JSON field by field, quaternions by SciPy. It
reads only what nerfcli writes, so it is short and checks nothing: any error shows as a residual or as an
`UnreadableError`. Lenses are OpenCV's, or pycolmap's if OpenCV has none such. Pixel positions are those of nerfcli: the
centre of the top-left pixel is (0.5, 0.5); the formulas do not depend on it.
"""

import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

# After the principal point, their parameters are the first of OpenCV's distortion terms k1 k2 p1 p2 k3 k4 k5 k6.
# Source: docs.opencv.org calib3d, "Detailed Description"; colmap src/colmap/sensor/models.h.
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


@dataclass(frozen=True)
class FileLens:
    """A lens as a file describes it, with COLMAP's name and order of parameters."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


def project(lens: FileLens, points_cam: np.ndarray) -> np.ndarray:
    """Return pixels (N, 2) of points (N, 3) in OpenCV camera axes; meaningless for points that the lens cannot see."""
    if not len(points_cam):
        return np.zeros((0, 2))
    points = np.ascontiguousarray(points_cam, dtype=np.float64)[:, None]
    if lens.model in _PERSPECTIVE:
        matrix, terms = _matrix_and_terms(lens)
        distortion = np.zeros(8)
        distortion[: len(terms)] = terms
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    elif lens.model in _FISHEYE:
        pixels = _fisheye_pixels(lens, points[:, 0])
    else:
        camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
        pixels = np.asarray(camera.img_from_cam(points[:, 0], check_cheirality=False))
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def _matrix_and_terms(lens: FileLens) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return OpenCV's camera matrix (3, 3) and distortion terms."""
    fx, fy, cx, cy = lens.params[:1] * 2 + lens.params[1:3] if lens.model in _ONE_FOCAL else lens.params[:4]
    terms = lens.params[3:] if lens.model in _ONE_FOCAL else lens.params[4:]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), terms


def _fisheye_pixels(lens: FileLens, points: np.ndarray) -> np.ndarray:
    """Return pixels of the equidistant fisheye, theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8), at any angle.

    cv2.fisheye.projectPoints has the same formula, but divides by z and therefore ends at 90 degrees.
    """
    matrix, terms = _matrix_and_terms(lens)
    across = np.hypot(points[:, 0], points[:, 1])
    theta = np.arctan2(across, points[:, 2])
    bent = theta * (1 + sum(term * theta ** (2 * power) for power, term in enumerate(terms, start=1)))
    scale = np.divide(bent, across, out=np.zeros_like(bent), where=across > 0)
    return (points[:, :2] * scale[:, None]) @ matrix[:2, :2].T + matrix[:2, 2]


class UnreadableError(Exception):
    """A file that was just written does not conform to its format."""


@dataclass(frozen=True)
class ReadBack:
    """The views in a file.

    Args:
        labels: the photo of each view, as the file names it; None if the order of views determines it.
        cam_from_world: (views, 3, 3) rotations, OpenCV axes.
        centres: (views, 3) camera centres in the world.
        lenses: one per view; None if the format has no intrinsics.
        points: (N, 3), or None if the format has no points.
        colours: (N, 3), 0...255; None if the format has none.
        features: returns the positions (F, 2) of a view's features and the indices of their points (F,), -1 for none;
            None if the format has no observations.
        images, masks: of each view, as paths, "" for none; None, like the following, if the format does not state them.
        splits: of each view: "train", "val", "test", or "" for none.
        depth_bounds: (views, 2).
        unit: "arbitrary" or "metre".
    """

    labels: tuple[str, ...] | None
    cam_from_world: np.ndarray
    centres: np.ndarray
    lenses: tuple[FileLens, ...] | None
    points: np.ndarray | None
    colours: np.ndarray | None = None
    features: Callable[[int], tuple[np.ndarray, np.ndarray]] | None = None
    images: tuple[str, ...] | None = None
    masks: tuple[str, ...] | None = None
    splits: tuple[str, ...] | None = None
    depth_bounds: np.ndarray | None = None
    unit: str | None = None


@dataclass(frozen=True)
class UnstatedFacts:
    """Facts that a file does not state: its camera axes as three letters, the coordinate of the first pixel's centre,
    and the widths and heights of its views' pictures in the file's order."""

    axes: str
    pixel_centre: float
    sizes: tuple[tuple[int, int], ...]


def read_colmap(path: Path, unstated: UnstatedFacts) -> ReadBack:
    """Read a COLMAP model, by pycolmap."""
    model = pycolmap.Reconstruction(str(path))
    lenses = {
        camera_id: FileLens(camera.model.name, camera.width, camera.height, tuple(camera.params))
        for camera_id, camera in model.cameras.items()
    }
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    point_ids = sorted(model.points3D)
    places = {point_id: place for place, point_id in enumerate(point_ids)}
    poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    rotations = poses[:, :, :3]
    return ReadBack(
        labels=tuple(image.name for image in images),
        cam_from_world=rotations,
        centres=-np.einsum("nji,nj->ni", rotations, poses[:, :, 3]),
        lenses=tuple(lenses[image.camera_id] for image in images),
        points=np.array([model.points3D[index].xyz for index in point_ids]).reshape(-1, 3),
        colours=np.array([model.points3D[index].color for index in point_ids]).reshape(-1, 3),
        features=lambda view: _features(images[view], places),
    )


def read_scene(path: Path, unstated: UnstatedFacts) -> ReadBack:
    """Read a scene of nerfcli: its model by pycolmap, scene.json by the json module."""
    content = json.loads((path / "scene.json").read_text(encoding="utf-8"))
    back = read_colmap(path / content["model"], unstated)
    names = back.labels or ()
    masks, bounds, root = content["masks"] or {}, content.get("depth_bounds"), os.path.realpath(path)
    parts = {name: part for part in ("test", "val", "unused") for name in content["split"].get(part, [])}
    return replace(
        back,
        images=tuple(os.path.join(root, content["image_folder"], name) for name in names),
        masks=tuple(os.path.join(root, masks[name]) if name in masks else "" for name in names),
        splits=tuple(parts.get(name, "train").replace("unused", "") for name in names),
        depth_bounds=None if bounds is None else np.array([bounds[name] for name in names]),
        unit=content["unit"],
    )


def _features(image: Any, places: dict[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (F, 2) of an image's features, and indices (F,) of their points in the list, -1 for none."""
    features = list(image.points2D)
    points = [places[feature.point3D_id] if feature.has_point3D() else -1 for feature in features]
    return np.array([feature.xy for feature in features]).reshape(-1, 2), np.array(points, dtype=np.int64)


def read_transforms(path: Path, unstated: UnstatedFacts) -> ReadBack:
    """Read transforms.json, by the json module, and the PLY file of points that it names."""
    content = json.loads(path.read_text(encoding="utf-8"))
    cloud = content.get("ply_file_path")
    points, colours = (np.zeros((0, 3)), None) if cloud is None else read_ply(path.parent / cloud)
    parts = {name: part for part in ("train", "val", "test") for name in content.get(f"{part}_filenames", [])}
    records = content["frames"]
    return replace(
        _from_transforms([content], unstated),
        points=points,
        colours=colours,
        images=tuple(os.path.join(path.parent, record["file_path"]) for record in records),
        masks=tuple(
            os.path.join(path.parent, record["mask_path"]) if "mask_path" in record else "" for record in records
        ),
        splits=tuple(parts.get(record["file_path"], "") for record in records),
    )


def read_blender(path: Path, unstated: UnstatedFacts) -> ReadBack:
    """Read transforms_{train,val,test}.json of a folder, whose only intrinsic is the angle of view."""
    files = [path / f"transforms_{split}.json" for split in ("train", "val", "test")]
    contents = [json.loads(file.read_text(encoding="utf-8")) for file in files if file.exists()]
    named = [file.stem.removeprefix("transforms_") for file in files if file.exists()]
    splits = [split for split, content in zip(named, contents, strict=True) for _ in content["frames"]]
    for content in contents:
        content["frames"] = [{**record, "angle": content["camera_angle_x"]} for record in content["frames"]]
    return replace(_from_transforms(contents, unstated), splits=tuple(splits))


def read_llff(path: Path, unstated: UnstatedFacts) -> ReadBack:
    """Read poses_bounds.npy, by NumPy: 17 numbers per view; the fifth column of its 3 x 5 is height, width, focal."""
    rows = np.load(path / "poses_bounds.npy")
    matrices = rows[:, :15].reshape(-1, 3, 5)
    rotations, centres = _views_from_world_from_cam(matrices[:, :, :4], unstated.axes)
    lenses = []
    for height, width, focal in matrices[:, :, 4]:
        lenses.append(FileLens("SIMPLE_PINHOLE", int(width), int(height), (focal, width / 2, height / 2)))
    return ReadBack(None, rotations, centres, tuple(lenses), None, depth_bounds=rows[:, 15:])


def read_tum(path: Path, unstated: UnstatedFacts) -> ReadBack:
    """Read a TUM trajectory: time, position, quaternion with its real part last, by NumPy and SciPy."""
    rows = np.loadtxt(path, ndmin=2)
    matrices = np.concatenate([Rotation.from_quat(rows[:, 4:8]).as_matrix(), rows[:, 1:4, None]], axis=2)
    rotations, centres = _views_from_world_from_cam(matrices, unstated.axes)
    return ReadBack(None, rotations, centres, None, None)


def read_kitti(path: Path, unstated: UnstatedFacts) -> ReadBack:
    """Read a KITTI odometry file: 3 x 4 numbers a line, by NumPy."""
    rotations, centres = _views_from_world_from_cam(np.loadtxt(path, ndmin=2).reshape(-1, 3, 4), unstated.axes)
    return ReadBack(None, rotations, centres, None, None)


def read_opensfm(path: Path, unstated: UnstatedFacts) -> ReadBack:
    """Read reconstruction.json, by the json module and SciPy: angle-axis and translation of cam_from_world."""
    (content,) = json.loads(path.read_text(encoding="utf-8"))
    shots = content["shots"]
    rotations = Rotation.from_rotvec(np.array([shot["rotation"] for shot in shots.values()])).as_matrix()
    translations = np.array([shot["translation"] for shot in shots.values()])
    lenses = {key: _opensfm_lens(record) for key, record in content["cameras"].items()}
    return ReadBack(
        labels=tuple(shots),
        cam_from_world=rotations,
        centres=-np.einsum("nji,nj->ni", rotations, translations),
        lenses=tuple(lenses[shot["camera"]] for shot in shots.values()),
        points=np.array([point["coordinates"] for point in content["points"].values()]).reshape(-1, 3),
        colours=np.array([point["color"] for point in content["points"].values()]).reshape(-1, 3),
    )


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read vertices (N, 3) of a binary PLY file, its first three properties as doubles, and colours (N, 3) from the
    bytes that follow, if there are any."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    sizes = {"double": 8, "float64": 8, "float": 4, "uchar": 1, "uint8": 1}
    stride = sum(sizes[line.split()[1]] for line in lines if line.startswith("property"))
    rows = np.frombuffer(body, dtype=np.uint8, count=count * stride).reshape(count, stride)
    points = np.ascontiguousarray(rows[:, :24]).view("<f8").reshape(count, 3)
    return points, rows[:, 24:27] if stride == 27 else None


def _opensfm_lens(record: dict[str, Any]) -> FileLens:
    """Return a lens from numbers in units of the picture's longer side, measured from its centre."""
    kind, width, height = record["projection_type"], record["width"], record["height"]
    if kind in ("spherical", "equirectangular"):
        return FileLens("EQUIRECTANGULAR", width, height, (width, height))
    unit = max(width, height)
    fx, fy = record["focal_x"] * unit, record["focal_y"] * unit
    head = (fx, fy, record["c_x"] * unit + width / 2, record["c_y"] * unit + height / 2)
    k1, k2, k3, k4, k5, k6, p1, p2, sx, sy = (
        record.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s0", "s2")
    )
    if kind == "fisheye_opencv":
        return FileLens("OPENCV_FISHEYE", width, height, (*head, k1, k2, k3, k4))
    if kind == "fisheye62":
        terms = (k1, k2, k3, k4, k5, k6, p1, p2, 0.0, 0.0, 0.0, 0.0)
        return FileLens("RAD_TAN_THIN_PRISM_FISHEYE", width, height, (*head, *terms))
    if kind == "fisheye624":
        return FileLens("THIN_PRISM_FISHEYE", width, height, (*head, k1, k2, p1, p2, k3, k4, sx, sy))
    return FileLens("FULL_OPENCV", width, height, (*head, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))


def _from_transforms(contents: list[dict[str, Any]], unstated: UnstatedFacts) -> ReadBack:
    records = [{**content, **record} for content in contents for record in content["frames"]]
    rotations, centres = _views_from_world_from_cam([record["transform_matrix"] for record in records], unstated.axes)
    return ReadBack(
        labels=tuple(record["file_path"] for record in records),
        cam_from_world=rotations,
        centres=centres,
        lenses=tuple(
            _transforms_lens(record, 0.5 - unstated.pixel_centre, size)
            for record, size in zip(records, unstated.sizes, strict=True)
        ),
        points=None,
    )


def _transforms_lens(record: dict[str, Any], shift: float, size: tuple[int, int]) -> FileLens:
    if "angle" in record:
        width, height = size
        return FileLens(
            "SIMPLE_PINHOLE", width, height, (width / 2 / math.tan(record["angle"] / 2), width / 2, height / 2)
        )
    width, height = record["w"], record["h"]
    if record["camera_model"] == "EQUIRECTANGULAR":
        return FileLens("EQUIRECTANGULAR", width, height, (width, height))
    head = (record["fl_x"], record["fl_y"], record["cx"] + shift, record["cy"] + shift)
    if "FISHEYE" in record["camera_model"]:
        terms = (record.get(key, 0.0) for key in ("k1", "k2", "k3", "k4"))
        return FileLens("OPENCV_FISHEYE", width, height, (*head, *terms))
    terms = (record.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    return FileLens("FULL_OPENCV", width, height, (*head, *terms))


def _views_from_world_from_cam(matrices: Any, axes: str) -> tuple[np.ndarray, np.ndarray]:
    """Return cam_from_world rotations and centres from matrices whose columns are the camera's axes in the world.

    The columns are put in OpenCV's order one by one: right, down, forward.
    """
    poses = np.array(matrices, dtype=np.float64)
    rows = [_pointing(poses, axes, *pair) for pair in ("rl", "du", "fb")]
    return np.stack(rows, axis=1), poses[:, :3, 3]


def _pointing(poses: np.ndarray, axes: str, along: str, against: str) -> np.ndarray:
    """Return a direction of the cameras in world coordinates, (views, 3); `axes` names it or its opposite."""
    if along in axes:
        return poses[:, :3, axes.index(along)]
    return -poses[:, :3, axes.index(against)]


READERS = {
    "nerfcli": read_scene,
    "colmap": read_colmap,
    "colmap-text": read_colmap,
    "transforms": read_transforms,
    "blender": read_blender,
    "llff": read_llff,
    "opensfm": read_opensfm,
    "tum": read_tum,
    "kitti": read_kitti,
}
