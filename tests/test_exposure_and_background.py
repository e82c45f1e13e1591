"""Exposures of photos and learned backgrounds: closed forms, gradients, and that a run keeps them."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image
from pools import pool_of_photos
from present import present
from test_images import exif_with, noise
from trainings import FEW, fit, resumed_bit_for_bit

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import from_parts
from nerfcli.captures.capture import Capture
from nerfcli.errors import UserError
from nerfcli.evaluate.photos import HeldOutPhoto
from nerfcli.evaluate.protocol import evaluate_model
from nerfcli.field.background import SphereBackground, colours_behind
from nerfcli.field.exposure import Exposure, exposed, linear_from_srgb, srgb_from_linear
from nerfcli.field.hash_field import DETAILED_LOG2_ROWS
from nerfcli.photos import exif
from nerfcli.photos.exif import log_exposures, mean_log_exposure, relative_log_exposures
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.render.model import load_model
from nerfcli.render.pictures import render_picture
from nerfcli.training import schedule
from nerfcli.training.appearance import Appearance
from nerfcli.training.checkpoints import Checkpoints, Totals
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.pool import PixelBatch
from nerfcli.training.preparation import EarlierDecisions, prepare
from nerfcli.training.runs.components import Components, Selection
from nerfcli.training.runs.run import Run, RunConfig
from nerfcli.training.step import light_from_beyond

CAMERA = Camera("SIMPLE_PINHOLE", 12, 8, (12.0, 6.0, 4.0))
LEARNED = Components(background="sphere", exposure="learned")
SHORT = replace(FEW, steps=6, components=LEARNED)


def pose(x: float) -> np.ndarray:
    """Return the pose of a camera at (x, 0, -2) that looks along +z."""
    return from_parts(np.eye(3), np.array([x, 0.0, -2.0]))


def save_photo(
    path: Path, levels: np.ndarray | None = None, *, seconds: float | None, iso: int = 100, f_number: float = 4.0
) -> Path:
    """Save a photo of given or random levels with EXIF."""
    entries = {ExifTags.Base.ISOSpeedRatings: iso, ExifTags.Base.FNumber: f_number}
    if seconds is not None:
        entries[ExifTags.Base.ExposureTime] = seconds
    # Pillow writes no EXIF into a PNG if its main directory is empty.
    exif = exif_with({ExifTags.Base.Orientation: 1}, {ExifTags.IFD.Exif: entries})
    Image.fromarray(noise(8, 12, 3, seed=len(path.name)) if levels is None else levels).save(path, exif=exif)
    return path


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Four photos, each exposed twice as long as the one before; the first is held out."""
    paths = [save_photo(tmp_path / f"{i}.png", seconds=2.0**i / 100) for i in range(4)]
    frames = tuple(Frame(path.name, CAMERA, pose(0.2 * i), path) for i, path in enumerate(paths))
    return Capture(frames, np.zeros((0, 3)), kind="colmap", root=tmp_path, test_names=frozenset({"0.png"}))


@pytest.fixture
def inputs(capture: Capture, tmp_path: Path) -> TrainingInputs:
    return prepare(capture, SHORT, run=tmp_path, notify=lambda text: None)


def trained(inputs: TrainingInputs, *, steps: int) -> Fitting:
    training = Fitting(inputs)
    for step in range(steps):
        training.advance(step / steps)
    return training


def test_the_srgb_curve_is_that_of_the_standard_and_its_own_inverse():
    # IEC 61966-2-1: 0.5 is 21.404 % of linear light, 0.04 is on the linear segment.
    levels = torch.tensor([0.0, 0.04, 0.5, 1.0], dtype=torch.float64)
    assert linear_from_srgb(levels).tolist() == pytest.approx([0.0, 0.04 / 12.92, 0.21404114, 1.0], abs=1e-8)
    dense = torch.linspace(0.0, 1.5, 1001, dtype=torch.float64)
    again = srgb_from_linear(linear_from_srgb(dense))
    assert torch.allclose(again, dense, atol=1e-7, rtol=0)  # the two segments meet within 1e-8


def test_a_gain_multiplies_linear_light_and_its_gradient_is_right():
    rgb = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    gains = torch.tensor([math.log(2), 0.0, -math.log(3)], dtype=torch.float64, requires_grad=True)
    expected = linear_from_srgb(rgb) * torch.tensor([2.0, 1.0, 1 / 3])
    assert torch.allclose(linear_from_srgb(exposed(rgb, gains)), expected, atol=1e-7)
    assert torch.autograd.gradcheck(exposed, (rgb, gains))
    black = torch.zeros(1, 3, requires_grad=True)
    exposed(black, torch.zeros(3)).sum().backward()  # a power alone has an infinite slope there
    assert present(black.grad).tolist() == [[1.0, 1.0, 1.0]]


def test_only_differences_between_photos_are_learned():
    start = torch.randn(7, 3)
    every = torch.ones(7, dtype=torch.bool)
    one, other = Exposure(start, every), Exposure(start + torch.tensor([5.0, -1.0, 0.3]), every)
    assert one.log_gains().mean(0).tolist() == pytest.approx([0.0] * 3, abs=1e-6)
    assert torch.allclose(one.log_gains(), other.log_gains(), atol=1e-5)
    one(torch.rand(4, 3), torch.tensor([0, 3, 3, 6])).square().sum().backward()
    assert present(one.free.grad).sum(0).abs().max() < 1e-5  # no gradient for a gain that all photos share


def test_known_exposures_keep_their_differences_while_the_others_are_learned(capture, tmp_path):
    """Two of the three training photos are known, with exposures that they do not have."""
    components = Components(exposure="matched", masks="empty")
    settings = replace(SHORT, components=components, steps=60)
    inputs = prepare(capture, settings, run=tmp_path, notify=lambda text: None)
    given = torch.tensor([[0.9, 0.6, 0.3], [-0.9, -0.6, -0.3], [math.nan] * 3])
    again = Fitting(replace(inputs, log_gains=given))
    assert present(again.appearance.exposure).log_gains()[2].tolist() == [0.0] * 3
    training = trained(replace(inputs, log_gains=given), steps=60)
    found = present(training.appearance.exposure).log_gains().detach()
    assert (found[0] - found[1] - (given[0] - given[1])).abs().max() < 1e-6
    assert (found[2] - found[:2].mean(0)).abs().min() > 0.01
    assert found.mean(0).abs().max() < 1e-6
    # All of it is restored when a training is resumed.
    again.restore(*training.state())
    assert torch.equal(present(again.appearance.exposure).log_gains(), found)


def test_a_resumed_training_keeps_the_exposures_that_auto_has_fixed(capture, inputs, tmp_path, monkeypatch):
    """EXIF of three photos is too little to confirm them again, as with other stereo depths it might be."""
    found = np.array([[0.4] * 3, [-0.4] * 3, [np.nan] * 3])
    monkeypatch.setattr("nerfcli.training.evidence.dense_depths", lambda *photos, **options: [])
    monkeypatch.setattr("nerfcli.training.evidence.matched_log_gains", lambda photos, dense: found)
    settings, notes = replace(SHORT, model="auto", components=Components()), []
    selection = Selection(Components(exposure="matched"), ())
    begun = EarlierDecisions(inputs.extent, RunConfig(settings=settings, selection=selection))
    again = prepare(capture, settings, run=tmp_path, begun=begun, notify=notes.append)
    np.testing.assert_array_equal(present(again.log_gains).numpy(), found)
    assert "matched pixels give the exposure of 2 of 3 photos; the others are learned" in notes


def test_exif_gives_stops_between_photos(capture, tmp_path):
    stops = log_exposures(capture.frames) / math.log(2)
    assert np.diff(stops).tolist() == pytest.approx([1.0, 1.0, 1.0])
    save_photo(tmp_path / "wide.png", seconds=0.01, iso=400, f_number=2.0)  # 2 stops by ISO and 2 by the aperture
    save_photo(tmp_path / "silent.png", seconds=None)
    others = [Frame(name, CAMERA, pose(0), tmp_path / name) for name in ("wide.png", "silent.png")]
    assert (log_exposures(others) / math.log(2) - stops[0])[0] == pytest.approx(4.0)
    reference = mean_log_exposure(log_exposures(capture.train_frames))
    relative = relative_log_exposures(log_exposures([*capture.test_frames, others[1]]), reference)
    # A photo without exposure in EXIF counts as the mean.
    assert relative.tolist() == pytest.approx([-2 * math.log(2), 0.0])
    assert mean_log_exposure(log_exposures(others[1:])) is None
    assert relative_log_exposures(stops, None).tolist() == [0.0] * 4


def test_the_exif_of_a_photo_is_read_once_before_training(capture, tmp_path, monkeypatch):
    read, opened = exif.read_exif, list[Path]()

    def noted(path: Path) -> exif.Exif:
        opened.append(path)
        return read(path)

    monkeypatch.setattr(exif, "read_exif", noted)
    prepare(capture, SHORT, run=tmp_path, notify=lambda text: None)
    assert sorted(map(str, opened)) == sorted(str(frame.image) for frame in capture.train_frames)


def test_a_sphere_interpolates_its_grid_and_one_vertex_is_one_colour():
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    sphere = SphereBackground(5).double()
    axis = torch.linspace(-1, 1, 5, dtype=torch.float64)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    with torch.no_grad():
        sphere.logits.copy_(torch.stack([x, 2 * y - z, 0 * x + 3]))  # linear functions are interpolated exactly
    expected = torch.stack([directions[:, 0], 2 * directions[:, 1] - directions[:, 2], torch.full((50,), 3.0)], dim=-1)
    assert torch.allclose(sphere(directions), torch.sigmoid(expected))
    single = SphereBackground(1).double()
    with torch.no_grad():
        single.logits.copy_(torch.tensor([-1.0, 0.0, 2.0]).view(3, 1, 1, 1))
    assert torch.equal(single(directions), torch.sigmoid(torch.tensor([-1.0, 0.0, 2.0]).double()).expand(50, 3))
    small = SphereBackground(2).double()

    def of_grid(logits: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(small, {"logits": logits}, (directions[:3],))

    assert torch.autograd.gradcheck(of_grid, (torch.randn(3, 2, 2, 2, dtype=torch.float64, requires_grad=True),))
    one_colour = directions.new_tensor([0.1, 0.2, 0.3]).expand(50, 3)
    assert torch.equal(colours_behind((0.1, 0.2, 0.3), directions), one_colour)


def parts_of(components: Components, colours: torch.Tensor, gains: list[float]) -> tuple[Appearance, PixelBatch]:
    """Parts over photos of one pixel each."""
    photos = [
        LoadedPhoto(Frame(f"{i}", Camera("SIMPLE_PINHOLE", 1, 1, (1.0, 0.5, 0.5)), np.eye(4)), level.numpy(), None)
        for i, level in enumerate((colours * 255).round().to(torch.uint8)[:, None, None])
    ]
    pool = pool_of_photos(photos)
    log_gains = torch.tensor(gains)[:, None].expand(-1, 3)
    return Appearance(components, pool, log_gains=log_gains), pool.rays_of(torch.arange(len(photos)))


def test_a_ray_sees_the_background_through_what_the_field_lets_pass_as_its_photo_is_exposed():
    parts, drawn = parts_of(replace(LEARNED, background="constant"), torch.full((2, 3), 0.5), [math.log(2), 0.0])
    rendered, transmittance = torch.full((2, 3), 0.25), torch.tensor([0.5, 0.5])
    seen, measured = parts.compared(rendered, transmittance, drawn, behind=torch.zeros(2, 3))
    # An untrained background is grey, 0.5; the mean of the two gains is half a stop.
    expected = [exposed(torch.tensor(0.5), torch.tensor(sign * math.log(2) / 2)).item() for sign in (1, -1)]
    assert seen[:, 0].tolist() == pytest.approx(expected)
    assert torch.equal(measured, drawn.colours)
    seen.sum().backward()
    assert (present(present(parts.background).logits.grad) > 0).all()


def test_a_background_begins_with_the_colour_of_the_sky():
    colours = torch.tensor([[0.2, 0.4, 0.8], [0.9, 0.1, 0.1]])
    for sky in ([True, False], [False, True]):
        parts, _ = parts_of(replace(LEARNED, exposure="none"), colours, [0.0, 0.0])
        parts.init_background_from_sky(torch.tensor(sky))
        seen = present(parts.background)(torch.tensor([[0.0, 0.6, -0.8]]))[0]
        assert seen.tolist() == pytest.approx(colours[sky.index(True)].tolist(), abs=0.003)


def test_light_of_the_sky_does_not_end_before_it(inputs, monkeypatch):
    inputs = replace(inputs, extent=inputs.extent.before("sphere", sky_known=False))  # few steps clear a short way
    passed, sky = [], torch.ones(len(inputs.pool.colours), dtype=torch.bool)
    for weight in (0.0, schedule.SKY_WEIGHT):
        monkeypatch.setattr(schedule, "SKY_WEIGHT", weight)
        training = trained(replace(inputs, sky=sky), steps=60)
        drawn = inputs.pool.draw(64, torch.Generator().manual_seed(0))
        passed.append(float(light_from_beyond(training, drawn, training.plan, distance=math.inf).mean()))
    assert 1.0 - passed[1] < 0.7 * (1.0 - passed[0])


def test_space_that_no_training_ray_has_reached_is_empty_before_a_known_sky(capture, tmp_path):
    detailed = replace(SHORT, log2_rows=DETAILED_LOG2_ROWS)
    inputs = prepare(capture, detailed, run=tmp_path, notify=lambda text: None)
    for sky in (None, torch.ones(len(inputs.pool.colours), dtype=torch.bool)):
        training = trained(replace(inputs, sky=sky), steps=3)
        model = Checkpoints(tmp_path, training, Totals(), inputs=inputs, scene=capture).model()
        assert torch.equal(model.occupied, training.cells.coarse if sky is None else training.cells.visited)
        assert bool(model.occupied.all()) == (sky is None)
        assert model.occupied.any()


def test_directions_without_pixels_take_the_colours_of_their_neighbours(inputs):
    """No direction reads the middle of the grid, so only the roughness penalty lowers an outlying vertex there."""
    training = Fitting(inputs)
    logits = present(training.appearance.background).logits
    logits.data[:, 16, 16, 16] = 1.0
    for step in range(10):
        training.advance(step / 10)
    assert (logits[:, 16, 16, 16] < 0.9).all()
    assert (logits[:, 16, 16, 17] > 0.0).all()


def test_a_sky_that_no_pixel_shows_changes_nothing():
    parts, drawn = parts_of(replace(LEARNED, exposure="none"), torch.full((2, 3), 0.5), [0.0, 0.0])
    parts.init_background_from_sky(torch.tensor([False, False]))
    assert parts.sky is None
    assert parts.compared(torch.zeros(2, 3), torch.ones(2), drawn, behind=torch.zeros(2, 3))[0].requires_grad


def test_a_saturated_pixel_says_only_that_the_light_was_at_least_that_bright():
    parts, drawn = parts_of(replace(LEARNED, background="auto"), torch.tensor([[1.0] * 3, [0.9] * 3]), [1.0, 1.0])
    rendered = torch.tensor([[1.4] * 3, [1.4] * 3], requires_grad=True)
    seen, measured = parts.compared(rendered, torch.zeros(2), drawn, behind=torch.zeros(2, 3))
    (seen - measured).square().sum().backward()
    saturated, other = present(rendered.grad)
    assert saturated.tolist() == [0.0] * 3
    assert (other > 0).all()


def test_what_is_behind_an_object_is_not_exposed():
    """Half of the light of a ray is the object's, of colour 0.3, the rest white: only the object's is multiplied."""
    colours = torch.tensor([[0.3, 0.3, 0.3, 0.5]] * 2)
    parts, drawn = parts_of(replace(LEARNED, background="auto"), colours, [math.log(4), 0.0])
    behind, transmittance = torch.ones(2, 3), torch.full((2,), 0.5)
    seen, measured = parts.compared(torch.full((2, 3), 0.5 * 0.3 + 0.5), transmittance, drawn, behind=behind)
    own = [exposed(torch.tensor(0.3), torch.tensor(sign * math.log(2))).item() for sign in (1, -1)]
    assert seen[:, 0].tolist() == pytest.approx([0.5 * colour + 0.5 for colour in own])
    expected = drawn.colours[:, 3:] * drawn.colours[:, :3] + (1 - drawn.colours[:, 3:])
    assert torch.equal(measured, expected)
    # Rays that meet no object show the background unchanged.
    clear, _ = parts.compared(behind, torch.ones(2), drawn, behind=behind)
    assert clear.flatten().tolist() == pytest.approx([1.0] * 6)


def test_behind_photos_with_alpha_nothing_is_learned():
    with pytest.raises(UserError, match="their alpha channel says"):
        parts_of(LEARNED, torch.rand(2, 4), [0.0, 0.0])


def test_a_run_keeps_background_and_exposures_and_goes_on_bit_for_bit(capture, tmp_path):
    state = resumed_bit_for_bit(capture, tmp_path, SHORT, stop_at=3)
    by_exif = [-math.log(2), 0.0, math.log(2)]
    assert state["parts.exposure.free"][:, 0].tolist() == pytest.approx(by_exif, abs=0.06)  # six steps on
    model = load_model(tmp_path / "parts" / "field.safetensors", "cpu")
    assert isinstance(model.background, SphereBackground)
    assert torch.equal(model.background.logits, state["parts.background.logits"])
    reference = mean_log_exposure(log_exposures(capture.train_frames))
    assert Run(tmp_path / "parts").cameras.exposures.log_exposure == pytest.approx(reference)


def test_empty_space_shows_the_background_by_direction_whatever_the_tile(capture, tmp_path, monkeypatch):
    fit(capture, tmp_path / "run", replace(SHORT, steps=1))
    model = load_model(tmp_path / "run" / "field.safetensors", "cpu")
    assert isinstance(model.background, SphereBackground)
    with torch.no_grad():
        model.background.logits.copy_(torch.randn_like(model.background.logits))
    empty = replace(model, occupied=torch.zeros_like(model.occupied), fine=None)
    frame = capture.frames[1]
    picture = render_picture(empty, frame, background=empty.background)
    bearings = torch.from_numpy(CAMERA.pixel_bearings()[0]).float()  # the camera's axes are those of the world
    expected = model.background(bearings).detach().numpy().reshape(8, 12, 3)
    assert picture.rgb == pytest.approx(expected, abs=1e-6)
    monkeypatch.setattr("nerfcli.render.pictures.RAYS_PER_TILE", 7)
    assert np.array_equal(render_picture(empty, frame, background=empty.background).rgb, picture.rgb)
    # Held-out photos of known exposure are compared as they were exposed, and the protocol says so.
    truth = np.round(255 * exposed(torch.from_numpy(picture.rgb), torch.tensor(0.5)).clamp(0, 1).numpy())
    photo = HeldOutPhoto(frame, truth.astype(np.uint8), None, log_gains=(0.5, 0.5, 0.5), gains_from="EXIF")
    measured = evaluate_model(empty, [photo])
    assert measured.mean.psnr > 50
    assert "exposures by EXIF," in measured.protocol
    assert measured.images[0].exposure == {"from": "EXIF", "log_gains": [0.5, 0.5, 0.5]}
