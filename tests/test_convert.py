"""Conversions: round trips through every writable format, losses, faults that reading back must see, exit codes."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import photograph, reprojection_px, with_photos
from commands import completed, error_of, listing, nerfcli, refusal
from every_format import parse
from views import BROWN, FISHEYE, PANORAMA, PINHOLE, PRISM, RADIAL, RATIONAL, SQUARE, capture_of

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.axes import Convention, all_axes, expressed, opencv_from_axes, pose_in_axes, reinterpreted
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.conversion import TargetOptions, convert
from nerfcli.captures.formats import blender, llff, transforms, transforms_cameras
from nerfcli.captures.formats.colmap import write_colmap_binary
from nerfcli.captures.formats.ply import write_points
from nerfcli.captures.formats.registry import FORMATS, format_named
from nerfcli.cli.convert import FORMATS_WRITTEN
from nerfcli.errors import BAD_INPUT, GATE_NOT_MET, UserError

USAGE = 2
LIMIT_PX = 1e-6


def model_of(tmp_path: Path, capture: Capture) -> Path:
    """Write a model, and pictures beside it if there are none."""
    if not any(frame.has_photo for frame in capture.frames):
        photograph(with_photos(capture, tmp_path / "images").frames)
    write_colmap_binary(capture, tmp_path / "in")
    return tmp_path / "in"


# Axes


def test_named_axes_are_those_of_the_other_programs():
    np.testing.assert_array_equal(opencv_from_axes("opencv"), np.eye(4))
    # OpenGL: x right, y up, z backward. LLFF: x down, y right, z backward.
    np.testing.assert_array_equal(opencv_from_axes("opengl"), np.diag([1.0, -1.0, -1.0, 1.0]))
    np.testing.assert_array_equal(opencv_from_axes("llff")[:3, :3], [[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    # PyTorch3D: x left, y up, z forward. ROS: x forward is OpenCV's z, y left is -x, z up is -y.
    np.testing.assert_array_equal(opencv_from_axes("pytorch3d"), np.diag([-1.0, -1.0, 1.0, 1.0]))
    np.testing.assert_array_equal(opencv_from_axes("ros")[:3, :3], [[0, -1, 0], [0, 0, -1], [1, 0, 0]])


def test_there_are_24_right_handed_axes():
    turns = np.array([opencv_from_axes(axes)[:3, :3] for axes in all_axes()])
    assert len(np.unique(turns.reshape(-1, 9), axis=0)) == len(turns) == 24
    np.testing.assert_array_equal(np.linalg.det(turns), 1)


@pytest.mark.parametrize(
    ("axes", "message"), [("ruf", "left-handed"), ("rud", "unknown"), ("rrd", "unknown"), ("blend", "unknown")]
)
def test_axes_that_there_are_not(axes, message):
    with pytest.raises(UserError, match=message):
        opencv_from_axes(axes)


@pytest.mark.parametrize("axes", ["opencv", "llff", "ros"])
@pytest.mark.parametrize("centre", [0.5, 0.0])
def test_reading_in_a_convention_undoes_writing_in_it(axes, centre):
    capture = capture_of([PINHOLE, BROWN])
    convention = Convention(axes, pixel_centre=centre)
    again = reinterpreted(expressed(capture, convention, written_axes="opengl"), convention, parsed_axes="opengl")
    assert reprojection_px(capture, again) < 1e-9
    assert again.observations is not None
    assert capture.observations is not None
    np.testing.assert_allclose(again.observations.pixels, capture.observations.pixels, rtol=0, atol=1e-12)


@pytest.mark.parametrize("option", ["--axes", "--from-axes"])
def test_empty_axes_are_refused(option, tmp_path):
    """Regression: they counted as those of the format, as if the option were not given."""
    source = model_of(tmp_path, capture_of([PINHOLE]))
    result = nerfcli("convert", source, tmp_path / "out.json", "--to", "transforms", option, "")
    assert result.exit_code == USAGE
    assert "names no axes" in result.stderr
    assert option in result.stderr
    assert not (tmp_path / "out.json").exists()


def test_an_unknown_format_is_reported_with_the_known_ones():
    """Regression: a bare KeyError."""
    with pytest.raises(UserError, match="unknown format 'nerfstudio'") as raised:
        format_named("nerfstudio")
    assert raised.value.exit_code == USAGE
    assert all(form.name in raised.value.hint for form in FORMATS)


# Round trips

EVERYTHING = [PINHOLE, BROWN, RATIONAL, FISHEYE, PRISM, PANORAMA]
CAMERAS = {
    "transforms": [PINHOLE, BROWN, FISHEYE],
    "opensfm": [PINHOLE, BROWN, FISHEYE, RADIAL],
    "blender": [SQUARE],
    "llff": [SQUARE],
}


@pytest.mark.parametrize("program", ["nerfstudio", "instant-ngp"])
def test_programs_that_read_transforms_name_it(program, tmp_path):
    source = model_of(tmp_path, capture_of([PINHOLE]))
    named = completed("convert", source, tmp_path / "program.json", "--to", program, "--json")
    assert json.loads(named.stdout)["to"] == "transforms"
    nerfcli("convert", source, tmp_path / "form.json", "--to", "transforms")
    cameras = [json.loads((tmp_path / name).read_text())["frames"] for name in ("program.json", "form.json")]
    assert cameras[0] == cameras[1]
    assert cameras[0]


@pytest.mark.parametrize("form", [name for name in FORMATS_WRITTEN if name != "ply"])
def test_colmap_to_a_format_and_back_moves_no_pixel(form, tmp_path):
    capture = capture_of(CAMERAS.get(form, EVERYTHING))
    capture = with_photos(capture, tmp_path / "images")
    photograph(capture.frames)
    source = model_of(tmp_path, capture)
    there = completed("convert", source, tmp_path / "there", "--to", form, "--allow-loss", "--json")
    report = json.loads(there.stdout)
    assert report["read_back"]["max_px"] < LIMIT_PX
    assert report["read_back"]["rays"] > 100
    more = ["--images", tmp_path / "images"]
    if form in ("tum", "kitti"):
        one = {"model": "PINHOLE", "width": 640, "height": 480, "params": PINHOLE.params}
        (tmp_path / "camera.json").write_text(json.dumps(one))
        more = ["--intrinsics", tmp_path / "camera.json"]
        capture = replace(capture, frames=tuple(replace(frame, camera=PINHOLE) for frame in capture.frames))
    completed("convert", report["path"], tmp_path / "back", "--to", "colmap", "--allow-loss", *more)
    again = parse(tmp_path / "back")
    assert reprojection_px(capture, again) < LIMIT_PX


def test_axes_and_pixel_centre_of_the_written_file(tmp_path):
    """By hand: with OpenCV axes the matrix is world_from_cam itself, and with centres at 0 cx is half a pixel less."""
    source, out = model_of(tmp_path, capture_of([PINHOLE])), tmp_path / "out.json"
    capture = parse(source)
    options = ("--axes", "opencv", "--pixel-center", "0", "--allow-loss")
    completed("convert", source, out, "--to", "transforms", *options)
    content = json.loads(out.read_text())
    matrix = content["frames"][0]["transform_matrix"]
    np.testing.assert_allclose(matrix, capture.frames[0].world_from_cam, rtol=0, atol=1e-15)
    assert content["cx"] == PINHOLE.params[2] - 0.5
    options = ("--from-axes", "opencv", "--from-pixel-center", "0")
    assert nerfcli("convert", out, tmp_path / "back", "--to", "colmap", *options).exit_code == 0
    assert reprojection_px(capture, parse(tmp_path / "back")) < LIMIT_PX


@pytest.mark.parametrize(
    ("form", "options", "message"),
    [
        ("colmap", ("--axes", "opengl"), "colmap prescribes the camera axes"),
        ("opensfm", ("--pixel-center", "0"), "opensfm prescribes the pixel convention"),
    ],
)
def test_a_convention_that_the_format_fixes_is_refused(form, options, message, tmp_path):
    source = model_of(tmp_path, replace(capture_of([PINHOLE]), observations=None))
    assert message in refusal("convert", source, tmp_path / "out", "--to", form, *options)[0]
    assert not (tmp_path / "out").exists()


def test_intrinsics_for_a_format_that_has_its_own_are_refused(tmp_path):
    """They were ignored without a word."""
    source = model_of(tmp_path, capture_of([PINHOLE]))
    (tmp_path / "camera.json").write_text(json.dumps(SQUARE.to_json()))
    options = ("--to", "transforms", "--intrinsics", tmp_path / "camera.json")
    error, hint = refusal("convert", source, tmp_path / "out.json", *options, exit_code=USAGE)
    assert "colmap captures have their own cameras" in error
    assert "tum, kitti" in hint
    assert not (tmp_path / "out.json").exists()
    (tmp_path / "blender").mkdir()
    (tmp_path / "blender/transforms_train.json").write_text("{}")
    error, _ = refusal("convert", tmp_path / "blender", tmp_path / "out.json", *options, exit_code=USAGE)
    assert "blender captures have their own cameras" in error


def test_a_file_that_holds_the_inverse_is_read_so(tmp_path):
    capture = capture_of([PINHOLE])
    photograph(with_photos(capture, tmp_path).frames)
    content = {"w": 640, "h": 480, "fl_x": 500.0, "fl_y": 505.0, "cx": 321.25, "cy": 238.5, "frames": []}
    for frame in capture.frames:
        matrix = np.linalg.inv(frame.world_from_cam).tolist()
        content["frames"].append({"file_path": frame.name, "transform_matrix": matrix})
    (tmp_path / "wrong.json").write_text(json.dumps(content))
    options = ("--from-axes", "opencv", "--from-inverted")
    completed("convert", tmp_path / "wrong.json", tmp_path / "out", "--to", "colmap", *options)
    assert reprojection_px(capture, parse(tmp_path / "out")) < LIMIT_PX


def test_intrinsics_for_another_size(tmp_path):
    """Intrinsics for twice the resolution, principal point off the middle, in a file with the size of the photos."""
    double = Camera("PINHOLE", 640, 480, (1000.0, 1010.0, 642.5, 477.0))
    source = model_of(tmp_path, capture_of([double]))
    result = completed("convert", source, tmp_path / "out", "--to", "colmap", "--from-size", "2")
    assert "principal point" not in result.stderr
    assert parse(tmp_path / "out").frames[0].camera == PINHOLE
    warned = nerfcli("convert", source, tmp_path / "as-it-is", "--to", "colmap").stderr
    assert "principal point of" in " ".join(warned.split())
    assert "--from-size" in warned


def test_the_world_frame_and_its_scale(tmp_path):
    capture = capture_of([PINHOLE])
    first, second = capture.frames[:2]
    metres = 2.5 * float(np.linalg.norm(first.centre - second.centre))
    photograph(with_photos(capture, tmp_path / "images").frames)
    out = tmp_path / "out"
    distance = f"{','.join(map(str, first.centre))} {','.join(map(str, second.centre))} {metres}"
    options = ("--origin", "centre-of-cameras", "--world-up", "-y", "--distance", distance, "--json")
    result = completed("convert", model_of(tmp_path, capture), out, "--to", "nerfcli", *options)
    again = parse(out)
    centres = np.array([frame.centre for frame in again.frames])
    np.testing.assert_allclose(centres.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(centres[0] - centres[1]), metres, rtol=1e-12)
    assert again.unit == "metre"
    change = rigid.Similarity.from_json(json.loads(result.stdout)["new_from_old"])
    np.testing.assert_allclose(change.apply(capture.points), again.points, rtol=0, atol=1e-12)
    assert change.scale == pytest.approx(2.5, rel=1e-12)


@pytest.mark.parametrize(
    "options", [("--markers", "DICT_4X4_50"), ("--markers", "DICT_4X4_50:0.05", "--scale", "2"), ("--scale", "-1")]
)
def test_a_scale_that_says_nothing_or_two_of_them(options, tmp_path):
    source = model_of(tmp_path, capture_of([PINHOLE]))
    assert nerfcli("convert", source, tmp_path / "out", "--to", "colmap", *options).exit_code == USAGE
    assert not (tmp_path / "out").exists()


# Losses


@pytest.mark.parametrize(
    ("form", "camera", "lost"),
    [
        ("transforms", RATIONAL, "k4 of 1 camera"),
        ("transforms", PRISM, "sx1 of 1 camera"),
        ("opensfm", RATIONAL, "k4 of 1 camera"),
        ("llff", BROWN, "k1 of 1 camera"),
        ("blender", BROWN, "k1 of 1 camera"),
        ("tum", BROWN, "intrinsics of 1 camera"),
    ],
)
def test_losses_are_refused_and_named_then_accepted(form, camera, lost, tmp_path):
    capture = capture_of([camera])
    source = model_of(tmp_path, capture)
    before = listing(tmp_path)
    result = nerfcli("convert", source, tmp_path / "out", "--to", form)
    assert result.exit_code == BAD_INPUT
    assert lost in error_of(result)[0]
    assert "--allow-loss" in error_of(result)[1]
    assert result.stdout == ""
    assert listing(tmp_path) == before
    accepted = completed("convert", source, tmp_path / "out", "--to", form, "--allow-loss", "--json")
    assert f"{form} cannot hold {lost}" in accepted.stderr
    report = json.loads(accepted.stdout)
    assert any(lost in clause for clause in report["losses"])
    assert report["read_back"]["max_px"] < LIMIT_PX


def test_features_are_left_out_with_a_warning(tmp_path):
    capture = capture_of([PINHOLE])
    seen = Observations(np.zeros(3, np.int64), np.arange(3), np.ones((3, 2)))
    source = model_of(tmp_path, replace(capture, observations=seen))
    result = completed("convert", source, tmp_path / "out.json", "--to", "transforms")
    assert "Warning: transforms cannot hold 3 observations" in result.stderr


def test_the_effect_of_a_lost_term_is_reported_in_pixels(tmp_path):
    """The loss of the distortion moves pixels by at most f k r^3 at the corner of the picture."""
    source = model_of(tmp_path, capture_of([RADIAL]))
    result = completed("convert", source, tmp_path / "out", "--to", "llff", "--allow-loss", "--json")
    (corner,), _ = RADIAL.bearings(np.zeros((1, 2)))
    most = 500 * 0.05 * np.hypot(corner[0] / corner[2], corner[1] / corner[2]) ** 3
    assert 0.3 * most < json.loads(result.stdout)["loss_px"] < most


# Faults of writers, as the parser of the format finds them


def half_a_pixel(camera: Camera) -> dict[str, Any]:
    content = transforms_cameras.record_of_camera(camera)
    return {**content, "cx": content["cx"] + 0.5, "cy": content["cy"] + 0.5}


FAULTS = {
    "half a pixel": ("transforms", transforms, "record_of_camera", half_a_pixel, "a ray is off by 0.707 px"),
    "flipped axes": ("blender", blender, "pose_in_axes", lambda pose, axes: pose, "a ray is off by"),
    "axes of OpenGL": ("llff", llff, "pose_in_axes", lambda pose, _: pose_in_axes(pose, "opengl"), "a ray is off by"),
    "moved points": (
        *("transforms", transforms, "write_points"),
        *(lambda c, path: write_points(replace(c, points=c.points[:, ::-1]), path), "60 points instead of 60, or"),
    ),
    "no PLY file": ("transforms", transforms, "write_points", lambda c, path: None, "reading it back fails"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_a_writer_is_found_and_nothing_is_kept(name, tmp_path, monkeypatch):
    form, module, function, fault, message = FAULTS[name]
    source = model_of(tmp_path, capture_of([SQUARE]))
    before = listing(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(module, function, fault)
        result = nerfcli("convert", source, tmp_path / "new" / "out", "--to", form, "--allow-loss")
    assert result.exit_code == GATE_NOT_MET, result.stderr
    assert message in error_of(result)[0]
    assert result.stdout == ""
    assert listing(tmp_path) == before
    assert not (tmp_path / "new").exists()
    assert nerfcli("convert", source, tmp_path / "out", "--to", form, "--allow-loss").exit_code == 0


def test_coordinates_of_the_globe_are_compared_as_finely_as_float64_can(tmp_path):
    """At 5,000 km from the origin and 4 m from the scene, rounding alone moves pixels by about 1e-6."""
    capture = capture_of([PINHOLE])
    moved = tuple(
        replace(f, world_from_cam=rigid.from_parts(f.world_from_cam[:3, :3], f.centre + 5e6)) for f in capture.frames
    )
    capture = replace(capture, frames=moved, points=capture.points + 5e6)
    done = convert(capture, tmp_path / "out", TargetOptions(format_named("colmap")))
    assert done.check.max_px < 1e-6 < done.check.tolerance_px < 1e-5


def test_points_alone(tmp_path):
    source = model_of(tmp_path, capture_of([PINHOLE]))
    result = completed("convert", source, tmp_path / "points.ply", "--to", "ply", "--allow-loss")
    assert "6 cameras and their poses" in result.stderr
    assert result.stderr.endswith("points.ply: read back\n")
    capture = capture_of([PINHOLE])
    shifted = replace(capture, points=capture.points + 1e-9)
    wrong = replace(format_named("ply"), write=lambda _, path: write_points(shifted, path))
    with pytest.raises(UserError, match="60 points instead of 60, or other positions"):
        convert(capture, tmp_path / "2.ply", TargetOptions(wrong, allow_loss=True))


# The command


def test_stdout_is_the_path_and_stderr_the_report(tmp_path):
    source = model_of(tmp_path, capture_of([PINHOLE]))
    result = nerfcli("convert", source, tmp_path / "out", "--to", "colmap")
    assert result.stdout == f"{tmp_path / 'out'}\n"
    assert "216 rays are off by at most" in result.stderr
    quiet = nerfcli("convert", source, tmp_path / "out", "--to", "colmap", "--overwrite", "--quiet")
    assert (quiet.exit_code, quiet.stderr) == (0, "")


@pytest.mark.parametrize(
    ("out", "form", "more", "message"),
    [
        ("out.json", "transforms", (), "out.json exists"),
        ("out.json", "colmap", (), "out.json is a file"),
        ("out.json", "colmap", ("--overwrite",), "out.json is a file"),
        ("out.json/model", "colmap", (), "cannot write"),
        ("photos", "colmap", ("--overwrite",), "photos"),
    ],
)
def test_what_is_in_the_way_is_kept(out, form, more, message, tmp_path):
    source = model_of(tmp_path, capture_of([PINHOLE]))
    (tmp_path / "out.json").write_text("mine")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"photo")
    before = listing(tmp_path)
    assert message in refusal("convert", source, tmp_path / out, "--to", form, "--allow-loss", *more)[0]
    assert listing(tmp_path) == before


def test_many_captures_each_under_its_name(tmp_path):
    photograph(with_photos(capture_of([PINHOLE]), tmp_path / "images").frames)
    for name in ("one", "two"):
        write_colmap_binary(capture_of([PINHOLE]), tmp_path / name)
    lines = f"{tmp_path / 'one'}\n{tmp_path / 'three'}\n{tmp_path / 'two'}\n"
    result = nerfcli("convert", "-", tmp_path / "out", "--to", "colmap", stdin=lines)
    assert result.exit_code == BAD_INPUT
    assert result.stdout.split() == [str(tmp_path / "out" / "one"), str(tmp_path / "out" / "two")]
    assert f"{tmp_path / 'three'}" in error_of(result)[0]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("out", "--to", "colmpa"), "colmpa"),
        (("--to", "colmap"), "OUT"),
        (("out", "--detect"), "--detect"),
        (("out", "--to", "colmap", "--pixel-center", "1"), "--pixel-center"),
        *((("out", "--to", "ply", "--scale", factor), "--scale") for factor in ("0", "-1", "nan", "1e-300", "1e300")),
    ],
)
def test_wrong_usage(options, named, tmp_path):
    result = nerfcli("convert", model_of(tmp_path, capture_of([PINHOLE])), *options)
    assert result.exit_code == USAGE
    assert named in result.stderr


@pytest.mark.parametrize("prefix", ["", "images/"])
def test_photos_of_a_model_are_found_whatever_its_names_are_relative_to(prefix, tmp_path):
    capture = replace(capture_of([PINHOLE]), observations=None)
    photograph(with_photos(capture, tmp_path / "images").frames)
    capture = replace(capture, frames=tuple(replace(f, name=prefix + f.name) for f in capture.frames))
    convert(capture, tmp_path / "sparse" / "0", TargetOptions(format_named("colmap")))
    completed("convert", tmp_path, tmp_path / "elsewhere" / "transforms.json", "--to", "transforms")
    content = json.loads((tmp_path / "elsewhere" / "transforms.json").read_text())
    assert content["frames"][0]["file_path"] == "../images/photo 00.png"


def test_help_names_all_formats():
    text = nerfcli("convert", "--help").stdout
    read, written = text.split("Formats read:")[1].split("Inside")[0].split("Formats written:")
    intrinsics = text.rsplit("--intrinsics", 1)[1].split("--world-up")[0].replace("│", "")
    for form in FORMATS:
        assert (form.write is None) == (form.name not in FORMATS_WRITTEN)
        assert form.write is None or form.name in written
        assert form.name == "ply" or form.name.removesuffix("-text") in read
        assert not form.takes_camera or form.name in re.split(r"[\s,:]+", intrinsics)
