"""The machine: devices by name, what `nerfcli info --machine` says, and memory that is kept, counted in page faults."""

import ctypes
import json
import os
from dataclasses import replace
from types import SimpleNamespace

import psutil
import pytest
import torch
from commands import in_python, nerfcli

from nerfcli import kernels, machine
from nerfcli.bench import measurement
from nerfcli.errors import UserError
from nerfcli.kernels import describe_machine
from nerfcli.machine import default_memory_limit, device_name, keep_freed_memory, return_freed_memory, thread_count
from nerfcli.training.runs.settings import TrainSettings


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
    assert caught.value.hint == "use --device cuda:0 to cuda:1"


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
    measurement.begin_peak("cuda:1")
    assert measurement.peak_bytes("cuda:1") == 7


def test_a_gpu_gets_larger_steps_and_tables():
    sized = TrainSettings(device="cuda:1")
    assert (sized.samples, sized.chosen_log2_rows) == ((2**16, 2**18), 19)
    assert replace(sized, device="cpu").samples == (2**13, 2**16)


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


@pytest.mark.parametrize(
    ("own", "limits", "processors", "memory"),
    [
        ("0::/", {"cpu.max": "max 100000", "memory.max": "max"}, None, None),
        ("0::/", {"cpu.max": "150000 100000", "memory.max": "1000000"}, 2, 800_000),  # in a container
        (
            "0::/system.slice/slurm/job_7/step_0",
            {
                "system.slice/slurm/job_7/step_0/memory.max": "max",
                "system.slice/slurm/job_7/memory.max": "3000000",
                "system.slice/memory.max": "9000000",
                "system.slice/slurm/job_7/cpu.max": "100000 100000",
            },
            1,
            2_400_000,
        ),
        ("7:memory:/job\n0::/", {"memory/job/memory.limit_in_bytes": "500000"}, None, 400_000),
        (
            "4:cpu,cpuacct:/job\n0::/",
            {
                "cpu/job/cpu.cfs_quota_us": "150000",
                "cpu/job/cpu.cfs_period_us": "100000",
                "cpu/cpu.cfs_quota_us": "-1",
                "cpu/cpu.cfs_period_us": "100000",
            },
            2,
            None,
        ),
    ],
    ids=["none", "container", "slurm", "version 1, memory", "version 1, processors"],
)
def test_limits_of_containers_and_jobs_count(own, limits, processors, memory, monkeypatch, tmp_path):
    """Regression: only those of containers did; a job with 8 GB of a large machine was killed."""
    (tmp_path / "own").write_text(own + "\n")
    for name, text in limits.items():
        (tmp_path / "groups" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / name).write_text(text + "\n")
    monkeypatch.setattr(machine, "_OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(machine, "_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(64)), raising=False)
    assert thread_count(0) == (processors or 64)
    assert default_memory_limit() == (memory or int(0.8 * psutil.virtual_memory().total))


_MEGABYTE = 2**20
# Arrays of 40 MB are allocated and freed: the system provides cleared pages for each, or none if memory is kept.
_PROGRAM = """
import os, resource
from nerfcli.machine import keep_freed_memory, resident_bytes, return_freed_memory
{keep}
def work():
    for _ in range(10):
        bytearray(40 * 2**20)
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
resident = resident_bytes(os.getpid())
return_freed_memory()
print(faults, resident, resident_bytes(os.getpid()))
"""


def _measured(keep: str) -> list[int]:
    ended = in_python(_PROGRAM.format(keep=keep))
    assert ended.returncode == 0, ended.stderr
    return [int(number) for number in ended.stdout.split()]


def test_freed_memory_is_used_again_without_page_faults_until_it_is_returned():
    if not hasattr(ctypes.CDLL(None), "mallopt"):
        pytest.skip("the C library is not glibc")
    faults, kept, returned = _measured("keep_freed_memory()")
    assert faults < 100
    assert returned < kept - 30 * _MEGABYTE
    assert _measured("")[0] > 1000  # without it


@pytest.mark.skipif(not os.path.exists("/proc/self/clear_refs"), reason="only Linux tells them apart")
def test_the_peak_of_memory_is_not_that_of_the_process_that_started_this_one():
    child = "from nerfcli.machine import peak_resident_bytes; print(peak_resident_bytes())"
    parent = f"import subprocess, sys; kept = b'x' * 2**28; subprocess.run([sys.executable, '-c', {child!r}])"
    ended = in_python(parent)
    assert ended.stdout, ended.stderr
    assert int(ended.stdout) < 2**27


def _no_library(name: None) -> object:
    raise TypeError("LoadLibrary() argument 1 must be str, not None")


@pytest.mark.parametrize("load", [lambda name: object(), _no_library], ids=["musl", "windows"])
def test_another_c_library_is_left_alone(load, monkeypatch):
    monkeypatch.setattr("ctypes.CDLL", load)
    keep_freed_memory()
    return_freed_memory()
