"""Priors besides colour: points of structure from motion, empty space behind masks, rays that are opaque or clear."""

import math
import re
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import mpmath
import numpy as np
import pytest
import torch
from PIL import Image
from pools import pool_of_photos
from present import present
from trainings import FEW, fit, prepared

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.formats.colmap import write_colmap_binary
from nerfcli.captures.formats.scene_folder import MODEL_FOLDER, save
from nerfcli.captures.loading import load_scene
from nerfcli.errors import UserError
from nerfcli.kernels import reference
from nerfcli.matching.camera_check import CameraCheck
from nerfcli.matching.correspondences import SharedFeatures, chosen_pairs
from nerfcli.matching.tracks import Tracks, triangulate
from nerfcli.photos.loading import load_photos
from nerfcli.training.evidence import point_depths, tracks_of_model
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.losses import emerging_losses
from nerfcli.training.pool import PixelPool, PointRays
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import point_weight
from nerfcli.training.selection import Facts
from nerfcli.training.step import NonFiniteError

CAMERA = Camera("SIMPLE_PINHOLE", 12, 8, (12.0, 6.0, 4.0))
SAME = Similarity.identity()
TEN_STEPS = TrainSettings(budget_seconds=None, steps=10)
# Both cameras see them; the first point is off by half a pixel in the second camera.
POINTS = np.array([[0.0, 0.0, 1.0], [0.3, 0.1, 2.0], [-0.2, -0.1, 4.0]])


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Two photos, a model with points, and masks that are black on their left halves."""
    levels = np.random.default_rng(0).integers(0, 256, (2, 8, 12, 3), dtype=np.uint8)
    frames, rows = [], []
    for index in range(2):
        name = f"{index}.png"
        mask = np.repeat(np.array([[0, 255]], np.uint8), 6, 1).repeat(8, 0)
        for folder, picture in (("images", levels[index]), ("masks", mask)):
            (tmp_path / folder).mkdir(exist_ok=True)
            Image.fromarray(picture).save(tmp_path / folder / name)
        pose = from_parts(np.eye(3), np.array([0.2 * index, 0.0, -2.0]))  # it looks along z
        frames.append(Frame(name, CAMERA, pose, tmp_path / "images" / name))
        pixels, _ = CAMERA.project(POINTS - frames[index].centre)
        rows += [(index, point, pixel) for point, pixel in enumerate(pixels)]
    rows.append((0, -1, np.array([1.0, 1.0])))  # a feature that no other photo has
    observed = Observations(*(np.array(column) for column in zip(*rows, strict=True)))
    observed.pixels[3] += (0.0, 0.5)
    (tmp_path / MODEL_FOLDER).mkdir(parents=True)
    model = Capture(tuple(frames), POINTS, (), None, "colmap", observations=observed)
    write_colmap_binary(model, tmp_path / MODEL_FOLDER)
    split = {"0.png": "train", "1.png": "train"}
    save(tmp_path, image_folder=tmp_path / "images", provenance={}, masks=tmp_path / "masks", split=split)
    return load_scene(tmp_path)


@pytest.fixture
def inputs(capture: Capture, tmp_path: Path) -> TrainingInputs:
    return prepared(capture, tmp_path, replace(TEN_STEPS, components=Components(points=0.1)))[0]


def pool_of(scene: Capture, masks: str = "ignore", *, similarity: Similarity = SAME) -> PixelPool:
    photos = load_photos(scene.train_frames, factor=1, threads=1, masks=masks)
    return pool_of_photos(photos, similarity)


def tracks_in(scene: Capture) -> Tracks:
    return tracks_of_model(scene, load_photos(scene.train_frames, factor=1, threads=1))


def test_points_are_found_at_their_pixels_with_their_distances_and_trust(capture):
    similarity = Similarity(0.5, np.eye(3), np.array([1.0, 2.0, 3.0]))
    pool = pool_of(capture, "empty", similarity=similarity)
    of_points = point_depths(tracks_in(capture), pool)
    rays = pool.rays_of(of_points.numbers)
    reached = rays.origins + rays.directions * of_points.distances[:, None]
    expected = torch.from_numpy(similarity.apply(np.concatenate([POINTS, POINTS]))).float()
    # A ray goes through the middle of its pixel: half a pixel's diagonal off at most, at these distances.
    off = (reached - expected).norm(dim=-1) / of_points.distances
    assert (off[[1, 2, 4, 5]] <= math.sqrt(0.5) / 12 + 1e-6).all()
    # The rays to the first point are e = 0.5 px apart in height where they meet at the angle a: the point nearest to
    # both is at a^2 / (a^2 + e^2) of the way.
    fraction = (0.2 / 3) ** 2 / ((0.2 / 3) ** 2 + (0.5 / 12) ** 2)
    assert of_points.distances[[0, 3]].tolist() == pytest.approx([0.5 * 3 * fraction] * 2, rel=0.01)
    assert pool.photo_of(of_points.numbers).tolist() == [0, 0, 0, 1, 1, 1]
    misses = triangulate(pool.frames, tracks_in(capture)).misses_px
    assert misses[[0, 3]].min() > 0.2
    assert of_points.trust.tolist() == pytest.approx((1 / (1 + misses**2)).tolist(), abs=1e-6)


def test_points_behind_a_mask_are_not_looked_at(capture):
    pool = pool_of(capture)
    of_points = point_depths(tracks_in(capture), pool)
    columns = [pool.place(number)[1] for number in of_points.numbers.tolist()]
    assert len(columns) == 3
    assert min(columns) >= 6


def test_only_training_photos_place_points(capture):
    """With the first photo held out, a single training photo sees each point, which gives no distance."""
    held_out = replace(capture, test_names=frozenset({"0.png"}))
    tracks = tracks_in(held_out)
    assert set(tracks.photos.tolist()) == {0}
    assert len(point_depths(tracks, pool_of(held_out, "empty")).numbers) == 0


def test_a_model_without_sightings_gives_no_tracks(spheres):
    assert tracks_in(replace(spheres, frames=spheres.train_frames[:1], test_names=frozenset())).count == 0


def test_missing_points_that_were_requested_are_an_error(spheres, tmp_path):
    alone = replace(spheres, frames=spheres.train_frames[:1], test_names=frozenset())
    with pytest.raises(UserError, match="no 3D point could be triangulated"):
        prepared(alone, tmp_path, replace(TEN_STEPS, downscale=8, components=Components(points=0.1)))


def test_light_off_its_target_counts_by_how_far_it_is():
    # Three rays; the last two have targets at 2 and 1.
    rays = torch.tensor([0, 1, 1, 2])
    middles = torch.tensor([5.0, 2.0, 2.25, 9.0])
    weights, left = torch.tensor([0.9, 0.5, 0.3, 0.7]), torch.tensor([0.1, 0.2, 0.3])
    distances = torch.tensor([2.0, 1.0])
    # First: 0.5 at the point, 0.3 half of the way to "elsewhere", 0.2 passes; second: all is elsewhere.
    expected = [0.3 * 0.5 + 0.2, 0.7 + 0.3]
    off = reference.depth_loss(weights, left, middles, rays=rays, distances=distances)
    assert off.tolist() == pytest.approx(expected)
    at_targets = reference.depth_loss(
        torch.tensor([0.0, 1.0, 0.0, 1.0]), torch.zeros(3), torch.tensor([5.0, 2.0, 3.0, 1.0]),
        rays=rays, distances=distances,
    )  # fmt: skip
    assert at_targets.tolist() == [0.0, 0.0]


def test_the_gradient_of_light_off_its_target_is_right():
    offsets = torch.tensor([0, 2, 2, 5])
    density = torch.rand(5, dtype=torch.float64, requires_grad=True)
    lengths = torch.full((5,), 0.5, dtype=torch.float64)
    middles = torch.tensor([1.0, 2.0, 1.0, 1.1, 1.7], dtype=torch.float64)
    distances = torch.tensor([1.9, 1.0, 1.2], dtype=torch.float64)

    def off(density: torch.Tensor) -> torch.Tensor:
        weights, transmittance = reference.interval_weights(density, lengths, offsets)
        rays = reference.ray_indices(offsets)
        return reference.depth_loss(weights, transmittance, middles, rays=rays, distances=distances)

    assert torch.autograd.gradcheck(off, (density,))


def test_an_eighth_as_many_known_pixels_are_drawn_as_others(capture):
    pool = pool_of(capture, "empty")
    of_points = point_depths(tracks_in(capture), pool)
    generator = torch.Generator().manual_seed(0)
    both = PointRays([of_points], pool).added_to(pool.draw(80, generator), generator)
    assert (len(both.numbers), len(both.distances), len(both.trust)) == (90, 10, 10)
    of_pixel = dict(zip(of_points.numbers.tolist(), of_points.distances.tolist(), strict=True))
    assert both.distances.tolist() == [of_pixel[number] for number in both.numbers[-10:].tolist()]
    of_both = PointRays([of_points, of_points], pool).added_to(pool.draw(80, generator), generator)
    assert len(of_both.distances) == 10  # sets share them
    assert len(PointRays([of_points], pool).added_to(pool.draw(3, generator), generator).distances) == 1


def test_the_loss_of_distances_is_a_log_likelihood_with_a_bounded_slope():
    depth_loss = torch.tensor([0.0, 1e-9, 0.3, 0.999, 1.0], dtype=torch.float64, requires_grad=True)
    losses = emerging_losses(depth_loss)
    for off, loss in zip(depth_loss.tolist(), losses.tolist(), strict=True):
        with mpmath.workdps(40):
            expected = mpmath.mpf("1.1") * mpmath.log(mpmath.mpf("1.1") / (mpmath.mpf("1.1") - mpmath.mpf(off)))
        assert loss == pytest.approx(float(expected), rel=1e-12)
    losses.sum().backward()
    assert present(depth_loss.grad)[[0, -1]].tolist() == pytest.approx([1.0, 11.0])
    assert torch.autograd.gradcheck(emerging_losses, (depth_loss[1:4].detach().requires_grad_(),))


def test_a_known_surface_that_is_nearly_empty_gets_eleven_times_the_gradient():
    gradients = []
    for loss in (torch.clone, emerging_losses):
        log_density = torch.tensor([-30.0, -12.0, -30.0], dtype=torch.float64, requires_grad=True)
        offsets, lengths = torch.tensor([0, 3]), torch.full((3,), 0.1, dtype=torch.float64)
        weights, transmittance = reference.interval_weights(log_density.exp(), lengths, offsets)
        middles, distances = torch.tensor([0.5, 1.0, 1.5]).double(), torch.tensor([1.0]).double()
        off = reference.depth_loss(weights, transmittance, middles, rays=torch.zeros(3).long(), distances=distances)
        loss(off).sum().backward()
        gradients.append(present(log_density.grad)[1].item())
    assert gradients[1] / gradients[0] == pytest.approx(11.0, rel=1e-4)


def test_cameras_with_an_impossible_lens_are_named_and_not_called_exact(spheres, tmp_path, monkeypatch):
    """Their distortion turns back within the picture, so that most pixels have no ray."""

    monkeypatch.setattr("nerfcli.training.selection.FEWEST_STEPS", 1)
    monkeypatch.setattr("nerfcli.training.schedule.FEWEST_STEPS", 1)

    width, height = (focal := spheres.frames[0].camera).size
    bent = Camera("RADIAL", width, height, (focal.focal_px, width / 2, height / 2, -20.0, 0.0))
    broken = replace(spheres, frames=tuple(replace(frame, camera=bent) for frame in spheres.frames))
    settings = replace(TEN_STEPS, steps=40, downscale=8, model="auto", log2_rows=10)
    of_spheres, said = ("\n".join(prepared(scene, tmp_path, settings)[1]) for scene in (spheres, broken))
    assert "these cameras are exact" in of_spheres
    assert "these cameras are exact" not in said
    assert re.search(r"[6-9]\d % of all: the distortion of the lens must be wrong", said)


def test_trials_that_become_non_finite_end_without_an_error(capture, tmp_path, monkeypatch):
    """Components that photos support are still selected."""
    monkeypatch.setattr("nerfcli.training.schedule.FEWEST_STEPS", 1)
    monkeypatch.setattr(Fitting, "advance", Mock(side_effect=NonFiniteError))
    inputs, reported = prepared(capture, tmp_path, replace(TEN_STEPS, steps=40, model="auto", log2_rows=10))
    assert "numbers became non-finite in a trial; only components that need no trial are selected" in reported
    assert inputs.settings.components.points > 0.0


def test_known_distances_are_a_log_likelihood_only_until_surfaces_have_emerged(inputs, monkeypatch):
    fitting, emerging = Fitting(inputs), []

    def recorded(depth_loss: torch.Tensor) -> torch.Tensor:
        emerging.append(fraction)
        return emerging_losses(depth_loss)

    monkeypatch.setattr("nerfcli.training.step.emerging_losses", recorded)
    for fraction in (0.0, 0.29, 0.3, 0.9):
        fitting.advance(fraction)
    assert emerging == [0.0, 0.29]


def test_points_fade_out():
    wide = [point_weight(progress, step=5000, parallax=1.0) for progress in (0.0, 0.25, 1.0, 1.5)]
    assert wide == [1.0, 0.75, 0.0, 0.0]
    # With a narrow baseline, also by 800 / step.
    assert [point_weight(0.5, step=step, parallax=0.5) for step in (0, 800, 3200)] == [0.5, 0.5, 0.125]


@pytest.mark.parametrize(("parallax", "weight"), [(1.0, 0.5), (0.5, 0.125)])
def test_points_of_a_narrow_baseline_fade_with_the_steps_of_a_training(parallax, weight, inputs, monkeypatch):
    """Half of the budget and four times 800 steps: a loss of 4 for each distance adds 4 times its weight."""
    losses = []
    for value in (0.0, 4.0):
        monkeypatch.setattr("nerfcli.training.schedule.EMERGING_ENDS", 1.0)
        monkeypatch.setattr("nerfcli.training.step.emerging_losses", lambda off, value=value: 0 * off + value)
        fitting = Fitting(inputs)
        sets = present(fitting.points).sets
        trusted = [replace(points, trust=torch.ones_like(points.trust)) for points in sets]
        fitting.points = PointRays(trusted, inputs.pool)
        fitting.step, fitting.schedule = 3200, replace(fitting.schedule, parallax=parallax)
        losses.append(fitting.advance(0.5).loss)
    assert losses[1] - losses[0] == pytest.approx(0.1 * weight * 4.0, rel=1e-4)


def test_black_of_a_mask_is_ignored_or_is_empty_space(capture):
    ignored, empty = (pool_of(capture, masks) for masks in ("ignore", "empty"))
    assert (ignored.has_alpha, ignored.usable_count) == (False, 96)
    assert (empty.has_alpha, empty.usable_count) == (True, 192)
    alpha = empty.colours[:, 3].view(2, 8, 12)
    assert not alpha[:, :, :6].any()
    assert (alpha[:, :, 6:] == 255).all()
    assert torch.equal(empty.colours[:, :3], ignored.colours)


def test_training_takes_all_of_them_at_once(capture, tmp_path):
    # Equal seeds give equal losses, which are finite with every prior on.
    components = Components(masks="empty", points=0.1)
    settings = replace(FEW, steps=4, components=components)
    one, other = ([step.loss for step in fit(capture, tmp_path / name, settings)] for name in ("one", "two"))
    assert one == other
    assert all(map(math.isfinite, one))


def test_a_short_training_takes_known_points_without_a_trial(capture, tmp_path):
    inputs, reported = prepared(capture, tmp_path, replace(TEN_STEPS, model="auto"))
    assert inputs.settings.components == Components(points=0.1)
    assert [len(depths.numbers) for depths in present(inputs.points).sets] == [3]
    assert "points: kept, 3 pixels see a 3D point at a known distance" in reported


@pytest.mark.parametrize("limit", [{"budget_seconds": None, "steps": 10}, {"budget_seconds": 1.0}])
def test_a_short_training_does_not_wait_for_photos_to_be_compared(capture, tmp_path, monkeypatch, limit):
    compared = "nerfcli.matching.correspondences.match"
    monkeypatch.setattr(compared, lambda *photos, **threads: pytest.fail("photos were compared"))
    without_model = replace(capture, root=tmp_path / "elsewhere")
    inputs, _ = prepared(without_model, tmp_path, TrainSettings(**limit, model="auto"))
    assert inputs.settings.components == Components()


@pytest.mark.parametrize("cameras", ["focal", "all", "poses", "fixed"])
def test_lenses_that_are_to_learn_begin_where_matched_features_say(cameras, capture, tmp_path, monkeypatch):
    """With requested components and no search; refining poses alone leaves lenses as they are."""
    check = CameraCheck(-0.019, 0.0006, (0.26, 0.14), 900)
    facts = Facts("hash", has_alpha=False, has_exif=False, cameras=check, fixed=("cameras",))
    monkeypatch.setattr("nerfcli.training.preparation._facts", lambda *args: facts)
    inputs, reported = prepared(capture, tmp_path, replace(TEN_STEPS, components=Components(cameras=cameras)))
    learns = cameras in ("focal", "all")
    assert inputs.log_focal == (check.log_focal if learns else 0.0)
    assert any("suggest a focal length 1.88 %" in line for line in reported) == learns
    if learns:
        refined = present(Fitting(inputs).appearance.cameras)
        assert present(refined.lenses).values.min().item() == pytest.approx(check.log_focal)


def test_comparing_photos_has_a_price_once(spheres):
    """0.7 us for each pixel of the compared photos, divided by two threads; 0 once it is done."""
    photos = load_photos(spheres.train_frames, factor=4, threads=1)
    shared = SharedFeatures(photos, lambda: tracks_of_model(spheres, photos), threads=2)
    wanted = {index for pair in chosen_pairs(photos) for index in pair}
    pixels = sum(photos[index].pixels.shape[0] * photos[index].pixels.shape[1] for index in wanted)
    assert shared.matching_seconds == pytest.approx(0.7e-6 * pixels / 2)
    assert shared.of_model.count == 0
    assert shared.tracks is shared.of_matches
    assert shared.matching_seconds == 0.0
