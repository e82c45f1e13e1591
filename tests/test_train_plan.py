"""The plan of a training against the files that a training leaves, and through the command."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from conftest import SPHERES
from typer.testing import CliRunner

from nerfcli.captures.capture import Capture
from nerfcli.cli import app
from nerfcli.errors import OUT_OF_MEMORY, UserError
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.kinds import KINDS, chosen_size, parameter_bytes
from nerfcli.machine import Resources
from nerfcli.training import loop
from nerfcli.training.loop import train
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import SHOWN, THRESHOLD
from nerfcli.training.storage import planned_field
from nerfcli.workflows.train import plan_training

STEPS = TrainSettings(budget_seconds=None, steps=250)


def test_disk_space_covers_a_run_its_waypoints_and_the_state_that_is_replaced(
    spheres: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(STEPS, steps=4, first_samples_per_step=2**9, samples_per_step=2**9, threads=2)
    run, measured, measure = tmp_path / "run", list[int](), loop.measure_waypoints

    def weighed(*arguments: Any, **named: Any) -> None:
        measured.append(sum(file.stat().st_size for file in run.rglob("*") if file.is_file()))
        measure(*arguments, **named)

    monkeypatch.setattr(loop, "measure_waypoints", weighed)
    train(spheres, run, settings, resume=False, notify=lambda text: None, on_progress=lambda progress: None)
    planned = plan_training(SPHERES, settings).disk_bytes
    assert planned == pytest.approx(measured[0] + (run / "state.safetensors").stat().st_size, rel=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_the_size_of_a_field_is_that_which_it_gets(kind: str) -> None:
    rows = 16
    size = chosen_size(kind, hash_grid=HashFieldSettings("l2", log2_rows=rows), footprint=1e-4, memory_bytes=None)
    planned = planned_field(replace(STEPS, field=kind, log2_rows=rows))
    assert parameter_bytes(planned) == pytest.approx(parameter_bytes(size), rel=0.15)  # sizes are whole levels


def test_help_states_the_sizes_of_a_hash_grid() -> None:
    text = CliRunner().invoke(app, ["train", "--help"]).stdout
    stated = re.search(r"hash\s+(\d+)\s+to\s+(\d+)MiB", text)
    assert stated is not None, text
    usual = TrainSettings(budget_seconds=1.0, threads=2)
    sizes = (usual, replace(usual, budget_seconds=120.0), replace(usual, budget_seconds=3600.0))
    found = [parameter_bytes(planned_field(size)) >> 20 for size in (*sizes, replace(usual, device="cuda"))]
    assert (min(found), max(found)) == (int(stated[1]), int(stated[2]))


def test_photos_that_memory_cannot_hold_are_on_the_disk() -> None:
    """At least the RGBA bytes of 24 photos of 96 x 72, besides those that the search and cameras keep."""
    free = plan_training(SPHERES, STEPS)
    assert (free.train_photos, free.held_out_photos, free.downscale, free.pixels) == (21, 3, 1, 21 * 96 * 72)
    limited = plan_training(SPHERES, STEPS, resources=Resources(memory_bytes=free.memory_bytes - 10_000))
    assert limited.memory_bytes == free.memory_bytes - 10_000
    assert limited.disk_bytes - free.disk_bytes >= 24 * 96 * 72 * 4
    with pytest.raises(UserError) as refused:
        plan_training(SPHERES, STEPS, resources=Resources(memory_bytes=10**7))
    assert refused.value.exit_code == OUT_OF_MEMORY


def test_twice_the_rows_take_twice_the_field() -> None:
    small, large = (plan_training(SPHERES, replace(STEPS, log2_rows=rows)) for rows in (18, 19))
    assert large.disk_bytes == pytest.approx(2 * small.disk_bytes, rel=1e-3)  # besides the networks


def test_dry_run_prints_the_plan_and_writes_nothing(capture: Path) -> None:
    result = CliRunner().invoke(app, ["train", str(capture), "--budget", "90s", "--dry-run", "--json"])
    assert result.exit_code == 0, result.stderr
    printed = json.loads(result.stdout)
    assert (printed["path"], printed["seconds"], printed["steps"]) == (str(capture), 90, None)
    printed = CliRunner().invoke(app, ["train", str(capture), "--dry-run"]).stdout
    assert printed.startswith(f"{capture}: 4 training photos")
    assert not capture.with_name("spheres-run").exists()


def test_a_scene_whose_only_photo_is_held_out_is_refused(capture: Path) -> None:
    listed = json.loads((capture / "transforms_train.json").read_text())
    for split in ("train", "test"):
        (capture / f"transforms_{split}.json").unlink()
    (capture / "transforms.json").write_text(json.dumps({**listed, "frames": listed["frames"][:1]}))
    result = CliRunner().invoke(app, ["train", str(capture), "--dry-run"])
    assert result.exit_code == 3
    assert "has no training photo" in result.stderr


def test_the_schedule_is_what_steps_do(capture: Path) -> None:
    """Every row against the plan of a step; what changes at 30 % are the closed cells and the loss of points."""
    printed = CliRunner().invoke(app, ["train", str(capture), "--steps", "3000", "--dry-run"]).stdout.splitlines()
    cells = {line[:26].strip(): line[26:].split() for line in printed if "%" in line[26:] or " x " in line[26:]}
    assert cells["progress"] == [cell for value in SHOWN for cell in (f"{100 * value:.0f}", "%")]
    assert " ".join(cells["steps along rays"]) == "8 x 8 x 4 x 2 x 2 x 1 x shortest shortest shortest"
    plans = dict(plan_training(SPHERES, replace(STEPS, steps=3000, model="auto")).schedule)
    assert [plans[value].are_emerging for value in (0.2, 0.3)] == [True, False]
    assert [plans[value].threshold == THRESHOLD for value in (0.0, 0.3)] == [False, True]
    assert plans[0.5].weights == {"colour": 1.0, "distortion": 0.05, "points": 0.05, "sky": 0.1, "roughness": 1e-6}
    assert [plans[value].step for value in (0.0, 0.5, 1.0)] == [0, 1500, 3000]


@pytest.mark.parametrize("settings", [STEPS, replace(STEPS, steps=5000), TrainSettings(budget_seconds=90.0, threads=2)])
def test_the_expected_steps_have_the_expected_samples(settings: TrainSettings) -> None:
    taken = sum(settings.samples_at(step) for step in range(round(settings.expected_steps)))
    assert taken == pytest.approx(settings.expected_samples, rel=0.01)
    assert settings.steps is None or settings.expected_steps == pytest.approx(settings.steps)
