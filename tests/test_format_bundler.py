"""Bundler's model against the formula of its manual written out here, and by hand."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from captures import put_photos, refused
from scipy.spatial.transform import Rotation

from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.bundler import find_bundler, parse_bundler
from nerfcli.captures.formats.format import UserInputs
from nerfcli.errors import UserError

LENSES = [(60.0, 0.1, -0.05), (55.0, 0.02, 0.0), (50.0, 0.0, 0.0)]
NAMES = ["a.jpg", "b c.jpg", "ü.jpg"]
POINTS = np.random.default_rng(5).uniform(-1, 1, (7, 3))


def bundler_cameras() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return R and t of three cameras, four units from the origin, looking at it along their -z."""
    turns = Rotation.random(3, rng=np.random.default_rng(6)).as_matrix()
    return [(turn, np.array([0.1 * index, -0.2, -4.0])) for index, turn in enumerate(turns)]


def from_middle(lens: tuple[float, float, float], turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Bundler v0.4 User's Manual: pixels from the picture's middle, y upwards."""
    f, k1, k2 = lens
    cam = POINTS @ turn.T + shift
    p = -cam[:, :2] / cam[:, 2:]
    n2 = (p**2).sum(axis=1, keepdims=True)
    return f * (1 + k1 * n2 + k2 * n2**2) * p


def model_text() -> str:
    cameras, seen = [], []
    for lens, (turn, shift) in zip(LENSES, bundler_cameras(), strict=True):
        cameras += [lens, *turn.tolist(), shift.tolist()]
        seen.append(from_middle(lens, turn, shift).tolist())
    lines = ["# Bundle file v0.3", "3 7", *(" ".join(map(repr, row)) for row in cameras)]
    for index, point in enumerate(POINTS.tolist()):
        # A view for each camera, but not point 0, which nobody saw.
        places = [pixels[index] for pixels in seen] if index else []
        views = [f"{camera} {17 * index} {x!r} {y!r}" for camera, (x, y) in enumerate(places)]
        lines += [" ".join(map(repr, point)), f"{index} 128 255", " ".join([str(len(views)), *views])]
    return "\n".join(lines) + "\n"


def write(folder: Path, text: str, names: list[str] = NAMES, *, on_disk: list[str] = NAMES) -> Path:
    put_photos(folder, *on_disk)
    (folder / "list.txt").write_text("\n".join(names) + "\n", encoding="utf-8")
    (folder / "bundle").mkdir(exist_ok=True)
    path = folder / "bundle" / "bundle.out"
    path.write_text(text, encoding="utf-8")
    return path


def test_cameras_project_as_in_the_manual(tmp_path):
    capture = parse_bundler(write(tmp_path, model_text()))
    assert [frame.name for frame in capture.frames] == NAMES
    assert [frame.camera.model for frame in capture.frames] == ["RADIAL", "SIMPLE_RADIAL", "PINHOLE"]
    np.testing.assert_array_equal(capture.points, POINTS)
    np.testing.assert_array_equal(capture.colours, [[index, 128, 255] for index in range(7)])
    assert (capture.kind, capture.unit, capture.missing) == ("bundler", "arbitrary", ())
    for frame, lens, (turn, shift) in zip(capture.frames, LENSES, bundler_cameras(), strict=True):
        assert frame.image == tmp_path / frame.name
        np.testing.assert_allclose(frame.centre, -turn.T @ shift, rtol=0, atol=1e-14)
        pixels, valid = frame.camera.project(frame.in_camera(POINTS))
        assert valid.all()
        expected = from_middle(lens, turn, shift) * [1, -1] + [32, 24]
        np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-9)


def test_views_are_where_the_points_project(tmp_path):
    capture = parse_bundler(write(tmp_path, model_text()))
    seen = capture.observations
    assert seen is not None
    assert len(seen.pixels) == 18
    assert set(zip(seen.frame_index.tolist(), seen.point_index.tolist(), strict=True)) == {
        (frame, point) for frame in range(3) for point in range(1, 7)
    }
    for frame_index, point_index, pixel in zip(seen.frame_index, seen.point_index, seen.pixels, strict=True):
        frame = capture.frames[frame_index]
        in_cam = frame.in_camera(capture.points[point_index])
        np.testing.assert_allclose(frame.camera.project(in_cam)[0][0], pixel, rtol=0, atol=1e-9)


def test_an_identity_camera_by_hand(tmp_path):
    # It looks along world -z with +y up. The point (1, 2, -10) is 10 px to the right and 20 px above the middle.
    text = "# Bundle file v0.3\n1 1\n100 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n1 2 -10\n1 2 3\n1 0 5 10.0 20.0\n"
    capture = parse_bundler(write(tmp_path, text, ["./a.jpg 0 1234.5"]))
    frame = capture.frames[0]
    assert frame.name == "a.jpg"
    assert frame.camera == Camera("PINHOLE", 64, 48, (100, 100, 32, 24))
    np.testing.assert_array_equal(frame.world_from_cam, np.diag([1.0, -1, -1, 1]))
    assert capture.observations is not None
    np.testing.assert_array_equal(capture.observations.pixels, [[42.0, 4.0]])


def test_unregistered_and_missing_photos_are_no_frames(tmp_path):
    lines = model_text().splitlines()
    lines[2:7] = ["0 0 0"] * 5
    unseen = [line if len(line.split()) < 12 else "2 " + line.split(maxsplit=5)[5] for line in lines]
    capture = parse_bundler(write(tmp_path, "\n".join(unseen), on_disk=["ü.jpg"]))
    assert [frame.name for frame in capture.frames] == ["ü.jpg"]
    assert capture.missing == ("b c.jpg",)
    assert capture.notes[-1] == "1 photo without a pose left out: a.jpg"
    assert capture.observations is not None
    np.testing.assert_array_equal(capture.observations.frame_index, np.zeros(6))
    np.testing.assert_array_equal(capture.observations.point_index, np.arange(1, 7))


def test_the_list_is_found_where_colmap_writes_it(tmp_path):
    path = write(tmp_path, model_text())
    (tmp_path / "list.txt").rename(tmp_path / "bundle" / "model.list.txt")
    with pytest.raises(UserError, match="the list of images next to it is missing"):
        parse_bundler(path)
    path = path.rename(path.with_name("model.bundle.out"))
    given = parse_bundler(path, UserInputs(tmp_path))
    assert [frame.image for frame in given.frames] == [tmp_path / name for name in NAMES]


def test_a_folder_with_one_model_of_any_name_is_found(tmp_path):
    path = write(tmp_path, model_text())
    assert find_bundler(tmp_path) == path
    cameras = path.rename(tmp_path / "cameras.out")
    (tmp_path / "nohup.out").write_text("32 photos\n")
    (tmp_path / "empty.out").write_bytes(b"")
    assert find_bundler(tmp_path) == cameras
    shutil.copy(cameras, tmp_path / "others.out")
    assert find_bundler(tmp_path) is None
    assert find_bundler(cameras) == cameras


def edited(number: int, line: str | None) -> str:
    lines = model_text().splitlines()
    lines[number - 1 : number] = [] if line is None else [line]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "names", "what"),
    [
        ("", NAMES, "does not begin with # Bundle file"),
        (edited(1, "# Bundle file v0.2"), NAMES, "line 1: is of an unsupported version"),
        (edited(2, "3"), NAMES, "line 2: has 1 number"),
        (edited(2, "3 -7"), NAMES, "line 2: announces 3 cameras and -7 points"),
        (edited(2, "900000000000 7"), NAMES, "announces 900000000000 cameras and 7 points, but the file has 37"),
        (edited(20, None), NAMES, "but the file has 36 lines"),
        (edited(3, "-60 0 0"), NAMES, "line 3: .*invalid parameters"),
        (edited(3, "60 0"), NAMES, "line 3: has 2 numbers"),
        (edited(4, "1 1 1"), NAMES, "line 4: the upper left 3x3 block is not a rotation"),
        (edited(18, "1 nan 1"), NAMES, "line 18: 'nan' is not finite"),
        (edited(18, "1 2 x"), NAMES, "line 18: 'x' is not a number"),
        (edited(20, "1 0 5 10"), NAMES, "line 20: announces 1 views, but has 3 numbers"),
        (edited(20, "1 3 5 10 20"), NAMES, "line 20: a view refers to a camera that does not exist"),
        (edited(20, "1 0.5 5 10 20"), NAMES, "line 20: a view refers to a camera that does not exist"),
        (model_text(), NAMES[:2], r"has 3 cameras, but .*list\.txt has 2 images"),
        (model_text(), ["a.jpg", "a.jpg", "b c.jpg"], r"list\.txt: image 'a.jpg' is listed twice"),
        (model_text(), ["x", "y", "z"], "none of the 3 listed photos"),
    ],
)
def test_malformed_files_are_refused_with_file_and_line(tmp_path, text, names, what):
    path = write(tmp_path, text, names)
    with refused(what, tmp_path):
        parse_bundler(path)
