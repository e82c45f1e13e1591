"""Converting to scenes of nerfcli's own: the unit, the split, masks and EXIF-turned photos reach training."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import put_photos, reprojection_px, with_photos
from commands import completed, error_of, listing, nerfcli, refusal
from every_format import parse
from PIL import Image
from test_convert import LIMIT_PX, model_of
from test_scale import photos_of, sheet_of_markers
from views import BROWN, PINHOLE, PRISM, capture_of

from nerfcli.cameras.camera import Camera
from nerfcli.captures.capture import Capture
from nerfcli.captures.conversion import TargetOptions, convert
from nerfcli.captures.formats import colmap_binary
from nerfcli.captures.formats.colmap import write_colmap_binary, write_colmap_text
from nerfcli.captures.formats.registry import format_named
from nerfcli.captures.formats.scene_folder import write_scene
from nerfcli.captures.formats.transforms import write_transforms
from nerfcli.captures.loading import load_scene
from nerfcli.captures.orientation import in_pixels
from nerfcli.errors import BAD_INPUT, GATE_NOT_MET, UserError
from nerfcli.photos.images import read_image

USAGE = 2
# OpenCV's rotation from stored to upright for each value of tag 0x0112, by EXIF 2.32.
TURNS = {1: None, 3: cv2.ROTATE_180, 6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}


def photographed(capture: Capture, folder: Path, orientations: dict[int, int] | None = None) -> Capture:
    """Return the capture with photos on disk, some with an EXIF orientation; the cameras are for stored pixels."""
    for index, frame in enumerate(capture.frames):
        put_photos(folder, frame.name, size=frame.camera.size, orientation=(orientations or {}).get(index, 1))
    return with_photos(capture, folder)


def masked(capture: Capture, folder: Path, *indices: int) -> Capture:
    folder.mkdir(parents=True)
    frames = list(capture.frames)
    for index in indices:
        camera = frames[index].camera
        mask = folder / f"mask of {index}.png"
        Image.new("L", (camera.width, camera.height), 255).save(mask)
        frames[index] = replace(frames[index], mask=mask)
    return replace(capture, frames=tuple(frames))


def split_into(capture: Capture, *splits: str | None) -> Capture:
    return replace(
        capture, frames=tuple(replace(f, split=split) for f, split in zip(capture.frames, splits, strict=True))
    )


def made_scene(capture: Capture, folder: Path, *, allow_loss: bool = False) -> None:
    """Convert a capture to a scene of nerfcli."""
    wanted = TargetOptions(format_named("nerfcli"), allow_loss=allow_loss)
    convert(capture, folder, wanted)


def seen_upright(capture: Capture, index: int, orientation: int) -> np.ndarray:
    """Return where the photo of a frame shows the points after OpenCV has turned it upright."""
    frame = capture.frames[index]
    pixels, valid = frame.camera.project(frame.in_camera(capture.points))
    assert valid.all()
    turned = []
    for x, y in pixels:
        # Four weighted pixels whose centre of mass is (x, y), turned with the picture.
        stored = np.zeros((frame.camera.height, frame.camera.width), np.float64)
        column, row = int(x - 0.5), int(y - 0.5)
        u, v = x - 0.5 - column, y - 0.5 - row
        stored[row : row + 2, column : column + 2] = np.outer([1 - v, v], [1 - u, u])
        turn = TURNS[orientation]
        upright = stored if turn is None else cv2.rotate(stored, turn)
        rows, columns = np.nonzero(upright)
        weights = upright[rows, columns]
        turned.append(((columns + 0.5) @ weights, (rows + 0.5) @ weights))
    return np.array(turned)


def test_a_known_distance_reaches_training_as_metres(tmp_path):
    capture = photographed(capture_of([PINHOLE]), tmp_path / "images")
    first, second = capture.frames[:2]
    source = model_of(tmp_path, capture)
    distance = f'"{first.name}" "{second.name}" 2.5'
    before = listing(tmp_path)
    completed("convert", source, tmp_path / "my scene", "--to", "nerfcli", "--distance", distance, "--json")
    assert {name: data for name, data in listing(tmp_path).items() if "my scene" not in name} == before
    scene = load_scene(tmp_path / "my scene")
    assert (scene.kind, scene.unit, scene.unit_source) == ("nerfcli", "metre", "1 known distance")
    assert scene.test_names == {first.name}
    assert scene.frames[0].image == tmp_path / "images" / first.name
    assert np.linalg.norm(scene.frames[0].centre - scene.frames[1].centre) == pytest.approx(2.5, rel=1e-12)
    content = json.loads((tmp_path / "my scene" / "scene.json").read_text())
    assert content["image_folder"] == "../images"
    scale = content["provenance"]["new_from_old"]["scale"]
    np.testing.assert_allclose(scene.points, scale * capture.points, rtol=0, atol=1e-12)
    assert json.loads(nerfcli("info", tmp_path / "my scene", "--json").stdout)["unit"] == "metre"
    assert nerfcli("convert", tmp_path / "my scene", tmp_path / "again", "--to", "nerfcli").exit_code == 0
    again = parse(tmp_path / "again")
    assert (again.unit, again.unit_source, again.pixels) == ("metre", "1 known distance", "upright")


def test_a_folder_of_masks_reaches_training(tmp_path):
    """Every third mask is named as by COLMAP; the second photo has none."""
    capture = photographed(capture_of([PINHOLE]), tmp_path / "project" / "images")
    write_transforms(capture, tmp_path / "project" / "transforms.json")
    masks = tmp_path / "project" / "masks"
    for index, frame in enumerate(capture.frames):
        place = masks / (f"{frame.name}.png" if index % 3 == 0 else Path(frame.name).with_suffix(".png"))
        if index != 1:
            place.parent.mkdir(parents=True, exist_ok=True)
            Image.new("L", (frame.camera.width, frame.camera.height), 255).save(place)
    options = ("--to", "nerfcli", "--masks", masks)
    result = completed("convert", tmp_path / "project", tmp_path / "scene", *options)
    count = len(capture.frames)
    assert f"{count - 1} masks" in result.stderr
    frames = load_scene(tmp_path / "scene").frames
    assert [frame.mask is None for frame in frames] == [index == 1 for index in range(count)]
    assert all(frame.mask is None or frame.mask.parent.is_relative_to(masks) for frame in frames)
    assert json.loads(nerfcli("info", tmp_path / "scene", "--json").stdout)["masks"] == count - 1


def test_a_mask_folder_without_masks_of_these_photos_is_an_error(tmp_path):
    capture = photographed(capture_of([PINHOLE]), tmp_path / "images")
    write_transforms(capture, tmp_path / "transforms.json")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "other.png").touch()
    for folder, message in (
        ("masks", f"contains no mask for any of the {len(capture.frames)} photos"),
        ("nowhere", "does not exist"),
        ("images", f"contains photos, such as images/{Path(capture.frames[0].name).name}"),
    ):
        options = ("--to", "nerfcli", "--masks", tmp_path / folder)
        result = nerfcli("convert", tmp_path / "transforms.json", tmp_path / "scene", *options)
        assert (result.exit_code, not (tmp_path / "scene").exists()) == (BAD_INPUT, True)
        assert message in error_of(result)[0]


@pytest.mark.parametrize(("missing", "reported"), [(0, True), (1, False)])
def test_info_reports_a_complete_folder_of_unused_masks(missing: int, reported: bool, tmp_path):
    """Masks match by file name alone, mask/0001.png for images/0001.jpg; an incomplete folder may be something else."""
    capture = photographed(capture_of([PINHOLE]), tmp_path / "images")
    write_transforms(capture, tmp_path / "transforms.json")
    (tmp_path / "mask").mkdir()
    for frame in capture.frames[missing:]:
        (tmp_path / "mask" / f"{Path(frame.name).stem}.png").touch()
    facts = json.loads(nerfcli("info", tmp_path, "--json").stdout)
    assert facts["masks"] is None
    command = f"nerfcli convert {tmp_path} SCENE --to nerfcli --masks {tmp_path / 'mask'}"
    expected = f"{tmp_path / 'mask'}; to use them: {command}" if reported else None
    assert facts["unused_masks"] == expected


@pytest.mark.parametrize("camera", [BROWN, PRISM], ids=lambda camera: camera.model)
def test_cameras_of_a_scene_are_for_upright_photos(camera, tmp_path):
    """Projections into the stored pictures, which OpenCV turns, against the cameras that training loads."""
    orientations = {0: 6, 1: 3, 2: 8}
    capture = photographed(capture_of([camera], num_points=12), tmp_path / "images", orientations)
    write_colmap_binary(capture, tmp_path / "sparse/0")
    result = completed("convert", tmp_path, tmp_path / "scene", "--to", "nerfcli")
    assert "3 photos have an EXIF orientation: the cameras refer to pixels upright" in result.stderr
    scene = load_scene(tmp_path / "scene")
    parsed = parse(tmp_path / "scene")
    assert parsed.observations is not None
    for index, frame in enumerate(scene.frames):
        assert frame.image is not None
        assert read_image(frame.image).shape[:2] == (frame.camera.height, frame.camera.width)
        pixels, _ = frame.camera.project(frame.in_camera(capture.points))
        expected = seen_upright(capture, index, orientations.get(index, 1))
        np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-8)
        rows = parsed.observations.frame_index == index
        seen = parsed.observations.point_index[rows]
        np.testing.assert_allclose(parsed.observations.pixels[rows], expected[seen], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("form", "place"),
    [
        ("colmap", "sparse/0"),
        ("colmap-text", "sparse/0"),
        ("transforms", "transforms.json"),
        ("opensfm", "reconstruction.json"),
    ],
)
def test_other_programs_get_cameras_for_the_pixels_as_they_are_stored(form, place, tmp_path):
    """From stored to upright and back nothing moves, and training reads the same cameras from the result."""
    capture = capture_of([BROWN])
    named = tuple(replace(f, name=f.name.replace(" ", "_")) for f in capture.frames)
    capture = photographed(replace(capture, frames=named, colours=None), tmp_path / "images", {0: 6, 1: 3, 2: 8})
    upright = in_pixels(capture, "upright").capture
    write_scene(upright, tmp_path / "scene")
    options = ("--pixels", "stored", "--allow-loss")
    result = completed("convert", tmp_path / "scene", tmp_path / place, "--to", form, *options)
    assert "3 photos have an EXIF orientation: the cameras refer to pixels as stored" in result.stderr
    assert reprojection_px(capture, parse(tmp_path / place)) < LIMIT_PX
    if form in ("colmap", "colmap-text", "transforms"):
        trained = load_scene(tmp_path)
        assert trained.kind == form.removesuffix("-text")
        assert reprojection_px(upright, replace(upright, frames=trained.frames)) < LIMIT_PX


def test_which_pixels_can_be_chosen(tmp_path):
    capture = photographed(capture_of([PINHOLE]), tmp_path / "images", {0: 6})
    write_scene(in_pixels(capture, "upright").capture, tmp_path / "scene")
    options = ("--to", "colmap", "--pixels", "upright", "--allow-loss")
    assert nerfcli("convert", tmp_path / "scene", tmp_path / "out", *options).exit_code == 0
    assert parse(tmp_path / "out").frames[0].camera.width == PINHOLE.height
    for pixels in ("stored", "lying"):
        options = ("--to", "nerfcli", "--pixels", pixels)
        assert nerfcli("convert", tmp_path / "scene", tmp_path / "2", *options).exit_code == USAGE


def test_markers_are_sought_in_photos_as_the_scene_shows_them(tmp_path):
    """The shape of a camera does not reveal half a turn, and cameras of a scene must not be turned a second time.

    Here they are for photos of half the size.
    """
    frames = photos_of(tmp_path, sheet_of_markers([3, 17], 120), per_unit=120 / 0.7)
    for frame in frames:
        assert frame.image is not None
        pixels = read_image(frame.image)
        exif = Image.Exif()
        exif[0x0112] = 3
        Image.fromarray(pixels[::-1, ::-1]).save(frame.image, exif=exif)
    frames = [replace(frame, camera=frame.camera.resized(320, 240)) for frame in frames]
    capture = Capture(tuple(frames), np.zeros((0, 3)), (), None, "made", pixels="upright")
    write_scene(capture, tmp_path / "scene")
    options = ("--to", "nerfcli", "--markers", "DICT_4X4_50:0.05", "--json")
    result = completed("convert", tmp_path / "scene", tmp_path / "out", *options)
    assert "from ArUco markers (DICT_4X4_50, 0.05 m), 8 sides" in result.stderr
    assert json.loads(result.stdout)["new_from_old"]["scale"] == pytest.approx(0.05 / 0.7, rel=1e-4)
    assert load_scene(tmp_path / "out").unit == "metre"


# Data beside the cameras


@pytest.mark.parametrize(
    ("splits", "test", "train"),
    [
        ((None,) * 6, (0,), (1, 2, 3, 4, 5)),
        (("train", "test", "train", "test", "train", "train"), (1, 3), (0, 2, 4, 5)),
        (("train", "test", "val", "val", "train", None), (1,), (0, 4)),
        (("train", "val", "train", "val", "train", None), (1, 3), (0, 2, 4)),
    ],
)
def test_a_split_is_kept_and_else_every_eighth_photo_is_held_out(splits, test, train, tmp_path):
    capture = split_into(photographed(capture_of([PINHOLE]), tmp_path / "images"), *splits)
    made_scene(capture, tmp_path / "scene")
    scene = load_scene(tmp_path / "scene")
    names = [frame.name for frame in capture.frames]
    assert [frame.name for frame in scene.test_frames] == [names[i] for i in test]
    assert [frame.name for frame in scene.train_frames] == [names[i] for i in train]
    again = parse(tmp_path / "scene")
    expected = splits if any(splits) else tuple("test" if i in test else "train" for i in range(6))
    assert tuple(frame.split for frame in again.frames) == expected


def test_masks_and_depth_bounds_of_any_layout_are_kept(tmp_path):
    capture = photographed(capture_of([PINHOLE]), tmp_path / "images")
    capture = masked(capture, tmp_path / "some" / "masks", 1, 4)
    bounds = np.array([(1.0 + index, 9.0) for index in range(6)])
    made_scene(replace(capture, depth_bounds=bounds), tmp_path / "scene")
    scene = load_scene(tmp_path / "scene")
    assert [f.mask for f in scene.frames] == [f.mask for f in capture.frames]
    np.testing.assert_array_equal(scene.depth_bounds, bounds)
    assert capture.frames[4].mask is not None
    capture.frames[4].mask.unlink()
    with pytest.raises(UserError, match=r"the mask of photo 04\.png, does not exist"):
        load_scene(tmp_path / "scene")


def test_a_mask_that_lies_otherwise_is_a_loss(tmp_path):
    """Training turns masks of stored pixels if their shape reveals the turn, which it does not for half a turn."""
    capture = photographed(capture_of([PINHOLE]), tmp_path / "images", {0: 6, 1: 3})
    capture = masked(capture, tmp_path / "masks", 0, 1, 2)
    with pytest.raises(UserError, match="1 mask not turned like the photo"):
        made_scene(capture, tmp_path / "scene")
    made_scene(capture, tmp_path / "scene", allow_loss=True)
    frames = load_scene(tmp_path / "scene").frames
    assert [frame.mask is not None for frame in frames] == [True, False, True, False, False, False]


def test_photos_in_several_folders_get_their_paths_for_names(tmp_path):
    capture = capture_of([PINHOLE])
    frames = photographed(capture, tmp_path / "a").frames[:3] + photographed(capture, tmp_path / "b").frames[3:]
    with pytest.raises(UserError, match="the names of 6 photos, which become paths relative to one folder"):
        made_scene(replace(capture, frames=frames), tmp_path / "scene")
    made_scene(replace(capture, frames=frames), tmp_path / "scene", allow_loss=True)
    assert [frame.name for frame in load_scene(tmp_path / "scene").frames][2:4] == ["a/photo 02.png", "b/photo 03.png"]


def test_views_without_photos_make_no_scene(tmp_path):
    capture = capture_of([PINHOLE])
    write_colmap_binary(capture, tmp_path / "in")
    error, _ = refusal("convert", tmp_path / "in", tmp_path / "scene", "--to", "nerfcli")
    assert "none of the 6 photos of the capture is on disk, such as photo 00.png" in error
    assert not (tmp_path / "scene").exists()


def test_a_scene_is_replaced_only_with_overwrite_and_restored_after_a_fault(tmp_path, monkeypatch):
    capture = photographed(capture_of([PINHOLE]), tmp_path / "images")
    source = model_of(tmp_path, capture)
    assert nerfcli("convert", source, tmp_path / "scene", "--to", "nerfcli").exit_code == 0
    before = listing(tmp_path)
    assert "scene.json exists" in refusal("convert", source, tmp_path / "scene", "--to", "nerfcli", "--scale", "2")[0]
    right = colmap_binary.pose_rows
    monkeypatch.setattr(colmap_binary, "pose_rows", lambda model: right(model) + 1e-3)
    error, _ = refusal("convert", source, tmp_path / "scene", "--to", "nerfcli", "--overwrite", exit_code=GATE_NOT_MET)
    assert "a ray is off by" in error
    assert listing(tmp_path) == before
    elsewhere = nerfcli("convert", source, tmp_path / "other" / "scene", "--to", "nerfcli")
    assert elsewhere.exit_code == GATE_NOT_MET
    assert not (tmp_path / "other").exists()
    monkeypatch.undo()
    # A scene can be given its scale in place.
    distance = ("--distance", '"photo 00.png" "photo 01.png" 1.5')
    place = tmp_path / "scene"
    assert nerfcli("convert", place, place, "--to", "nerfcli", "--overwrite", *distance).exit_code == 0
    assert load_scene(place).unit == "metre"


def test_a_text_model_in_the_place_of_a_scenes_model_is_kept(tmp_path):
    """Regression: it was deleted without --overwrite, as its files have other names than those of a scene."""
    write_colmap_text(photographed(capture_of([PINHOLE]), tmp_path / "images"), tmp_path / "sparse/0")
    before = listing(tmp_path)
    assert "sparse/0/cameras.txt exists" in refusal("convert", tmp_path, tmp_path, "--to", "nerfcli")[0]
    assert listing(tmp_path) == before


# Intrinsics for another size


@pytest.mark.parametrize("command", ["info", "convert", "train"])
def test_intrinsics_for_another_size_are_reported_once(command, tmp_path):
    capture = photographed(capture_of([PINHOLE]), tmp_path / "images", {0: 6})
    double = Camera("PINHOLE", 1280, 960, tuple(2 * value for value in PINHOLE.params))
    frames = tuple(replace(frame, camera=double) for frame in capture.frames)
    bare = replace(capture, frames=frames, points=np.zeros((0, 3)), colours=None)
    write_transforms(bare, tmp_path / "transforms.json")
    if command == "info":
        said = " ".join(json.loads(nerfcli("info", tmp_path, "--json").stdout)["rescaled"])
    elif command == "train":
        (tmp_path / "run").touch()  # it fails, as this is no folder
        said = nerfcli("train", tmp_path, "-o", tmp_path / "run").stderr
    else:
        said = nerfcli("convert", tmp_path, tmp_path / "out", "--to", "colmap").stderr
    assert said.count("5 photos are 640x480, but the intrinsics are for 1280x960") == 1
    assert said.count("1 photo is 480x640, but the intrinsics are for 960x1280") == 1
