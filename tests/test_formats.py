"""Readers of captures against files made by hand and, for COLMAP, by pycolmap; and their errors on damaged files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.axes import pose_in_axes
from nerfcli.captures.formats.colmap import is_model, read_model
from nerfcli.captures.formats.transforms import parse_transforms
from nerfcli.captures.loading import load_scene
from nerfcli.errors import BAD_INPUT, UserError

# A camera at (1, 2, 3) that looks along -x with +z up. OpenGL axes: right +y, up +z, backward +x, as columns.
OPENGL_POSE = [[0.0, 0.0, 1.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
# OpenCV axes: right +y, down -z, forward -x.
OPENCV_POSE = [[0.0, 0.0, -1.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, -1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
# LLFF axes: down -z, right +y, backward +x.
LLFF_POSE = [[0.0, 0.0, 1.0, 1.0], [0.0, 1.0, 0.0, 2.0], [-1.0, 0.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]

SHARED = {"fl_x": 50.0, "fl_y": 51.0, "cx": 33.0, "cy": 23.0, "w": 64.0, "h": 48}


def put(folder: Path, *names: str, size: tuple[int, int] = (64, 48)) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", size).save(path)


def write_capture(folder: Path, content: dict[str, Any], *, name: str = "transforms.json") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def entry(file_path: str, **more: Any) -> dict[str, Any]:
    return {"file_path": file_path, "transform_matrix": OPENGL_POSE, **more}


def test_instant_ngp_file_with_shared_intrinsics_and_missing_images(tmp_path):
    names = ["./images/a b.jpg", "images\\ü.jpg", "images/gone.jpg", "images/no_suffix"]
    put(tmp_path, "images/a b.jpg", "images/ü.jpg", "images/no_suffix.png")
    content = {**SHARED, "k1": 0.1, "k2": -0.05, "p1": 0.001, "p2": 0.002, "aabb_scale": 4, "scale": 0.33}
    path = write_capture(tmp_path, {**content, "frames": [entry(name, sharpness=3.0) for name in names]})
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
    put(tmp_path, "a.png", "b.png", "masks/a.png")
    fisheye = {**SHARED, "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "camera_model": "OPENCV_FISHEYE"}
    frames = [entry("a.png", mask_path="masks/a.png", **fisheye), entry("b.png", **SHARED, k3=0.3)]
    path = write_capture(tmp_path, {"frames": frames, "train_filenames": ["a.png"], "test_filenames": ["./b.png"]})
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
    put(tmp_path, "a.png")
    path = write_capture(tmp_path, {**intrinsics, "frames": [entry("a.png")]})
    camera = load_scene(path).frames[0].camera
    assert (camera.model, camera.width, camera.height) == ("PINHOLE", 64, 48)
    np.testing.assert_allclose(camera.params, params, rtol=1e-14)


def test_rounded_poses_become_exactly_rigid(tmp_path):
    put(tmp_path, "a.png")
    rounded = rigid.look_at(np.array([1.0, 2, 3]), np.zeros(3), np.array([0, 0, 1.0])).round(4)
    path = write_capture(tmp_path, {**SHARED, "frames": [{"file_path": "a", "transform_matrix": rounded[:3].tolist()}]})
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
    put(tmp_path, "a.png")
    path = write_capture(tmp_path, {**SHARED, "frames": [entry("a.png")], **change})
    with pytest.raises(UserError, match=what) as caught:
        load_scene(path)
    assert caught.value.exit_code == BAD_INPUT
    assert str(tmp_path) in caught.value.message


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
    path = write_capture(tmp_path, {"fl_x": 50, "w": 40, "h": 30, "frames": [view, view]})
    assert [frame.name for frame in parse_transforms(path).frames] == ["frame_0000", "frame_0001"]


def llff_rows(count: int) -> np.ndarray:
    """Full size 256 x 192 with focal length 200; the centre of camera i is (1, 2, 3 + i)."""
    rows = []
    for index in range(count):
        pose = np.array(LLFF_POSE)[:3]
        pose[2, 3] += index
        rows.append(np.concatenate([np.column_stack([pose, [192.0, 256.0, 200.0]]).ravel(), [1.5, 20.0 + index]]))
    return np.array(rows)


def test_llff_by_hand(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", llff_rows(2))
    # images/ has a different number of photos than poses; images_4/ has the right number, at a quarter of the size.
    put(tmp_path, "images/1.jpg", "images_4/b.png", "images_4/a.png")
    capture = load_scene(tmp_path)
    assert [frame.name for frame in capture.frames] == ["images_4/a.png", "images_4/b.png"]
    assert capture.frames[0].camera == Camera("PINHOLE", 64, 48, (50, 50, 32, 24))
    np.testing.assert_allclose(capture.frames[0].world_from_cam, OPENCV_POSE, rtol=0, atol=1e-15)
    np.testing.assert_allclose(capture.frames[1].centre, [1, 2, 4])
    np.testing.assert_array_equal(capture.depth_bounds, [[1.5, 20], [1.5, 21]])
    assert capture.kind == "llff"
    put(tmp_path, "images/2.jpg")
    assert load_scene(tmp_path).frames[0].name == "images/1.jpg"


def test_malformed_llff_is_refused(tmp_path):
    path = tmp_path / "poses_bounds.npy"
    np.save(path, llff_rows(3))
    with pytest.raises(UserError, match="none of its 3 photos is on disk, such as image000"):
        load_scene(tmp_path)
    put(tmp_path, "images/1.jpg", "images_8/1.jpg", "images_8/2.jpg")
    with pytest.raises(UserError, match="3 rows, but images/ has 1 photo, images_8/ has 2 photos"):
        load_scene(tmp_path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(UserError, match=r"poses_bounds\.npy is not a readable NumPy array"):
        load_scene(tmp_path)
    path.write_bytes(b"")
    with pytest.raises(UserError, match="not a readable NumPy array"):
        load_scene(tmp_path)
    np.save(path, llff_rows(3)[:, :15])
    with pytest.raises(UserError, match=r"array of shape \(3, 15\)"):
        load_scene(tmp_path)
    for column, value, what in (
        (15, 0.0, "depth bounds 0 and 20"),
        (14, -1.0, "row 0: .* -1"),
        (3, np.nan, "row 0: .*finite"),
    ):
        rows = llff_rows(1)
        rows[0, column] = value
        np.save(path, rows)
        with pytest.raises(UserError, match=what):
            load_scene(tmp_path)


@pytest.fixture(scope="module")
def synthetic() -> pycolmap.Reconstruction:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 30
    pycolmap.set_random_seed(0)
    reconstruction = pycolmap.synthesize_dataset(options)
    for index, image in enumerate(reconstruction.images.values()):
        image.name = f"ring {index % 2}/ä {index}.jpg"
    return reconstruction


@pytest.mark.parametrize(
    "name", ["cameras.bin", "images.bin", "points3D.bin", "cameras.txt", "images.txt", "points3D.txt"]
)
def test_a_damaged_colmap_file_is_named(tmp_path, synthetic, name):
    """A truncated file never causes a hang or passes as complete; pycolmap loops forever on some of them."""
    (synthetic.write_binary if name.endswith("bin") else synthetic.write_text)(str(tmp_path))
    path = tmp_path / name
    whole = path.read_bytes()
    if name.endswith("bin"):
        damaged = [whole[:size] for size in (0, 5, 20, len(whole) // 2, len(whole) - 1)] + [b"garbage " * 100]
    else:
        damaged = [b"garbage " * 100, b"\xff\xfe\xfd", b"1 2 3\n"]
    for data in damaged:
        path.write_bytes(data)
        with pytest.raises(UserError, match=name.replace(".", r"\.")):
            read_model(tmp_path)
    path.unlink()
    if name.startswith("points3D"):
        assert is_model(tmp_path)
        assert len(read_model(tmp_path).points) == 0
        return
    with pytest.raises(UserError, match=r"No such file|cameras\.txt"):
        read_model(tmp_path)
    assert not is_model(tmp_path)


def test_colmap_text_by_hand(tmp_path):
    """Names with spaces, images without points (an empty line), comments and a model without points."""
    (tmp_path / "cameras.txt").write_text("# cameras\n3 PINHOLE 64 48 50 51 33 23\n")
    (tmp_path / "images.txt").write_text("# images\n\n1 1 0 0 0 1 2 3 3 b c.jpg\n\n2 0 0 0 1 0 0 0 3 a.jpg\n1 2 -1\n")
    (tmp_path / "points3D.txt").write_text("# points\n")
    model = read_model(tmp_path)
    assert [image.name for image in model.images] == ["a.jpg", "b c.jpg"]
    np.testing.assert_allclose(model.images[1].world_from_cam[:3, 3], [-1, -2, -3])
    np.testing.assert_allclose(model.images[0].world_from_cam[:3, :3], np.diag([-1, -1, 1]), rtol=0, atol=1e-15)
    assert model.points.shape == (0, 3)
    for text, what in (
        ("1 1 0 0 0 1 2 3 4 a.jpg\n\n", "image a.jpg refers to camera 4, which does not exist"),
        ("1 1 0 0 0 1 2 3 3 a.jpg\n\n2 1 0 0 0 1 2 3 3 a.jpg\n\n", "a.jpg is registered twice"),
        (
            "1 0 0 0 0 1 2 3 3 a.jpg\n\n",
            r"txt: the pose of image a\.jpg is not finite, or .* of length 0; only 0 of 1 frame",
        ),
        ("1 1 0 0 0 nan 2 3 3 a.jpg\n\n", r"images\.txt: the pose of image a\.jpg is not finite"),
        ("# nothing\n", "no registered images"),
    ):
        (tmp_path / "images.txt").write_text(text)
        with pytest.raises(UserError, match=what):
            read_model(tmp_path)
