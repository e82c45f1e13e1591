"""transforms.json and Blender's files as captures: by hand, what they hold, and what they lose."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import CAMERAS, assert_same, photograph, put_photos, refused, reprojection_px, ring, with_photos
from scipy.spatial.transform import Rotation

from nerfcli.atomic import write_json
from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.axes import pose_in_axes
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.blender import losses_blender, parse_blender, write_blender
from nerfcli.captures.formats.transforms import losses_transforms, parse_transforms, write_transforms
from nerfcli.captures.formats.transforms_cameras import lost_to_transforms
from nerfcli.captures.loading import load_scene
from nerfcli.errors import UserError

LOST = {
    "FULL_OPENCV": ("k4", "k5", "k6"),
    "THIN_PRISM_FISHEYE": ("p1", "p2", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
    "FOV": ("omega",),
    "SIMPLE_DIVISION": ("k",),
    "DIVISION": ("k",),
    "EUCM": ("alpha", "beta"),
}

# A camera at (1, 2, 3) that looks along -x with +z up: OpenGL axes, and OpenCV axes.
OPENGL_POSE = [[0.0, 0.0, 1.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
OPENCV_POSE = [[0.0, 0.0, -1.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, -1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
SHARED = {"fl_x": 50.0, "fl_y": 51.0, "cx": 33.0, "cy": 23.0, "w": 64.0, "h": 48}


def transforms_of(folder: Path, **content: object) -> Path:
    path = folder / "transforms.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def pinhole_ring() -> Capture:
    """A capture that Blender's files hold, apart from its points."""
    capture = ring(Camera.pinhole(640, 480, 500.0))
    return replace(capture, points=np.zeros((0, 3)), colours=None, observations=None)


def entry(file_path: str, **more: Any) -> dict[str, Any]:
    return {"file_path": file_path, "transform_matrix": OPENGL_POSE, **more}


def test_instant_ngp_file_with_shared_intrinsics_and_missing_images(tmp_path):
    names = ["./images/a b.jpg", "images\\ü.jpg", "images/gone.jpg", "images/no_suffix"]
    put_photos(tmp_path, "images/a b.jpg", "images/ü.jpg", "images/no_suffix.png")
    content = {**SHARED, "k1": 0.1, "k2": -0.05, "p1": 0.001, "p2": 0.002, "aabb_scale": 4, "scale": 0.33}
    path = transforms_of(tmp_path, **content, frames=[entry(name, sharpness=3.0) for name in names])
    capture = load_scene(path)
    assert capture.kind == "transforms"
    assert [frame.name for frame in capture.frames] == ["images/a b.jpg", "images/ü.jpg", "images/no_suffix.png"]
    assert all(frame.image is not None and frame.image.is_file() for frame in capture.frames)
    assert capture.missing == ("images/gone.jpg",)
    first = capture.frames[0]
    assert first.camera == Camera("OPENCV", 64, 48, (50, 51, 33, 23, 0.1, -0.05, 0.001, 0.002))
    np.testing.assert_allclose(first.world_from_cam, OPENCV_POSE, rtol=0, atol=1e-15)
    assert capture.points.shape == (0, 3)


def test_nerfstudio_file_with_intrinsics_and_masks_per_frame(tmp_path):
    put_photos(tmp_path, "a.png", "b.png", "masks/a.png")
    fisheye = {**SHARED, "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "camera_model": "OPENCV_FISHEYE"}
    frames = [entry("a.png", mask_path="masks/a.png", **fisheye), entry("b.png", **SHARED, k3=0.3)]
    path = transforms_of(tmp_path, frames=frames, train_filenames=["a.png"], test_filenames=["./b.png"])
    first, second = load_scene(path).frames
    assert first.camera == Camera("OPENCV_FISHEYE", 64, 48, (50, 51, 33, 23, 0.1, 0.2, 0.3, 0.4))
    assert second.camera == Camera("FULL_OPENCV", 64, 48, (50, 51, 33, 23, 0, 0, 0, 0, 0.3, 0, 0, 0))
    assert (first.mask, second.mask) == (tmp_path / "masks/a.png", None)
    assert (first.split, second.split) == ("train", "test")


@pytest.mark.parametrize(
    ("intrinsics", "params"),
    [
        ({"camera_angle_x": 2 * np.arctan(0.5)}, (64, 64, 32, 24)),  # square pixels, size and centre of the image
        ({"camera_angle_x": 2 * np.arctan(0.5), "camera_angle_y": 2 * np.arctan(0.25)}, (64, 96, 32, 24)),
        ({"fl_y": 50.0}, (50, 50, 32, 24)),
        ({"fl_x": 100.0, "w": 128, "h": 96}, (50, 50, 32, 24)),  # for twice the size that is on disk
        ({"fl_x": 100.0, "cx": 60.0, "cy": 50.0, "w": 128, "h": 96}, (50, 50, 30, 25)),
    ],
)
def test_focal_length_from_what_the_file_gives(tmp_path, intrinsics, params):
    put_photos(tmp_path, "a.png")
    path = transforms_of(tmp_path, **intrinsics, frames=[entry("a.png")])
    camera = load_scene(path).frames[0].camera
    assert (camera.model, camera.width, camera.height) == ("PINHOLE", 64, 48)
    np.testing.assert_allclose(camera.params, params, rtol=1e-14)


def test_rounded_poses_become_exactly_rigid(tmp_path):
    put_photos(tmp_path, "a.png")
    rounded = rigid.look_at(np.array([1.0, 2, 3]), np.zeros(3), np.array([0, 0, 1.0])).round(4)
    path = transforms_of(tmp_path, **SHARED, frames=[entry("a", transform_matrix=rounded[:3].tolist())])
    pose = load_scene(path).frames[0].world_from_cam
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), rtol=0, atol=1e-14)
    np.testing.assert_allclose(pose_in_axes(pose, "opengl"), rounded, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"frames": []}, "has no list of frames"),
        ({"frames": [3]}, "has no list of frames"),
        ({"frames": [{"file_path": "a.png"}]}, r"frames\[0\]: transform_matrix is missing"),
        ({"frames": [entry("a.png", transform_matrix=[[1, 0], [0, 1]])]}, "transform_matrix is a list of 2"),
        ({"frames": [entry("a.png", transform_matrix="no")]}, "transform_matrix is 'no'"),
        ({"frames": [entry("a.png", transform_matrix=np.diag([1, 2, 1, 1]).tolist())]}, "is not a rotation"),
        ({"frames": [entry("a.png", transform_matrix=np.diag([1, 1, -1, 1]).tolist())]}, "mirrors the scene"),
        ({"frames": [entry("a.png", transform_matrix=np.full((4, 4), np.nan).tolist())]}, "not finite"),
        ({"frames": [entry("a.png"), {"transform_matrix": OPENGL_POSE}]}, r"frames\[1\]: file_path is None"),
        ({"frames": [entry("a.png"), entry("./a.png")]}, "'a.png' is listed twice"),
        ({"frames": [entry("x.png"), entry("y.png")]}, r"none of its 2 photos is on disk, such as .*x\.png"),
        ({"fl_x": "wide"}, "fl_x is 'wide'"),
        ({"fl_x": -3}, "fl_x is -3.0"),
        ({"fl_x": None, "fl_y": None}, "neither fl_x nor camera_angle_x"),
        ({"fl_x": None, "camera_angle_x": 4.0}, "camera_angle_x is 4.0"),
        ({"fl_x": None, "fl_y": None, "K": [[40, 0], [0, 40]]}, "neither fl_x nor camera_angle_x"),
        ({"w": 63.5}, "w and h are 63.5"),
        ({"w": 0}, "w and h are 0"),
        ({"h": float("nan")}, "h is nan"),
        ({"fl_x": float("nan")}, "fl_x is nan"),
        ({"w": 48, "h": 64}, "64x48 pixels does not match a camera of 48x64"),
        ({"camera_model": "PENTAGON"}, "camera_model 'PENTAGON' is not supported"),
        ({"test_filenames": "a.png"}, "test_filenames is not a list"),
    ],
)
def test_malformed_transforms_are_refused_with_file_and_field(tmp_path, change, what):
    put_photos(tmp_path, "a.png")
    path = transforms_of(tmp_path, **SHARED | {"frames": [entry("a.png")]} | change)
    with refused(what, tmp_path):
        load_scene(path)


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b'{"frames": [', "not valid JSON: Expecting value in line 1"),
        (b"", "not valid JSON"),
        (b"[1, 2]", "is a list of 2"),
        (b"\xff\xfe\x00", "not UTF-8"),
    ],
)
def test_what_is_no_json_object_is_refused(tmp_path, data, what):
    path = tmp_path / "transforms.json"
    path.write_bytes(data)
    with pytest.raises(UserError, match=what):
        parse_transforms(path)
    with pytest.raises(UserError, match="No such file"):
        parse_transforms(tmp_path / "none.json")


def test_views_of_a_camera_path_need_no_photo(tmp_path):
    view = entry("")
    del view["file_path"]
    path = transforms_of(tmp_path, fl_x=50, w=40, h=30, frames=[view, view])
    assert [frame.name for frame in parse_transforms(path).frames] == ["frame_0000", "frame_0001"]


@pytest.mark.parametrize("model", LOST)
def test_a_lens_without_keys_is_listed_and_the_rest_of_it_written(tmp_path, model):
    assert set(LOST) == {model for model, camera in CAMERAS.items() if lost_to_transforms(camera)}
    capture = replace(ring(CAMERAS[model], CAMERAS["PINHOLE"]), observations=None)
    assert losses_transforms(capture) == tuple(f"{name} of 1 camera" for name in LOST[model])
    write_transforms(capture, tmp_path / "transforms.json")
    back = parse_transforms(tmp_path / "transforms.json")
    assert losses_transforms(back) == ()
    camera, camera_back = capture.frames[0].camera, back.frames[0].camera
    assert camera_back.focal_px == camera.focal_px
    assert camera_back.principal_point == camera.principal_point
    others, others_back = (replace(each, frames=each.frames[1::2]) for each in (capture, back))
    assert reprojection_px(others, others_back) < 1e-10
    if model == "THIN_PRISM_FISHEYE":
        assert camera_back.params == (*camera.params[:6], *camera.params[8:10])
    if model == "RAD_TAN_THIN_PRISM_FISHEYE":
        assert camera_back.params == camera.params[:8]


def test_images_masks_splits_and_cameras_per_image(tmp_path):
    capture = with_photos(ring(CAMERAS["OPENCV"], CAMERAS["OPENCV_FISHEYE"]), tmp_path / "photos ü")
    splits = ("train", "train", "val", "test", "train", "test")
    frames = [replace(frame, split=split) for frame, split in zip(capture.frames, splits, strict=True)]
    frames[1] = replace(frames[1], mask=tmp_path / "masks/ö.png")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/ö.png").write_bytes(b"")
    capture = replace(capture, frames=tuple(frames))
    assert capture.observations is not None
    assert losses_transforms(capture) == (f"{len(capture.observations.pixels)} observations",)
    path = tmp_path / "out" / "my transforms.json"
    write_transforms(capture, path)
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["frames"][1]["file_path"] == "../photos ü/my photos/ä 01.jpg"
    assert content["frames"][1]["mask_path"] == "../masks/ö.png"
    assert content["test_filenames"] == ["../photos ü/my photos/ä 03.jpg", "../photos ü/my photos/ä 05.jpg"]
    assert "fl_x" not in content
    assert content["ply_file_path"] == "my transforms_points.ply"
    back = parse_transforms(path)
    assert [frame.split for frame in back.frames] == list(splits)
    assert [frame.camera for frame in back.frames] == [frame.camera for frame in capture.frames]
    assert len({id(frame.camera) for frame in back.frames}) == 2
    for frame, again in zip(capture.frames, back.frames, strict=True):
        assert frame.image is not None
        assert again.image is not None
        assert again.image.resolve() == frame.image.resolve()
        assert (again.mask is None) == (frame.mask is None)


def test_poses_stay_in_the_files_world(tmp_path):
    applied = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 5.0], [0.0, -1.0, 0.0, 0.0]]
    frames = [entry("0.jpg"), entry("1.jpg")]
    path = transforms_of(tmp_path, **SHARED, applied_transform=applied, offset=[0, 0, 0], frames=frames)
    capture = parse_transforms(path)
    np.testing.assert_array_equal(capture.frames[0].world_from_cam, OPENCV_POSE)


def test_names_and_sizes_without_the_photos(tmp_path):
    """Suffixes come from the files on disk; a missing size is measured, or taken from the other photos."""
    entries = ["./images\\a b.jpg", "images/no_suffix", "images/gone", "/home/you/c.d/x.png"]
    path = transforms_of(tmp_path, camera_angle_x=1.0, frames=list(map(entry, entries)))
    with pytest.raises(UserError, match=r"frames\[0\]: w and h are missing, and .*images/a b.jpg does not exist"):
        parse_transforms(path)
    put_photos(tmp_path, "images/no_suffix.JPG")
    capture = parse_transforms(path)
    expected = ["images/a b.jpg", "images/no_suffix.JPG", "images/gone", "x.png"]
    assert [frame.name for frame in capture.frames] == expected
    assert capture.frames[0].image == tmp_path / "images/a b.jpg"
    assert {frame.camera for frame in capture.frames} == {Camera.pinhole(64, 48, 32 / math.tan(0.5))}


def test_a_listed_cloud_that_is_missing_is_named(tmp_path):
    shared = {**SHARED, "frames": [entry("a.png")]}
    path = transforms_of(tmp_path, **shared, ply_file_path="sparse_pc.ply")
    capture = parse_transforms(path)
    assert len(capture.points) == 0
    assert capture.notes == ("sparse_pc.ply, which transforms.json names, does not exist: no points are read",)
    with pytest.raises(UserError, match="ply_file_path is 3"):
        parse_transforms(transforms_of(tmp_path, **shared, ply_file_path=3))
    with pytest.raises(UserError, match="the lens model of ftheta_p0 is not supported"):
        parse_transforms(transforms_of(tmp_path, **shared, ftheta_p0=0.1))


def test_training_gets_the_points_beside_the_file(tmp_path):
    capture = with_photos(ring(CAMERAS["PINHOLE"]), tmp_path / "images")
    photograph(capture.frames)
    write_transforms(capture, tmp_path / "transforms.json")
    np.testing.assert_array_equal(load_scene(tmp_path).points, capture.points)


def test_blender_files_are_read_back(tmp_path):
    capture = with_photos(pinhole_ring(), tmp_path)
    splits = ("train", "train", "train", "val", "test", "test")
    frames = [replace(frame, split=split) for frame, split in zip(capture.frames, splits, strict=True)]
    png = tmp_path / "train/r 0.png"
    frames[0] = replace(frames[0], name="train/r 0.png", image=png)
    capture = replace(capture, frames=tuple(frames))
    assert losses_blender(capture) == ()
    write_blender(capture, tmp_path)
    content = json.loads((tmp_path / "transforms_train.json").read_text(encoding="utf-8"))
    assert set(content) == {"camera_angle_x", "frames"}
    assert math.isclose(content["camera_angle_x"], 2 * math.atan(0.64))
    assert [record["file_path"] for record in content["frames"]][:2] == ["./train/r 0", "./my photos/ä 01.jpg"]
    put_photos(tmp_path, "train/r 0.png", "my photos/ä 03.jpg", "my photos/ä 05.jpg", size=(640, 480))
    back = parse_blender(tmp_path)
    for frame, again in zip(capture.frames, back.frames, strict=True):
        assert (again.name, again.image, again.split) == (frame.name, frame.image, frame.split)
        np.testing.assert_allclose(again.camera.params, frame.camera.params, rtol=1e-14)
        np.testing.assert_allclose(again.world_from_cam, frame.world_from_cam, rtol=0, atol=1e-15)
    png.unlink()  # a missing picture's name gets the suffix of NeRF's loader
    put_photos(tmp_path, "my photos/ä 02.jpg", size=(640, 480))
    assert parse_blender(tmp_path).frames[0].name == "train/r 0.png"


def test_a_view_in_several_blender_files_is_used_once(tmp_path):
    capture = with_photos(pinhole_ring(), tmp_path)
    write_blender(replace(capture, frames=tuple(replace(frame, split="train") for frame in capture.frames)), tmp_path)
    content = json.loads((tmp_path / "transforms_train.json").read_text(encoding="utf-8"))
    for split, numbers in (("train", (0, 1, 2)), ("val", (4, 5)), ("test", (2, 3, 4))):
        records = [content["frames"][number] for number in numbers]
        write_json(tmp_path / f"transforms_{split}.json", {**content, "frames": records})
    put_photos(tmp_path, *(frame.name for frame in capture.frames), size=(640, 480))
    parsed = parse_blender(tmp_path)
    splits = [(int(frame.name[-6:-4]), frame.split) for frame in parsed.frames]
    assert splits == [(0, "train"), (1, "train"), (2, "train"), (5, "val"), (3, "test"), (4, "test")]
    twice = ", ".join(capture.frames[number].name for number in (2, 4))
    assert parsed.notes == (f"listed in several files: {twice}; used as of the first of train, test and val",)
    other = {**content["frames"][0], "transform_matrix": content["frames"][1]["transform_matrix"]}
    write_json(tmp_path / "transforms_test.json", {**content, "frames": [other]})
    both = "transforms_train.json and transforms_test.json"
    with pytest.raises(UserError, match=f"is listed with different poses in {both}"):
        parse_blender(tmp_path)
    other = {**content, "camera_angle_x": 1.01 * content["camera_angle_x"], "frames": content["frames"][:1]}
    write_json(tmp_path / "transforms_test.json", other)
    with pytest.raises(UserError, match=f"is listed with different fields of view in {both}"):
        parse_blender(tmp_path)
    write_json(tmp_path / "transforms_test.json", {**content, "frames": 2 * content["frames"][:1]})
    with pytest.raises(UserError, match="is listed twice"):
        parse_blender(tmp_path)


def test_a_view_in_several_blender_files_may_be_rounded_to_six_digits(tmp_path):
    """Its centre is thousands of units away."""
    pose = np.array(OPENGL_POSE)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    pose[:3, 3] = 1234.56789, -2345.67891, 3456.78912
    rounded = [[float(f"{value:.6g}") for value in row] for row in pose]
    put_photos(tmp_path, "a.png", size=(64, 48))
    for split, angle, matrix in (("train", 0.6911112070083618, pose.tolist()), ("test", 0.691111, rounded)):
        record = {"file_path": "a", "transform_matrix": matrix}
        write_json(tmp_path / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": [record]})
    (frame,) = parse_blender(tmp_path).frames
    assert frame.split == "train"


MATRIX = np.array([[50.0, 0, 30.5], [0, 55.0, 24.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("K", MATRIX.tolist()),
        ("intrinsics", np.pad(MATRIX, (0, 1)).tolist()),
        ("intrinsic_matrix", MATRIX.T.ravel().tolist()),  # as Open3D stores it
    ],
)
def test_a_matrix_of_intrinsics_is_read_like_its_numbers(tmp_path, key, value):
    put_photos(tmp_path, "a.png", "b.png", "c.png", size=(64, 48))
    frames = [entry("a.png", **{key: value}), entry("b.png", fl_x=70.0), entry("c.png")]
    write_json(tmp_path / "transforms.json", {"fl_x": 90.0, "cx": 31.0, "frames": frames})
    first, second, third = load_scene(tmp_path).frames
    assert first.camera.params == (50.0, 55.0, 30.5, 24.5)  # those of the frame count, not those of the file
    assert second.camera.params == (70.0, 70.0, 31.0, 24.0)
    assert third.camera.params == (90.0, 90.0, 31.0, 24.0)


@pytest.mark.parametrize(
    "value", [[], 0, {"fx": 40}, [40, 40, 32, 24], 1, np.full((3, 3), 2.0).tolist(), [[10**400, 0, 0]] * 3, "K.txt"]
)
def test_what_is_no_matrix_of_intrinsics_changes_nothing(tmp_path, value):
    put_photos(tmp_path, "a.png", size=(64, 48))
    write_json(tmp_path / "transforms.json", {"fl_x": 90.0, "frames": [entry("a.png", intrinsics=value)]})
    assert load_scene(tmp_path).frames[0].camera.params == (90.0, 90.0, 32.0, 24.0)


@pytest.mark.parametrize(
    ("place", "value", "more", "said"),
    [
        ((0, 1), 3.0, {}, "skew is 3, which no supported lens has, and the nearest one is off by 1"),
        ((0, 1), 3.0, {"k1": 0.1}, "skew is 3, which no supported lens has"),
        ((0, 1), 3.0, {"k1": 0.1, "camera_model": "OPENCV_FISHEYE"}, "skew is 3, which no supported lens has"),
        ((0, 1), 3.0, {"k4": 0.1, "camera_model": "FULL_OPENCV"}, "skew is 3, which no lens with k4"),
        ((1, 0), 3.0, {}, "K: is not a matrix of intrinsics"),
        ((0, 0), math.nan, {}, "K: is not a matrix of intrinsics"),
        ((0, 0), 0.5, {}, "K: fx is 0.5"),
    ],
)
def test_what_a_matrix_of_intrinsics_cannot_hold_is_refused(tmp_path, place, value, more, said):
    put_photos(tmp_path, "a.png", size=(64, 48))
    matrix = MATRIX.copy()
    matrix[place] = value
    transforms_of(tmp_path, frames=[entry("a.png", K=matrix.tolist(), **more)])
    with pytest.raises(UserError, match=said):
        load_scene(tmp_path)


@pytest.mark.parametrize(("more", "model"), [({}, "PINHOLE"), ({"k1": 0.1}, "OPENCV")])
def test_a_small_skew_in_a_matrix_of_intrinsics_is_fitted_and_said(tmp_path, more, model):
    """The skew shifts the upper and lower edge of the picture by 0.1 * 24 / 55 px."""
    put_photos(tmp_path, "a.png", size=(64, 48))
    matrix = MATRIX.copy()
    matrix[0, 1] = 0.1
    write_json(tmp_path / "transforms.json", {"frames": [entry("a.png", K=matrix.tolist(), **more)]})
    (note,) = load_scene(tmp_path).notes
    assert note.startswith(f"skew of 1 camera, which {model} does not have: at most 0.04")


def test_what_blender_cannot_hold_is_listed(tmp_path):
    cameras = (CAMERAS["OPENCV"], CAMERAS["PINHOLE"], Camera.pinhole(640, 480, 400.0))
    capture = replace(ring(*cameras, CAMERAS["OPENCV_FISHEYE"]), unit="metre")
    assert capture.observations is not None
    assert losses_blender(capture) == (
        "k1 of 2 cameras",
        "k2 of 2 cameras",
        "k3 of 1 camera",
        "k4 of 1 camera",
        "p1 of 1 camera",
        "p2 of 1 camera",
        "the fisheye projection of 1 camera",
        "the principal point of 3 cameras",
        "the second focal length of 3 cameras",
        "the field of view of 2 frames (one per file)",
        "the picture's size of 6 frames",
        "40 points",
        "colours of 40 points",
        f"{len(capture.observations.pixels)} observations",
        "the unit of length (metre)",
    )
    with pytest.raises(UserError, match="spherical picture"):
        write_blender(ring(CAMERAS["EQUIRECTANGULAR"]), tmp_path)
    with pytest.raises(UserError, match=r"transforms_train\.json: No such file"):
        parse_blender(tmp_path / "elsewhere")


def test_a_file_written_twice_is_the_same(tmp_path):
    capture = replace(ring(CAMERAS["OPENCV"]), observations=None)
    write_transforms(capture, tmp_path / "a.json")
    first = parse_transforms(tmp_path / "a.json")
    write_transforms(replace(first, frames=tuple(replace(f, image=None) for f in first.frames)), tmp_path / "a.json")
    assert_same(first, parse_transforms(tmp_path / "a.json"), pose_tolerance=0.0)
