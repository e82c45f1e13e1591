"""Speed against error: the Pareto set by its definition, errors in closed form, the command and its files."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import error_of, nerfcli
from conftest import write_run
from fog import CUBE, fog
from full_disk import files_of_at_most
from hypothesis import given, settings
from hypothesis import strategies as st

from nerfcli.bench import measurement
from nerfcli.bench.measurement import (
    FINER,
    SHORTEST_TRAINING_SECONDS,
    RenderSetting,
    TrainSetting,
    affordable,
    as_text,
    is_busy,
    measure_renderings,
    render_settings,
    smaller,
    train_settings,
)
from nerfcli.bench.results import Point, pareto, spread, table_of
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts
from nerfcli.captures.capture import Capture
from nerfcli.errors import BAD_INPUT, INTERRUPTED, UserError
from nerfcli.evaluate.photos import HeldOutPhoto
from nerfcli.evaluate.sampled import SampledPixels
from nerfcli.machine import Resources, processor_name
from nerfcli.render.model import Model
from nerfcli.training.extent import object_frame
from nerfcli.training.runs.settings import TrainSettings

FEW = [RenderSetting(2), RenderSetting(2, step=2.0), RenderSetting(2, step=0.5), RenderSetting(1)]


def at(name: str, seconds: float, error: float) -> Point:
    return Point(name, seconds, seconds, seconds, 1, None, psnr=30.0, levels_off=error)


@pytest.fixture
def _few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit settings and rounds so that a bench takes a second."""
    monkeypatch.setattr(measurement, "render_settings", lambda threads: FEW)
    monkeypatch.setattr(measurement, "MOST_PHOTOS", 1)
    monkeypatch.setattr(measurement, "MOST_ROUNDS", measurement.LEAST_ROUNDS)


@pytest.fixture(scope="module")
def foggy(spheres: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the spheres in which nothing was trained: a cube of fog. Shared by tests, so do not write into it."""
    run = tmp_path_factory.mktemp("foggy") / "run"
    similarity, _ = object_frame(spheres)
    model = fog(CUBE, similarity, background=(1.0, 1.0, 1.0), step=1 / 16)
    with torch.no_grad():
        dict(model.field.named_parameters())["weights.1"][0, 0] = 0.1
    write_run(run, spheres, model, factor=4)
    return run


@given(st.lists(st.tuples(st.integers(1, 8), st.integers(0, 6)), min_size=1, max_size=12))
@settings(deadline=None)
def test_the_pareto_set_is_the_one_of_its_definition(pairs):
    """Against a double loop; of points with the same time and error the first one stands for all."""
    points = [at(str(index), time, error) for index, (time, error) in enumerate(pairs)]

    def beaten(one: Point, index: int) -> bool:
        return any(
            (other.seconds <= one.seconds and other.error < one.error)
            or (other.seconds < one.seconds and other.error <= one.error)
            or ((other.seconds, other.error) == (one.seconds, one.error) and before < index)
            for before, other in enumerate(points)
        )

    assert pareto(points) == {point.name for index, point in enumerate(points) if not beaten(point, index)}


def test_trainings_are_compared_by_psnr_and_spreads_are_medians_with_quartiles():
    assert spread([1.0, 2.0, 3.0, 4.0, 100.0]) == {"seconds": 3.0, "low": 2.0, "high": 4.0, "repeats": 5}
    shorter, longer = (Point(name, s, s, s, 1, None, psnr=db, steps=9) for name, s, db in (("a", 1, 20), ("b", 2, 19)))
    assert pareto([shorter, longer]) == {"a"}
    assert [row[0] for row in table_of([longer, shorter])] == ["a", "b"]


@given(seconds=st.floats(1.0, 5000.0), overhead=st.floats(0.5, 60.0))
@settings(deadline=None)
def test_trainings_fit_into_their_time_and_the_first_ones_are_kept(seconds, overhead):
    everything = train_settings()
    chosen, unit = affordable(everything, seconds, overhead=overhead)
    assert chosen == everything[: len(chosen)]
    if len(chosen) > 1:
        assert unit >= SHORTEST_TRAINING_SECONDS
        assert sum(s.fraction for s in chosen) * unit + len(chosen) * overhead <= seconds * (1 + 1e-9)


def test_every_setting_has_one_name_and_changes_what_it_says():
    names = [setting.name(render_settings(8)[0]) for setting in render_settings(8)]
    assert len(set(names)) == len(names)
    assert names[0] == train_settings()[0].name == "default"
    assert {setting.threads for setting in render_settings(8)} == {1, 2, 4, 8}
    assert RenderSetting(1, step=2.0, tolerance=1 / 255).name(FEW[0]) == "step 2, tolerance 1/255, 1 thread"
    assert [as_text(value) for value in (1 / 1020, 1.0)] == ["1/1020", "1"]
    made = {setting.name: setting.settings(TrainSettings(seed=3), 10.0) for setting in train_settings()}
    assert (made["2 x time"].budget_seconds, made["2 x time"].seed) == (20.0, 3)
    assert (made["2^15 rows"].log2_rows, made["seed 2"].seed) == (15, 2)
    assert made["batch 32768"].samples == (2**13, 2**15)


def towards_fog() -> tuple[Model, HeldOutPhoto]:
    """Return a cube of fog, and an all-black photo that looks at it along z."""
    model = fog(CUBE, Similarity(1.0, np.eye(3), np.zeros(3)), step=1 / 37)
    pose = from_parts(np.eye(3), np.array([0.1, -0.05, -2.0]))
    frame = Frame("a", Camera("PINHOLE", 24, 18, (30.0, 30.0, 12.0, 9.0)), pose)
    return model, HeldOutPhoto(frame, np.zeros((18, 24, 3), np.uint8), None)


def test_a_photo_that_is_some_levels_off_has_the_psnr_of_that():
    model, photo = towards_fog()
    inside = np.zeros((18, 24), bool)
    inside[7:11, 10:14] = True  # the middle sees fog alone: 1/2 (1 - exp(-length))
    grey = round(255 * 0.5 * (1 - np.exp(-1.0)))
    for off in (2, 40):
        shifted = HeldOutPhoto(photo.frame, np.full((18, 24, 3), grey + off, np.uint8), inside)
        assert SampledPixels.drawn([shifted], seed=0).psnr(model) == pytest.approx(20 * np.log10(255 / off), abs=0.5)
    assert len(SampledPixels.drawn([photo], seed=0).pixels[0]) == 18 * 24
    assert len(SampledPixels.drawn([shifted], seed=0).pixels[0]) == inside.sum()


def test_photos_that_masks_hide_are_left_out_of_the_sample():
    model, photo = towards_fog()
    hidden = replace(photo, used=np.zeros((18, 24), bool))
    sample = SampledPixels.drawn([hidden, photo], seed=0)
    assert sample.psnr(model) == SampledPixels.drawn([photo], seed=0).psnr(model)
    assert "pixels of 1 held-out photos" in sample.protocol()
    with pytest.raises(UserError, match="no pixels of the photos are left"):
        SampledPixels.drawn([hidden], seed=0)


def test_the_error_of_steps_shrinks_with_the_step():
    """The border of the fog is at most half a step off, so a quarter of the step has at most half of the error."""
    model, photo = towards_fog()
    converged = [measurement._converged(model, photo)]
    coarse, fine = (measurement._errors(model, [photo], converged, RenderSetting(1, step=s))[1] for s in (2.0, 0.5))
    assert 0 < fine < 0.5 * coarse
    assert measurement._errors(model, [photo], converged, RenderSetting(1, step=1 / FINER, tolerance=1e-6))[1] < 1e-3


def test_smaller_photos_keep_what_they_show():
    _, photo = towards_fog()
    masked = HeldOutPhoto(photo.frame, np.full((18, 24, 3), 200, np.uint8), np.ones((18, 24), bool))
    half = smaller(masked, 2.0)
    assert half.pixels.shape == (9, 12, 3)
    assert half.used is not None
    assert half.used.all()
    assert (half.frame.camera.width, half.frame.camera.height) == (12, 9)
    assert smaller(photo, 0.7) is photo


def test_the_machine_is_named_and_a_busy_one_is_noticed():
    assert processor_name()
    assert is_busy(1000.0)
    assert not is_busy(0.0)
    assert not is_busy(None)


@pytest.mark.usefixtures("_few")
def test_a_bench_of_a_run_writes_table_csv_json_and_plot_and_is_kept(foggy, spheres, tmp_path):
    folder = tmp_path / "bench"
    line = ("bench", foggy, "--budget", "60s", "--threads", "2", "-o", folder)
    first = nerfcli(*line)
    assert (first.exit_code, first.stdout.strip()) == (0, str(folder / "bench.csv")), first.stderr
    content = json.loads((folder / "bench.json").read_text())
    points = {point["name"]: point for point in content["points"]}
    assert list(points) == ["default", "step 2", "step 0.5", "1 thread"]
    assert points["step 0.5"]["levels_off"] < points["default"]["levels_off"] < points["step 2"]["levels_off"]
    for name in ("psnr", "levels_off"):  # the number of threads changes no bit of a picture
        assert points["1 thread"][name] == points["default"][name]
    assert all(point["repeats"] == measurement.LEAST_ROUNDS for point in points.values())
    with (folder / "bench.csv").open(encoding="utf-8") as file:
        assert {row["name"]: float(row["psnr"]) for row in csv.DictReader(file)} == {
            name: point["psnr"] for name, point in points.items()
        }
    assert (folder / "bench.png").read_bytes().startswith(b"\x89PNG")
    again = nerfcli(*line)
    assert "is complete" in again.stderr
    for other in (("bench", spheres.root, *line[2:]), (*line, "--budget", "50s"), (*line, "--threads", "1")):
        error, hint = error_of(nerfcli(*other))
        assert (error, "--overwrite" in hint) == (
            f"Error: {folder / 'bench.json'} exists, made from other files or with other settings",
            True,
        )
    assert json.loads((folder / "bench.json").read_text()) == content
    with files_of_at_most(100):
        result = nerfcli(*line, "--overwrite")
    assert result.exit_code == BAD_INPUT
    assert "free some disk space" in error_of(result)[1]
    assert json.loads((folder / "bench.json").read_text()) == content


@pytest.mark.usefixtures("_few")
def test_an_interrupted_bench_keeps_what_it_has(foggy, tmp_path, monkeypatch):
    def interrupted(*given, save, **named):
        def save_and_stop(points):
            save(points)
            raise KeyboardInterrupt

        measure_renderings(*given, save=save_and_stop, **named)

    monkeypatch.setattr(measurement, "measure_renderings", interrupted)
    (tmp_path / "bench" / ".training").mkdir(parents=True)  # of a bench of a scene that was killed
    result = nerfcli("bench", foggy, "--budget", "60s", "--threads", "2", "-o", tmp_path / "bench")
    assert (result.exit_code, result.stdout) == (INTERRUPTED, "")
    content = json.loads((tmp_path / "bench" / "bench.json").read_text())
    assert not content["complete"]
    assert len(content["points"]) == len(FEW)


def test_a_bench_of_a_scene_trains_it(spheres, tmp_path, monkeypatch):
    """Two trainings of a few steps; of the runs nothing is left."""
    monkeypatch.setattr("nerfcli.training.runs.settings.FEWEST_LOG2_ROWS", 10)
    monkeypatch.setattr(measurement, "affordable", lambda settings, seconds, overhead: (settings[:2], 600.0))
    monkeypatch.setattr(TrainSetting, "settings", lambda self, base, seconds: replace(base, steps=2, downscale=8))
    saved: list[list[Point]] = []
    how = {"resources": Resources(2, "cpu"), "seconds": 60.0}
    measurement.measure_trainings(
        spheres, tmp_path, **how, save=lambda points: saved.append(list(points)), tell=lambda *progress: None
    )
    assert [[point.name for point in points] for points in saved] == [["default"], ["default", "seed 1"]]
    assert all((point.steps, point.levels_off) == (2, None) and np.isfinite(point.psnr) for point in saved[-1])
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_measured_is_reported(tmp_path, foggy):
    assert nerfcli("bench", foggy, "--budget", "3s").exit_code == 2
    (tmp_path / "empty").mkdir()
    result = nerfcli("bench", tmp_path / "empty")
    assert result.exit_code == 3
    assert not (tmp_path / "empty-bench").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    assert "is not a bench folder" in error_of(nerfcli("bench", foggy, "-o", tmp_path / "mine"))[0]
    (tmp_path / "mine" / "bench.json").write_text('{"complete": true}')
    error, hint = error_of(nerfcli("bench", foggy, "-o", tmp_path / "mine"))
    assert "it has no source_sha256" in error
    assert "--overwrite" in hint
