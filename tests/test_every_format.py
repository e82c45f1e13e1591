"""Training reads every format of captures: the same views, written in each, have the same cameras and photos."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from every_format import WITH_PHOTOS, Views, parse
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import FORMATS, recognise
from nerfcli.captures.loading import describe_source, load_scene
from nerfcli.errors import BAD_INPUT, UserError

CAMERA = Camera.pinhole(64, 48, 70.0)  # the only kind of lens that all formats hold
ONE_FOCAL_LENGTH = Camera("PINHOLE", 64, 48, (70.0, 70.0, 30.25, 25.5))
TWO_FOCAL_LENGTHS = Camera("PINHOLE", 64, 48, (70.0, 71.5, 30.25, 25.5))
# The lens that a format's sample can have, if that is not one with two focal lengths.
LENSES = {
    **dict.fromkeys(("blender", "llff", "bundler"), CAMERA),
    **dict.fromkeys(("metashape", "reality-capture", "openmvg"), ONE_FOCAL_LENGTH),
}
METRIC = ("polycam", "record3d", "stray-scanner", "3d-scanner-app", "euroc", "tum-rgbd", "scannetpp", "run")
ROTATIONS = Rotation.from_rotvec([[0.1, -0.4, 0.2], [1.3, 0.2, -0.7], [-0.5, 2.1, 0.3]])
POSES = rigid.from_parts(ROTATIONS.as_matrix(), np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 2.0], [0.1, -3.0, 1.5]]))
VIEWS = Views(CAMERA, POSES)
VIEW = np.eye(4).ravel().tolist()
WITHOUT_PHOTOS = {
    "camera-path": (
        "camera_path.json",
        json.dumps({"render_height": 48, "render_width": 64, "camera_path": [{"camera_to_world": VIEW, "fov": 60}]}),
    ),
    "tum": ("trajectory.txt", "0 1 2 3 0 0 0 1\n"),
    "kitti": ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n"),
}


def test_every_format_that_is_read_is_tested():
    assert {*WITH_PHOTOS, *WITHOUT_PHOTOS} == {form.name for form in FORMATS} - {"ply"}


@pytest.mark.parametrize("name", WITH_PHOTOS)
def test_a_capture_with_photos_is_trained_on(name, tmp_path):
    camera = LENSES.get(name, TWO_FOCAL_LENGTHS)
    file = WITH_PHOTOS[name](Views(camera, POSES), tmp_path)
    place = file if name == "run" else tmp_path  # a folder of a run is taken for a mistake
    scene = load_scene(place)
    kind = name.removesuffix("-text")
    assert (scene.kind, scene.missing, scene.notes, len(scene.frames)) == (kind, (), (), 3)
    assert scene.unit == ("metre" if name in METRIC else "arbitrary")
    assert len(scene.test_frames) == 1
    for frame in scene.frames:
        index = int(re.findall(r"\d+", Path(frame.name).stem)[-1]) % 1000
        np.testing.assert_allclose(frame.world_from_cam, POSES[index], rtol=0, atol=1e-12)
        assert frame.camera.size == camera.size
        np.testing.assert_allclose(frame.camera.focal_lengths, camera.focal_lengths, rtol=1e-12)
        np.testing.assert_allclose(frame.camera.principal_point, camera.principal_point, rtol=1e-12)
        assert frame.has_photo
    assert re.fullmatch(rf"{tmp_path}.*: {kind} \(.+\), 3 of 3 photos on disk", describe_source(place, scene))
    if file.is_file() and name not in ("nerfcli", "polycam", "mvsnet", "pose-files"):  # found by a file, not a folder
        assert load_scene(file).kind == kind


@pytest.mark.parametrize("name", ["colmap", "reality-capture", "realityscan-xmp"])
def test_photos_that_a_model_does_not_place_are_counted(name, tmp_path):
    """Regression: a model of 3 of 87 photos was trained on without a word about the others."""
    WITH_PHOTOS[name](VIEWS, tmp_path)
    scene = load_scene(tmp_path)
    first = scene.frames[0].image
    assert first is not None
    layers = (f"{first.name}.mask.png", f"{first.name}.texture.jpg", f"{first.stem}_mask.png")  # not photos
    for other in ("y.jpg", "z.jpg", "notes.txt", *layers):
        shutil.copy(first, first.with_name(other))
    text = describe_source(tmp_path, scene)
    assert "3 of 3 photos on disk; 2 photos beside them, such as y.jpg, without a pose" in text
    assert text.endswith(f"run nerfcli poses {first.parent}")


@pytest.mark.parametrize("name", WITH_PHOTOS)
def test_a_capture_without_photos_says_how_to_give_them(name, tmp_path):
    WITH_PHOTOS[name](VIEWS, tmp_path)
    for photo in (*tmp_path.rglob("*.jpg"), *tmp_path.rglob("*.png")):
        photo.unlink()
    with pytest.raises(UserError) as caught:
        load_scene(tmp_path / "cameras.json" if name == "run" else tmp_path)
    assert caught.value.exit_code == BAD_INPUT
    assert str(tmp_path) in caught.value.message
    assert "--images" in caught.value.hint or name in ("blender", "llff")


@pytest.mark.parametrize("name", WITH_PHOTOS)
def test_photos_in_another_folder_are_given(name, tmp_path, monkeypatch):
    file = WITH_PHOTOS[name](VIEWS, tmp_path / "capture")
    (tmp_path / "elsewhere").mkdir()
    for photo in [path for path in (tmp_path / "capture").rglob("*") if path.suffix in (".jpg", ".png")]:
        if photo.parent.name != "mask":
            photo.rename(tmp_path / "elsewhere" / photo.name)
    source = file if name == "run" else tmp_path / "capture"
    monkeypatch.chdir(tmp_path)
    for images in (tmp_path / "elsewhere", Path("elsewhere")):
        frames = parse(source, UserInputs(images=images)).frames
        assert len(frames) == len(POSES)
        assert all(frame.has_photo for frame in frames)
        assert {frame.image.absolute().parent for frame in frames if frame.image} == {tmp_path / "elsewhere"}


@pytest.mark.parametrize("name", WITHOUT_PHOTOS)
def test_poses_alone_are_no_scene(name, tmp_path):
    file, content = WITHOUT_PHOTOS[name]
    (tmp_path / file).write_text(content)
    assert recognise(tmp_path / file)[0].name == name
    with pytest.raises(UserError, match=file):
        load_scene(tmp_path / file)
