"""The model without shape: right where shape cannot matter, and beaten where it does.

Evidence: photos from cameras that only turn are homographies of each other, however far away the scene is (closed
form); a wall at one distance, seen by cameras side by side; and the spheres, with known geometry.
"""

from dataclasses import replace

import numpy as np
import pytest
from conftest import SPHERES
from present import present
from trainings import held_out_photos

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import from_parts, rotation_from_vector
from nerfcli.captures.loading import load_scene
from nerfcli.evaluate.billboards import (
    COMPARED_PIXELS,
    Billboards,
    GeometryComparison,
    GeometryEvidence,
    gain_error_db,
    random_pixels,
)
from nerfcli.evaluate.photos import HeldOutPhoto
from nerfcli.evaluate.protocol import evaluate_model
from nerfcli.photos.colours import over_white, psnr_of, to_8_bit
from nerfcli.photos.loading import load_photos
from nerfcli.render.model import load_model
from nerfcli.render.pictures import Renderable

CAMERA = Camera.pinhole(80, 60, 70.0)


def pattern(directions: np.ndarray) -> np.ndarray:
    """Return smooth colours in [0, 1], (N, 3), of an infinitely distant scene in these directions."""
    waves = np.array([[5.0, 1.0, 0.0], [0.0, 6.0, 2.0], [3.0, -4.0, 1.0]])
    return 0.5 + 0.5 * np.sin(directions @ waves.T)


def frame(name: str, rotation_vector: tuple[float, float, float], centre: tuple[float, float, float]) -> Frame:
    pose = from_parts(rotation_from_vector(np.array(rotation_vector)), np.array(centre))
    return Frame(name, CAMERA, pose, None)


def far_photo(view: Frame) -> np.ndarray:
    bearings, _ = view.camera.pixel_bearings()
    colours = pattern(bearings @ view.world_from_cam[:3, :3].T)
    return to_8_bit(colours.reshape(view.camera.height, view.camera.width, 3))


def narrower(view: Frame) -> Frame:
    """Return the view with a narrower camera, so that its neighbours see all of its picture."""
    return replace(view, camera=Camera.pinhole(48, 40, 70.0))


def turned(count: int) -> list[Frame]:
    """Return views from one place, in overlapping directions."""
    angles = np.linspace(-0.4, 0.4, count)
    return [frame(f"{i}", (0.05 * (-1) ** i, angle, 0.0), (1.0, 2.0, 3.0)) for i, angle in enumerate(angles)]


def psnr_on(billboards: Billboards, view: Frame, photo: np.ndarray) -> float:
    pixels = random_pixels(view, np.ones(photo.shape[:2], bool), COMPARED_PIXELS, np.random.default_rng(0))
    columns, rows = pixels.astype(int).T
    return psnr_of(float(np.square(billboards.colours(view, pixels) - photo[rows, columns] / 255.0).mean()))


def test_photos_of_a_camera_that_only_turned_are_explained():
    views = turned(9)
    held_out, training = narrower(views[4]), [view for index, view in enumerate(views) if index != 4]
    billboards = Billboards(training, [far_photo(view) for view in training])
    # The remaining error is from interpolation between pixels and their rounding.
    assert psnr_on(billboards, held_out, far_photo(held_out)) > 45


def test_a_field_of_a_camera_that_only_turned_shows_no_shape():
    views = turned(9)
    training = views[::2]
    evidence = GeometryComparison(Billboards(training, [far_photo(view) for view in training]))
    for view in map(narrower, views[1::2]):
        photo = far_photo(view)
        # A good field: 35 dB.
        noisy = photo / 255.0 + np.random.default_rng(1).normal(0.0, 10 ** (-35 / 20), photo.shape)
        evidence.add(view, noisy, photo, np.ones(photo.shape[:2], bool))
    shape = present(evidence.shape())
    assert not shape.shown
    assert "do not trust its depth" in shape.in_words()


@pytest.mark.parametrize(
    ("gain", "error", "needed"),
    [(0.77, 0.2, "1.0 dB"), (0.77, 0.58, "1.2 dB"), (0.77, None, "1.0 dB"), (-1.0, 0.2, "")],
)
def test_a_gain_that_is_too_small_is_named_with_what_it_takes(gain: float, error: float | None, needed: str):
    words = GeometryEvidence(14.83, 14.83 + gain, gain, error, shown=False, seconds=0.0).in_words()
    assert words.startswith("no evidence of geometry")
    assert ("to be sure" in words) == bool(needed)
    assert needed in words


def gain_db(errors: list[np.ndarray]) -> float:
    return float(np.mean([10 * np.log10(parts[:, 1].sum() / parts[:, 0].sum()) for parts in errors]))


def test_the_standard_error_of_a_gain_agrees_with_a_bootstrap():
    """The bootstrap resamples the parts of each photo 2000 times."""
    generator = np.random.default_rng(3)
    pixels = generator.integers(200, 300, (3, 16, 1))
    errors = list(np.concatenate([pixels * generator.lognormal(size=(3, 16, 2)), pixels], axis=2))
    redrawn = [gain_db([parts[generator.integers(16, size=16)] for parts in errors]) for _ in range(2000)]
    assert gain_error_db(errors) == pytest.approx(np.std(redrawn), rel=0.15)


def test_different_gains_of_two_photos_are_certain_if_their_parts_agree():
    """One held-out photo has a near neighbour, the other has none: gains of 0.8 and 4.6 dB."""
    gains = np.array([0.8, 4.6])
    pixels = np.full(16, 256.0)
    errors = [np.stack([pixels, pixels * 10 ** (gain / 10), pixels], axis=1) for gain in gains]
    assert gain_error_db(errors) == pytest.approx(0.0, abs=1e-9)
    # Parts without pixels change nothing.
    cut = [np.concatenate([parts, np.zeros((3, 3))]) for parts in errors]
    assert gain_error_db(cut) == gain_error_db(errors)


def test_photos_with_one_part_have_no_standard_error():
    assert gain_error_db([np.array([[1.0, 2.0, 9.0]]), np.array([[0.0, 0.0, 0.0], [3.0, 5.0, 9.0]])]) is None


def test_the_standard_error_from_two_parts_is_half_their_difference():
    """Without one part, the gain of a photo of two parts is that of the other."""
    parts = np.array([[4.0, 9.0, 30.0], [5.0, 2.0, 20.0]])
    gains = 10 * np.log10(parts[:, 1] / parts[:, 0])
    assert gain_error_db([parts]) == pytest.approx(abs(gains[0] - gains[1]) / 2)


@pytest.mark.parametrize(
    ("width", "height", "inside", "outside", "shown"),
    [
        pytest.param(20, 15, 0.6, 0.09, False, id="corner"),
        pytest.param(20, 60, 0.193, 0.075, False, id="columns"),
        pytest.param(80, 15, 0.193, 0.075, False, id="rows"),
        pytest.param(80, 60, 0.12, 0.12, True, id="everywhere"),
        pytest.param(80, 60, 0.105, 0.105, False, id="everywhere, small"),
    ],
)
def test_a_gain_in_only_one_region_is_not_significant(
    width: int, height: int, inside: float, outside: float, shown: bool, monkeypatch: pytest.MonkeyPatch
):
    """A field that is off by 0.1 on grey photos, and billboards that are off by more in one region only."""
    views = turned(4)
    grey = np.full((60, 80, 3), 128, np.uint8)
    billboards = Billboards(views[:2], [grey, grey])

    def off(view: Frame, pixels: np.ndarray) -> np.ndarray:
        in_region = (pixels[:, 0] < width) & (pixels[:, 1] < height)
        return np.repeat(128 / 255 + np.where(in_region, inside, outside)[:, None], 3, axis=1)

    monkeypatch.setattr(billboards, "colours", off)
    evidence = GeometryComparison(billboards)
    for view in views[2:]:
        evidence.add(view, grey / 255 + 0.1, grey, np.ones((60, 80), bool))
    shape = present(evidence.shape())
    assert shape.shown == shown
    of_region = width * height / 4800
    expected = 10 * np.log10((of_region * inside**2 + (1 - of_region) * outside**2) / 0.1**2)
    assert shape.gain_db == pytest.approx(expected, abs=0.3)


def test_the_distance_of_a_round_wall_is_found():
    """A pattern on a sphere of radius 5 around the origin, seen from near its centre."""
    views = [frame(f"{i}", (0.0, 0.1 * i, 0.0), (0.15 * i, 0.1 * (-1) ** i, 0.0)) for i in range(-3, 4)]

    def photo(view: Frame) -> np.ndarray:
        bearings, _ = view.camera.pixel_bearings()
        directions = bearings @ view.world_from_cam[:3, :3].T
        along = directions @ view.centre
        t = np.sqrt(along**2 - view.centre @ view.centre + 25.0) - along
        return to_8_bit(pattern((view.centre + t[:, None] * directions) / 5.0).reshape(60, 80, 3))

    billboards = Billboards(views, [photo(view) for view in views])
    middle = [billboards.distances[2], billboards.distances[3], billboards.distances[4]]
    # The cameras are up to 0.3 from the centre, and distances are tried in steps of 14 %.
    assert middle == pytest.approx([5.0, 5.0, 5.0], rel=0.2)


@pytest.fixture
def spheres_model(spheres_run) -> Renderable:
    return load_model(spheres_run / "field.safetensors", "cpu")


@pytest.fixture
def spheres_billboards() -> Billboards:
    frames = load_scene(SPHERES).train_frames
    return Billboards(frames, [over_white(photo.pixels) for photo in load_photos(frames, factor=1, threads=1)])


@pytest.fixture
def held_out() -> list[HeldOutPhoto]:
    return held_out_photos(load_scene(SPHERES))


def test_the_spheres_have_a_shape(spheres_model, spheres_billboards, held_out):
    metrics = evaluate_model(spheres_model, held_out, billboards=spheres_billboards)
    shape = present(metrics.shape)
    assert shape.shown
    assert shape.gain_db > 5
    assert shape.field_psnr == pytest.approx(metrics.mean.psnr, abs=0.5)


def test_a_comparison_that_cannot_be_computed_ends_no_evaluation(
    spheres_model, spheres_billboards, held_out, monkeypatch: pytest.MonkeyPatch
):
    """The metrics of the photos equal those without the comparison, and a warning says why it is missing."""

    def singular(frame: Frame, pixels: np.ndarray) -> np.ndarray:
        raise np.linalg.LinAlgError("singular matrix")

    monkeypatch.setattr(spheres_billboards, "colours", singular)
    plain = evaluate_model(spheres_model, held_out[:1])
    metrics = evaluate_model(spheres_model, held_out[:1], billboards=spheres_billboards)
    assert metrics.shape is None
    assert metrics.warnings == ("the comparison with a model without geometry failed: LinAlgError: singular matrix",)
    assert metrics.mean == plain.mean


def test_one_training_view_and_a_view_that_none_has_seen_are_no_trouble():
    views = turned(2)
    billboards = Billboards(views[:1], [far_photo(views[0])])
    away = replace(views[1], world_from_cam=from_parts(rotation_from_vector(np.array([0.0, np.pi, 0.0])), np.zeros(3)))
    pixels = np.array([[0.5, 0.5], [40.0, 30.0]])
    mean = far_photo(views[0]).mean(axis=(0, 1)) / 255.0
    assert billboards.colours(away, pixels) == pytest.approx(np.broadcast_to(mean, (2, 3)))
