"""Formats that fill a folder beside the photos: the same views written out by hand in each."""

import json
from pathlib import Path

import numpy as np
import pytest
from captures import refused
from every_format import WITH_PHOTOS, Views, change_json, matrix_text, parse, text
from test_every_format import POSES
from test_every_format import TWO_FOCAL_LENGTHS as CAMERA

from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import recognise
from nerfcli.errors import UserError

VIEWS = Views(CAMERA, POSES)
NAMES = ("pose-files", "mvsnet", "neus", "polycam", "record3d")


def write(name: str, folder: Path) -> Path:
    return WITH_PHOTOS[name](VIEWS, folder)


def photo(path: Path) -> None:
    VIEWS.put(0, path)


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_photo_is_listed(tmp_path, name):
    write(name, tmp_path)
    photos = sorted((*tmp_path.rglob("*.jpg"), *tmp_path.rglob("image/*.png")))
    photos[0].unlink()
    if name == "neus":  # pairs photos and cameras by order
        with pytest.raises(UserError, match="has 3 cameras, but there are 2 photos"):
            parse(tmp_path)
    else:
        capture = parse(tmp_path)
        assert capture.missing == (photos[0].stem,)
        np.testing.assert_allclose(capture.frames[0].world_from_cam, POSES[1], rtol=0, atol=1e-13)


OTHER_NAMES = [
    ("pose-files", "color", "images"),
    ("pose-files", "pose", "poses"),
    ("pose-files", "intrinsic/intrinsic_color.txt", "intrinsics.txt"),
    ("mvsnet", "images", "blended_images"),
    ("neus", "image", "images"),
    ("neus", "image", "rgb"),
    ("neus", "mask", "masks"),
    ("record3d", "rgb", "rgbd"),
    ("record3d", "rgb", "images"),
    ("record3d", "metadata.json", "metadata"),
]


@pytest.mark.parametrize(("name", "usual", "other"), OTHER_NAMES)
def test_other_names_of_folders_and_files_give_the_same_capture(tmp_path, name, usual, other):
    write(name, tmp_path)
    expected = parse(tmp_path)
    (tmp_path / usual).rename(tmp_path / other)
    found = parse(tmp_path)
    assert [frame.name for frame in found.frames] == [frame.name for frame in expected.frames]
    for frame, usual_frame in zip(found.frames, expected.frames, strict=True):
        np.testing.assert_array_equal(frame.world_from_cam, usual_frame.world_from_cam)
        assert frame.camera == usual_frame.camera
        assert frame.image is not None
        assert frame.image.is_file()
        assert (frame.mask is None) == (usual_frame.mask is None)


def test_photos_that_differ_only_in_suffix_are_refused(tmp_path):
    write("record3d", tmp_path)
    photo(tmp_path / "rgb/1.png")
    with pytest.raises(UserError, match=r"1: both rgb/1\.(png|jpg) and rgb/1\.(png|jpg) fit this name"):
        parse(tmp_path)


class TestPoseFiles:
    def test_7_scenes_has_everything_in_one_folder_and_its_camera_is_given(self, tmp_path):
        for index, pose in enumerate(POSES):
            photo(tmp_path / f"frame-{index:06d}.color.png")
            text(tmp_path / f"frame-{index:06d}.pose.txt", matrix_text(pose[:3]))
        with pytest.raises(UserError, match=r"has poses but no file of intrinsics") as caught:
            parse(tmp_path)
        assert "--intrinsics" in caught.value.hint
        twice = CAMERA.resized(128, 96)
        capture = parse(tmp_path, UserInputs(camera=twice))
        assert [frame.name for frame in capture.frames] == [f"frame-{index:06d}.color.png" for index in range(3)]
        np.testing.assert_allclose([frame.world_from_cam for frame in capture.frames], POSES, rtol=0, atol=1e-13)
        assert {frame.camera for frame in capture.frames} == {CAMERA}

    def test_frames_that_were_not_tracked_are_left_out_and_numbers_are_in_order(self, tmp_path):
        write("pose-files", tmp_path)
        photo(tmp_path / "color/10.jpg")
        text(tmp_path / "pose/10.txt", matrix_text(POSES[0]))
        text(tmp_path / "pose/1.txt", "-inf " * 12 + "0 0 0 1")
        capture = parse(tmp_path)
        assert [frame.name for frame in capture.frames] == ["0.jpg", "2.jpg", "10.jpg"]
        assert capture.missing == ()

    def test_names_of_nsvf_give_the_split_and_srn_gives_the_size_of_its_intrinsics(self, tmp_path):
        for split, pose in enumerate(POSES):
            photo(tmp_path / f"rgb/{split}_a_0000.png")
            text(tmp_path / f"pose/{split}_a_0000.txt", " ".join(map(repr, pose.ravel().tolist())))
        text(tmp_path / "intrinsics.txt", "140 60.5 51 0.\n0. 0. 0.\n1.\n96 128\n")
        capture = parse(tmp_path)
        assert [frame.split for frame in capture.frames] == ["train", "val", "test"]
        assert {frame.camera for frame in capture.frames} == {Camera("PINHOLE", 64, 48, (70.0, 70.0, 30.25, 25.5))}
        photo(tmp_path / "rgb/more.png")
        text(tmp_path / "pose/more.txt", matrix_text(POSES[0]))
        assert {frame.split for frame in parse(tmp_path).frames} == {None}

    @pytest.mark.parametrize(
        ("content", "what"),
        [
            ("70 0 30\n0 70 25\n", "has lines of 3, 3 numbers"),
            ("", "is empty"),
            ("70 1.0 30\n0 70 25\n0 0 1\n", r"skew is 1, which no supported lens has, .* off by \d"),
            ("70 0 30\n0 70 25\n0 0 2\n", "is not a matrix of intrinsics"),
            ("70 0 30\n0 -70 25\n0 0 1\n", "invalid parameters"),
            ("70 30 25 0\n48 64.5\n", "width and height are 64.5 and 48"),
        ],
    )
    def test_intrinsics_that_are_none_are_refused(self, tmp_path, content, what):
        write("pose-files", tmp_path)
        path = text(tmp_path / "intrinsic/intrinsic_color.txt", content)
        with refused(what, path):
            parse(tmp_path)


class TestMvsnet:
    @pytest.mark.parametrize(
        ("depths", "bounds"),
        [("2 0.5 64", (2, 34)), ("2 0.5 64 30", (2, 30)), ("2 0.5", None), ("", None), ("2 0.5 64 1", None)],
    )
    def test_depth_bounds(self, tmp_path, depths, bounds):
        write("mvsnet", tmp_path)
        for path in (tmp_path / "cams").iterdir():
            path.write_text(path.read_text().replace("2.5 0.01", depths))
        found = parse(tmp_path).depth_bounds
        if bounds is None:
            assert found is None
        else:
            np.testing.assert_array_equal(found, [bounds] * 3)


class TestNeus:
    def test_masks_belong_to_photos_in_order(self, tmp_path):
        write("neus", tmp_path)
        masks = [frame.mask for frame in parse(tmp_path).frames]
        assert masks == [tmp_path / f"mask/{index:03d}.png" for index in range(3)]
        (tmp_path / "mask/001.png").unlink()
        assert {frame.mask for frame in parse(tmp_path).frames} == {None}

    def test_one_camera_rounded_to_float32_stays_one(self, tmp_path):
        path = write("neus", tmp_path)
        with np.load(path) as arrays:
            rounded = {name: array.astype(np.float32) for name, array in arrays.items()}
        np.savez(path, **rounded)
        capture = parse(tmp_path)
        assert len({frame.camera for frame in capture.frames}) == 1
        np.testing.assert_allclose(capture.frames[0].camera.params, CAMERA.params, rtol=1e-5)
        rounded["world_mat_1"] = np.diag([1.01, 1, 1, 1]) @ rounded["world_mat_1"]
        np.savez(path, **rounded)
        assert len({frame.camera for frame in parse(tmp_path).frames}) == 3

    def test_a_projection_of_no_camera_is_refused(self, tmp_path):
        path = write("neus", tmp_path)
        with np.load(path) as arrays:
            changed = dict(arrays)
        for damaged in (np.zeros((4, 4)), np.diag([1, 1, 0, 1]), np.full((4, 4), np.nan)):
            np.savez(path, **(changed | {"world_mat_2": damaged}))
            with pytest.raises(UserError, match="world_mat_2: is not the projection of a camera"):
                parse(tmp_path)
        for array, what in ((np.eye(3), r"\(3, 3\) values of type float64"), (np.array([{}]), "values of type object")):
            np.savez(path, **(changed | {"world_mat_2": array}))
            with pytest.raises(UserError, match=f"world_mat_2: .*{what}"):
                parse(tmp_path)


class TestPolycam:
    @pytest.mark.parametrize("corrected_cameras", [False, True])
    def test_a_capture_without_corrected_photos_has_the_poses_of_arkit(self, tmp_path, corrected_cameras):
        write("polycam", tmp_path)
        for name in ("cameras", "images"):
            (tmp_path / f"keyframes/corrected_{name}").rename(tmp_path / f"keyframes/{name}")
        if corrected_cameras:
            text(tmp_path / "keyframes/corrected_cameras/1000.json", "{}")
        capture = parse(tmp_path / "keyframes")
        np.testing.assert_allclose([frame.world_from_cam for frame in capture.frames], POSES, rtol=0, atol=1e-13)


class TestRecord3d:
    def test_the_focus_may_move(self, tmp_path):
        rows = [[70.0 + index, 71.5, 30.25, 25.5] for index in range(len(POSES))]
        change_json(write("record3d", tmp_path), perFrameIntrinsicCoeffs=rows)
        assert [frame.camera.params for frame in parse(tmp_path).frames] == [tuple(row) for row in rows]

    @pytest.mark.parametrize(
        ("change", "what"),
        [
            ({"poses": [[0, 0, 0, 2, 1, 1, 1]] * 3}, r"poses\[0\]: its quaternion has length 2"),
            ({"poses": []}, "poses is a list of 0"),
            ({"perFrameIntrinsicCoeffs": [[70, 70, 32, 24]]}, "is a list of 1"),
            ({"w": 63.5}, "width and height are 63.5"),
        ],
    )
    def test_damaged_metadata_is_refused_with_its_field(self, tmp_path, change, what):
        change_json(write("record3d", tmp_path), **change)
        with pytest.raises(UserError, match=what):
            parse(tmp_path)

    def test_metadata_of_another_program_is_not_taken_for_it(self, tmp_path):
        text(tmp_path / "metadata.json", json.dumps({"poses": 3}))
        with pytest.raises(UserError, match="contains no capture in a supported format"):
            recognise(tmp_path)
