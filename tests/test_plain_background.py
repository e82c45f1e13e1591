"""Objects before a plain background: what is background, where the field ends, and how well it is learned."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from commands import nerfcli
from conftest import SPHERES
from PIL import Image

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.framing import equirectangular
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
    masks = plain_background([photo(colour, seed=seed) for seed in range(3)])
    assert masks is not None
    for mask in masks:
        assert mask[FROM_MIDDLE > 50].mean() > 0.98
        assert not mask[FROM_MIDDLE < 45].any()


def test_photos_of_which_one_is_filled_have_no_plain_background():
    filled = replace(photo(), pixels=np.random.default_rng(1).integers(0, 255, (120, 160, 3), dtype=np.uint8))
    assert plain_background([photo(seed=seed) for seed in range(9)]) is not None
    assert plain_background([*(photo(seed=seed) for seed in range(9)), filled]) is None


def test_backgrounds_that_differ_between_photos_are_not_plain():
    assert plain_background([photo(colour) for colour in (0, 60, 120, 180)]) is None


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


@pytest.mark.parametrize("levels", [(0, 0, 0), (255, 255, 255)], ids=["black", "white"])
def test_an_object_on_black_or_white_is_learned_although_most_pixels_have_one_colour(tmp_path, levels):
    """In contracted space, the field becomes opaque fog of this colour in front of the cameras: 11 and 18 dB."""
    shutil.copytree(SPHERES, tmp_path / "spheres")
    for path in tmp_path.glob("spheres/t*/*.png"):
        with Image.open(path) as cut_out:
            on_background = Image.new("RGB", cut_out.size, levels)
            on_background.paste(cut_out, mask=cut_out.getchannel("A"))
        on_background.save(path)
    run = tmp_path / "run"
    trained = nerfcli("train", tmp_path / "spheres", "-o", run, "--steps", "120", "--threads", "1")
    assert trained.exit_code == 0, trained.stderr
    assert "bounded scene" in trained.stderr
    assert "% of the pixels are a plain background" in trained.stderr
    assert read_log(run)[-1].get("heldout_psnr", 0.0) > 19.0
