"""Photos in subfolders, each of a camera of its own: a stereo rig in the room corner of `corner`."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from commands import error_of, nerfcli
from corner import CENTRES, FOCAL_PX, HEIGHT, WIDTH, render
from in_this_process import poses_in_this_process
from PIL import Image

from nerfcli.cameras.camera import Camera
from nerfcli.captures.calibration import Calibration, calibrated
from nerfcli.captures.loading import load_scene
from nerfcli.captures.orientation import Picture
from nerfcli.errors import BAD_INPUT
from nerfcli.photos.images import list_photos
from nerfcli.photos.masks import find_mask
from nerfcli.poses.input.photos import camera_groups, find_photos
from nerfcli.poses.input.settings import QUALITIES, PoseSettings
from nerfcli.poses.workspace import is_same_scene

RIG = PoseSettings(max_features=200, threads=1, subfolders=True)
PHOTOS, SCALE = 5, 2 / 3  # photos of each camera, and their size relative to those of `corner`
# The camera on the right sees a quarter less of the scene than the one on the left, in pictures of the same size.
ZOOM = 1.25
BASELINE = np.array([0.15, -0.15, 0.1])


def write_photos(folder: Path, count: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        Image.new("RGB", (16, 12), (index, 100, 200)).save(folder / f"{index}.png")


def zoomed(centre: np.ndarray) -> np.ndarray:
    """Return the middle of a larger picture, whose focal length in pixels is `ZOOM` times as long."""
    larger = render(centre, SCALE * ZOOM, np.zeros(2))
    height, width = round(SCALE * HEIGHT), round(SCALE * WIDTH)
    top, left = (larger.shape[0] - height) // 2, (larger.shape[1] - width) // 2
    return larger[top : top + height, left : left + width]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both cameras give their photos the same names."""
    folder = tmp_path_factory.mktemp("capture") / "my rig"
    for camera, shift, draw in (("left", 0.0, lambda c: render(c, SCALE, np.zeros(2))), ("right", 1.0, zoomed)):
        (folder / camera).mkdir(parents=True)
        for index, centre in enumerate(CENTRES[:PHOTOS]):
            Image.fromarray(draw(centre + shift * BASELINE)).save(folder / camera / f"{index}.png")
    return folder


@pytest.fixture(scope="module")
def scene(rig: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("solved") / "scene"
    report = poses_in_this_process(rig, folder, RIG)
    assert (report.registered, report.total) == (2 * PHOTOS, 2 * PHOTOS)
    return folder


def test_each_subfolder_has_the_camera_that_took_its_photos(scene: Path):
    """Without subfolders in the key of cameras, all photos would share one focal length, as they have the same size."""
    model = pycolmap.Reconstruction(str(scene / "sparse/0"))
    focal = {
        folder: {model.camera(i.camera_id).focal_length for i in model.images.values() if i.name.startswith(folder)}
        for folder in ("left/", "right/")
    }
    assert [len(lengths) for lengths in focal.values()] == [1, 1]
    (left,), (right,) = focal.values()
    assert left == pytest.approx(SCALE * FOCAL_PX, rel=0.02)
    assert right / left == pytest.approx(ZOOM, rel=0.01)


def test_the_scene_has_the_photos_of_both_and_is_kept_later(rig: Path, scene: Path, monkeypatch: pytest.MonkeyPatch):
    loaded = load_scene(scene)
    names = [f"{folder}/{index}.png" for folder in ("left", "right") for index in range(PHOTOS)]
    assert sorted(frame.name for frame in loaded.frames) == names
    for frame in loaded.frames:
        assert frame.image is not None
        assert frame.image.samefile(rig / frame.name)
    assert is_same_scene(scene, rig, RIG)
    monkeypatch.setitem(QUALITIES, "default", (RIG.max_image_size, RIG.max_features))
    result = nerfcli("poses", rig, "-o", scene, "--subfolders", "--threads", "1", "--json")
    assert result.exit_code == 0, result.stderr
    assert "is kept" in result.stderr
    assert not is_same_scene(scene, rig / "left", PoseSettings(max_features=200, threads=1))


def test_pictures_of_such_photos_go_to_subfolders(scene: Path, tmp_path: Path):
    run = tmp_path / "run"
    options = ("--steps", "2", "--log2-rows", "8", "--downscale", "8", "--threads", "1", "--model", "default")
    assert nerfcli("train", scene, "-o", run, *options).exit_code == 0
    assert nerfcli("evaluate", run).exit_code == 0
    measured = [image["name"] for image in json.loads((run / "metrics.json").read_text())["images"]]
    assert measured == ["left/0.png", "right/0.png"]
    assert nerfcli("render", run, "--outputs", "rgb").exit_code == 0
    written = {path.relative_to(run / "renders").as_posix() for path in run.rglob("renders/**/*.png")}
    assert {"test/rgb/left/0.png", "test/rgb/right/0.png"} <= written


def test_subfolders_are_searched_at_any_depth_but_not_hidden_ones(tmp_path: Path):
    for folder in (".", "b", "a/deep", ".thumbnails", "b/.cache"):
        write_photos(tmp_path / folder, 1)
    (tmp_path / "b" / "raw.dng").write_bytes(b"")
    found = [path.relative_to(tmp_path).as_posix() for path in list_photos(tmp_path, subfolders=True).pictures]
    assert found == ["0.png", "a/deep/0.png", "b/0.png"]
    write_photos(tmp_path / "b", 3)
    photos = find_photos(tmp_path, subfolders=True)
    assert set(photos.unreadable) == {"b/raw.dng"}
    assert len(photos.names) == 5
    assert [len(group) for group in camera_groups(photos.photos)] == [1, 1, 3]
    assert list_photos(tmp_path).pictures == [tmp_path / "0.png"]


@pytest.mark.parametrize(
    ("folders", "wanted"),
    [
        (("left",), "there are photos in {0}/left; give that folder"),
        (("left", "right"), "in {0}/left and {0}/right; give one of them, or use all with --subfolders"),
        (("a", "b", "c", "d"), "in {0}/a and 3 more folders; give one of them, or use all with --subfolders"),
    ],
)
def test_the_hint_for_a_folder_without_photos_names_the_option(tmp_path: Path, folders: tuple[str, ...], wanted: str):
    for folder in folders:
        write_photos(tmp_path / folder, 1)
    result = nerfcli("poses", tmp_path)
    assert result.exit_code == BAD_INPUT
    error, hint = error_of(result)
    assert error == f"Error: no photos in {tmp_path}"
    assert wanted.format(tmp_path) in hint


def test_a_scene_among_the_photos_is_refused(rig: Path):
    """Its pictures would be taken for photos when the command is run again."""
    result = nerfcli("poses", rig, "-o", rig / "scene", "--subfolders")
    assert result.exit_code == BAD_INPUT
    assert "would count as photos" in error_of(result)[0]
    assert not (rig / "scene").exists()


def test_masks_are_in_subfolders_too(tmp_path: Path):
    write_photos(tmp_path / "right", 2)
    assert find_mask("right/1.jpg", tmp_path) == tmp_path / "right" / "1.png"
    assert find_mask("left/1.jpg", tmp_path) is None


def test_masks_among_the_photos_are_refused(rig: Path, tmp_path: Path):
    """They would be used as photos, too."""
    copied = shutil.copytree(rig, tmp_path / "rig")
    shutil.copytree(rig, copied / "masks")
    result = nerfcli("poses", copied, "-o", tmp_path / "scene", "--subfolders", "--masks", copied / "masks")
    assert result.exit_code == BAD_INPUT
    assert error_of(result)[0] == f"Error: {copied / 'masks'} contains photos, such as masks/left/0.png"


@pytest.mark.parametrize("listed", [lambda name: name, lambda name: f"images/{name}"])
def test_intrinsics_of_equal_names_are_distinguished_by_folder(tmp_path: Path, listed: Callable[[str], str]):
    cameras = tuple(Camera("SIMPLE_PINHOLE", 64, 48, (focal, 32.0, 24.0)) for focal in (50.0, 60.0))
    calibration = Calibration(tmp_path, cameras, {listed("left/1.png"): 0, listed("right/1.png"): 1})
    pictures = [Picture(tmp_path / "images" / side / "1.png", 64, 48, 1) for side in ("right", "left")]
    assert [one.number for one in calibrated(calibration, pictures)] == [1, 0]
    assert all(one.by_name for one in calibrated(calibration, pictures))


def test_a_moved_rig_keeps_its_scene(rig: Path, scene: Path, tmp_path: Path):
    """Names are relative to the folder of photos, so only the folder decides."""
    copied = shutil.copytree(rig, tmp_path / "rig")
    assert not is_same_scene(scene, copied, RIG)


def test_doctor_examines_the_photos_of_all_subfolders(rig: Path, scene: Path, tmp_path: Path):
    refused = nerfcli("doctor", rig)
    assert refused.exit_code == BAD_INPUT
    assert "use all with --subfolders" in error_of(refused)[1]
    done = nerfcli("doctor", rig, "--subfolders", "--json", "-o", tmp_path / "page.html")
    assert done.exit_code == 0, done.stderr
    content = json.loads(done.stdout)
    assert [photo["name"] for photo in content["photos"][::PHOTOS]] == ["left/0.png", "right/0.png"]
    (cameras,) = (finding for finding in content["findings"] if finding["check"] == "cameras")
    assert cameras["summary"].startswith("one camera in each of 2 folders")
    assert nerfcli("doctor", scene, "--subfolders").exit_code == BAD_INPUT


def test_photos_behind_links_to_folders_are_found_once(tmp_path: Path):
    for folder in ("photos/right", "elsewhere"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "a.jpg").touch()
    (tmp_path / "photos" / "again").symlink_to(tmp_path / "photos")
    (tmp_path / "photos" / "copy").symlink_to(tmp_path / "photos" / "right")
    (tmp_path / "photos" / "left").symlink_to(tmp_path / "elsewhere")
    pictures = list_photos(tmp_path / "photos", subfolders=True).pictures
    found = [path.relative_to(tmp_path).as_posix() for path in pictures]
    assert found == ["photos/left/a.jpg", "photos/right/a.jpg"]
