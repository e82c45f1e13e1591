"""Training on a capture with known geometry: it learns, it repeats bit for bit, it goes on, it stops as asked."""

import itertools
import json
import math
import os
import shutil
import signal
from dataclasses import replace
from mmap import mmap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import SPHERES
from present import present
from trainings import FEW, fit, held_out_photos, resumed_bit_for_bit, weights

from nerfcli import kernels
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, apply, rotation_from_quaternion
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import recognise
from nerfcli.captures.formats.run_cameras import read_cameras, write_cameras
from nerfcli.captures.holdout import default_split
from nerfcli.captures.loading import fingerprint
from nerfcli.errors import BAD_INPUT, UserError
from nerfcli.evaluate.protocol import evaluate_model
from nerfcli.field import hash_field
from nerfcli.field.checkpoint import load_tensors, save_tensors
from nerfcli.machine import peak_resident_bytes
from nerfcli.photos.colours import over_white
from nerfcli.photos.images import read_image, write_png
from nerfcli.photos.loading import load_photos
from nerfcli.render.files.float_maps import read_tiff
from nerfcli.render.model import load_model
from nerfcli.render.pictures import DepthRequest, render_picture
from nerfcli.training import loop, sentinel
from nerfcli.training.loop import Progress
from nerfcli.training.pool import PixelBatch, PixelPool
from nerfcli.training.runs.components import Components, choose
from nerfcli.training.runs.files import LogEntry, append_log, read_log
from nerfcli.training.runs.run import Run, continued, read_config
from nerfcli.training.runs.settings import TrainSettings, automatic_downscale

LONGER = replace(FEW, steps=24, log2_rows=12)
# The number of rows is chosen automatically, as by default.
CHOSEN_ROWS = replace(FEW, log2_rows=None)
# Enough samples that the number of rays adapts to the samples of earlier rays.
ADAPTIVE = replace(LONGER, first_samples_per_step=2**15, samples_per_step=2**15)


@pytest.fixture(scope="module")
def views(spheres: Capture) -> Capture:
    """Some of the views, none held out: checks on held-out pixels take longer than steps."""
    return replace(spheres, frames=spheres.frames[:4], test_names=frozenset())


@pytest.fixture(scope="module")
def straight(views: Capture, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Progress]]:
    """A training with `ADAPTIVE` that nothing interrupts, and the progress of its steps. Do not write into its run."""
    run = tmp_path_factory.mktemp("straight") / "run"
    return run, fit(views, run, ADAPTIVE)


def test_held_out_views_are_far_better_than_one_colour(spheres, spheres_run):
    # The yardstick: the best single colour, the mean of the training photos on white.
    photos = held_out_photos(spheres)
    mean = np.mean([over_white(p.pixels) for p in load_photos(spheres.train_frames, factor=1, threads=1)], (0, 1, 2))
    errors = [np.square((over_white(photo.pixels) - mean) / 255).mean() for photo in photos]
    one_colour = np.mean([-10 * math.log10(error) for error in errors])
    metrics = evaluate_model(load_model(spheres_run / "field.safetensors", "cpu"), photos)
    assert 9 < one_colour < 11
    assert metrics.mean.psnr > one_colour + 8
    assert present(metrics.mean.ssim) > 0.7
    # What the log said during training is the same quantity, pooled over some pixels.
    assert read_log(spheres_run)[-1].get("heldout_psnr", 0.0) == pytest.approx(metrics.mean.psnr, abs=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("with_points", [True, False])
def test_photos_of_a_desk_are_learned_too(with_points, tmp_path):
    # Photos without alpha, of an unbounded scene, with the cameras that rendered them, and points as structure from
    # motion would give them, from the true depth of the held-out views.
    desk = SPHERES.with_name("desk")
    recorded = json.loads((desk / "truth" / "cameras.json").read_text())
    camera = Camera.from_json(recorded["camera"])
    views = [(view["name"], np.array(view["world_from_cam"])) for view in recorded["images"]]
    frames = tuple(Frame(name, camera, pose, desk / "images" / name) for name, pose in views)
    names = default_split(frame.name for frame in frames)
    points = []
    for frame in (frame for frame in frames if frame.name in names):
        depth = read_tiff(desk / "truth" / "depth" / f"{Path(frame.name).stem}.tiff")
        bearings, _ = camera.pixel_bearings()
        in_camera = (bearings / bearings[:, 2:] * depth.reshape(-1, 1))[::400]
        points.append(apply(frame.world_from_cam, in_camera))
    # Points show how near to the cameras the scene begins.
    cloud = np.concatenate(points) if with_points else np.zeros((0, 3))
    scene = Capture(frames, cloud, kind="transforms", root=desk, test_names=names)
    settings = TrainSettings(budget_seconds=None, steps=400, downscale=8, samples_per_step=2**14, threads=2)
    fit(scene, tmp_path / "run", settings)
    photos = load_photos(scene.test_frames, factor=8, threads=1)
    mean = np.mean([p.pixels for p in load_photos(scene.train_frames, factor=8, threads=1)], (0, 1, 2))
    one_colour = np.mean([-10 * math.log10(np.square((photo.pixels - mean) / 255).mean()) for photo in photos])
    assert read_log(tmp_path / "run")[-1].get("heldout_psnr", 0.0) > one_colour + 3


@pytest.mark.parametrize(("axis", "truth"), [("z", "z"), ("ray", "distance")])
def test_trained_depth_is_the_true_depth_of_the_balls(axis, truth, spheres, spheres_run):
    # Truth: rays intersected with the balls and the box in closed form, by the script that made the capture.
    model = load_model(spheres_run / "field.safetensors", "cpu")
    for index, frame in enumerate(spheres.test_frames):
        expected = read_tiff(SPHERES / "truth" / f"r_{index:03d}_{truth}.tiff")
        request = DepthRequest("median", axis)
        depth = present(render_picture(model, frame, background=model.background, depth=request).depth)
        both = np.isfinite(expected) & np.isfinite(depth)
        assert (np.isfinite(expected) == np.isfinite(depth)).mean() > 0.95
        # 0.15 of 4: the fog of a short training is that thick.
        assert np.median(np.abs(depth - expected)[both]) < 0.15


def test_occupancy_keeps_the_surfaces_and_little_else(spheres, spheres_run):
    # Points just inside of the surfaces that the held-out views see, by the true distances along their rays.
    model = load_model(spheres_run / "field.safetensors", "cpu")
    for index, frame in enumerate(spheres.test_frames):
        distance = read_tiff(SPHERES / "truth" / f"r_{index:03d}_distance.tiff")
        hit = np.isfinite(distance).ravel()
        bearings, _ = frame.camera.pixel_bearings()
        rays = bearings[hit] @ frame.world_from_cam[:3, :3].T
        surface = frame.centre + (0.02 + distance.reshape(-1, 1)[hit]) * rays
        unit = model.training_from_scene.apply(surface) / 2 + 0.5
        x, y, z = (unit * len(model.occupied)).astype(int).T
        assert model.occupied[z, y, x].float().mean() > 0.85
    assert model.occupied.float().mean() < 0.2


def test_a_hundred_steps_do_not_close_all_of_space(spheres, tmp_path):
    """An empty field has 8.5 dB, and no sample from which it could learn."""
    fit(spheres, tmp_path / "run", replace(LONGER, steps=100, first_samples_per_step=2**12, samples_per_step=2**12))
    *_, before, last = read_log(tmp_path / "run")
    assert last["samples"] > before["samples"]
    assert last.get("heldout_psnr", 0.0) > 14


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(views, tmp_path):
    settings = replace(FEW, steps=10)
    for name, seed in (("one", 3), ("two", 3), ("other", 4)):
        fit(views, tmp_path / name, replace(settings, seed=seed))
    assert weights(tmp_path / "one") == weights(tmp_path / "two")
    assert weights(tmp_path / "one") != weights(tmp_path / "other")


def test_the_reference_trains_as_the_compiled_kernels_do(views, tmp_path, monkeypatch):
    # CUDA tensors and machines without Numba use the reference. Rounding grows with each step but is small after six.
    settings = replace(FEW, steps=6)
    compiled = fit(views, tmp_path / "compiled", settings)
    monkeypatch.setattr(kernels, "_numba_cpu", lambda: None)
    reference = fit(views, tmp_path / "reference", settings)
    assert [step.loss for step in reference] == pytest.approx([step.loss for step in compiled], rel=1e-3)


def test_interrupted_and_resumed_equals_straight_bit_for_bit(views, straight, tmp_path):
    assert kernels.backend_for(torch.device("cpu"), torch.float32).deterministic
    whole, steps = straight
    fit(views, tmp_path / "parts", ADAPTIVE, stop_at=11)
    halfway = load_model(tmp_path / "parts" / "field.safetensors", "cpu")  # the run left by Ctrl-C can be loaded
    assert all(torch.isfinite(tensor).all() for tensor in halfway.field.state_dict().values())
    assert not Run(tmp_path / "parts").is_complete(ADAPTIVE)
    second = fit(views, tmp_path / "parts", ADAPTIVE, resume=True)
    assert [progress.step for progress in second] == list(range(12, 25))
    assert [progress.loss for progress in second] == [progress.loss for progress in steps[11:]]
    assert weights(tmp_path / "parts") == weights(whole)
    assert Run(tmp_path / "parts").is_complete(ADAPTIVE)
    log = read_log(tmp_path / "parts")
    assert [entry["step"] for entry in log] == sorted(entry["step"] for entry in log)
    assert log[-1]["samples"] == read_log(whole)[-1]["samples"]


@pytest.mark.parametrize("kind", ["voxels", "mlp"])
def test_fields_of_other_kinds_train_and_resume_bit_for_bit(kind, views, tmp_path):
    resumed_bit_for_bit(views, tmp_path, replace(FEW, field=kind, field_memory_bytes=50_000), stop_at=5)
    assert load_model(tmp_path / "parts" / "field.safetensors", "cpu").field.settings.kind == kind


def test_photos_of_another_size_leave_the_field_of_a_training_as_it_is(views, tmp_path):
    """By itself, a dense grid would have fewer vertices for smaller photos."""
    settings = replace(FEW, steps=1, field="voxels", downscale=4)
    fit(views, tmp_path / "run", settings)
    before = load_model(tmp_path / "run" / "field.safetensors", "cpu").field.settings
    assert len(fit(views, tmp_path / "run", replace(settings, steps=2, downscale=8), resume=True)) == 1
    assert load_model(tmp_path / "run" / "field.safetensors", "cpu").field.settings == before


@pytest.mark.parametrize("steps", [1, 600, 1800, 1801, 9000])
@pytest.mark.parametrize("first", [2**13, 2**16, 2**17])
def test_expected_samples_are_the_sum_over_the_steps(first, steps):
    settings = replace(FEW, first_samples_per_step=first, samples_per_step=2**16, steps=steps)
    total = sum(min(2**16, first * 2 ** (step / 600)) for step in range(steps))
    assert settings.expected_samples == pytest.approx(total, rel=1e-3)
    by_time = replace(settings, budget_seconds=1e-3)
    assert by_time.expected_samples == pytest.approx(min(total, 2e3), rel=1e-3)


def test_longer_trainings_have_more_rows_and_given_ones_stay():
    budgets = [1e-6, 15, 60, 120, 300, 600, 1800, 1e9]
    rows = [replace(CHOSEN_ROWS, steps=None, budget_seconds=seconds).chosen_log2_rows for seconds in budgets]
    assert rows == sorted(rows)
    assert (rows[0], rows[1], rows[-1]) == (16, 16, 19)
    assert replace(FEW, log2_rows=12).chosen_log2_rows == 12
    assert len({replace(CHOSEN_ROWS, steps=4000, threads=threads).chosen_log2_rows for threads in (1, 2)}) == 1


def test_a_training_that_goes_on_to_a_larger_total_keeps_its_rows(views, tmp_path, monkeypatch):
    """The larger total would by default choose more rows; a different number given explicitly is refused."""
    fit(views, tmp_path / "run", replace(CHOSEN_ROWS, steps=2))
    monkeypatch.setattr("nerfcli.training.runs.settings.FEWEST_LOG2_ROWS", 17)
    assert replace(CHOSEN_ROWS, steps=3).chosen_log2_rows == 17
    fit(views, tmp_path / "run", replace(CHOSEN_ROWS, steps=3), resume=True)
    assert load_model(tmp_path / "run" / "field.safetensors", "cpu").field.settings.to_json()["log2_rows"] == 16
    assert read_config(tmp_path / "run").settings.log2_rows == 16
    on_gpu = replace(CHOSEN_ROWS, device="cuda")
    assert continued(tmp_path, on_gpu, before=read_config(tmp_path / "run")).log2_rows == 16
    with pytest.raises(UserError, match="was trained with log2_rows=16, not log2_rows=17"):
        fit(views, tmp_path / "run", replace(CHOSEN_ROWS, steps=4, log2_rows=17), resume=True)


def test_detailed_fields_train_and_resume_bit_for_bit_with_their_fine_cells(views, tmp_path, monkeypatch):
    monkeypatch.setattr(sentinel, "SNAPSHOT_EVERY", 4)  # also while the sentinel takes snapshots
    monkeypatch.setattr(hash_field, "DETAILED_LOG2_ROWS", LONGER.log2_rows)
    state = resumed_bit_for_bit(views, tmp_path, LONGER, stop_at=11)
    assert {"fine_occupied", "fine_visits"} <= state.keys()
    assert 0.01 < state["fine_depth"].isfinite().float().mean() < 0.99


def test_detailed_fields_are_rendered_in_half_of_the_steps_of_their_training(views, tmp_path, monkeypatch):
    monkeypatch.setattr(hash_field, "DETAILED_LOG2_ROWS", 11)
    saved = {}
    for rows in (10, 11):
        fit(views, tmp_path / str(rows), replace(FEW, steps=1, log2_rows=rows))
        marching = load_model(tmp_path / str(rows) / "field.safetensors", "cpu").marching
        trained = load_tensors(tmp_path / str(rows) / "state.safetensors", "cpu")[1]["extent"]["marching"]
        saved[rows] = (marching.shortest_step / trained["shortest_step"], marching.far == trained["far"])
    assert saved == {10: (1.0, True), 11: (0.5, True)}


def test_resume_goes_on_to_a_larger_total(views, tmp_path):
    fit(views, tmp_path / "run", replace(FEW, steps=3))
    second = fit(views, tmp_path / "run", replace(FEW, steps=5), resume=True)
    assert [progress.step for progress in second] == [4, 5]
    assert second[0].seconds > read_log(tmp_path / "run")[0]["seconds"]  # the clock goes on too
    assert read_config(tmp_path / "run").settings.steps == 5
    assert fit(views, tmp_path / "run", replace(FEW, steps=5), resume=True) == []


@pytest.mark.parametrize("size", [{"log2_rows": None, "field_memory_bytes": 200_000}, {"field": "voxels"}])
def test_a_resumed_training_keeps_its_settings(size, views, tmp_path):
    """They need not be given again; others than before are refused, or would be in the description alone."""
    chosen = {"components": Components(distortion=0.01, exposure="learned"), "fixed": ("distortion", "exposure")}
    settings = replace(FEW, steps=6, downscale=4, seed=3, **chosen, **size)
    bare = TrainSettings(budget_seconds=None, steps=6, threads=2)
    fit(views, tmp_path / "straight", settings)
    fit(views, tmp_path / "parts", settings, stop_at=3)
    for wanted in ("background=sphere", "distortion=0.05"):
        others = choose(settings.components, included=(wanted,), excluded=())
        changed = replace(settings, components=others, fixed=(wanted.partition("=")[0],))
        with pytest.raises(UserError, match=rf"was trained with .*, not {wanted}"):
            fit(views, tmp_path / "parts", changed, resume=True)
    changes = (replace(bare, seed=5), replace(bare, log2_rows=11), replace(bare, field="mlp"))
    changes += (replace(bare, field_memory_bytes=9), replace(bare, contraction="l2"))
    for changed in (*changes, replace(bare, components=Components(exposure="exif"))):
        with pytest.raises(UserError, match="was trained with"):
            fit(views, tmp_path / "parts", changed, resume=True)
    fit(views, tmp_path / "parts", bare, resume=True)
    assert weights(tmp_path / "parts") == weights(tmp_path / "straight")
    assert read_config(tmp_path / "parts") == read_config(tmp_path / "straight")


def test_what_has_learned_goes_on_learning_in_a_larger_budget(views, tmp_path):
    """At step 4 of 400 the finest level of the grid does not learn, except in a field that has learned it before."""

    def finest(run: Path) -> torch.Tensor:
        return load_tensors(run / "field.safetensors", "cpu")[0]["table"][-1]

    fit(views, tmp_path / "fresh", replace(FEW, steps=400), stop_at=4)
    assert finest(tmp_path / "fresh").abs().max() <= 1e-4  # as initialised
    fit(views, tmp_path / "run", replace(FEW, steps=3))
    learned = finest(tmp_path / "run")
    assert learned.abs().max() > 1e-4
    fit(views, tmp_path / "run", replace(FEW, steps=400), resume=True, stop_at=4)
    assert not torch.equal(finest(tmp_path / "run"), learned)


def test_a_training_goes_on_from_the_checkpoint_of_another_type_of_device(views, tmp_path):
    """The state of a GPU's random numbers has 16 bytes, and means nothing to a CPU."""
    fit(views, tmp_path / "run", replace(FEW, steps=3))
    tensors, description = load_tensors(tmp_path / "run" / "state.safetensors", "cpu")
    tensors["generator"] = torch.zeros(16, dtype=torch.uint8)
    save_tensors(tmp_path / "run" / "state.safetensors", tensors, description)
    assert [progress.step for progress in fit(views, tmp_path / "run", replace(FEW, steps=4), resume=True)] == [4]


@pytest.mark.parametrize("last", ["field.safetensors", "state.safetensors"])
def test_a_kill_between_field_and_state_is_no_harm(last, views, straight, tmp_path):
    # The process dies between the two files of the second checkpoint, or of the first.
    whole, _ = straight
    fit(views, tmp_path / "run", ADAPTIVE, stop_at=9)
    if last == "state.safetensors":
        (tmp_path / "run" / "field.safetensors").unlink()  # the first time, the state is written first
    else:
        shutil.copy(whole / "field.safetensors", tmp_path / "run")  # a field that is ahead of the state
    with (tmp_path / "run" / "log.jsonl").open("a") as log:
        log.write('{"step": 24, "seconds": 1e3, "loss": 1}\n{"step": 25, "seco')
    assert not Run(tmp_path / "run").is_complete(ADAPTIVE)
    fit(views, tmp_path / "run", ADAPTIVE, resume=True)
    assert weights(tmp_path / "run") == weights(whole)
    steps = [entry["step"] for entry in read_log(tmp_path / "run")]
    assert steps == sorted(set(steps))
    assert (steps[-1], 9 in steps) == (24, True)


def test_ctrl_c_waits_for_the_end_of_the_step(views, straight, tmp_path, monkeypatch):
    draw = PixelPool.draw
    calls = 0

    def interrupt(self: PixelPool, count: int, generator: torch.Generator) -> PixelBatch:
        nonlocal calls
        calls += 1
        if calls == 5:  # in the middle of the fifth step
            signal.raise_signal(signal.SIGINT)
        return draw(self, count, generator)

    monkeypatch.setattr(PixelPool, "draw", interrupt)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        fit(views, tmp_path / "run", ADAPTIVE)
    assert signal.getsignal(signal.SIGINT) is before
    assert Run(tmp_path / "run").saved_progress()[0] == 5
    fit(views, tmp_path / "run", ADAPTIVE, resume=True)
    assert weights(tmp_path / "run") == weights(straight[0])


def test_resume_without_a_checkpoint_is_reported(views, tmp_path):
    with pytest.raises(UserError, match=r"state\.safetensors does not exist"):
        fit(views, tmp_path / "run", FEW, resume=True)


def test_the_time_budget_is_kept_within_a_step(views, tmp_path, monkeypatch):
    ticks = itertools.count(step=0.2)
    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: next(ticks)))
    progress = fit(views, tmp_path / "run", replace(FEW, budget_seconds=0.5, steps=None))
    assert progress[-2].seconds < 0.5 <= progress[-1].seconds
    assert progress[-1].fraction == 1
    assert [p.fraction for p in progress] == sorted(p.fraction for p in progress)


def test_the_first_limit_that_is_reached_ends_the_training(views, tmp_path):
    progress = fit(views, tmp_path / "run", replace(FEW, budget_seconds=1000.0, steps=2))
    assert [p.step for p in progress] == [1, 2]


def test_the_log_records_speed_memory_and_held_out_psnr(spheres, tmp_path):
    progress = fit(spheres, tmp_path / "run", replace(FEW, steps=2))
    log = read_log(tmp_path / "run")
    assert [entry["step"] for entry in log if "heldout_psnr" in entry] == [1, 2]
    last = log[-1]
    assert last["loss"] == progress[-1].loss == sum(last.get("losses", {}).values())
    assert [name for name, loss in last.get("losses", {}).items() if loss] == ["colour", "distortion"]
    assert last["seconds"] == pytest.approx(progress[-1].seconds, abs=1e-3)
    assert last["samples_per_second"] > 0
    assert last["rays_per_second"] > 0
    assert 2**26 < last["peak_memory_bytes"] < 2**34


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux counts from a moment on")
def test_the_peak_of_memory_is_that_of_the_training(views, tmp_path):
    """Regression: of several trainings in a process, each had the largest peak of those before it."""
    with mmap(-1, 2**28) as memory:  # not an array, whose memory a process may keep
        memory[::4096] = bytes(2**16)
        peak = peak_resident_bytes()
    fit(views, tmp_path / "run", replace(FEW, steps=1))
    assert read_log(tmp_path / "run")[-1]["peak_memory_bytes"] < peak - 2**26


def test_a_scene_without_held_out_photos_trains(views, tmp_path):
    fit(views, tmp_path / "run", replace(FEW, steps=1))
    assert "heldout_psnr" not in read_log(tmp_path / "run")[-1]


def test_photos_without_alpha_train_an_unbounded_scene(spheres, tmp_path):
    # The same views on white, as photos that fill the frame.
    frames = []
    for frame in spheres.frames[:2]:
        image = tmp_path / f"{frame.name.replace('/', '_')}"
        write_png(image, over_white(read_image(frame.image)))
        frames.append(replace(frame, image=image))
    scene = replace(spheres, frames=tuple(frames), test_names=frozenset())
    fit(scene, tmp_path / "run", replace(FEW, steps=2))
    model = load_model(tmp_path / "run" / "field.safetensors", "cpu")
    assert model.contraction == "l2"
    assert model.marching.far > 100
    picture = render_picture(model, frames[0], background=model.background)
    assert np.isfinite(picture.rgb).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"budget_seconds": None, "steps": None}, "no stopping criterion"),
        ({"budget_seconds": -1.0}, "budget must be positive"),
        ({"budget_seconds": 0.0, "steps": 10}, "budget must be positive"),
        ({"steps": -3}, "budget must be positive"),
        ({"budget_seconds": None, "steps": 0}, "budget must be positive"),
        ({"downscale": 3}, "invalid downscale factor 3"),
        ({"log2_rows": 0}, "invalid size of the field: log2-rows 0"),
        ({"field": "gaussians"}, "unknown type of field: 'gaussians'"),
    ],
)
def test_impossible_settings_are_refused(wrong, message):
    with pytest.raises(UserError, match=message) as caught:
        TrainSettings(**wrong)
    assert caught.value.exit_code == BAD_INPUT


def test_automatic_downscale_is_the_smallest_that_fits():
    sides = [(800, 600), (801, 600), (600, 1600), (1601, 10), (3200, 3200), (3201, 10), (6400, 9), (20000, 1)]
    cameras = [Camera.pinhole(*size, 500.0) for size in sides]
    assert [automatic_downscale([camera]) for camera in cameras] == [1, 2, 2, 4, 4, 8, 8, 8]
    # One small photo, even the first of all, does not have the others trained at their full size.
    assert [automatic_downscale([cameras[0], *[cameras[3]] * count]) for count in (0, 1, 9)] == [1, 4, 4]
    panoramas = [Camera("EQUIRECTANGULAR", width, width // 2, (width, width // 2)) for width in (1600, 1602, 5760)]
    assert [automatic_downscale([panorama]) for panorama in panoramas] == [1, 2, 4]


def beside_photos(folder: Path, scene: Capture) -> tuple[Frame, ...]:
    """Return the held-out frames with copies of their photos in `folder`."""
    shutil.copytree(SPHERES / "test", folder / "photos")
    return tuple(replace(frame, image=folder / "photos" / Path(frame.name).name) for frame in scene.test_frames)


def test_cameras_of_a_run_come_back_exactly_and_move_with_it(tmp_path, spheres):
    frames = beside_photos(tmp_path / "here", spheres)
    masked = replace(frames[0], mask=frames[0].image)
    run = tmp_path / "here" / "runs" / "one"
    run.mkdir(parents=True)
    write_cameras(run, frames[1:], [masked])
    os.rename(tmp_path / "here", tmp_path / "there")
    moved = tmp_path / "there" / "runs" / "one"
    read = read_cameras(moved)
    for found, expected in ((read.train, frames[1:]), (read.test, (masked,))):
        for ours, theirs in zip(found, expected, strict=True):
            assert (ours.name, ours.camera) == (theirs.name, theirs.camera)
            np.testing.assert_array_equal(ours.world_from_cam, theirs.world_from_cam)
            assert present(ours.image).is_file()
    assert read.test[0].mask is not None
    assert read.train[0].mask is None


def test_a_run_that_is_moved_alone_finds_its_photos(tmp_path, spheres):
    run, moved = tmp_path / "runs" / "one", tmp_path / "kept" / "deeper" / "one"
    run.mkdir(parents=True)
    moved.parent.mkdir(parents=True)
    frames = beside_photos(tmp_path, spheres)
    write_cameras(run, frames[1:], [replace(frames[0], mask=frames[0].image)])
    run.rename(moved)
    read = read_cameras(moved)
    assert [frame.image for frame in (*read.test, *read.train)] == [frame.image for frame in frames]
    assert read.test[0].mask == frames[0].image
    shutil.rmtree(tmp_path / "photos")
    missing = present(read_cameras(moved).train[0].image)
    assert missing.is_relative_to(moved)


def test_a_folder_that_is_no_run_is_reported(tmp_path):
    for read, file in ((read_cameras, "cameras.json"), (read_config, "config.json")):
        with pytest.raises(UserError, match=f"is not a run folder: it has no {file}"):
            read(tmp_path)
        for content in ("{", '{"train": [{"name": "a"}], "test": []}'):
            (tmp_path / file).write_text(content)
            with pytest.raises(UserError, match=f"{file} cannot be read"):
                read(tmp_path)


def test_a_log_line_that_a_kill_cut_short_is_left_out(tmp_path):
    assert read_log(tmp_path) == []
    totals: Any = {"step": 1, "seconds": 0.5, "loss": 0.1, "samples": 7, "rays": 3, "peak_memory_bytes": 9}
    entry: LogEntry = totals
    for broken in ('{"step": 3, "sec', "[]", "\x00", json.dumps({**entry, "samples": "7"}), json.dumps(entry)[:-2]):
        append_log(tmp_path, entry)
        append_log(tmp_path, totals | {"step": 2})
        with (tmp_path / "log.jsonl").open("a") as file:
            file.write(broken)
        assert read_log(tmp_path) == [entry, {**entry, "step": 2}]
        (tmp_path / "log.jsonl").unlink()


def as_convert_reads(run: Path) -> Capture:
    """Read the cameras of a run as `nerfcli convert` does."""
    form, found = recognise(run)
    return form.parse(found, UserInputs())


def says_the_same(text: str, other: str) -> bool:
    try:
        return json.loads(text) == json.loads(other)
    except json.JSONDecodeError:
        return False


@pytest.mark.parametrize(
    ("file", "read"), [("config.json", read_config), ("cameras.json", read_cameras), ("cameras.json", as_convert_reads)]
)
def test_a_digit_that_changes_in_the_description_of_a_run_is_noticed(file, read, views, tmp_path):
    fit(views, tmp_path / "run", replace(FEW, steps=1))
    path = tmp_path / "run" / file
    whole = path.read_text()
    name = whole.index('"blake2b"')  # without this name the file would pass unchecked
    digits = [index for index, letter in enumerate(whole) if letter.isdigit() and not 0 <= index - name < 9]
    for index in digits[:: max(1, len(digits) // 40)]:
        changed = whole[:index] + str((int(whole[index]) + 1) % 10) + whole[index + 1 :]
        if says_the_same(changed, whole):
            continue  # the 17th digit of a float64
        path.write_text(changed)
        with pytest.raises(UserError, match=rf"{file} cannot be read"):
            read(tmp_path / "run")
    path.write_text(whole)
    read(tmp_path / "run")


def test_what_counts_as_the_same_run(views, tmp_path):
    settings = replace(FEW, steps=1, downscale=4)
    fit(views, tmp_path / "run", settings)
    same = [settings, replace(settings, threads=1), replace(settings, device="cuda"), replace(settings, downscale=None)]
    assert all(Run(tmp_path / "run").is_trained_from(views, other) for other in same)
    other_settings = [replace(settings, seed=1), replace(settings, downscale=2), replace(settings, steps=2)]
    assert not any(Run(tmp_path / "run").is_trained_from(views, other) for other in other_settings)
    turned = Similarity(1.0, rotation_from_quaternion(np.array([1.0, 0.01, 0.0, 0.0])), np.zeros(3))
    frames = tuple(replace(f, world_from_cam=turned.apply_pose(f.world_from_cam)) for f in views.frames)
    assert not Run(tmp_path / "run").is_trained_from(replace(views, frames=frames), settings)
    config = read_config(tmp_path / "run")
    assert config.settings.downscale == 4
    assert config.scene_fingerprint == fingerprint(views)
    assert set(config.versions) >= {"nerfcli", "python", "torch", "numpy"}
