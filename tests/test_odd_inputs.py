"""Captures with the oddities of files that were moved, converted or written by other programs: what must come out.

Positions and counts are known, as the captures are written here. Photos differ in their grey level, so that the level
says which photo was found.
"""

import json
import re
import shutil
import struct
import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from captures import put_photos, ring
from commands import completed, nerfcli, refusal
from every_format import WITH_PHOTOS, Views, numbers, parse, replace_in
from PIL import Image
from views import PINHOLE, capture_of

from nerfcli.cameras.camera import Camera
from nerfcli.captures.axes import pose_in_axes
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.colmap import write_colmap_binary, write_colmap_text
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.lenses import Fits, Terms
from nerfcli.captures.formats.photo_names import find_photos
from nerfcli.captures.formats.ply import write_points
from nerfcli.captures.formats.registry import with_masks
from nerfcli.captures.loading import load_scene
from nerfcli.errors import UserError

CAPTURE = capture_of([PINHOLE])
COUNT = len(CAPTURE.frames)
SIZE = PINHOLE.size


def photos(folder: Path, names: Sequence[str], *, size: tuple[int, int] = SIZE) -> None:
    """Write photos whose grey level is 10 times their number."""
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", size, 10 * index).save(folder / name)


def levels(found: Sequence[Path | None]) -> list[int | None]:
    """Return the numbers of the photos that were found."""
    return [None if path is None else round(float(np.asarray(Image.open(path)).mean()) / 10) for path in found]


def colmap(folder: Path, names: Sequence[str]) -> None:
    named = [replace(frame, name=name) for frame, name in zip(CAPTURE.frames, names, strict=True)]
    write_colmap_text(replace(CAPTURE, frames=tuple(named)), folder / "sparse/0")


def transforms_record(names: Sequence[str], **more: Any) -> dict[str, Any]:
    fx, fy, cx, cy = PINHOLE.params
    head = {"w": SIZE[0], "h": SIZE[1], "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    matrices = [pose_in_axes(frame.world_from_cam, "opengl").tolist() for frame in CAPTURE.frames]
    frames = [{"file_path": n, "transform_matrix": m} for n, m in zip(names, matrices, strict=False)]
    return {**head, "frames": frames, **more}


def transforms(folder: Path, names: Sequence[str], **more: Any) -> None:
    (folder / "transforms.json").write_text(json.dumps(transforms_record(names, **more)))


def numbered(pattern: str) -> list[str]:
    return [pattern.format(index) for index in range(COUNT)]


@pytest.mark.parametrize("write", [colmap, transforms])
@pytest.mark.parametrize(
    ("on_disk", "listed", "note"),
    [
        ("images/left/view_{}.png", "left\\view_{}.png", None),
        ("images/view_{}.png", "C:\\capture\\images\\view_{}.png", "other names: images/view_0.png for C:"),
        ("images/view_{}.png", "\\\\server\\share\\images\\view_{}.png", "other names: images/view_0.png for "),
        ("images/view_{}.png", "/home/user/capture/images/view_{}.png", "other names: images/view_0.png for /home"),
        ("images/view_{}.png", "VIEW_{}.PNG", "other names: images/view_0.png for VIEW_0.PNG"),
        ("images/view_{}.png", "view_{}.jpg", "other names: images/view_0.png for view_0.jpg"),
        ("input/view_{}.png", "view_{}.png", "other names: input/view_0.png for view_0.png"),
        ("images_4/view_{}.png", "view_{}.png", "other names: images_4/view_0.png for view_0.png"),
        ("rgb/ü {}.png", "input/u\u0308 {}.JPG", "other names: rgb/ü 0.png for input/u\u0308 0.JPG"),
        ("images/my view_{}.png", "images/my%20view_{}.png", "other names: images/my view_0.png for images/my%20view"),
        ("images/left/é_{}.png", "file:///C:/a%20b/Left/%C3%A9_{}.png", "other names: images/left/é_0.png for file:"),
        ("images/100%25_{}.png", "images/100%25_{}.png", None),
        ("images/view_{}.HEIC.jpg", "images/view_{}.HEIC", "other names: images/view_0.HEIC.jpg for images/view_0"),
        ("view_{}.png", "view_{}.png", None),
    ],
)
def test_photos_under_other_names_are_found_and_said_once(write, on_disk, listed, note, tmp_path):
    photos(tmp_path, numbered(on_disk))
    write(tmp_path, numbered(listed))
    capture = parse(tmp_path)
    assert levels([frame.image for frame in capture.frames]) == list(range(COUNT))
    np.testing.assert_allclose([f.centre for f in capture.frames], [f.centre for f in CAPTURE.frames], atol=1e-12)
    if note is None and not (write is transforms and "left" in listed):
        assert capture.notes == ()
    elif note is not None:
        assert len(capture.notes) == 1
        assert f"{COUNT} photos found under {note}" in capture.notes[0]


def find(folder: Path, names: Sequence[str], **more: Any) -> Any:
    return find_photos(names, [folder], sizes=[SIZE] * len(names), **more)


def test_the_longest_common_end_wins_and_an_exact_name_comes_first(tmp_path):
    photos(tmp_path, ["images/a.png", "images/left/a.png", "images/A.PNG"])
    assert levels(find(tmp_path, ["D:\\x\\left\\a.png", "A.PNG", "a.png"]).paths) == [1, 2, 0]


def test_a_name_with_a_percent_sign_is_first_taken_as_it_is(tmp_path):
    photos(tmp_path, ["images/a%20b.png", "images/a b.png", "images/IMG_1.jpg", "images/IMG_1.HEIC.jpg"])
    listed = ["a b.png", "a%20b.png", "C:\\x\\a%20b.png", "images/IMG_1.HEIC.jpg", "IMG_1.heic", " images/IMG_1.jpg "]
    assert [levels(find(tmp_path, [name]).paths) for name in listed] == [[1], [0], [0], [3], [2], [2]]


@pytest.mark.parametrize("listed", ["C:\\trip\\a.png", "file:///C:/trip/a.png", "file://C:/trip/a.png", " C:/a.png"])
def test_an_absolute_path_is_no_name(listed, tmp_path):
    photos(tmp_path, ["images/a.png"])
    assert find(tmp_path, [listed]).names == ("a.png",)


@pytest.mark.parametrize(
    ("on_disk", "listed", "two"),
    [
        (["images/left/a.png", "images/right/a.png"], ["/home/x/a.png"], "left/a.png"),
        (["images/a.png", "images/A.PNG"], ["A.png"], "images/A.PNG"),
        (["images/a.png", "images/a.webp"], ["a.jpg"], "images/a.webp"),
        (["images/a.png"], ["left/a.png", "right/a.png"], "fits two names, left/a.png and right/a.png"),
        (["input/a.png", "x/b.png", "rgb/a.png"], ["a.png"], "input/a.png and rgb/a.png"),
    ],
)
def test_two_candidates_are_refused_by_name(on_disk, listed, two, tmp_path):
    photos(tmp_path, on_disk)
    with pytest.raises(UserError) as caught:
        find(tmp_path, listed)
    assert two in caught.value.message


def test_a_folder_of_undistorted_photos_is_not_taken_for_that_of_the_cameras(tmp_path):
    photos(tmp_path / "images", ["0.png", "1.png"], size=(SIZE[0] - 40, SIZE[1] - 11))
    photos(tmp_path / "input", ["0.png", "1.png"])
    assert find(tmp_path, ["0.png", "1.png"]).paths == (tmp_path / "input/0.png", tmp_path / "input/1.png")


def test_photos_of_another_shape_are_not_found(tmp_path):
    """Neither in another folder nor with another suffix; where it is only one, the others are used."""
    photos(tmp_path / "input", ["0.png"], size=(100, 100))
    what = r"input/0\.png has 100x100 pixels, which is not the shape of its camera, 640x480"
    with pytest.raises(UserError, match=what):
        find(tmp_path, ["0.png"])
    photos(tmp_path / "images", ["0.png", "1.png"])
    photos(tmp_path / "images", ["2.png"], size=(100, 100))
    found = find(tmp_path, ["0.jpg", "1.jpg", "2.jpg"])
    assert (levels(found.paths), found.missing) == ([0, 1, None], ("2.jpg",))
    assert found.notes[1].startswith("images/2.png has 100x100 pixels")


def test_a_folder_of_another_name_is_no_other_folder_of_the_same_photo(tmp_path):
    """The photo left/a.png is not right/a.png."""
    photos(tmp_path, ["images/right/a.png"])
    assert find(tmp_path, ["left/a.png"]).paths == (None,)


def test_photos_in_full_size_come_before_reduced_ones_where_no_size_is_known(tmp_path):
    photos(tmp_path, ["images_4/b.png", "input/b.png"])
    assert find_photos(["b.png"], [tmp_path]).paths == (tmp_path / "input/b.png",)


def test_a_photo_that_was_moved_to_a_subfolder_is_not_brought_back(tmp_path):
    photos(tmp_path / "images", ["a.png", "rejected/b.png"])
    assert levels(find(tmp_path, ["a.png", "b.png"]).paths) == [0, None]


def test_the_mask_of_a_photo_that_is_missing_is_not_taken_for_it(tmp_path):
    photos(tmp_path, ["images/a.jpg", "masks/a.jpg.png", "masks/b.jpg.png"])
    assert levels(find(tmp_path, ["a.jpg", "b.jpg"], given=tmp_path).paths) == [0, None]


@pytest.mark.parametrize("listed", ["{}.png", "{}.PNG", "C:\\trip\\{}.png", "/home/x/images/{}.jpg"])
@pytest.mark.parametrize("beside", ["images/masks/{}.png", "images/thumbs/{}.png"])
def test_a_file_in_a_folder_within_that_of_the_photos_is_not_taken_for_one_that_is_missing(listed, beside, tmp_path):
    photos(tmp_path, [*(f"images/{name}.png" for name in "ab"), *map(beside.format, "abc")])
    assert levels(find(tmp_path, [listed.format(name) for name in "abc"]).paths) == [0, 1, None]


@pytest.mark.parametrize("listed", ["{}", "{}.PNG", "/home/x/images/{}.jpg"])
def test_photos_of_which_some_were_moved_into_a_folder_are_found(listed, tmp_path):
    """Labels of Metashape name no folders at all."""
    photos(tmp_path, ["images/a.png", "images/b.png", "images/drone/c.png"])
    assert levels(find(tmp_path, [listed.format(name) for name in "abc"]).paths) == [0, 1, 2]


@pytest.mark.parametrize("write", [colmap, transforms])
@pytest.mark.parametrize("listed", ["../images/{{}}.png", "{folder}/images/{{}}.png", "images/{{}}.png"])
def test_photos_are_only_taken_from_the_folder_that_the_user_gives(write, listed, tmp_path):
    """Not from where the names lead, not even those that the folder lacks."""
    photos(tmp_path, numbered("images/{}.png"))
    photos(tmp_path, numbered("capture/images/{}.png"))
    photos(tmp_path, numbered("edited/{}.png"))
    (tmp_path / "edited/0.png").unlink()
    write(tmp_path / "capture", numbered(listed.format(folder=tmp_path)))
    images = [frame.image for frame in parse(tmp_path / "capture", UserInputs(images=tmp_path / "edited")).frames]
    there = [path for path in images if path and path.is_file()]
    assert there == [tmp_path / "edited" / name for name in numbered("{}.png")[1:]]


@pytest.mark.parametrize("write", [colmap, transforms])
@pytest.mark.parametrize("listed", ["images/VIEW_{}.PNG", "images/view_{}.jpg", "C:\\x\\view_{}.png", "images/view_{}"])
def test_photos_under_other_names_make_a_scene(write, listed, tmp_path):
    """Renaming them as they are on disk, which is said, is no loss that must be allowed."""
    photos(tmp_path, numbered("images/view_{}.png"))
    write(tmp_path, numbered(listed))
    assert "found under other names" in completed("convert", tmp_path, tmp_path / "scene", "--to", "nerfcli").stderr
    images = [frame.image for frame in parse(tmp_path / "scene").frames]
    assert images == [tmp_path / name for name in numbered("images/view_{}.png")]


@pytest.mark.parametrize("write", [colmap, transforms])
@pytest.mark.parametrize("listed", ["images/{}.png", "/home/x/images/{}.png"])
def test_a_scene_of_which_a_photo_is_missing_has_the_names_and_split_of_the_capture(write, listed, tmp_path):
    """Every 8th of the photos that are there is held out; that was the missing one."""
    photos(tmp_path / "images", numbered("{}.png")[1:])
    write(tmp_path, numbered(listed))
    completed("convert", tmp_path, tmp_path / "scene", "--to", "nerfcli")
    before, after = load_scene(tmp_path), load_scene(tmp_path / "scene")
    assert (after.test_names, after.missing) == (before.test_names, before.missing)
    assert [frame.image for frame in after.frames] == [frame.image for frame in before.frames]


@pytest.mark.parametrize("write", [colmap, transforms])
def test_a_conversion_names_missing_photos_and_fails_without_any(write, tmp_path):
    photos(tmp_path / "images", numbered("{}.png")[2:])
    write(tmp_path, numbered("images/{}.png"))
    some = completed("convert", tmp_path, tmp_path / "out.json", "--to", "transforms", "--allow-loss")
    assert f"2 of {COUNT} photos missing: images/0.png, images/1.png" in " ".join(some.stderr.split())
    write(tmp_path, numbered("images/other {}.png"))
    error, _ = refusal("convert", tmp_path, tmp_path / "out 2.json", "--to", "transforms", "--allow-loss")
    assert f"none of the {COUNT} photos of the capture is on disk, such as images/other 0.png" in error
    assert not (tmp_path / "out 2.json").exists()


@pytest.mark.parametrize("write", [colmap, transforms])
@pytest.mark.parametrize("again", ["images/../images/0.png", "{folder}/images/0.png"])
def test_a_photo_with_two_cameras_is_refused_under_any_names(write, again, tmp_path):
    photos(tmp_path / "images", numbered("{}.png"))
    write(tmp_path, ["images/0.png", again.format(folder=tmp_path), *numbered("images/{}.png")[2:]])
    with pytest.raises(UserError, match=r"'images/0\.png' and '.* are the same photo"):
        parse(tmp_path)


@pytest.mark.parametrize("write", [colmap, transforms])
def test_a_conversion_refuses_cameras_of_another_shape_than_their_photos(write, tmp_path):
    """As training does. Poses alone can be written; a photo that EXIF mirrors or that is damaged is left to others."""
    photos(tmp_path / "images", numbered("{}.png"), size=SIZE[::-1])
    write(tmp_path, numbered("images/{}.png"))
    error, _ = refusal("convert", tmp_path, tmp_path / "out.json", "--to", "transforms", "--allow-loss")
    assert "images/0.png: a picture of 480x640 pixels does not match a camera of 640x480" in error
    assert nerfcli("convert", tmp_path, tmp_path / "out.txt", "--to", "tum", "--allow-loss").exit_code == 0
    photos(tmp_path / "images", numbered("{}.png"))
    (tmp_path / "images/0.png").write_bytes(b"")
    put_photos(tmp_path, "images/1.png", size=SIZE, orientation=2)
    completed("convert", tmp_path, tmp_path / "out.json", "--to", "transforms", "--allow-loss")


def test_a_panorama_with_an_orientation_is_converted_as_stored_and_not_turned(tmp_path):
    photos(tmp_path, numbered("images/{}.png"), size=(128, 64))
    put_photos(tmp_path, "images/1.png", size=(128, 64), orientation=3)
    transforms(tmp_path, numbered("images/{}.png"), camera_model="EQUIRECTANGULAR", w=128, h=64)
    completed("convert", tmp_path, tmp_path / "out", "--to", "colmap")
    error, _ = refusal("convert", tmp_path, tmp_path / "scene", "--to", "nerfcli")
    assert "images/1.png: a spherical picture with EXIF orientation 3" in error
    photos(tmp_path, ["images/0.png", "images/1.png"], size=(128, 64))
    assert nerfcli("convert", tmp_path, tmp_path / "scene", "--to", "nerfcli").exit_code == 0
    put_photos(tmp_path, "images/1.png", size=(64, 128), orientation=6)
    error, _ = refusal("convert", tmp_path / "scene", tmp_path / "out.json", "--to", "transforms")
    assert "images/1.png: a spherical picture with EXIF orientation 6" in error


def test_a_folder_is_listed_once_for_all_names(tmp_path, monkeypatch):
    names = [f"{index}.png" for index in range(2000)]
    (tmp_path / "images").mkdir()
    for name in names:
        (tmp_path / "images" / name).touch()
    listed = []
    monkeypatch.setattr("os.walk", lambda folder: listed.append(folder) or [(str(folder), [], sorted(names))])
    found = find(tmp_path, [name.upper() for name in names])
    assert found.paths == tuple(tmp_path / "images" / name for name in names)
    assert len(listed) == 2  # images/ and the folder itself


def test_photos_of_one_name_in_folders_of_their_own_are_found_by_these(tmp_path, monkeypatch):
    """Each name is compared with the photos in its folder, not with all: 2,000 took a minute and a half."""
    count = 300
    for index in range(count):
        (tmp_path / f"images/{index}").mkdir(parents=True)
        (tmp_path / f"images/{index}/rgb.png").touch()
    plain = []
    normalize = unicodedata.normalize
    monkeypatch.setattr(unicodedata, "normalize", lambda form, text: plain.append(text) or normalize(form, text))
    found = find_photos([f"/home/x/images/{index}/rgb.png" for index in range(count)], [tmp_path])
    assert found.paths == tuple(tmp_path / f"images/{index}/rgb.png" for index in range(count))
    assert len(plain) < 40 * count


@pytest.mark.parametrize("centre", [(4 * SIZE[0] / 2, 4 * SIZE[1] / 2), (0.5, 0.5), (SIZE[0] / 2, -1.0)])
def test_a_principal_point_that_is_no_place_in_the_picture_is_said_when_a_scene_is_read(centre, tmp_path):
    content = written(tmp_path, cx=centre[0], cy=centre[1])
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    (note,) = load_scene(tmp_path).notes
    assert note.startswith(f"the principal point of {COUNT} photos, such as 0.png, is outside the picture or at its")


def test_cameras_at_one_place_are_said_when_a_scene_is_read(tmp_path):
    """Templates have one pose for all; and none of depth is in photos that a camera took while it only turned."""
    content = written(tmp_path)
    for frame in content["frames"]:
        frame["transform_matrix"] = np.eye(4).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    (note,) = load_scene(tmp_path).notes
    assert note == f"all {COUNT} cameras are at the same place, from which no depth can be learned"


# Poses

CAMERA = Camera("PINHOLE", 64, 48, (70.0, 70.0, 32.0, 24.0))
POSES = np.array([frame.world_from_cam for frame in ring(CAMERA, num_frames=8).frames])
LOST = 2
# Formats whose files hold matrices, and are written number by number.
OF_MATRICES = (
    *("metashape", "bundler", "polycam", "mvsnet", "pose-files", "alicevision", "openmvg", "nerfies"),
    *("3d-scanner-app", "realityscan-xmp"),
)


def put(form: str, folder: Path, poses: np.ndarray = POSES) -> Path:
    """Write views in a format of `every_format`; return the file or folder that it is read from."""
    WITH_PHOTOS[form](Views(CAMERA, poses), folder)
    return folder


def changed(block: np.ndarray, *indices: int) -> np.ndarray:
    """Return the poses with the rotations of some, or of all, multiplied by a block (3, 3)."""
    poses = POSES.copy()
    poses[list(indices) or slice(None), :3, :3] @= block
    return poses


def assert_centres(capture: Capture, expected: np.ndarray) -> None:
    np.testing.assert_allclose([frame.centre for frame in capture.frames], expected, rtol=0, atol=1e-9)
    for frame in capture.frames:
        rotation = frame.world_from_cam[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-12)


def lose_in_json(file: str, keys: Sequence[Any], value: Any, folder: Path) -> None:
    """Change one value in a JSON file."""
    content = part = json.loads((folder / file).read_text())
    for key in keys[:-1]:
        part = part[key]
    part[keys[-1]] = value
    (folder / file).write_text(json.dumps(content))


def lose_llff(folder: Path) -> None:
    rows = np.load(folder / "poses_bounds.npy")
    rows[LOST, [0, 1, 2, 5, 6, 7, 10, 11, 12]] = 0.0
    np.save(folder / "poses_bounds.npy", rows)


def lose_in_row(file: str, row: str, separator: str, cells: slice, folder: Path, *, unknown: str = "nan") -> None:
    """Make some cells unknown in the row of a table that matches a pattern."""
    lines = (folder / file).read_text().splitlines()
    (index,) = (index for index, line in enumerate(lines) if re.search(row, line))
    words = lines[index].split(separator)
    words[cells] = [unknown] * len(words[cells])
    lines[index] = separator.join(words)
    (folder / file).write_text("\n".join(lines) + "\n")


LOSE = {
    "kapture": partial(lose_in_row, "sensors/trajectories.txt", "^0002,", ", ", slice(2, None)),
    "stray-scanner": partial(lose_in_row, "odometry.csv", ", 000002,", ", ", slice(2, None)),
    "record3d": partial(lose_in_json, "metadata.json", ("poses", LOST, slice(4)), [0.0] * 4),
    "transforms": partial(lose_in_json, "transforms.json", ("frames", LOST, "transform_matrix"), None),
    "opensfm": partial(lose_in_json, "reconstruction.json", (0, "shots", "2.jpg", "rotation"), [float("nan")] * 3),
    "llff": lose_llff,
    "colmap-text": partial(lose_in_row, "sparse/0/images.txt", " 2.jpg$", " ", slice(1, 8)),
    "reality-capture": partial(lose_in_row, "cameras.csv", "^images/2.", ",", slice(1, 4), unknown="-nan(ind)"),
}


@pytest.mark.parametrize("form", [*OF_MATRICES, *LOSE])
def test_a_frame_without_a_pose_is_left_out_and_named(form, tmp_path):
    """The other seven have the centres that were written."""
    if form in LOSE:
        LOSE[form](put(form, tmp_path))
    else:
        put(form, tmp_path, changed(np.full((3, 3), np.nan), LOST))
    capture = parse(tmp_path)
    assert_centres(capture, np.delete(POSES[:, :3, 3], LOST, axis=0))
    assert len(capture.notes) == 1
    assert "1 of 8 frames left out: " in capture.notes[0]
    assert "2" in capture.notes[0].split(" left out: ")[1].split(" (")[0]


def test_a_capture_whose_only_photo_has_no_pose_is_refused(tmp_path):
    LOSE["record3d"](put("record3d", tmp_path))
    for photo in tmp_path.rglob("*.jpg"):
        if photo.stem != str(LOST):
            photo.unlink()
    with pytest.raises(UserError, match="lists no images with a pose"):
        parse(tmp_path)


@pytest.mark.parametrize("form", ["mvsnet", "polycam", "pose-files"])
@pytest.mark.parametrize("count", [5, 7])
def test_too_few_poses_are_refused_with_the_reason(form, count, tmp_path):
    put(form, tmp_path, changed(np.full((3, 3), np.nan), *range(count)))
    with pytest.raises(UserError, match=f"not finite|nan.*; only {8 - count} of 8 frames can be used"):
        parse(tmp_path)


@pytest.mark.parametrize("form", OF_MATRICES)
def test_evenly_scaled_rotations_are_normalised_and_said(form, tmp_path):
    put(form, tmp_path, changed(0.33 * np.eye(3)))
    capture = parse(tmp_path)
    assert_centres(capture, POSES[:, :3, 3])
    scale = "3.03" if form == "mvsnet" else "0.33"  # its files hold the inverse
    assert capture.notes == (f"the rotations of 8 frames are scaled by {scale}: normalised",)


@pytest.mark.parametrize("form", OF_MATRICES)
@pytest.mark.parametrize(("block", "what"), [((1, 1, 1.2), "is not a rotation"), ((1, 1, -1), "mirrors the scene")])
def test_uneven_scale_and_mirrors_stay_refused(form, block, what, tmp_path):
    put(form, tmp_path, changed(np.diag(block)))
    with pytest.raises(UserError, match=what):
        parse(tmp_path)


@pytest.mark.parametrize("form", ["metashape", "mvsnet", "pose-files", "3d-scanner-app", "transforms"])
def test_matrices_that_are_stored_column_by_column_are_refused(form, tmp_path):
    """Read row by row, they would put all cameras at the origin."""
    put(form, tmp_path, np.swapaxes(POSES, 1, 2))
    refused_by_columns(tmp_path)


def test_a_camera_on_a_body_that_is_stored_column_by_column_is_refused(tmp_path):
    put("euroc", tmp_path)
    row = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, -0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]])
    replace_in(tmp_path / "mav0/cam0/sensor.yaml", numbers(row), numbers(row.T))
    refused_by_columns(tmp_path)


def refused_by_columns(folder: Path) -> None:
    with pytest.raises(UserError, match=r"last row is .*, expected 0 0 0 1") as caught:
        parse(folder)
    assert "column by column" in caught.value.hint


def written(folder: Path, **more: Any) -> dict[str, Any]:
    """Write photos; return a transforms.json of them, with further keys."""
    photos(folder, numbered("{}.png"))
    return transforms_record(numbered("{}.png"), **more)


def read_again(folder: Path, content: dict[str, Any]) -> Capture:
    (folder / "transforms.json").write_text(json.dumps(content))
    return parse(folder)


def test_numbers_as_text_and_names_of_models_in_any_case(tmp_path):
    content = written(tmp_path, camera_model="opencv", k1=-0.05)
    content |= {key: str(content[key]) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    frames = read_again(tmp_path, content).frames
    assert {frame.camera.model for frame in frames} == {"OPENCV"}
    assert frames[0].camera.params[:4] == PINHOLE.params
    with pytest.raises(UserError, match="fl_x is 'wide'"):
        read_again(tmp_path, {**content, "fl_x": "wide"})


def test_a_matrix_as_one_list_of_numbers_and_frames_without_one(tmp_path):
    content = written(tmp_path)
    for frame in content["frames"]:
        frame["transform_matrix"] = np.ravel(frame["transform_matrix"]).tolist()
    content["frames"][0]["transform_matrix"] = []
    del content["frames"][2]["transform_matrix"]
    capture = read_again(tmp_path, content)
    kept = [0 < index != 2 for index in range(COUNT)]
    expected = [frame.centre for frame, keep in zip(CAPTURE.frames, kept, strict=True) if keep]
    np.testing.assert_allclose([frame.centre for frame in capture.frames], expected, atol=1e-12)
    assert len(capture.notes) == 1
    assert capture.notes[0].startswith(f"2 of {COUNT} frames left out: 0.png, 2.png (")


def test_a_frame_has_its_own_focal_length_in_either_key(tmp_path):
    content = written(tmp_path, fl_x=300.0, fl_y=300.0)
    for frame in content["frames"]:
        frame |= {f"camera_angle_{axis}": 2 * np.arctan(SIZE[side] / 2 / 140) for side, axis in enumerate("xy")}
    capture = read_again(tmp_path, content)
    np.testing.assert_allclose([frame.camera.focal_lengths for frame in capture.frames], 140.0, rtol=1e-12)
    assert capture.notes == ()
    for frame in content["frames"]:
        del frame["camera_angle_y"]
    capture = read_again(tmp_path, content)
    np.testing.assert_allclose([frame.camera.focal_lengths for frame in capture.frames], 140.0, rtol=1e-12)


def test_a_list_of_distortion_terms_replaces_single_ones(tmp_path):
    """As in nerfstudio, for the file or for a frame. Photos of Aria that were undistorted have 12 zeros."""
    content = written(tmp_path, k1=0.3, camera_model="OPENCV", distortion_params=[-0.05, 0.02, 0.0, 0.0, 0.001, -0.002])
    content["frames"][1]["distortion_params"], content["frames"][2]["distortion_params"] = [0.0] * 12, [0] * 4
    first, second, third, *_ = read_again(tmp_path, content).frames
    assert first.camera == Camera("OPENCV", *SIZE, (*PINHOLE.params, -0.05, 0.02, 0.001, -0.002))
    assert second.camera == third.camera == PINHOLE
    with pytest.raises(UserError, match="distortion_params is a list of 5"):
        read_again(tmp_path, content | {"distortion_params": [0.1] * 5})
    with pytest.raises(UserError, match="camera_model 'FISHEYE624' is not supported"):
        read_again(tmp_path, content | {"camera_model": "fisheye624", "distortion_params": [0.1] * 12})
    fisheye = {"distortion_params": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], "is_fisheye": True}  # as instant-ngp says it
    for model in ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE"):
        first, *_ = read_again(tmp_path, content | fisheye | {"camera_model": model}).frames
        assert first.camera == Camera("OPENCV_FISHEYE", *SIZE, (*PINHOLE.params, 0.1, 0.0, 0.0, 0.0))


def test_two_keys_that_give_different_focal_lengths_are_said(tmp_path):
    """nerfstudio and instant-ngp read fl_x; programs write both for the same length, up to rounding."""
    fx = PINHOLE.params[0]
    same = written(tmp_path, camera_angle_x=2 * np.arctan(SIZE[0] / 2 / fx) * 1.001, camera_angle_y=59.0)
    assert read_again(tmp_path, same).notes == ()
    capture = read_again(tmp_path, same | {"camera_angle_x": 2 * np.arctan(SIZE[0] / 2 / 200)})
    assert {frame.camera for frame in capture.frames} == {PINHOLE}
    what = f"camera_angle_x of {COUNT} frames is that of another focal length, 200 pixels, than fl_x, {fx:.4g}"
    assert capture.notes == (f"{what}: fl_x is used",)
    same["frames"][1] |= {"transform_matrix": np.full((4, 4), np.nan).tolist(), "fl_x": np.nan, "camera_angle_y": None}
    assert len(read_again(tmp_path, same).frames) == COUNT - 1
    assert read_again(tmp_path, written(tmp_path, camera_angle_x="wide", camera_angle_y=np.nan)).notes == ()
    fisheye = written(tmp_path, camera_model="OPENCV_FISHEYE", camera_angle_x=SIZE[0] / fx)  # of equal angles
    assert read_again(tmp_path, fisheye).notes == ()


def test_photos_of_a_split_that_are_none_of_the_file_are_said(tmp_path):
    content = written(tmp_path, train_filenames=numbered(".\\{}.png")[1:], test_filenames=["0.png", "lost.png"])
    capture = read_again(tmp_path, content)
    assert [frame.split for frame in capture.frames] == ["test", *["train"] * (COUNT - 1)]
    assert capture.notes == ("1 photo of a split of transforms.json not among its frames: lost.png",)


@pytest.mark.parametrize("listed", ["C:\\out\\points.ply", "Points.PLY", "file:///out/%70oints.ply"])
def test_a_cloud_of_points_is_found_beside_the_file(listed, tmp_path):
    write_points(CAPTURE, tmp_path / "points.ply")
    capture = read_again(tmp_path, written(tmp_path, ply_file_path=listed))
    np.testing.assert_array_equal(capture.points, CAPTURE.points)
    assert capture.notes == ()


def test_empty_texts_of_a_template_are_no_numbers_and_no_masks(tmp_path):
    content = written(tmp_path, k1="", k2="", camera_angle_x="", camera_model=" pinhole ", mask_path=" ")
    for model in (" pinhole ", "", " "):
        capture = read_again(tmp_path, content | {"camera_model": model})
        assert {frame.camera for frame in capture.frames} == {PINHOLE}
        assert capture.notes == ()
    for frame in content["frames"]:
        frame |= {"fl_x": "", "cx": "", "cy": None}
    assert {frame.camera for frame in read_again(tmp_path, content).frames} == {PINHOLE}


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ({"fl_x": 0.78, "fl_y": 1.04, "cx": 0.5, "cy": 0.5}, "fl_x is 0.78"),
        ({"camera_model": "OPENCV", "k5": 0.1}, "k5 is 0.1 and k6 is 0"),
        ({"camera_model": "OPENCV_FISHEYE", "k6": 0.1}, "k5 is 0 and k6 is 0.1"),
    ],
)
def test_intrinsics_without_a_meaning_are_refused(more, what, tmp_path):
    """Fractions of the picture instead of pixels; terms that the model does not have, and that were ignored."""
    with pytest.raises(UserError, match=what):
        read_again(tmp_path, written(tmp_path, **more))


def test_full_opencv_is_the_model_of_colmap_with_a_divisor(tmp_path):
    terms = {"k1": 0.1, "k2": 0.02, "p1": 0.001, "p2": 0.002, "k3": 0.003, "k4": 0.11, "k5": 0.01, "k6": 0.001}
    capture = read_again(tmp_path, written(tmp_path, camera_model="FULL_OPENCV", **terms))
    (camera,) = {frame.camera for frame in capture.frames}
    assert camera == Camera("FULL_OPENCV", *SIZE, (*PINHOLE.params, *terms.values()))
    plain = read_again(tmp_path, written(tmp_path, camera_model="FULL_OPENCV", k1=0.0, k4=0.0))
    assert {frame.camera for frame in plain.frames} == {PINHOLE}  # which more programs read


# Models


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_of_several_models_the_largest_is_read_and_the_others_are_counted(end, tmp_path):
    photos(tmp_path / "images", numbered("{}.png"))
    named = tuple(replace(frame, name=f"{i}.png") for i, frame in enumerate(CAPTURE.frames))
    for number, part in (("0", named[:2]), ("1", named[2:]), ("10", named[:1])):
        own = replace(CAPTURE, frames=part, observations=None)
        write_colmap_text(own, tmp_path / "sparse" / number)
        for path in (tmp_path / "sparse" / number).iterdir():
            path.write_bytes(("\ufeff" + path.read_text().replace("\n", end)).encode())
    capture = parse(tmp_path)
    assert [frame.name for frame in capture.frames] == numbered("{}.png")[2:]
    others = "other models, which are in other coordinates: sparse/0 with 2, sparse/10 with 1"
    assert capture.notes == (f"sparse/1 with 4 photos is read; {others}",)


@pytest.mark.parametrize("lost", ["points3D.txt", "points3D.bin"])
def test_a_model_without_its_points_keeps_its_poses(lost, tmp_path):
    photos(tmp_path / "images", numbered("{}.png"))
    named = tuple(replace(frame, name=f"{i}.png") for i, frame in enumerate(CAPTURE.frames))
    write = write_colmap_text if lost.endswith(".txt") else write_colmap_binary
    write(replace(CAPTURE, frames=named), tmp_path / "sparse/0")
    (tmp_path / "sparse/0" / lost).unlink()
    capture = parse(tmp_path)
    np.testing.assert_allclose([f.centre for f in capture.frames], [f.centre for f in CAPTURE.frames], atol=1e-12)
    assert len(capture.points) == 0
    assert capture.notes == (f"{tmp_path / 'sparse/0' / lost} does not exist: no points are read",)


@pytest.mark.parametrize("between", ["\n", "\n\n"])
def test_lines_of_features_that_were_left_out_by_hand(between, tmp_path):
    """COLMAP's documentation asks for an empty line there; names have spaces, as RealityScan writes them."""
    names = numbered("A DJI ({}).png")
    photos(tmp_path / "images", names)
    colmap(tmp_path, names)
    path = tmp_path / "sparse/0/images.txt"
    listed = [line for line in path.read_text().splitlines() if line.endswith(".png")]
    path.write_text("# by hand\n" + between.join(listed) + "\n")
    capture = parse(tmp_path)
    assert [frame.name for frame in capture.frames] == names
    np.testing.assert_allclose([f.centre for f in capture.frames], [f.centre for f in CAPTURE.frames], atol=1e-12)
    assert len(capture.points) == len(CAPTURE.points)


def test_whole_numbers_with_decimals_tabs_and_indented_comments(tmp_path):
    photos(tmp_path / "images", numbered("{}.png"))
    colmap(tmp_path, numbered("{}.png"))
    cameras, images, points = (tmp_path / f"sparse/0/{name}.txt" for name in ("cameras", "images", "points3D"))
    (line,) = (line for line in cameras.read_text().splitlines() if not line.startswith("#"))
    camera_id, model, width, height, *params = line.split()
    cameras.write_text("\t# by hand\n" + "\t".join([f"{camera_id}.0", model, f"{width}.00", f"{height}e0", *params]))
    rows = [line.split("\t") for line in images.read_text().replace(" ", "\t").splitlines() if line[0] != "#"]
    for row in rows[::2]:
        row[0], row[8] = f"{row[0]}.000e+00", f"{row[8]}.0"
    images.write_text("  # by hand\n" + "\n".join(map("\t".join, rows)))
    points.write_text(" # by hand\n" + points.read_text())
    capture = parse(tmp_path)
    np.testing.assert_allclose([f.centre for f in capture.frames], [f.centre for f in CAPTURE.frames], atol=1e-12)
    assert {frame.camera for frame in capture.frames} == {PINHOLE}
    assert len(capture.points) == len(CAPTURE.points)
    cameras.write_text(f"1 PINHOLE 640.5 480 {' '.join(params)}\n")
    with pytest.raises(UserError, match=r"cameras\.txt is damaged: 640\.5 is not a whole number"):
        parse(tmp_path)


def test_names_in_a_code_page_of_windows_are_refused_with_what_to_do(tmp_path):
    put("colmap", tmp_path)
    path = tmp_path / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes().replace(b"2.jpg", "照2".encode("gbk") + b"jp"))
    with pytest.raises(UserError, match=r"images\.bin: the name of a photo is not in UTF-8 \(byte 0xd5\)") as caught:
        parse(tmp_path)
    assert "rename the photos to plain letters" in caught.value.hint


@pytest.mark.parametrize("folder", ["dense", "dense/0"])
def test_the_undistorted_copy_in_a_workspace_of_colmap_is_found(folder, tmp_path):
    photos(tmp_path / "images", numbered("{}.png"), size=(SIZE[0] + 60, SIZE[1] + 45))
    photos(tmp_path / folder / "images", numbered("{}.png"))
    colmap(tmp_path / folder, numbered("{}.png"))
    for path in (tmp_path / folder / "sparse/0").iterdir():
        path.rename(path.parents[1] / path.name)
    (tmp_path / folder / "sparse/0").rmdir()
    capture = parse(tmp_path)
    images = [tmp_path / folder / "images" / name for name in numbered("{}.png")]
    assert [frame.image for frame in capture.frames] == images
    assert capture.notes == ()


@pytest.mark.parametrize("order", ["utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("form", ["transforms", "colmap-text", "reality-capture", "pose-files", "record3d", "openmvg"])
def test_files_that_powershell_has_written(order, form, tmp_path):
    """Its > writes UTF-16 with a byte order mark and CRLF."""
    put(form, tmp_path)
    before = parse(tmp_path)
    for path in (path for path in tmp_path.rglob("*") if path.suffix in (".txt", ".json", ".csv")):
        path.write_bytes(("\ufeff" + path.read_text(encoding="utf-8").replace("\n", "\r\n")).encode(order))
    after = parse(tmp_path)
    np.testing.assert_array_equal([f.world_from_cam for f in after.frames], [f.world_from_cam for f in before.frames])
    np.testing.assert_array_equal(after.points, before.points)


@pytest.mark.parametrize("command", [("info",), ("convert", "--to", "nerfcli", "out")])
def test_a_name_that_is_no_text_is_refused(command, tmp_path):
    """As JSON and, on Linux, names of files in the code page of an old archive may be."""
    photos(tmp_path, numbered("{}.png"))
    transforms(tmp_path, ["caf\udce9.png", *numbered("{}.png")[1:]])
    error, hint = refusal(command[0], tmp_path, *command[1:])
    assert "transforms.json: the name 'caf\\udce9.png' is not in UTF-8" in error
    assert hint.startswith("Hint:  rename it")


def test_an_error_has_two_lines_whatever_a_name_holds(tmp_path):
    """It moves neither the cursor of the terminal nor its colours."""
    names = numbered("{}\n\x1b[2J.png")
    photos(tmp_path, names)
    (tmp_path / names[0]).write_bytes(b"")
    transforms(tmp_path, names)
    error, _ = refusal("convert", tmp_path, tmp_path / "out", "--to", "nerfcli")
    assert error == f"Error: {tmp_path}/0\\n\\x1b[2J.png is empty (0 bytes)"


def test_a_name_that_no_file_can_have_is_a_missing_photo(tmp_path):
    photos(tmp_path, numbered("{}.png")[1:])
    transforms(tmp_path, ["x" * 300 + ".png", *numbered("{}.png")[1:]])
    assert [frame.has_photo for frame in parse(tmp_path).frames] == [False, *[True] * (COUNT - 1)]


def test_a_lens_of_a_later_colmap_is_named_with_what_supports_it(tmp_path):
    put("colmap", tmp_path)
    path = tmp_path / "sparse/0/cameras.bin"
    path.write_bytes(path.read_bytes()[:12] + struct.pack("<i", 31) + path.read_bytes()[16:])
    what = r"cameras\.bin: camera 1 has the camera model 31, which COLMAP .* lacks"
    with pytest.raises(UserError, match=what) as caught:
        parse(tmp_path)
    assert "EQUIRECTANGULAR" in caught.value.hint


def put_sphere(form: str, folder: Path, *, height: int) -> None:
    """Put ordinary photos, of 640x480, and spherical cameras of 640 columns."""
    photos(folder / "images", numbered("{}.png"))
    if form == "transforms":
        transforms(folder, numbered("images/{}.png"), camera_model="equirectangular", w=640, h=height)
    else:
        colmap(folder, numbered("{}.png"))
        (folder / "sparse/0/cameras.txt").write_text(f"1 EQUIRECTANGULAR 640 {height} 640 {height}\n")


@pytest.mark.parametrize("form", ["transforms", "colmap"])
def test_a_sphere_that_is_not_two_to_one_is_refused(form, tmp_path):
    put_sphere(form, tmp_path, height=480)
    with pytest.raises(UserError, match="EQUIRECTANGULAR picture: 640x480") as caught:
        parse(tmp_path)
    assert "twice as wide as high" in caught.value.hint


@pytest.mark.parametrize("form", ["transforms", "colmap"])
def test_ordinary_photos_of_a_spherical_camera_are_refused(form, tmp_path):
    put_sphere(form, tmp_path, height=320)
    for command in (["convert", tmp_path, tmp_path / "out.json", "--to", "transforms"], ["info", tmp_path]):
        error, hint = refusal(*command)
        assert "0.png: a picture of 640x480 pixels does not match a camera of 640x320" in error
        assert "twice as wide as high" in hint


# Lenses

SAMPLE_PX = np.stack(np.meshgrid(np.linspace(2, 158, 27), np.linspace(2, 118, 21)), axis=-1).reshape(-1, 2)


def brown(x: np.ndarray, y: np.ndarray, focal: float, k: Sequence[float], skew: float) -> np.ndarray:
    """Return pixels of Brown's polynomial of any number of terms with skew, by the formula."""
    square = x * x + y * y
    factor = 1 + sum(term * square ** (power + 1) for power, term in enumerate(k))
    return np.stack([focal * x * factor + skew * y * factor + 80, focal * y * factor + 60], axis=-1)


@pytest.mark.parametrize(
    ("k", "skew", "said"),
    [
        ((-0.06, 0.03, -0.02, 0.05), 0.0, "k4 of 1 camera, which FULL_OPENCV does not have: at most 0.0088 px off"),
        ((-0.05, 0.0, 0.0, 0.0), 0.07, "skew of 1 camera, which SIMPLE_RADIAL does not have: at most 0.03 px off"),
    ],
)
def test_terms_that_no_lens_has_are_fitted_and_the_error_is_said(k, skew, said):
    fits = Fits()
    camera = fits.brown((160, 120), (140.0, 140.0), (80.0, 60.0), terms=Terms(k, skew=skew), where="here")
    x, y = (SAMPLE_PX - (80, 60)).T / 140
    pixels, _ = camera.project(np.stack([x, y, np.ones_like(x)], axis=-1))
    assert np.linalg.norm(pixels - brown(x, y, 140.0, k, skew), axis=1).max() < 0.1
    assert fits.notes() == (said,)


@pytest.mark.parametrize(
    ("size", "focal", "terms", "what"),
    [
        ((160, 120), 140.0, Terms(skew=0.6, skew_name="b2"), r"b2 is 0.6, .* off by 0.26 px"),
        ((4000, 3000), 2000.0, Terms((-0.06, 0.03, -0.02, 0.05)), r"k4 is 0.05, .* off by 0.25 px"),
    ],
)
def test_terms_that_matter_are_refused_by_name(size, focal, terms, what):
    """Skew moves the edge of the picture by skew height / (2 focal): 0.26 px."""
    with pytest.raises(UserError, match=what):
        Fits().brown(size, (focal, focal), (size[0] / 2, size[1] / 2), terms=terms, where="here")


def test_a_fisheye_with_tangential_terms_is_a_thin_prism_fisheye(tmp_path):
    content = written(tmp_path, camera_model="OPENCV_FISHEYE", k1=0.02, p1=0.001, p2=-0.002)
    camera = read_again(tmp_path, content).frames[0].camera
    assert camera == Camera("THIN_PRISM_FISHEYE", *SIZE, (*PINHOLE.params, 0.02, 0, 0.001, -0.002, 0, 0, 0, 0))


# Masks, groups


@pytest.mark.parametrize(
    ("photo", "on_disk", "listed", "lost"),
    [
        ("{}.png", "masks/0.png", ("C:\\x\\masks\\0.png", "masks/1.png", "", None), "masks/1.png"),
        # Named after the photo.
        ("{}.jpg", "masks/0.jpg.png", ("masks\\0.jpg", "1.jpg", "/"), "1.jpg"),
        ("{}.jpg", "masks/0_mask.png", ("masks\\0.jpg", "1.jpg", "/"), "1.jpg"),
    ],
)
def test_masks_under_other_names_and_those_that_are_missing(photo, on_disk, listed, lost, tmp_path):
    photos(tmp_path, [*numbered(photo), on_disk])
    content = transforms_record(numbered(photo))
    for frame, mask in zip(content["frames"], listed, strict=False):
        frame["mask_path"] = mask
    capture = read_again(tmp_path, content)
    assert [frame.mask for frame in capture.frames] == [tmp_path / on_disk, *[None] * (COUNT - 1)]
    assert capture.notes == (f"1 mask named in transforms.json left out, not found: {lost}",)


def test_masks_are_found_by_the_photos_as_they_are_on_disk(tmp_path):
    photos(tmp_path, [*numbered("images/my view {}.png"), "masks/my view 1.png"])
    transforms(tmp_path, numbered("images/my%20view%20{}.png"))
    capture = with_masks(parse(tmp_path), tmp_path / "masks")
    assert [frame.mask for frame in capture.frames] == [None, tmp_path / "masks/my view 1.png", *[None] * (COUNT - 2)]


def test_masks_of_photos_of_one_name_are_found_by_their_folders_on_disk(tmp_path):
    sides = ("left/my view.png", "right/my view.png")
    photos(tmp_path, [*(f"{folder}/{name}" for folder in ("images", "masks") for name in sides), "masks/my view.png"])
    transforms(tmp_path, [f"images/{name.replace(' ', '%20')}" for name in sides])
    capture = with_masks(parse(tmp_path), tmp_path / "masks")
    assert [frame.mask for frame in capture.frames] == [tmp_path / "masks" / name for name in sides]


def test_depth_maps_under_other_names_and_those_that_are_missing(tmp_path):
    content = written(tmp_path)
    names = ("0.png", "1.png", "0 left.png", "3.jpg", "3.png", "4.tif")  # 3.jpg is a preview
    photos(tmp_path, [f"depth/{name}" for name in names])
    (tmp_path / "depth/2.npy").touch()
    named = ("C:\\x\\depth\\0.png", "depth\\1.PNG", "depth/2.npy", "depth/3", "depth/4.tiff", "depth/5.png", "", None)
    for frame, depth in zip(content["frames"], named, strict=False):
        frame["depth_file_path"] = depth
    capture = read_again(tmp_path, content)
    maps = [None if frame.depth is None else frame.depth.path for frame in capture.frames]
    there = [tmp_path / "depth" / name for name in ("0.png", "1.png", "2.npy", "3.png", "4.tif")]
    assert maps == [*there, *[None] * (COUNT - 5)]
    assert capture.notes == ("1 depth map named in transforms.json left out, not found: depth/5.png",)


def test_a_preview_is_not_taken_for_the_depth_map(tmp_path):
    content = written(tmp_path)
    photos(tmp_path, ["depth/0.png", "depth/1.jpg"])
    content["frames"][0]["depth_file_path"] = "depth/0.npy"
    content["frames"][1]["depth_file_path"] = "depth/1"
    capture = read_again(tmp_path, content)
    assert [frame.depth for frame in capture.frames] == [None] * COUNT
    assert capture.notes == ("2 depth maps named in transforms.json left out, not found: depth/0.npy, depth/1",)


def test_equal_labels_of_metashape_are_told_apart_by_their_groups(tmp_path):
    put("metashape", tmp_path)
    path = tmp_path / "cameras.xml"
    photos(tmp_path / "images", ["left/0.jpg", "right/0.jpg"], size=CAMERA.size)
    replace_in(path, 'label="1"', 'label="0"')
    with pytest.raises(UserError, match="'0' is listed twice"):
        parse(path)
    tree = ElementTree.parse(path)
    cameras = tree.find("chunk/cameras")
    assert cameras is not None
    for side, camera in zip(("left", "right"), list(cameras)[:2], strict=True):
        cameras.remove(camera)
        ElementTree.SubElement(cameras, "group", label=side).append(camera)
    next(iter(cameras)).attrib.pop("label")
    tree.write(path)
    capture = parse(path)
    images = {frame.name: frame.image for frame in capture.frames}
    assert images["left/0"] == tmp_path / "images/left/0.jpg"
    assert images["right/0"] == tmp_path / "images/right/0.jpg"
    assert "1 of 8 cameras left out, without a label: id 2" in capture.notes


def test_keyframes_of_polycam_whose_corrected_cameras_lack_their_size(tmp_path):
    """Newer versions write width and height to cameras/ only."""
    put("polycam", tmp_path)
    home = tmp_path / "keyframes"
    shutil.copytree(home / "corrected_cameras", home / "cameras")
    for path in (home / "corrected_cameras").iterdir():
        content = json.loads(path.read_text())
        del content["width"], content["height"]
        path.write_text(json.dumps(content))
    capture = parse(tmp_path)
    assert_centres(capture, POSES[:, :3, 3])
    assert {frame.camera.size for frame in capture.frames} == {CAMERA.size}
    assert capture.notes == ()
    (home / "corrected_cameras/1002.json").unlink()
    assert parse(tmp_path).notes == ("1 of 8 keyframes left out, whose poses Polycam has not corrected",)
