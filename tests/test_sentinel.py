"""Numbers that are not finite in a training: named, kept for replay, stepped around or refused; and what that costs."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from present import present
from trainings import FEW, fit, weights

from nerfcli.captures.capture import Capture
from nerfcli.errors import NON_FINITE, UserError
from nerfcli.field.checkpoint import load_tensors, save_tensors
from nerfcli.kernels import numba_cpu
from nerfcli.kernels.numba_cpu.backend import NumbaBackend
from nerfcli.render.model import load_model, save_model
from nerfcli.render.pictures import render_picture
from nerfcli.training import fitting, sentinel, step
from nerfcli.training.optimiser import Delayed
from nerfcli.training.runs.files import read_log
from nerfcli.training.sentinel import FirstBad, is_finite, replay


@pytest.fixture(scope="module")
def views(spheres: Capture) -> Capture:
    return replace(spheres, frames=spheres.frames[:3], test_names=frozenset())


def reported_by(scene: Capture, run: Path) -> list[str]:
    """Train, and return the messages for the user."""
    fit(scene, run, FEW, notes=(notes := []))
    return notes


def with_rate_factors(factor_at: Callable[[fitting.Fitting], float]) -> Callable[..., None]:
    """Return the update of a step whose learning rate is multiplied by a factor for its state."""

    def update(state: fitting.Fitting, *args: Any, rate_factor: float) -> None:
        step.update(state, *args, rate_factor=rate_factor * factor_at(state))

    return update


def test_steps_that_are_too_large_end_with_exit_5_and_a_file_that_repeats_the_failure(views, tmp_path):
    # Adam's first step has the length of the learning rate, whatever the gradient: weights of 1e12 to the fifth power.
    with pytest.raises(UserError, match=r"colour of samples is not finite at step 2: \d+ of \d+ numbers") as caught:
        fit(views, tmp_path / "run", replace(FEW, learning_rate=1e12, warmup_steps=1))
    assert caught.value.exit_code == NON_FINITE
    assert "in train/r_00" in caught.value.message
    assert "failure-2.safetensors has the state before the failure" in caught.value.hint
    assert "checkpoint" not in caught.value.hint  # there is none yet
    description, bad = replay(tmp_path / "run" / "failure-2.safetensors")
    bad = present(bad)
    assert bad.name == "colour of samples"
    assert bad.name in description["message"]
    assert f"{bad.count} of {bad.total}" in description["message"]
    # Regression: a traceback for failures on a GPU, whose generators have a state of 16 bytes.
    tensors, content = load_tensors(tmp_path / "run" / "failure-2.safetensors", "cpu")
    of_gpu = {name: torch.zeros(16, dtype=torch.uint8) for name in ("generator", "batch.after_draw")}
    save_tensors(tmp_path / "gpu.safetensors", tensors | of_gpu, content)
    assert present(replay(tmp_path / "gpu.safetensors")[1]).name == "colour of samples"
    assert not (tmp_path / "run" / "field.safetensors").exists()


def poisoned_once(scene: Capture, run: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[list[str], str]:
    """Train with a wrong rate in the eighth step; return the messages, and the one of the failure.

    The table comes first among what the rate spoils, and the loss shows it a step later.
    """
    poisoned = with_rate_factors(lambda state: math.nan if state.step == 7 and state.rollbacks == 0 else 1.0)
    with monkeypatch.context() as patched:
        patched.setattr(fitting, "update", poisoned)
        patched.setattr(sentinel, "SNAPSHOT_EVERY", 4)
        reported = reported_by(scene, run)
    (line,) = [line for line in reported if "continuing from step" in line]
    assert line.startswith("table is not finite at step 8")
    assert load_tensors(run / "failure-8.safetensors", "cpu")[1]["state"]["step"] == 7
    return reported, line


def test_a_failure_is_passed_with_smaller_steps_and_counted(views, tmp_path, monkeypatch):
    reported, line = poisoned_once(views, tmp_path / "run", monkeypatch)
    assert "continuing from step 4 with 0.5 of the learning rate (1 of 3 retries)" in line
    assert reported[-1].startswith("numbers became non-finite 1 times")
    last = read_log(tmp_path / "run")[-1]
    assert (last["step"], last["rollbacks"]) == (12, 1)
    load_model(tmp_path / "run" / "field.safetensors", "cpu")  # which refuses what is not finite
    assert is_finite(load_tensors(tmp_path / "run" / "failure-8.safetensors", "cpu")[0]["field.table"])


def test_the_way_back_is_exact(views, tmp_path, monkeypatch):
    # After the rollback, training equals one whose learning rate is halved from the snapshot on.
    monkeypatch.setattr(sentinel, "SNAPSHOT_EVERY", 4)
    monkeypatch.setattr(fitting, "update", with_rate_factors(lambda state: 1.0 if state.step < 4 else 0.5))
    fit(views, tmp_path / "known", FEW)
    poisoned = with_rate_factors(lambda state: math.inf if state.step == 6 and state.rollbacks == 0 else 1.0)
    monkeypatch.setattr(fitting, "update", poisoned)
    fit(views, tmp_path / "found", FEW)
    assert weights(tmp_path / "found") == weights(tmp_path / "known")


def read_a_step_later(self: Delayed, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...] | None:
    """Return tensors one call late, as on a GPU."""
    before = self.take()
    copies = tuple(tensor.detach().clone() for tensor in tensors)
    self._sent = copies, SimpleNamespace(synchronize=lambda: None)  # type: ignore[assignment]
    return before


def make_flaky(monkeypatch: pytest.MonkeyPatch, bad_call: int) -> None:
    """Have compositing return NaN in one of its calls."""
    composite, calls = numba_cpu.composite, 0

    def flaky(*args: torch.Tensor, **named: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        nonlocal calls
        calls += 1
        rgb, transmittance, fractions = composite(*args, **named)
        return (rgb * math.nan if calls == bad_call else rgb), transmittance, fractions

    monkeypatch.setattr(numba_cpu, "composite", flaky)


@pytest.mark.parametrize(("bad_call", "on_gpu"), [(8, False), (8, True), (12, True)], ids=str)
def test_a_fault_that_does_not_come_back_changes_nothing(bad_call, on_gpu, views, tmp_path, monkeypatch):
    fit(views, tmp_path / "straight", FEW)
    if on_gpu:
        monkeypatch.setattr(Delayed, "exchange", read_a_step_later)
    make_flaky(monkeypatch, bad_call)
    reported = reported_by(views, tmp_path / "flaky")
    assert any("but are finite when the step is repeated" in line for line in reported)
    assert weights(tmp_path / "flaky") == weights(tmp_path / "straight")
    assert not list((tmp_path / "flaky").glob("failure-*"))


def test_where_no_two_runs_are_the_same_a_failure_is_found_all_the_same(views, tmp_path, monkeypatch):
    """A fault that does not come back is put down to a device that does not repeat its results."""
    monkeypatch.setattr(NumbaBackend, "__init__", lambda self, device: setattr(self, "deterministic", False))
    poisoned_once(views, tmp_path / "poisoned", monkeypatch)
    make_flaky(monkeypatch, 9)
    reported = reported_by(views, tmp_path / "flaky")
    assert any("this device does not repeat results exactly" in line for line in reported)


def test_a_poisoned_checkpoint_is_refused_by_name_and_kept(views, tmp_path):
    run = tmp_path / "run"
    fit(views, run, replace(FEW, steps=1))
    readers: list[tuple[str, str, Callable[[], object]]] = [
        ("state.safetensors", "field.weights.1", lambda: fit(views, run, replace(FEW, steps=2), resume=True)),
        ("field.safetensors", "weights.1", lambda: load_model(run / "field.safetensors", "cpu")),
    ]
    for file, name, read in readers:
        tensors, description = load_tensors(run / file, "cpu")
        tensors[name].view(-1)[5] = math.inf
        save_tensors(run / file, tensors, description)
        before = (run / file).read_bytes()
        with pytest.raises(UserError, match=rf"^{name} in .*{file} has 1 non-finite values of 512") as caught:
            read()
        assert caught.value.exit_code == NON_FINITE
        assert (run / file).read_bytes() == before


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
def test_the_first_bad_tensor_is_found_with_its_rays(poison):
    watch = FirstBad()
    good, bad = torch.zeros(6, 3), torch.zeros(6, 3)
    bad[2, 1] = bad[3, 0] = bad[5, 2] = poison
    rays = torch.tensor([0, 0, 4, 4, 7, 9])
    watch.rows("first", good, rays)
    watch.rows("second", bad, rays)
    watch.values("third", bad)
    found = present(watch.found)
    assert (found.name, found.count, found.total, found.rays) == ("second", 3, 18, (4, 9))


def test_gradients_are_looked_at_in_the_order_in_which_they_come():
    # d sqrt(x) at 0 is infinite; the root's own gradient is fine.
    watch = FirstBad()
    x = torch.tensor([1.0, 0.0], requires_grad=True)
    root = x.sqrt()
    watch.rows("x", x, torch.tensor([3, 8]))
    watch.rows("root", root, torch.tensor([3, 8]))
    root.sum().backward()
    found = present(watch.found)
    assert (found.name, found.rays) == ("gradient of x", (8,))


def test_replay_of_something_else_is_refused(spheres_run):
    with pytest.raises(UserError, match="is not a saved failure but 'nerfcli field 2'"):
        replay(spheres_run / "field.safetensors")


def test_a_field_that_overflows_is_no_picture(spheres, spheres_run, tmp_path):
    # The weights are finite and their products are not: found in the picture, by name and pixel.
    model = load_model(spheres_run / "field.safetensors", "cpu")
    with torch.no_grad():
        for name, parameter in model.field.named_parameters():
            if name.startswith("weights"):
                parameter.mul_(1e15)
    save_model(tmp_path / "field.safetensors", model)
    model = load_model(tmp_path / "field.safetensors", "cpu")
    with pytest.raises(UserError, match=r"rgb of .* is not finite at \d+ pixels?, such as \(\d+, \d+\)") as caught:
        render_picture(model, spheres.test_frames[0], background=model.background)
    assert caught.value.exit_code == NON_FINITE
