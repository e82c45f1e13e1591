"""Scenes: finding the format of a folder, the held-out split, nerfcli's own scene.json, and the fingerprint."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from captures import put_photos, refused
from every_format import change_json

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.colmap import write_colmap_binary
from nerfcli.captures.formats.scene_folder import save
from nerfcli.captures.formats.transforms import parse_transforms
from nerfcli.captures.loading import fingerprint, load_scene
from nerfcli.errors import BAD_INPUT, UserError

NAMES = [f"photo {index:02d}.jpg" for index in range(10)]


def write_transforms(folder: Path, names: list[str], *, file: str = "transforms.json") -> None:
    frames = []
    for index, name in enumerate(names):
        pose = np.eye(4)
        pose[0, 3] = index
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    content = {"fl_x": 50.0, "w": 64, "h": 48, "frames": frames}
    (folder / file).write_text(json.dumps(content), encoding="utf-8")


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """A COLMAP model of ten images of 1024 x 768, by pycolmap."""
    folder = tmp_path_factory.mktemp("model")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 30
    pycolmap.set_random_seed(0)
    reconstruction = pycolmap.synthesize_dataset(options)
    for name, image in zip(NAMES, reconstruction.images.values(), strict=True):
        image.name = name
    reconstruction.write_binary(str(folder))
    return folder


@pytest.fixture
def own(tmp_path, model) -> Path:
    """A scene as `nerfcli poses` leaves it: photos beside it, sparse/0 and scene.json in it."""
    put_photos(tmp_path / "photos", *NAMES)
    folder = tmp_path / "photos-scene"
    shutil.copytree(model, folder / "sparse/0")
    save(folder, image_folder=tmp_path / "photos", provenance={"command": "poses"})
    return folder


def test_splits_that_nerfstudio_lists_are_kept(tmp_path):
    names = [f"{name}.png" for name in "abcd"]
    put_photos(tmp_path, *names)
    write_transforms(tmp_path, names)
    path = tmp_path / "transforms.json"
    change_json(path, train_filenames=["a.png", "b.png"], val_filenames=["c.png"])
    assert load_scene(tmp_path).test_names == {"c.png"}  # held out for want of a test split; d is not used
    assert [frame.name for frame in load_scene(tmp_path).frames] == ["a.png", "b.png", "c.png"]
    change_json(path, train_filenames=["a.png"], test_filenames=["d.png"])
    assert [frame.name for frame in load_scene(tmp_path).frames] == ["a.png", "d.png"]
    assert load_scene(tmp_path).test_names == {"d.png"}


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_colmap_project_wherever_its_model_stands(tmp_path, model, place):
    shutil.copytree(model, tmp_path / place, dirs_exist_ok=True)
    what = r"colmap \(a COLMAP model\), none of its 10 photos is on disk, such as photo 00"
    with pytest.raises(UserError, match=what):
        load_scene(tmp_path)
    put_photos(tmp_path / "images", *NAMES[1:])
    scene = load_scene(tmp_path)
    assert scene.kind == "colmap"
    assert scene.missing == (NAMES[0],)
    assert scene.points.shape == (30, 3)
    assert scene.test_names == {NAMES[1], NAMES[9]}
    assert load_scene(tmp_path / place).frames[0].image == scene.frames[0].image or place != "."


def test_a_converted_model_whose_names_begin_with_the_folder_of_the_photos(tmp_path):
    put_photos(tmp_path / "images", *NAMES)
    write_transforms(tmp_path, [f"images/{name}" for name in NAMES])
    write_colmap_binary(parse_transforms(tmp_path / "transforms.json"), tmp_path / "sparse/0")
    scene = load_scene(tmp_path)
    assert (scene.kind, scene.missing) == ("colmap", ())
    assert scene.frames[0].image == tmp_path / "images" / NAMES[0]


def test_own_scene_is_read_back(own, tmp_path):
    content = json.loads((own / "scene.json").read_text(encoding="utf-8"))
    assert content["image_folder"] == "../photos"
    assert content["split"] == {"test": [NAMES[0], NAMES[8]]}
    assert content["provenance"] == {"command": "poses"}
    scene = load_scene(own)
    assert (scene.kind, scene.unit, scene.missing) == ("nerfcli", "arbitrary", ())
    assert scene.frames[3].image == tmp_path / "photos" / NAMES[3]
    assert scene.test_names == {NAMES[0], NAMES[8]}
    np.testing.assert_array_equal(scene.points.min(axis=0), content["bounds"]["points_min"])
    assert load_scene(own / "scene.json").test_names == scene.test_names
    # The scene and its photos can move together, and the split stays when a photo goes.
    (tmp_path / "elsewhere").mkdir()
    for folder in ("photos", "photos-scene"):
        (tmp_path / folder).rename(tmp_path / "elsewhere" / folder)
    (tmp_path / "elsewhere/photos" / NAMES[0]).unlink()
    moved = load_scene(tmp_path / "elsewhere/photos-scene")
    assert moved.missing == (NAMES[0],)
    assert moved.test_names == {NAMES[8]}


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"version": 2}, "unknown version 2"),
        ({"image_folder": 3}, "image_folder is 3"),
        ({"image_folder": "../gone"}, "none of its 10 photos is on disk, such as .*gone.photo 00"),
        ({"model": None}, "model is None"),
        ({"model": "sparse/1"}, r"sparse/1.cameras\.txt: No such file"),
        ({"unit": "mile"}, "unit is 'mile'"),
        ({"split": None}, "split.test is not a list"),
        ({"split": {}}, "split.test is not a list"),
        ({"split": {"test": [1]}}, "split.test is not a list"),
    ],
)
def test_malformed_scene_json_is_refused(own, changes, what):
    change_json(own / "scene.json", **changes)
    with refused(what, own):
        load_scene(own)


def test_what_is_no_scene_says_what_was_looked_for(tmp_path):
    with pytest.raises(UserError, match=r"nowhere does not exist"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(UserError, match="contains no capture in a supported format") as caught:
        load_scene(tmp_path)
    assert caught.value.exit_code == BAD_INPUT
    usual = "looked for scene.json, sparse/0/cameras.bin or .txt, transforms.json and the files of many more programs"
    assert caught.value.hint == f"{usual}: nerfcli convert --help lists them"
    put_photos(tmp_path, "images/a.JPG")
    with pytest.raises(UserError, match=r"images has 1 photo but no cameras") as caught:
        load_scene(tmp_path)
    assert caught.value.hint == f"estimate them with: nerfcli poses {tmp_path / 'images'}"
    with pytest.raises(UserError, match="contains no capture in a supported format"):
        load_scene(tmp_path / "images/a.JPG")


def test_the_fingerprint_depends_on_names_cameras_poses_and_split_and_nothing_else(own):
    scene = load_scene(own)
    original = fingerprint(scene)
    assert len(original) == 64
    first, *rest = scene.frames

    def with_first(**changes) -> str:
        return fingerprint(replace(scene, frames=(replace(first, **changes), *rest)))

    nudged = first.world_from_cam.copy()
    nudged[0, 3] += 1e-6
    turned = rigid.from_parts(first.world_from_cam[:3, :3] @ np.diag([-1, -1, 1]), first.centre)
    different = {
        with_first(name="other.jpg"),
        with_first(camera=Camera(first.camera.model, 64, 48, (*first.camera.params[:-1], 0.0501))),
        with_first(world_from_cam=nudged),
        with_first(world_from_cam=turned),
        fingerprint(replace(scene, test_names=frozenset([NAMES[1]]))),
        fingerprint(replace(scene, frames=tuple(rest))),
    }
    assert original not in different
    assert len(different) == 6
    zeros = with_first(world_from_cam=np.eye(4))
    assert zeros == with_first(world_from_cam=np.where(np.eye(4) == 0, -0.0, np.eye(4)))
    # The order of frames, the location of files and the last bits of a pose are not part of the fingerprint.
    last_bits = first.world_from_cam * (1 + 2e-16)
    same = {
        with_first(world_from_cam=last_bits),
        with_first(image=None),
        fingerprint(replace(scene, frames=scene.frames[::-1], root=Path("/elsewhere"), points=np.zeros((0, 3)))),
    }
    assert same == {original}
