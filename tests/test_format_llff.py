"""LLFF's poses_bounds.npy as a capture: what it holds and loses, depth bounds by hand."""

import io
from dataclasses import replace

import numpy as np
import pytest
from captures import CAMERAS, put_photos, reprojection_px, ring
from test_format_transforms import OPENCV_POSE

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.formats.fields import array_of_npy
from nerfcli.captures.formats.llff import losses_llff, parse_llff, write_llff
from nerfcli.captures.loading import load_scene
from nerfcli.errors import UserError

# A camera at (1, 2, 3) that looks along -x with +z up, in LLFF's axes: down -z, right +y, backward +x.
LLFF_POSE = [[0.0, 0.0, 1.0, 1.0], [0.0, 1.0, 0.0, 2.0], [-1.0, 0.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


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
    put_photos(tmp_path, "images/1.jpg", "images_4/b.png", "images_4/a.png")
    capture = load_scene(tmp_path)
    assert [frame.name for frame in capture.frames] == ["images_4/a.png", "images_4/b.png"]
    assert capture.frames[0].camera == Camera("PINHOLE", 64, 48, (50, 50, 32, 24))
    np.testing.assert_allclose(capture.frames[0].world_from_cam, OPENCV_POSE, rtol=0, atol=1e-15)
    np.testing.assert_allclose(capture.frames[1].centre, [1, 2, 4])
    np.testing.assert_array_equal(capture.depth_bounds, [[1.5, 20], [1.5, 21]])
    assert capture.kind == "llff"
    put_photos(tmp_path, "images/2.jpg")
    assert load_scene(tmp_path).frames[0].name == "images/1.jpg"


def test_malformed_llff_is_refused(tmp_path):
    path = tmp_path / "poses_bounds.npy"
    np.save(path, llff_rows(3))
    with pytest.raises(UserError, match="none of its 3 photos is on disk, such as image000"):
        load_scene(tmp_path)
    put_photos(tmp_path, "images/1.jpg", "images_8/1.jpg", "images_8/2.jpg")
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
    wrong = ((15, 0.0, "depth bounds 0 and 20"), (14, -1.0, "row 0: .* -1"), (3, np.nan, "row 0: .*finite"))
    for column, value, what in wrong:
        rows = llff_rows(1)
        rows[0, column] = value
        np.save(path, rows)
        with pytest.raises(UserError, match=what):
            load_scene(tmp_path)


def pinhole_ring() -> Capture:
    return ring(Camera.pinhole(640, 480, 500.0), Camera.pinhole(400, 480, 450.0))


def test_views_of_two_cameras_without_photos_are_numbered(tmp_path):
    capture = replace(pinhole_ring(), depth_bounds=np.column_stack([np.arange(1.0, 7.0), np.full(6, 9.0)]))
    write_llff(capture, tmp_path)
    back = parse_llff(tmp_path)
    assert reprojection_px(capture, back) < 1e-10
    assert [(frame.name, frame.image) for frame in back.frames] == [(f"image{index:03d}", None) for index in range(6)]


def test_rows_are_in_the_order_of_the_photos_names(tmp_path):
    capture = pinhole_ring()
    write_llff(capture, tmp_path / "a")
    write_llff(replace(capture, frames=capture.frames[::-1], observations=None), tmp_path / "b")
    rows, reversed_rows = (np.load(tmp_path / name / "poses_bounds.npy")[:, :15] for name in "ab")
    np.testing.assert_array_equal(reversed_rows, rows)


def test_depth_bounds_are_percentiles_of_what_each_view_sees(tmp_path):
    """Three cameras on a line: bounds from observed points, else from the points within the picture."""
    camera = Camera.pinhole(64, 48, 50.0)
    capture = ring(camera, num_frames=3)
    frames = tuple(
        replace(frame, world_from_cam=rigid.from_parts(np.eye(3), np.array([0.0, 0.0, -index])))
        for index, frame in enumerate(capture.frames)
    )
    depths = np.linspace(2.0, 5.0, 31)
    points = np.column_stack([np.zeros(31), np.zeros(31), depths])
    points[30, 0] = 100.0  # outside every picture
    observations = Observations(np.array([1, 0, 0, 1, 0]), np.array([3, 0, 30, 4, -1]), np.zeros((5, 2)))
    seen = replace(capture, frames=frames, points=points, colours=None, observations=observations)
    write_llff(seen, tmp_path)
    bounds = np.load(tmp_path / "poses_bounds.npy")[:, 15:]
    np.testing.assert_allclose(bounds[0], np.percentile([2.0, 5.0], [0.1, 99.9]), rtol=1e-14)
    np.testing.assert_allclose(bounds[1], np.percentile([3.3, 3.4], [0.1, 99.9]), rtol=1e-14)
    np.testing.assert_allclose(bounds[2], [bounds[0, 0], bounds[0, 1]], rtol=1e-14)  # observes nothing: the widest
    write_llff(replace(seen, observations=None), tmp_path)
    bounds = np.load(tmp_path / "poses_bounds.npy")[:, 15:]
    for index in range(3):
        np.testing.assert_allclose(bounds[index], np.percentile(depths[:30] + index, [0.1, 99.9]), rtol=1e-14)


def test_neither_points_nor_bounds_is_refused(tmp_path):
    capture = replace(pinhole_ring(), points=np.zeros((0, 3)), colours=None, observations=None)
    with pytest.raises(UserError, match="needs depth bounds, but none of the 6 views sees two of the 0 points"):
        write_llff(capture, tmp_path)
    with pytest.raises(UserError, match="spherical picture"):
        write_llff(ring(CAMERAS["EQUIRECTANGULAR"]), tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_the_array_cannot_hold_is_listed():
    bare = replace(pinhole_ring(), points=np.zeros((0, 3)), colours=None, observations=None)
    assert losses_llff(replace(bare, depth_bounds=np.tile([1.0, 2.0], (6, 1)))) == ()
    capture = ring(CAMERAS["RADIAL"], CAMERAS["PINHOLE"])
    moved = (replace(capture.frames[0], name="other/x.jpg", split="test"), *capture.frames[1:])
    assert capture.observations is not None
    num_observations = len(capture.observations.pixels)
    assert losses_llff(replace(capture, frames=moved)) == (
        "k1 of 1 camera",
        "k2 of 1 camera",
        "the principal point of 2 cameras",
        "the second focal length of 1 camera",
        "the photos' 2 folders",
        "40 points",
        "colours of 40 points",
        f"{num_observations} observations",
        "the split of 1 frame",
    )


@pytest.mark.parametrize("shape", [(10**12, 3), (-1, 3), (2**62, 2**62), (0, 2**40)])
def test_an_announced_size_is_not_believed(shape):
    stream = io.BytesIO()
    np.save(stream, np.zeros((5, 3)))
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    data = stream.getvalue()[:10] + text.encode() + stream.getvalue()[128:]
    with pytest.raises(ValueError, match="announces"):
        array_of_npy(data)


@pytest.mark.parametrize("dtype", [">f4", "<f8", "<i8"])
def test_arrays_of_other_writers_are_read(dtype):
    """float32, big endian, integers, by columns."""
    stream = io.BytesIO()
    rows = np.arange(15).reshape(5, 3)
    np.save(stream, np.asfortranarray(rows.astype(dtype)))
    np.testing.assert_array_equal(array_of_npy(stream.getvalue()), rows)
