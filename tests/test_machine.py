"""Devices by name, and what `nerfcli info --machine` says of a machine: this one, and one with two GPUs."""

import json
from types import SimpleNamespace

import pytest
import torch
from commands import nerfcli

from nerfcli import kernels
from nerfcli.bench import measurement
from nerfcli.errors import UserError
from nerfcli.kernels.devices import describe_machine
from nerfcli.machine import device_name
from nerfcli.training.runs.settings import TrainSettings, sizes_for


@pytest.fixture
def two_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    named = SimpleNamespace(name="H100", total_memory=80 * 10**9, major=9, minor=0)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: named)
    monkeypatch.setattr(kernels, "_why_not_triton", lambda index: None if index == 0 else "it is too old")
    monkeypatch.setattr(kernels, "gpu_launcher", lambda device: "CUDA driver")
    monkeypatch.setattr(kernels, "driver_version", lambda: "13.0")


def test_devices_by_name(two_gpus):
    assert [device_name(name) for name in ("auto", "cpu", "cuda", "cuda:1")] == ["cuda", "cpu", "cuda", "cuda:1"]
    with pytest.raises(UserError, match="--device cuda:2: there is no such device") as caught:
        device_name("cuda:2")
    assert caught.value.hint == "the last one is cuda:1"


@pytest.mark.parametrize("name", ["cuda:", "cuda:x", "gpu", "cpu:0", ""])
def test_unknown_devices_are_refused(name):
    with pytest.raises(UserError, match="unknown device") as caught:
        device_name(name)
    assert caught.value.exit_code == 2


def test_without_a_gpu_none_can_be_named(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device_name("auto") == "cpu"
    for name in ("cuda", "cuda:0"):
        with pytest.raises(UserError, match=f"--device {name}: torch finds no CUDA device"):
            device_name(name)


def test_a_benchmark_names_the_gpu_and_reads_its_memory(monkeypatch):
    """It uses the given device, which need not be the first."""
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"GPU of {device}")
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: None)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: {"cuda:1": 7}[device])
    assert measurement.describe_machine("cuda:1", 2)["device"] == "GPU of cuda:1"
    memory = measurement.PeakMemory("cuda:1")
    memory.begin()
    assert memory.read() == 7


def test_a_gpu_gets_larger_steps_and_tables():
    assert sizes_for("cpu") == {}
    sized = TrainSettings(**sizes_for("cuda:1"))
    assert (sized.first_samples_per_step, sized.samples_per_step, sized.log2_rows) == (2**16, 2**18, 19)


def test_a_machine_with_gpus_says_what_runs_on_each_and_why(two_gpus):
    described = describe_machine(processors=2)
    assert described["cuda:1"] == "H100, 80 GB, compute capability 9.0"
    assert described["backend on cuda:0"] == "triton_cuda, launched by CUDA driver"
    assert described["backend on cuda:1"] == "reference, because it is too old"
    assert (described["backend on cpu"], described["cuda of the driver"]) == ("numba_cpu", "13.0")


def test_info_shows_this_machine():
    lines = nerfcli("info", "--machine").stdout.splitlines()
    assert f"torch: {torch.__version__}" in lines
    assert json.loads(nerfcli("info", "--machine", "--json").stdout)["torch"] == torch.__version__
