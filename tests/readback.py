"""Read captures that nerfcli wrote, and project through their lenses, with code other than its writers and parsers.

COLMAP models are read by pycolmap, JSON field by field, quaternions by SciPy; lenses are OpenCV's, or pycolmap's if
OpenCV has none such. Pixel positions are those of nerfcli: the centre of the top-left pixel is (0.5, 0.5); the formulas
do not depend on it.
"""

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from nerfcli.captures.capture import Capture

# After the principal point, their parameters are the first of OpenCV's distortion terms k1 k2 p1 p2 k3 k4 k5 k6.
# Source: docs.opencv.org calib3d, "Detailed Description"; colmap src/colmap/sensor/models.h.
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


@dataclass(frozen=True)
class FileLens:
    """A lens as a file describes it, with COLMAP's name and order of parameters."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels (N, 2) of points (N, 3) in OpenCV camera axes; meaningless if the lens cannot see them."""
        if self.model not in PERSPECTIVE + FISHEYE:
            camera = pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))
            return np.asarray(camera.img_from_cam(points, check_cheirality=False))
        fx, fy, cx, cy = self.params[:1] * 2 + self.params[1:3] if self.model in ONE_FOCAL else self.params[:4]
        terms = self.params[3:] if self.model in ONE_FOCAL else self.params[4:]
        if self.model in PERSPECTIVE:
            matrix, distortion = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.zeros(8)
            distortion[: len(terms)] = terms
            return cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
        # cv2.fisheye.projectPoints has the same formula, but divides by z and therefore ends at 90 degrees.
        across = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(across, points[:, 2])
        bent = theta * (1 + sum(term * theta ** (2 * power) for power, term in enumerate(terms, start=1)))
        scale = np.divide(bent, across, out=np.zeros_like(bent), where=across > 0)
        return points[:, :2] * scale[:, None] * (fx, fy) + (cx, cy)


@dataclass(frozen=True)
class ReadBack:
    """The views in a file; None for what its format does not state.

    Args:
        cam_from_world: (views, 3, 3) rotations, OpenCV axes.
        centres: (views, 3) camera centres in the world.
        lenses: one per view.
        labels: the photo of each view, as the file names it.
        points, colours: (N, 3); colours are 0...255.
        features: returns the positions (F, 2) of a view's features and the indices of their points (F,), -1 for none.
        images, masks: of each view, as paths, None for none.
        splits: of each view: "train", "val", "test", or None.
        depth_bounds: (views, 2).
        unit: "arbitrary" or "metre".
    """

    cam_from_world: np.ndarray
    centres: np.ndarray
    lenses: Sequence[FileLens] | None = None
    labels: Sequence[str] | None = None
    points: np.ndarray | None = None
    colours: np.ndarray | None = None
    features: Callable[[int], tuple[np.ndarray, np.ndarray]] | None = None
    images: Sequence[Path] | None = None
    masks: Sequence[Path | None] | None = None
    splits: Sequence[str | None] | None = None
    depth_bounds: np.ndarray | None = None
    unit: str | None = None


def assert_holds(capture: Capture, back: ReadBack) -> None:
    """Assert that a file holds a capture, whose frames are in its order, as far as its format has a place for it.

    All points that a view sees are projected by nerfcli's cameras, and by the lenses of the file.
    """
    assert len(back.centres) == len(capture.frames)
    for index, frame in enumerate(capture.frames):
        rotation = frame.world_from_cam[:3, :3].T
        np.testing.assert_allclose(back.cam_from_world[index], rotation, rtol=0, atol=1e-12)
        np.testing.assert_allclose(back.centres[index], frame.centre, rtol=0, atol=1e-12)
        if back.lenses is not None:
            pixels, seen = frame.camera.project((capture.points - frame.centre) @ rotation.T)
            assert seen.sum() > 10
            again = back.lenses[index].project((capture.points - back.centres[index]) @ back.cam_from_world[index].T)
            np.testing.assert_allclose(again[seen], pixels[seen], rtol=0, atol=1e-6)
        if back.features is not None and capture.observations is not None:
            rows = capture.observations.frame_index == index
            positions, points = back.features(index)
            np.testing.assert_array_equal(points, capture.observations.point_index[rows])
            np.testing.assert_array_equal(positions, capture.observations.pixels[rows])
        if back.labels is not None:
            assert Path(back.labels[index]).name in (Path(frame.name).name, Path(frame.name).stem)
        for listed, path in ((back.images, frame.image), (back.masks, frame.mask)):
            if listed is not None:
                assert _real(listed[index]) == _real(path)
        if back.splits is not None:
            assert back.splits[index] == frame.split
    assert back.unit in (None, capture.unit)
    for part in ("points", "colours", "depth_bounds"):
        if getattr(back, part) is not None:
            np.testing.assert_array_equal(getattr(back, part), getattr(capture, part))


def _real(path: Path | None) -> str | None:
    return None if path is None else os.path.realpath(path)


def read_colmap(path: Path, _: Capture) -> ReadBack:
    """Read a COLMAP model, by pycolmap."""
    model = pycolmap.Reconstruction(str(path))
    lenses = {
        camera_id: FileLens(camera.model.name, camera.width, camera.height, tuple(camera.params))
        for camera_id, camera in model.cameras.items()
    }
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    point_ids = sorted(model.points3D)
    places = {point_id: place for place, point_id in enumerate(point_ids)}

    def features(view: int) -> tuple[np.ndarray, np.ndarray]:
        seen = list(images[view].points2D)
        points = [places[feature.point3D_id] if feature.has_point3D() else -1 for feature in seen]
        return np.array([feature.xy for feature in seen]), np.array(points)

    return ReadBack(
        *_views_from_cam_from_world(np.array([image.cam_from_world().matrix() for image in images])),
        lenses=[lenses[image.camera_id] for image in images],
        labels=[image.name for image in images],
        points=np.array([model.points3D[index].xyz for index in point_ids]),
        colours=np.array([model.points3D[index].color for index in point_ids]),
        features=features,
    )


def read_scene(path: Path, capture: Capture) -> ReadBack:
    """Read a scene of nerfcli: its model by pycolmap, scene.json by the json module."""
    content = json.loads((path / "scene.json").read_text(encoding="utf-8"))
    back = read_colmap(path / content["model"], capture)
    names = back.labels or ()
    masks = content["masks"] or {}
    parts = {name: part for part in ("test", "val", "unused") for name in content["split"].get(part, [])}
    return replace(
        back,
        images=[path / content["image_folder"] / name for name in names],
        masks=[path / masks[name] if name in masks else None for name in names],
        splits=[None if parts.get(name) == "unused" else parts.get(name, "train") for name in names],
        depth_bounds=np.array([content["depth_bounds"][name] for name in names]),
        unit=content["unit"],
    )


def read_transforms(path: Path, _: Capture) -> ReadBack:
    """Read transforms.json, by the json module, and the PLY file of points that it names."""
    content = json.loads(path.read_text(encoding="utf-8"))
    points, colours = read_ply(path.parent / content["ply_file_path"])
    parts = {name: part for part in ("train", "val", "test") for name in content.get(f"{part}_filenames", [])}
    records = [{**content, **record} for record in content["frames"]]
    return ReadBack(
        *_views_from_world_from_cam([record["transform_matrix"] for record in records], (0, -1, -2)),
        lenses=[_transforms_lens(record) for record in records],
        labels=[record["file_path"] for record in records],
        points=points,
        colours=colours,
        images=[path.parent / record["file_path"] for record in records],
        masks=[path.parent / record["mask_path"] if "mask_path" in record else None for record in records],
        splits=[parts.get(record["file_path"]) for record in records],
    )


def read_blender(path: Path, capture: Capture) -> ReadBack:
    """Read transforms_{train,val,test}.json of a folder, whose only intrinsic is the angle of view."""
    records = []
    for split in ("train", "val", "test"):
        if (file := path / f"transforms_{split}.json").exists():
            content = json.loads(file.read_text(encoding="utf-8"))
            records += [{**record, "split": split, "angle": content["camera_angle_x"]} for record in content["frames"]]
    lenses = []
    for record, frame in zip(records, capture.frames, strict=True):
        width, height = frame.camera.size
        params = (width / 2 / math.tan(record["angle"] / 2), width / 2, height / 2)
        lenses.append(FileLens("SIMPLE_PINHOLE", width, height, params))
    return ReadBack(
        *_views_from_world_from_cam([record["transform_matrix"] for record in records], (0, -1, -2)),
        lenses=lenses,
        labels=[record["file_path"] for record in records],
        splits=[record["split"] for record in records],
    )


def read_llff(path: Path, _: Capture) -> ReadBack:
    """Read poses_bounds.npy, by NumPy: 17 numbers per view; the fifth column of its 3 x 5 is height, width, focal."""
    rows = np.load(path / "poses_bounds.npy")
    matrices = rows[:, :15].reshape(-1, 3, 5)
    lenses = [
        FileLens("SIMPLE_PINHOLE", int(width), int(height), (focal, width / 2, height / 2))
        for height, width, focal in matrices[:, :, 4]
    ]
    return ReadBack(*_views_from_world_from_cam(matrices[:, :, :4], (1, 0, -2)), lenses, depth_bounds=rows[:, 15:])


def read_tum(path: Path, _: Capture) -> ReadBack:
    """Read a TUM trajectory: time, position, quaternion with its real part last, by NumPy and SciPy."""
    rows = np.loadtxt(path, ndmin=2)
    matrices = np.concatenate([Rotation.from_quat(rows[:, 4:8]).as_matrix(), rows[:, 1:4, None]], axis=2)
    return ReadBack(*_views_from_world_from_cam(matrices, (0, 1, 2)))


def read_kitti(path: Path, _: Capture) -> ReadBack:
    """Read a KITTI odometry file: 3 x 4 numbers a line, by NumPy."""
    return ReadBack(*_views_from_world_from_cam(np.loadtxt(path, ndmin=2).reshape(-1, 3, 4), (0, 1, 2)))


def read_opensfm(path: Path, _: Capture) -> ReadBack:
    """Read reconstruction.json, by the json module and SciPy: angle-axis and translation of cam_from_world."""
    (content,) = json.loads(path.read_text(encoding="utf-8"))
    shots, points = content["shots"], list(content["points"].values())
    rotations = Rotation.from_rotvec([shot["rotation"] for shot in shots.values()]).as_matrix()
    translations = np.array([shot["translation"] for shot in shots.values()])
    lenses = {key: _opensfm_lens(record) for key, record in content["cameras"].items()}
    return ReadBack(
        *_views_from_cam_from_world(np.concatenate([rotations, translations[:, :, None]], axis=2)),
        lenses=[lenses[shot["camera"]] for shot in shots.values()],
        labels=list(shots),
        points=np.array([point["coordinates"] for point in points]),
        colours=np.array([point["color"] for point in points]),
    )


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (N, 3) of a binary PLY file, three doubles, and their colours (N, 3), three bytes."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert [line.split()[1] for line in lines if line.startswith("property")] == ["double"] * 3 + ["uchar"] * 3
    rows = np.frombuffer(body, dtype=np.uint8).reshape(-1, 27)
    return np.ascontiguousarray(rows[:, :24]).view("<f8").reshape(-1, 3), rows[:, 24:]


def _opensfm_lens(record: Mapping[str, Any]) -> FileLens:
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


def _transforms_lens(record: Mapping[str, Any]) -> FileLens:
    width, height = record["w"], record["h"]
    if record["camera_model"] == "EQUIRECTANGULAR":
        return FileLens("EQUIRECTANGULAR", width, height, (width, height))
    head = (record["fl_x"], record["fl_y"], record["cx"], record["cy"])
    if "FISHEYE" in record["camera_model"]:
        terms = (record.get(key, 0.0) for key in ("k1", "k2", "k3", "k4"))
        return FileLens("OPENCV_FISHEYE", width, height, (*head, *terms))
    terms = (record.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    return FileLens("FULL_OPENCV", width, height, (*head, *terms))


def _views_from_cam_from_world(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations and centres from matrices (views, 3, 4)."""
    rotations = matrices[:, :, :3]
    return rotations, -np.einsum("nji,nj->ni", rotations, matrices[:, :, 3])


def _views_from_world_from_cam(matrices: Any, columns: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return cam_from_world rotations and centres from matrices whose columns are the camera's axes in the world.

    Args:
        columns: that point right, down and forward; negative where a column points the other way (never the first).
    """
    poses = np.array(matrices, dtype=np.float64)
    rows = [np.sign(column + 0.5) * poses[:, :3, abs(column)] for column in columns]
    return np.stack(rows, axis=1), poses[:, :3, 3]


READERS: dict[str, Callable[[Path, Capture], ReadBack]] = {
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
