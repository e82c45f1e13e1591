"""The first Gaussians of a field: those of a dense box lie on its faces, as closed forms say."""

from collections.abc import Callable
from dataclasses import replace

import fog
import numpy as np
import pytest
import torch
from views import BROWN, FISHEYE, SQUARE

from nerfcli.cameras import rigid
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.field.background import SphereBackground, colours_behind
from nerfcli.field.exposure import exposed
from nerfcli.field.hash_field import HashField
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.render.model import Model
from nerfcli.splats import start
from nerfcli.splats.gaussians import basis
from nerfcli.splats.start import count_for, gaussians_of_field, log_gains_of_photos

HALF = 0.5
# Half of all light has ended ln 2 / exp(6) = 0.0017 behind a face.
LOG_DENSITY = 6.0
TRAINING_FROM_SCENE = Similarity(0.2, rigid.rotation_from_vector(np.array([0.4, -0.3, 0.9])), np.array([0.1, 0.2, 0.0]))
LENSES = (SQUARE.resized(256, 192), BROWN.resized(192, 256), FISHEYE.resized(256, 192))


def dense_box() -> Model:
    """Return a box of sides 1 in the training frame, practically opaque, of sRGB 1/2."""
    model = fog.fog(fog.foggy_cells((-HALF,) * 3, (HALF,) * 3), TRAINING_FROM_SCENE, step=1 / 512)
    assert isinstance(model.field, HashField)
    with torch.no_grad():
        model.field.weights[1][0, 0] = LOG_DENSITY
    return model


def checks(places: np.ndarray) -> np.ndarray:
    """Return the colours (..., 3) of a surface: a smooth pattern where x > 0, one colour elsewhere."""
    waves = 0.5 + 0.3 * np.stack([np.sin(40 * places[..., k]) for k in range(3)], axis=-1)
    return np.where(places[..., :1] > 0, waves, (0.7, 0.4, 0.3))


def photos_of_box(colours: Callable[[np.ndarray], np.ndarray] = checks, *, count: int = 8) -> list[LoadedPhoto]:
    """Photograph the box from all sides, transparent around it."""
    photos, scene_from_training = [], TRAINING_FROM_SCENE.inverse()
    for index in range(count):
        angle = 2 * np.pi * index / count
        centre = 2.2 * np.array([np.cos(angle), np.sin(angle), 0.7 * (-1) ** index])
        pose, lens = rigid.look_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0])), LENSES[index % 3]
        bearings, valid = lens.pixel_bearings()
        rays = bearings @ pose[:3, :3].T
        with np.errstate(divide="ignore"):
            sides = np.stack([(-HALF - centre) / rays, (HALF - centre) / rays])
        near, far = sides.min(0).max(-1), sides.max(0).min(-1)
        hit = valid & (near < far)
        levels = np.where(hit[:, None], colours(centre + near[:, None] * rays), 0.0)
        pixels = np.rint(255 * np.concatenate([levels, hit[:, None]], axis=-1)).astype(np.uint8)
        frame = Frame(f"{index}.png", lens, scene_from_training.apply_pose(pose))
        photos.append(LoadedPhoto(frame, pixels.reshape(lens.height, lens.width, 4), None))
    return photos


def begun(model: Model, photos: list[LoadedPhoto], *, count: int = 4000, with_gains: bool = False) -> start.Start:
    return gaussians_of_field(model, photos, count=count, degree=1, with_gains=with_gains)


def shown(gaussians: start.Gaussians) -> np.ndarray:
    """Return the colours (N, 3) that the Gaussians show from a side on which only the constant harmonic counts."""
    np.testing.assert_allclose(gaussians.harmonics[:, 1:], 0.0, atol=1e-12)
    return 0.5 + gaussians.harmonics[:, 0] * basis(np.array([[0.0, 0.0, 1.0]]), 0)


def test_disks_of_a_box_lie_flat_on_its_faces_in_the_colours_of_the_photos():
    result = begun(dense_box(), photos_of_box())
    disks = result.gaussians.moved(TRAINING_FROM_SCENE)
    assert 1500 < len(disks) <= 4000
    # A pixel of a map is 0.03 wide: beyond three of them, a depth map mixes no two faces.
    places = disks.means.astype(np.float64)
    beyond = np.sort(np.abs(places), axis=1)
    inner = beyond[:, 1] < HALF - 0.1
    assert inner.sum() > 500
    # The depth of the median, and the step of the march that straddles the face.
    np.testing.assert_allclose(beyond[inner, 2], HALF - np.log(2) / np.exp(LOG_DENSITY), atol=1 / 512)
    turns = rigid.rotation_from_quaternion(disks.quaternions.astype(np.float64))
    thin = turns[np.arange(len(disks)), :, disks.log_scales.argmin(1)]
    faces = np.eye(3)[np.abs(places).argmax(1)]
    assert np.degrees(np.arccos(np.minimum(np.abs((thin * faces).sum(1)), 1.0)))[inner].max() < 3.0
    # Photos are averaged over at least 3 x 3 pixels, in which the waves change by up to a tenth.
    errors = np.abs(shown(disks) - checks(places))[inner & (np.abs(places[:, 0]) > 0.05)]
    assert np.median(errors) < 0.02
    # Half the surface has no detail: few and large disks do.
    sizes = np.exp(disks.log_scales.max(1)) / start.SPREAD
    plain = inner & (places[:, 0] < -0.2)
    waves = inner & (places[:, 0] > 0.2)
    assert waves.sum() > 8 * plain.sum() > 0
    assert np.median(sizes[plain]) > 3 * np.median(sizes[waves])


def test_pictures_of_the_field_add_what_no_photo_shows_in_their_own_brightness():
    photos = photos_of_box(lambda places: np.full_like(places, 0.6))
    pictures = photos_of_box(lambda places: np.full_like(places, 0.5))
    one, others = photos[:1], pictures[3:6]
    alone = gaussians_of_field(dense_box(), one, count=4000, degree=1, with_gains=True)
    result = gaussians_of_field(dense_box(), one, others, count=4000, degree=1, with_gains=True)
    np.testing.assert_array_equal(result.log_gains, alone.log_gains)  # one photo, so one gain
    assert result.log_gains.shape == (1, 3)
    # The photo looks along -x: the face at x = -1/2 is behind the box.
    means = [begun_with.gaussians.moved(TRAINING_FROM_SCENE).means for begun_with in (alone, result)]
    behind = [places[:, 0] < -HALF + 0.01 for places in means]
    assert behind[0].sum() == 0
    assert behind[1].sum() > 20
    # The photo's gain takes its 0.6 to the field's 0.5; the pictures are 0.5 as they are.
    np.testing.assert_allclose(shown(result.gaussians), 0.5, atol=0.01)


@pytest.mark.parametrize("count", [1, 30, 400])
def test_there_are_no_more_disks_than_asked_for_and_nearly_as_many(count):
    disks = begun(dense_box(), photos_of_box(), count=count).gaussians
    assert 0.9 * count <= len(disks) <= count
    assert all(np.isfinite(values).all() for values in disks)


def test_gains_by_which_photos_differ_are_found_and_divided_out():
    rng = np.random.default_rng(0)
    truth = rng.uniform(-0.4, 0.4, (8, 3))
    photos = photos_of_box(lambda places: np.full_like(places, 0.5))
    for photo, gains in zip(photos, truth, strict=True):
        photo.pixels[..., :3] = np.rint(255 * exposed(torch.full((3,), 0.5), torch.from_numpy(gains)).numpy())
    result = begun(dense_box(), photos, with_gains=True)
    # Levels are whole: half a step at 0.4 is 0.3 % of it, 0.8 % of its light.
    np.testing.assert_allclose(result.log_gains, truth, atol=0.012)
    np.testing.assert_allclose(shown(result.gaussians), 0.5, atol=0.01)
    apart = begun(dense_box(), photos)
    np.testing.assert_array_equal(apart.log_gains, 0.0)
    assert np.ptp(shown(apart.gaussians)) > 0.1
    # What is too dark to tell gains, or masked, says nothing.
    photos[0].pixels[..., :3] = 3
    photos[1] = replace(photos[1], used=np.zeros(photos[1].pixels.shape[:2], dtype=bool))
    found = log_gains_of_photos(dense_box(), photos)
    np.testing.assert_array_equal(found[:2], 0.0)
    np.testing.assert_allclose(found[2:], truth[2:], atol=0.012)


def test_masked_pixels_make_no_disks_and_do_not_colour_others():
    photos = photos_of_box()
    for index, photo in enumerate(photos):
        used = np.ones(photo.pixels.shape[:2], dtype=bool)
        used[:, : used.shape[1] // 2 + 1] = False
        photo.pixels[~used, :3] = (255, 0, 255)
        photos[index] = replace(photo, used=used)
    disks = begun(dense_box(), photos).gaussians
    assert len(disks) > 500
    # The waves reach (0.8, 0.2, 0.8); a ninth of purple in the mean of a map's pixel would be seen.
    assert np.abs(shown(disks) - (1.0, 0.0, 1.0)).max(1).min() > 0.19
    # With every second column masked, no pixel of a map is used as a whole.
    striped = [replace(photo, used=np.indices(photo.pixels.shape[:2])[1] % 2 == 0) for photo in photos]
    assert len(begun(dense_box(), striped).gaussians) == 0


def open_space(monkeypatch: pytest.MonkeyPatch, background: start.Colour | SphereBackground) -> Model:
    """Return a model of unbounded space without any surface."""
    monkeypatch.setattr(fog, "TINY", replace(fog.TINY, contraction="l2"))
    return replace(fog.fog(fog.foggy_cells((2.0,) * 3, (3.0,) * 3), TRAINING_FROM_SCENE), background=background)


def without_alpha(photos: list[LoadedPhoto]) -> list[LoadedPhoto]:
    return [replace(photo, pixels=np.ascontiguousarray(photo.pixels[..., :3])) for photo in photos]


def test_what_has_no_depth_lies_on_a_far_sphere_only_if_photos_show_it(monkeypatch):
    empty = fog.fog(fog.foggy_cells((2.0,) * 3, (3.0,) * 3), TRAINING_FROM_SCENE, background=(1.0, 1.0, 1.0))
    nothing = begun(empty, photos_of_box(), with_gains=True)
    assert (len(nothing.gaussians), nothing.background) == (0, (1.0, 1.0, 1.0))
    sky = begun(open_space(monkeypatch, (0.0, 0.0, 0.0)), without_alpha(photos_of_box())).gaussians
    assert len(sky) > 100
    radii = np.linalg.norm(TRAINING_FROM_SCENE.apply(sky.means), axis=1)
    np.testing.assert_allclose(radii, start.FAR, rtol=1e-5)
    assert all(np.isfinite(values).all() for values in sky)


@pytest.mark.parametrize(("count", "smallest"), [(30_000, 2.0), (300, 4.0)])
def test_squares_of_a_photo_tile_it(monkeypatch, count, smallest):
    (photo,) = without_alpha(photos_of_box(lambda places: 0 * places, count=1))
    height, width = photo.pixels.shape[:2]
    photo.pixels[:, : width // 2] = np.random.default_rng(0).integers(0, 256, (height, width // 2, 3))
    sky = begun(open_space(monkeypatch, (0.0, 0.0, 0.0)), [photo], count=count).gaussians
    distances = np.linalg.norm(sky.means - photo.frame.centre, axis=1)
    sides = np.exp(sky.log_scales.max(1)) / start.SPREAD / distances * photo.frame.camera.focal_px
    # Cells are up to 1.19 times as large as their squares, so some squares share one with their neighbour.
    assert 0.65 * height * width < np.square(sides).sum() <= 1.001 * height * width
    # Sides of the photo are 2.02 times as long as those of the map for 300.
    np.testing.assert_allclose([sides.min(), sides.max()], [smallest, 32.0], rtol=0.02)


def test_a_learned_background_is_shown_in_all_directions(monkeypatch):
    sphere = SphereBackground(4)
    with torch.no_grad():
        sphere.logits.normal_(generator=torch.Generator().manual_seed(0))
    model = open_space(monkeypatch, sphere)
    photos = without_alpha(photos_of_box(lambda places: 0 * places, count=2))
    result = begun(model, photos, count=16_000)
    disks = result.gaussians.moved(TRAINING_FROM_SCENE)
    assert 1000 < len(disks) <= 16_000
    seen_from = disks.means.astype(np.float64)
    directions = seen_from / np.linalg.norm(seen_from, axis=1, keepdims=True)
    learned = np.linalg.norm(seen_from, axis=1) > 1.2 * start.FAR
    with torch.no_grad():
        expected = colours_behind(sphere, torch.from_numpy(directions).float()).numpy()
    np.testing.assert_allclose(shown(disks)[learned], expected[learned], atol=1e-4)
    # Photos reach 25 degrees from their axes. They are black.
    axes = [TRAINING_FROM_SCENE.rotation @ photo.frame.world_from_cam[:3, 2] for photo in photos]
    assert max((directions[learned] @ axis).max() for axis in axes) < np.cos(np.radians(22))
    np.testing.assert_allclose(shown(disks)[~learned], 0.0, atol=1e-4)
    everywhere = np.random.default_rng(0).normal(size=(2000, 3))
    everywhere /= np.linalg.norm(everywhere, axis=1, keepdims=True)
    nearest = np.degrees(np.arccos(np.minimum((everywhere @ directions.T).max(1), 1.0)))
    # Squares of flat sky are up to 16 pixels of a map large, each with its disk in the middle.
    photographed = (everywhere @ directions[~learned].T).max(1) > np.cos(0.3)
    assert nearest[~photographed].max() < 4.0
    assert nearest.max() < 20.0


def test_the_count_grows_with_the_seconds_up_to_one_per_20_pixels():
    photos = photos_of_box() * 100  # of 49,152 pixels
    assert count_for(photos, core_seconds=60) == 2 * count_for(photos, core_seconds=30) == 36_000
    assert count_for(photos, core_seconds=1e9) == 800 * 49_152 // 20
    assert count_for(photos[:1], core_seconds=1e9) == count_for(photos, core_seconds=0.0) == 10_000
