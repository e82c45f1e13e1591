"""The same views and photos as a small capture in every format that training reads, written out by hand if need be."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import format_named, recognise
from nerfcli.captures.formats.run_cameras import write_cameras

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Views:
    """Views of one PINHOLE camera.

    Args:
        poses: (N, 4, 4) world_from_cam, OpenCV axes.
        photos: copied into the capture; None for grey pictures.
    """

    camera: Camera
    poses: np.ndarray
    photos: tuple[Path, ...] | None = None

    @property
    def matrix(self) -> np.ndarray:
        """The matrix of intrinsics, (3, 3)."""
        fx, fy, cx, cy = self.camera.params
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    @property
    def opengl_poses(self) -> np.ndarray:
        """The poses with OpenGL axes, (N, 4, 4)."""
        return self.poses @ OPENGL

    def put(self, index: int, path: Path) -> Path:
        """Put a photo at a path."""
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.photos is None:
            cv2.imwrite(str(path), np.full((self.camera.height, self.camera.width, 3), 128, np.uint8))
        else:
            shutil.copy(self.photos[index], path)
        return path

    def frames(self, folder: Path) -> list[Frame]:
        """Return the views as frames, with their photos in folder/images."""
        names = [f"{index}.jpg" for index in range(len(self.poses))]
        images = [self.put(index, folder / "images" / name) for index, name in enumerate(names)]
        return [Frame(n, self.camera, p, image=i) for n, p, i in zip(names, self.poses, images, strict=True)]


def parse(place: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the capture in a file or folder, in any format."""
    form, found = recognise(place)
    return form.parse(found, given)


def numbers(values: np.ndarray) -> str:
    return " ".join(map(repr, np.ravel(values).tolist()))


def matrix_text(matrix: np.ndarray) -> str:
    return "\n".join(map(numbers, matrix)) + "\n"


def change_json(path: Path, **change: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | change))


def replace_in(path: Path, old: str, new: str) -> None:
    content = path.read_text(encoding="utf-8")
    assert old in content
    path.write_text(content.replace(old, new), encoding="utf-8")


def text(path: Path, content: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content, encoding="utf-8")
    return path


def write_by(name: str, place: str, views: Views, folder: Path) -> Path:
    """Write a capture by the writer of its format."""
    frames = views.frames(folder)
    bounds = np.tile([0.1, 100.0], (len(frames), 1))
    write = format_named(name).write
    assert write is not None
    write(Capture(tuple(frames), np.zeros((0, 3)), (), bounds, "made"), folder / place)
    return folder / place


def write_run(views: Views, folder: Path) -> Path:
    frames = views.frames(folder)
    write_cameras(folder, frames[1:], frames[:1])
    text(folder / "config.json", '{"unit": "metre", "unit_source": "LiDAR"}')
    return folder / "cameras.json"


def write_scannet(views: Views, folder: Path) -> Path:
    """ScanNet's SensReader: 4x4 matrices everywhere."""
    for index, pose in enumerate(views.poses):
        views.put(index, folder / f"color/{index}.jpg")
        text(folder / f"pose/{index}.txt", matrix_text(pose))
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = views.matrix
    text(folder / "intrinsic/intrinsic_color.txt", matrix_text(intrinsics))
    return folder / "pose/0.txt"


def write_mvsnet(views: Views, folder: Path) -> Path:
    for index, pose in enumerate(views.poses):
        views.put(index, folder / f"images/{index:08d}.jpg")
        blocks = (f"extrinsic\n{matrix_text(np.linalg.inv(pose))}", f"intrinsic\n{matrix_text(views.matrix)}")
        text(folder / f"cams/{index:08d}_cam.txt", "\n".join((*blocks, "2.5 0.01\n")))
    return folder / "cams/00000000_cam.txt"


def write_neus(views: Views, folder: Path) -> Path:
    """The product K [R t] scaled by numbers of both signs, as a projection is only defined up to its scale."""
    arrays = {}
    for index, pose in enumerate(views.poses):
        views.put(index, folder / f"image/{index:03d}.png")
        views.put(index, folder / f"mask/{index:03d}.png")
        projection = np.eye(4)
        projection[:3] = (1.0, -2.0, 0.3)[index % 3] * views.matrix @ np.linalg.inv(pose)[:3]
        arrays |= {f"world_mat_{index}": projection, f"scale_mat_{index}": 2 * np.eye(4)}
    np.savez(folder / "cameras_sphere.npz", **arrays)
    return folder / "cameras_sphere.npz"


def write_polycam(views: Views, folder: Path) -> Path:
    lens = dict(zip(("fx", "fy", "cx", "cy"), views.camera.params, strict=True))
    for index, pose in enumerate(views.opengl_poses):
        views.put(index, folder / f"keyframes/corrected_images/{1000 + index}.jpg")
        record = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        record |= {**lens, "width": views.camera.width, "height": views.camera.height, "blur_score": 71.0}
        text(folder / f"keyframes/corrected_cameras/{1000 + index}.json", json.dumps(record))
    return folder / "keyframes/corrected_cameras/1000.json"


def write_record3d(views: Views, folder: Path) -> Path:
    for index in range(len(views.poses)):
        views.put(index, folder / f"rgb/{index}.jpg")
    content = {
        "poses": quaternion_rows(views.opengl_poses)[:, [3, 4, 5, 6, 0, 1, 2]].tolist(),  # qx, qy, qz, qw first
        "K": views.matrix.T.ravel().tolist(),  # by columns
        "w": views.camera.width,
        "h": views.camera.height,
        "fps": 60,
    }
    return text(folder / "metadata.json", json.dumps(content))


def write_alicevision(views: Views, folder: Path) -> Path:
    (width, height), (fx, fy, cx, cy) = views.camera.size, views.camera.params
    frames = views.frames(folder)
    lens = {"width": str(width), "height": str(height), "sensorWidth": "36", "sensorHeight": "24"}
    lens |= {"focalLength": repr(fx * 36 / width), "pixelRatio": repr(fy / fx)}
    centre = [repr(cx - width / 2), repr(cy - height / 2)]
    distortion = {"type": "radial3", "distortionParams": ["0", "0", "0"]}
    content = {
        "version": ["1", "2", "6"],
        "views": [{"poseId": f.name, "intrinsicId": "77", "path": str(f.image)} for f in frames],
        "intrinsics": [{"intrinsicId": "77", **lens, "principalPoint": centre, **distortion}],
        "poses": [
            {"poseId": f.name, "pose": {"transform": {"rotation": numbers(p[:3, :3]).split(), "center": c.split()}}}
            for f, p, c in ((f, f.world_from_cam, numbers(f.centre)) for f in frames)
        ],
    }
    return text(folder / "cameras.sfm", json.dumps(content))


def write_metashape(views: Views, folder: Path) -> Path:
    """Labels of cameras are names of photos without suffix."""
    (width, height), (f, _, cx, cy) = views.camera.size, views.camera.params
    size = f'<resolution width="{width}" height="{height}"/>'
    terms = f"<f>{f!r}</f><cx>{cx - width / 2!r}</cx><cy>{cy - height / 2!r}</cy>"
    calibration = f'<calibration type="frame" class="adjusted">{size}{terms}</calibration>'
    cameras = "".join(
        f'<camera id="{index}" sensor_id="0" component_id="0" label="{frame.image.stem if frame.image else ""}">'
        f"<transform>{numbers(frame.world_from_cam)}</transform></camera>"
        for index, frame in enumerate(views.frames(folder))
    )
    sensors = f'<sensors><sensor id="0" type="frame">{size}{calibration}</sensor></sensors>'
    parts = f'{sensors}<components><component id="0"/></components><cameras>{cameras}</cameras>'
    document = f'<document version="1.5.0"><chunk enabled="true">{parts}</chunk></document>'
    return text(folder / "cameras.xml", document)


def write_reality_capture(views: Views, folder: Path) -> Path:
    rows = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    (width, height), (f, _, cx, cy) = views.camera.size, views.camera.params
    lens = np.array([36 * f, cx - width / 2, cy - height / 2, 0, 0, 0, 0, 0, 0]) / max(width, height)
    for frame in views.frames(folder):
        turn = Rotation.from_matrix((frame.world_from_cam @ OPENGL)[:3, :3]).as_euler("ZXY", degrees=True)
        values = np.concatenate([frame.centre, turn * [-1, 1, 1], lens])
        rows.append(",".join([f"images/{frame.name}", *map(repr, values.tolist())]))
    return text(folder / "cameras.csv", "\n".join(rows) + "\n")


def write_bundler(views: Views, folder: Path) -> Path:
    """A camera of Bundler has one focal length, and its principal point in the middle."""
    text(folder / "list.txt", "".join(f"images/{frame.name}\n" for frame in views.frames(folder)))
    lines = ["# Bundle file v0.3", f"{len(views.poses)} 0"]
    for pose in rigid.inverse(views.opengl_poses)[:, :3]:
        lines += [f"{views.camera.params[0]!r} 0 0", *map(numbers, pose[:, :3]), numbers(pose[:, 3])]
    return text(folder / "bundle.out", "\n".join(lines) + "\n")


def write_realityscan_xmp(views: Views, folder: Path) -> Path:
    """As RealityScan exports "XMP with poses": some values are attributes, others elements."""
    (width, height), (fx, fy, cx, cy) = views.camera.size, views.camera.params
    longer = max(width, height)
    names = 'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" xcr:Coordinates="absolute"'
    lens = f'xcr:DistortionModel="brown3" xcr:FocalLength35mm="{fx * 36 / longer!r}" xcr:AspectRatio="{fy / fx!r}"'
    centre = f'xcr:PrincipalPointU="{(cx - width / 2) / longer!r}" xcr:PrincipalPointV="{(cy - height / 2) / longer!r}"'
    for index, pose in enumerate(views.poses):
        views.put(index, folder / f"{index}.jpg")
        text(
            folder / f"{index}.xmp",
            f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            f"<rdf:Description {names} {lens} {centre}><xcr:Rotation>{numbers(pose[:3, :3].T)}</xcr:Rotation>"
            f"<xcr:Position>{numbers(pose[:3, 3])}</xcr:Position>"
            "<xcr:DistortionCoeficients>0 0 0 0 0 0</xcr:DistortionCoeficients>"
            "</rdf:Description></rdf:RDF></x:xmpmeta>",
        )
    return folder / "0.xmp"


def write_openmvg(views: Views, folder: Path) -> Path:
    """A camera of OpenMVG has one focal length."""
    (width, height), (f, _, cx, cy) = views.camera.size, views.camera.params
    frames = views.frames(folder)
    pinhole = {"width": width, "height": height, "focal_length": f, "principal_point": [cx, cy]}
    shared = {"polymorphic_id": 2**31 + 1, "polymorphic_name": "pinhole", "ptr_wrapper": {"id": 2**31, "data": pinhole}}
    listed = [
        {"local_path": "", "filename": frame.name, "id_view": index, "id_intrinsic": 7, "id_pose": index}
        for index, frame in enumerate(frames)
    ]
    wrapped = [{"polymorphic_id": 2**30, "ptr_wrapper": {"id": 2**31 + 1, "data": view}} for view in listed]
    poses = [{"rotation": frame.world_from_cam[:3, :3].T.tolist(), "center": frame.centre.tolist()} for frame in frames]
    content = {
        "sfm_data_version": "0.3",
        "root_path": "/home/somebody/images",
        "views": [{"key": index, "value": view} for index, view in enumerate(wrapped)],
        "intrinsics": [{"key": 7, "value": shared}],
        "extrinsics": [{"key": index, "value": pose} for index, pose in enumerate(poses)],
        "structure": [],
    }
    return text(folder / "sfm_data.json", json.dumps(content))


def write_kapture(views: Views, folder: Path) -> Path:
    head, home = "# kapture format: 1.1\n", folder / "sensors"
    lens = ", ".join(map(repr, (*views.camera.size, *views.camera.params)))
    text(home / "sensors.txt", f"{head}cam0, phone, camera, PINHOLE, {lens}\ngps0, , gnss, EPSG:4326\n")
    records, rows = [], []
    for index, pose in enumerate(rigid.inverse(views.poses)):
        views.put(index, home / f"records_data/walk/{index}.jpg")
        records.append(f"{index:04d}, cam0, walk/{index}.jpg")
        quaternion = rigid.quaternion_from_rotation(pose[:3, :3])  # w first
        rows.append(f"{index:04d}, cam0, " + ", ".join(map(repr, [*quaternion.tolist(), *pose[:3, 3].tolist()])))
    text(home / "records_camera.txt", head + "\n".join(records) + "\n")
    return text(home / "trajectories.txt", head + "\n".join(rows) + "\n")


def quaternion_rows(poses: np.ndarray) -> np.ndarray:
    """Return x, y, z, qx, qy, qz, qw of poses, (N, 7)."""
    return np.concatenate([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()], axis=1)


def write_stray_scanner(views: Views, folder: Path) -> Path:
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for index, row in enumerate(quaternion_rows(views.poses).tolist()):
        views.put(index, folder / f"rgb/frame_{index:06d}.jpg")
        rows.append(f"{100 + index / 60!r}, {index:06d}, " + ", ".join(map(repr, row)))
    text(folder / "camera_matrix.csv", "\n".join(", ".join(map(repr, row)) for row in views.matrix.tolist()))
    return text(folder / "odometry.csv", "\n".join(rows) + "\n")


def write_scanner_app(views: Views, folder: Path) -> Path:
    for index, pose in enumerate(views.opengl_poses):
        views.put(index, folder / f"frame_{index:05d}.jpg")
        content = {"cameraPoseARFrame": pose.ravel().tolist(), "intrinsics": views.matrix.ravel().tolist()}
        text(folder / f"frame_{index:05d}.json", json.dumps(content | {"frame_index": index, "motionQuality": 1}))
    return folder / "frame_00000.json"


def write_euroc(views: Views, folder: Path) -> Path:
    """The body is turned against the camera by a quarter about its z axis, and away from it."""
    body_from_cam = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, -0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]])
    times = [10**18 + index for index in range(len(views.poses))]
    for index, time in enumerate(times):
        views.put(index, folder / f"mav0/cam0/data/{time}.png")
    text(folder / "mav0/cam0/data.csv", "#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\r\n" for t in times))
    lens = ", ".join(map(repr, views.camera.params))
    text(
        folder / "mav0/cam0/sensor.yaml",
        f"# camera\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers(body_from_cam)}]\n"
        f"rate_hz: 20\nresolution: [{views.camera.width}, {views.camera.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{lens}] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n",
    )
    rows = quaternion_rows(views.poses @ np.linalg.inv(body_from_cam))[:, [0, 1, 2, 6, 3, 4, 5]].tolist()
    lines = [f"{time},{','.join(map(repr, row))},0,0,0" for time, row in zip(times, rows, strict=True)]
    return text(folder / "mav0/state_groundtruth_estimate0/data.csv", "#timestamp\n" + "\n".join(lines) + "\n")


def write_tum_rgbd(views: Views, folder: Path) -> Path:
    for index in range(len(views.poses)):
        views.put(index, folder / f"rgb/{index}.png")
    times = [1305031100.25 + index / 30 for index in range(len(views.poses))]
    text(folder / "rgb.txt", "# color images\n" + "".join(f"{t!r} rgb/{i}.png\n" for i, t in enumerate(times)))
    text(folder / "calibration.txt", " ".join(map(repr, views.camera.params)) + "\n")
    rows = quaternion_rows(views.poses)
    lines = [f"{time!r} {numbers(row)}" for time, row in zip(times, rows, strict=True)]
    return text(folder / "groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")


def write_nerfies(views: Views, folder: Path) -> Path:
    fx, fy, cx, cy = views.camera.params
    lens = {"focal_length": fx, "pixel_aspect_ratio": fy / fx, "principal_point": [cx, cy], "skew": 0.0}
    lens |= {"radial_distortion": [0.0] * 3, "tangential_distortion": [0.0] * 2, "image_size": [*views.camera.size]}
    for index, pose in enumerate(views.poses):
        views.put(index, folder / f"rgb/1x/{index:06d}.png")
        content = {"orientation": pose[:3, :3].T.tolist(), "position": pose[:3, 3].tolist(), **lens}
        text(folder / f"camera/{index:06d}.json", json.dumps(content))
    ids = [f"{index:06d}" for index in range(len(views.poses))]
    text(folder / "dataset.json", json.dumps({"count": len(ids), "ids": ids, "train_ids": ids[1:], "val_ids": ids[:1]}))
    return folder / "camera/000000.json"


def write_scannetpp(views: Views, folder: Path) -> Path:
    """The released photos are of a fisheye lens; here their distortion is zero, and the lens of a pinhole camera."""
    (w, h), (fx, fy, cx, cy) = views.camera.size, views.camera.params
    frames = []
    for index, pose in enumerate(views.opengl_poses):
        views.put(index, folder / f"dslr/resized_images/DSC{index:05d}.jpg")
        frames.append({"file_path": f"DSC{index:05d}.jpg", "is_bad": False, "transform_matrix": pose.tolist()})
    content = {"w": w, "h": h, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "camera_model": "PINHOLE"}
    content |= {"frames": frames[1:], "test_frames": frames[:1]}
    return text(folder / "dslr/nerfstudio/transforms.json", json.dumps(content))


# Writes the capture into a folder, and returns a file of it.
Writer = Callable[[Views, Path], Path]
WITH_PHOTOS: dict[str, Writer] = {
    "nerfcli": partial(write_by, "nerfcli", "."),
    "colmap": partial(write_by, "colmap", "sparse/0"),
    "colmap-text": partial(write_by, "colmap-text", "sparse/0"),
    "transforms": partial(write_by, "transforms", "transforms.json"),
    "blender": partial(write_by, "blender", "."),
    "llff": partial(write_by, "llff", "."),
    "opensfm": partial(write_by, "opensfm", "reconstruction.json"),
    "metashape": write_metashape,
    "reality-capture": write_reality_capture,
    "bundler": write_bundler,
    "polycam": write_polycam,
    "record3d": write_record3d,
    "mvsnet": write_mvsnet,
    "neus": write_neus,
    "pose-files": write_scannet,
    "alicevision": write_alicevision,
    "realityscan-xmp": write_realityscan_xmp,
    "openmvg": write_openmvg,
    "kapture": write_kapture,
    "stray-scanner": write_stray_scanner,
    "3d-scanner-app": write_scanner_app,
    "euroc": write_euroc,
    "tum-rgbd": write_tum_rgbd,
    "nerfies": write_nerfies,
    "scannetpp": write_scannetpp,
    "run": write_run,
}
