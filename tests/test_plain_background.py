"""Objects before a plain background: what is background, where the field ends, and how well it is learned."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import completed
from conftest import SPHERES
from PIL import Image

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.framing import equirectangular
from nerfcli.cameras.rigid import rotation_from_vector
from nerfcli.captures.capture import Capture
from nerfcli.matching.plain_background import plain_background
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training.extent import fits_object_frame, object_frame
from nerfcli.training.runs.files import read_log

CAMERA = Camera.pinhole(160, 120, 200.0)
ROWS, COLUMNS = np.mgrid[:120, :160]
# A ring: the background is also seen through its middle, and a part of it has the background's colour.
FROM_MIDDLE = np.hypot(ROWS - 60, COLUMNS - 80)
IS_RING = (FROM_MIDDLE > 15) & (FROM_MIDDLE < 45)


def photo(colour: int = 20, *, noise: float = 4.0, seed: int = 0) -> LoadedPhoto:
    """Return a photo of a ring with texture before a background of one colour, with noise."""
    random = np.random.default_rng(seed)
    levels = np.where(IS_RING[..., None], random.uniform(60, 255, (120, 160, 3)), colour)
    levels = np.clip(levels + random.normal(0, noise, levels.shape), 0, 255)
    return LoadedPhoto(Frame(f"{seed}.png", CAMERA, np.eye(4)), np.rint(levels).astype(np.uint8), None)


@pytest.mark.parametrize("colour", [0, 20, 128, 255])
def test_the_background_is_what_has_its_colour_and_reaches_the_border(colour):
    found = plain_background([photo(colour, seed=seed) for seed in range(3)])
    assert found is not None
    assert np.abs(found.colour - colour).max() <= 4
    assert found.is_black == (colour == 0)
    for mask in found.masks:
        assert mask[FROM_MIDDLE > 50].mean() > 0.98
        assert not mask[FROM_MIDDLE < 45].any()


def test_photos_of_which_one_is_filled_have_no_plain_background():
    filled = replace(photo(), pixels=np.random.default_rng(1).integers(0, 255, (120, 160, 3), dtype=np.uint8))
    assert plain_background([photo(seed=seed) for seed in range(9)]) is not None
    assert plain_background([*(photo(seed=seed) for seed in range(9)), filled]) is None


def test_backgrounds_that_differ_between_photos_are_not_plain():
    assert plain_background([photo(colour) for colour in (0, 60, 120, 180)]) is None


def test_a_frame_around_photos_is_no_background():
    framed = np.full((360, 480, 3), 20, np.uint8)
    framed[6:-6, 6:-6] = np.random.default_rng(2).integers(0, 255, (348, 468, 3))
    assert plain_background([replace(photo(), pixels=framed)]) is None
    framed[6:40, 6:-6] = 20  # more than that
    assert plain_background([replace(photo(), pixels=framed)]) is not None


def test_an_object_may_reach_the_border():
    below = photo()
    below.pixels[80:, 40:120] = 200
    assert plain_background([below, photo(), photo()]) is not None


@pytest.mark.parametrize("kind", ["alpha", "mask", "panorama"])
def test_photos_that_say_what_is_background_are_not_searched(kind):
    other = photo()
    if kind == "alpha":
        other = replace(other, pixels=np.concatenate([other.pixels, other.pixels[..., :1]], axis=-1))
    elif kind == "mask":
        other = replace(other, used=IS_RING)
    else:
        other = replace(other, frame=replace(other.frame, camera=equirectangular(240, 120)))
    assert plain_background([photo(), other]) is None


def test_points_beyond_what_all_cameras_see_show_more_than_an_object(spheres):
    frame, _ = object_frame(spheres)
    inside = np.random.default_rng(0).normal(size=(100, 3))
    inside *= 0.9 / np.linalg.norm(inside, axis=1, keepdims=True)
    points = (inside - frame.translation) / frame.scale  # a similarity without rotation

    def with_points(points: np.ndarray) -> Capture:
        return replace(spheres, points=points)

    assert fits_object_frame(with_points(points[:0]))
    assert fits_object_frame(with_points(points))
    wrong = points.copy()
    wrong[:3] *= 1000.0
    assert fits_object_frame(with_points(wrong))
    wrong[:10] *= 1000.0
    assert not fits_object_frame(with_points(wrong))


def test_a_camera_that_turns_all_around_sees_no_object(spheres):
    frames = []
    for turn in range(6):
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_vector(np.array([0.0, turn * np.pi / 3, 0.0]))
        frames.append(Frame(f"{turn}.png", CAMERA, pose))
    assert not fits_object_frame(replace(spheres, frames=tuple(frames), points=np.zeros((0, 3))))


def put_on(scene: Path, levels: tuple[int, int, int]) -> None:
    """Write the spheres before a background of one colour, without alpha."""
    shutil.copytree(SPHERES, scene)
    for path in scene.glob("t*/*.png"):
        with Image.open(path) as cut_out:
            on_background = Image.new("RGB", cut_out.size, levels)
            on_background.paste(cut_out, mask=cut_out.getchannel("A"))
        on_background.save(path)


@pytest.mark.parametrize("levels", [(0, 0, 0), (255, 255, 255)], ids=["black", "white"])
def test_an_object_on_black_or_white_is_learned_although_most_pixels_have_one_colour(tmp_path, levels):
    """In contracted space, the field becomes opaque fog of this colour in front of the cameras: 16 and 13 dB."""
    put_on(tmp_path / "spheres", levels)
    run = tmp_path / "run"
    trained = completed("train", tmp_path / "spheres", "-o", run, "--steps", "200", "--threads", "1")
    assert "bounded scene" in trained.stderr
    assert "% of the pixels are a plain background" in trained.stderr
    assert read_log(run)[-1].get("heldout_psnr", 0.0) > 19.0


@pytest.mark.parametrize(
    ("levels", "options", "bounded"),
    [
        ((0, 0, 0), ("--model", "default"), True),
        ((255, 255, 255), ("--model", "default"), False),
        ((255, 255, 255), ("--with", "background=constant"), True),
    ],
)
def test_the_field_ends_around_an_object_if_its_background_can_be_shown(tmp_path, levels, options, bounded):
    put_on(tmp_path / "spheres", levels)
    trained = completed("train", tmp_path / "spheres", "-o", tmp_path / "run", "--steps", "1", *options)
    assert (", bounded scene" if bounded else ", unbounded scene") in trained.stderr


def test_a_resumed_training_knows_the_background_again(tmp_path):
    put_on(tmp_path / "spheres", (255, 255, 255))
    for steps in ("3", "6"):
        trained = completed("train", tmp_path / "spheres", "-o", tmp_path / "run", "--steps", steps, "--resume")
    assert "resumed at step 3" in trained.stderr
    assert ", bounded scene" in trained.stderr
    assert read_log(tmp_path / "run")[-1]["losses"]["sky"] > 0.0
