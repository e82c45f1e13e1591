"""Several processes that train one field, with gloo on this machine: the same result as one, and none hangs or writes
where it should not when another ends."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from commands import error_of, nerfcli
from present import present
from trainings import FEW

from nerfcli import distributed, machine
from nerfcli.errors import INTERRUPTED, LOST_RANK, TERMINATED
from nerfcli.field.checkpoint import load_tensors
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training import evidence, loop
from nerfcli.training.pool import PixelBatch
from nerfcli.training.runs.components import Components, choose
from nerfcli.training.runs.run import Run
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.workflows.train import train_scene

SPHERES = Path(__file__).parents[1] / "sample_scenes" / "spheres"
# Each variant with its budget of steps and the step at which it is stopped. Once cameras move (after a tenth of the
# budget) or rays end by opacity, a last bit decides about whole samples, even between one thread and two: stop soon.
VARIANTS = {
    "": (200, 34),
    "exposure,background=black": (200, 34),
    "points,occluders": (100, 24),
    "cameras=all": (100, 14),
}
SMALL = replace(FEW, steps=200, log2_rows=12, first_samples_per_step=2**11, samples_per_step=2**11, threads=1)
TRAININGS = """
import atexit, gc, math, sys
from dataclasses import replace
from pathlib import Path
atexit.register(gc.freeze)  # as in `nerfcli.__main__`
sys.path.insert(0, {tests!r})
from test_ranks import SPHERES, SMALL, VARIANTS, settings_with, torch, train_until
from nerfcli import distributed
from nerfcli.training import fitting, sentinel

# After all that the program does at its end: threads that still listen would abort some processes, one in four.
atexit.register(lambda: print("joined" if torch.distributed.is_initialized() else "parted"))
for number, (components, (steps, last)) in enumerate(VARIANTS.items()):
    train_until(last, Path({folder!r}) / str(number), settings_with(components, steps))

in_one_process = fitting.step

def poisoned(state, *args):
    losses = in_one_process(state, *args)
    if distributed.rank() == 1 and state.step == 7 and state.rollbacks == 0:
        state.field.weights[0].grad.fill_(math.nan)
    return losses

fitting.step = poisoned
sentinel.SNAPSHOT_EVERY = 4
train_until(12, Path({folder!r}) / "poisoned", SMALL)
"""


def settings_with(components: str, steps: int) -> TrainSettings:
    included = components.split(",") if components else []
    return replace(SMALL, steps=steps, components=choose(Components(), included=included, excluded=()))


def train_until(step: int, run: Path, settings: TrainSettings) -> None:
    """Train, and stop as Ctrl-C does."""
    stop = step / present(settings.steps)

    def progress(fraction: float, detail: str) -> None:
        if fraction >= stop:
            raise KeyboardInterrupt

    with suppress(KeyboardInterrupt), patch.object(evidence, "occluder_masks", left_halves):
        train_scene(SPHERES, Output(run, overwrite=True), settings, reporter=Reporter(progress=progress))


def left_halves(photos: Sequence[LoadedPhoto], *_: object, threads: int) -> list[np.ndarray]:
    """Stand in for occluders, of which the spheres have none."""
    shapes = (photo.pixels.shape[:2] for photo in photos)
    return [np.broadcast_to(np.arange(width) < width // 2, (height, width)) for height, width in shapes]


def of_rank(rank: int, port: int) -> dict[str, str]:
    """The environment that torchrun gives to a process."""
    return {
        **os.environ,
        **dict.fromkeys(("RANK", "LOCAL_RANK"), str(rank)),
        **dict.fromkeys(("WORLD_SIZE", "LOCAL_WORLD_SIZE"), "2"),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "TORCHELASTIC_RUN_ID": "test",
        "OMP_NUM_THREADS": "1",
    }


def two_ranks(program: str, *arguments: str | Path) -> list[subprocess.Popen[str]]:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    command = [sys.executable, "-c", program, *map(str, arguments)]
    pipe = subprocess.PIPE
    return [subprocess.Popen(command, env=of_rank(rank, port), stdout=pipe, stderr=pipe, text=True) for rank in (0, 1)]


def ended(processes: Sequence[subprocess.Popen[str]]) -> list[tuple[int, str, list[str]]]:
    """Return exit code, stdout and lines of stderr of each process; a process that hangs fails the test."""
    try:
        said = [process.communicate(timeout=300) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(p.returncode, out, error.splitlines()) for p, (out, error) in zip(processes, said, strict=True)]


@pytest.fixture(scope="module")
def by_two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("two")
    done = ended(two_ranks(TRAININGS.format(folder=str(folder), tests=str(Path(__file__).parent))))
    assert [(code, out) for code, out, _ in done] == [(0, "parted\n")] * 2, done
    return folder


@pytest.mark.parametrize("number", range(len(VARIANTS)), ids=[name or "default" for name in VARIANTS])
def test_two_processes_train_what_one_does(by_two, tmp_path, number):
    """The same rays in two halves: only the order of float32 sums differs. Where a gradient is 0 but for rounding,
    Adam makes whole steps, so that a few numbers may differ by more."""
    components, (steps, last) = list(VARIANTS.items())[number]
    train_until(last, tmp_path, settings_with(components, steps))
    runs = (tmp_path, by_two / str(number))
    (one, of_one), (two, of_two) = (load_tensors(run / "state.safetensors", "cpu") for run in runs)
    assert of_two["step"] == of_one["step"] == last
    assert of_two["totals"]["rays"] == of_one["totals"]["rays"]
    assert of_two["totals"]["samples"] == pytest.approx(of_one["totals"]["samples"], rel=1e-3)
    assert torch.equal(one["generator"], two["generator"])
    learned = [name for name in one if name.startswith(("field.", "parts.")) and "adam" not in name]
    differences = torch.cat([(one[name].double() - two[name].double()).abs().flatten() for name in learned])
    assert differences.quantile(0.95) < 1e-5
    losses = [Run(run).log[-1]["loss"] for run in runs]
    assert losses[1] == pytest.approx(losses[0], rel=1e-5)


def test_a_number_that_is_not_finite_in_one_process_takes_all_of_them_back(by_two):
    run = by_two / "poisoned"
    last = Run(run).log[-1]
    assert (last["step"], last["rollbacks"]) == (12, 1)
    assert [path.name for path in run.glob("failure-*")] == ["failure-8.safetensors"]


def killed(tmp_path: Path, victims: Sequence[int], sent: signal.Signals) -> list[tuple[int, str, list[str]]]:
    """Train with two ranks, send some of them a signal after some steps, and return what `ended` does."""
    run = tmp_path / "run"
    program = "from nerfcli.__main__ import start; start()"
    options = ("--steps", "4000", "--model", "default", "--batch", "1024", "--log2-rows", "10", "--threads", "1")
    processes = two_ranks(program, "train", SPHERES, "-o", run, *options)
    deadline = time.monotonic() + 60
    while not (run / "log.jsonl").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    for victim in victims:
        processes[victim].send_signal(sent)
    return ended(processes)


def test_when_a_process_is_killed_the_first_one_saves_and_ends_and_one_alone_can_go_on(tmp_path):
    (code, out, said), (victim, _, _) = killed(tmp_path, [1], signal.SIGKILL)
    assert (code, out, victim) == (LOST_RANK, "", -signal.SIGKILL)
    assert said[-2].startswith("Error: another process of this training has ended")
    assert "--resume" in said[-1]
    assert "Traceback" not in "".join(said)
    run = Run(tmp_path / "run")
    before, _ = run.saved_progress()
    total = str(before + 5)
    options = ("--model", "default", "--batch", "1024", "--log2-rows", "10", "--threads", "1", "--resume")
    assert nerfcli("train", SPHERES, "-o", run.path, "--steps", total, *options).exit_code == 0
    assert run.saved_progress()[0] == before + 5


@pytest.mark.slow
def test_when_the_first_process_is_killed_the_other_one_ends_and_writes_nothing(tmp_path):
    (victim, _, _), (code, out, said) = killed(tmp_path, [0], signal.SIGKILL)
    assert (victim, code, out) == (-signal.SIGKILL, LOST_RANK, "")
    assert [line.split(":")[0] for line in said] == ["Error", "Hint"]
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written <= {".train.lock", "cameras.json", "config.json", "log.jsonl"}


@pytest.mark.slow
@pytest.mark.parametrize(("victims", "expected", "how"), [([0, 1], TERMINATED, "Ended"), ([1], INTERRUPTED, "Interr")])
def test_sigterm_to_any_process_ends_all_with_a_checkpoint_and_one_message(tmp_path, victims, expected, how):
    (code, _, said), (other, out, nothing) = killed(tmp_path, victims, signal.SIGTERM)
    assert (code, other, out, nothing) == (expected, 0, "", [])
    assert said[-1].startswith(how)
    assert Run(tmp_path / "run").saved_progress()[0] > 0


@pytest.mark.slow
def test_torchrun_trains_by_time_with_selected_components_and_reports_once(tmp_path):
    run = tmp_path / "run"
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*launcher, "-m", "nerfcli", "train", SPHERES, "-o", run, "--budget", "20s", "--json"]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"path": str(run)}
    assert len([line for line in done.stderr.splitlines() if "PSNR on a sample" in line]) == 1
    assert Run(run).config.selection is not None
    again = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, timeout=200)
    assert (again.returncode, json.loads(again.stdout)) == (0, {"path": str(run)})
    assert "is kept" in again.stderr


@pytest.mark.parametrize("count", [2, 3, 7])
def test_every_pixel_of_a_step_is_one_process_s_and_points_stay_last(monkeypatch, count):
    numbers, points = torch.arange(23), 5
    origins, directions, colours = torch.rand(3, 23, 3)
    point_pixels = numbers[-points:]
    whole = PixelBatch(origins, directions, colours, numbers, point_pixels / 10, point_pixels / 20)
    monkeypatch.setattr(distributed, "count", lambda: count)
    parts = []
    for rank in range(count):
        monkeypatch.setattr(distributed, "rank", lambda rank=rank: rank)
        parts.append(PixelBatch(*(distributed.own(rows, 23) for rows in whole)))
    assert sorted(torch.cat([part.numbers for part in parts]).tolist()) == list(range(23))
    for part in parts:
        assert torch.equal(part.colours, whole.colours[part.numbers])
        point_pixels = part.numbers[len(part.numbers) - len(part.distances) :]
        assert torch.equal(part.distances, point_pixels / 10)
        assert torch.equal(part.trust, point_pixels / 20)
    assert sum(len(part.distances) for part in parts) == points


@pytest.mark.parametrize(("count", "rows"), [(1, 16), (2, 17), (4, 18)])
def test_rows_of_tables_follow_the_threads_of_all_processes(spheres, tmp_path, monkeypatch, count, rows):
    """Twice the processes take twice the samples and get twice the rows in a time budget; a step budget adds none."""

    class PreparedError(Exception): ...

    def prepared(scene, settings, **others):
        raise PreparedError(settings.log2_rows)

    monkeypatch.setattr(loop, "prepare", prepared)
    monkeypatch.setattr(distributed, "gathered", lambda value: [value] * count)
    by_steps = replace(SMALL, log2_rows=None)
    for settings, expected in ((TrainSettings(budget_seconds=26.0), rows), (by_steps, 16)):
        with pytest.raises(PreparedError) as found:
            loop.train(spheres, tmp_path, settings, resume=False, notify=lambda _: None, on_progress=lambda _: None)
        assert found.value.args == (expected,)


def test_processes_of_a_machine_divide_its_processors(monkeypatch):
    alone = machine.thread_count(0)
    for name, value in of_rank(1, 1).items():
        monkeypatch.setenv(name, value)
    assert machine.thread_count(0) == max(1, alone // 2)
    assert machine.thread_count(3) == 3


@pytest.mark.parametrize("arguments", [["-"], [SPHERES, "--dry-run"]])
def test_processes_of_torchrun_refuse_what_they_cannot_do_together(monkeypatch, arguments):
    for name, value in of_rank(0, 1).items():
        monkeypatch.setenv(name, value)
    result = nerfcli("train", *arguments)
    assert result.exit_code == 2
    assert error_of(result)[1] == "Hint:  use this command without torchrun"
