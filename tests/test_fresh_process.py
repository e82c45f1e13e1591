"""What holds in a process that has done nothing else. One process shows it all: importing torch takes 3 CPU seconds."""

import json
import subprocess
import sys

import pytest

# In this order; none may load what a later one must not find.
CODES = {
    "package": "import nerfcli",
    "conversion": "from nerfcli.workflows import convert",
    "adam": """
import torch
from nerfcli.training.optimiser import Adam
parameter = torch.ones(3, requires_grad=True)
adam = Adam([parameter])
parameter.grad = torch.ones(3)
adam.step(0.1)
assert (parameter < 1).all()
""",
    "after training": "from nerfcli.workflows import evaluate, render, report",
    "threads": """
import torch
torch.set_num_threads(1)
from nerfcli.kernels import numba_cpu
numba_cpu.warm_up()
from nerfcli.kernels.numba_cpu.threads import use_threads
assert (torch.get_num_threads(), use_threads()) == (1, 1)
""",
    "peak memory": """
import numpy as np
from nerfcli.bench.measurement import begin_peak, peak_bytes
begin_peak("cpu")
before = peak_bytes("cpu")
data = np.ones(60_000_000, np.uint8)
during = peak_bytes("cpu")
del data
begin_peak("cpu")
after = peak_bytes("cpu")
assert before is None or (during - before > 50e6 and during - after > 50e6), (before, during, after)
""",
}


@pytest.fixture(scope="module")
def modules() -> dict[str, set[str]]:
    """The modules that each of `CODES` adds; the last ones are missing if one fails."""
    program = "import json, sys\nfor name, code in json.loads(sys.argv[1]).items():\n"
    program += "    before = set(sys.modules)\n    exec(code, {})\n"
    program += "    print(json.dumps([name, sorted(set(sys.modules) - before)]), flush=True)\n"
    command = [sys.executable, "-c", program, json.dumps(CODES)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    added = {name: set(names) for name, names in map(json.loads, ended.stdout.splitlines())}
    if ended.returncode:
        added["stderr"] = {ended.stderr}
    return added


def test_the_package_is_imported_without_its_parts(modules):
    assert modules["package"] <= {"nerfcli", "zlib"}


def test_a_conversion_imports_no_torch(modules):
    """It would take twice as long to start."""
    assert "nerfcli.workflows.convert" in modules["conversion"]
    assert "torch" not in modules["conversion"]


def test_a_step_of_adam_loads_no_compiler(modules):
    assert "nerfcli.training.optimiser" in modules["adam"]
    assert "torch._dynamo" not in modules["adam"]


def test_what_comes_after_training_loads_no_trainer(modules):
    loaded = modules["package"] | modules["conversion"] | modules["adam"] | modules["after training"]
    assert "nerfcli.training.runs.run" in loaded
    trainer = ("loop", "preparation", "evidence", "checkpoints", "waypoints", "sentinel")
    assert not {f"nerfcli.training.{name}" for name in trainer} & loaded


def test_starting_numba_leaves_the_thread_count_alone(modules):
    """Both libraries share one OpenMP: without care, the first compiled loop gave --threads 1 two threads."""
    assert "threads" in modules, modules["stderr"]


def test_peak_memory_is_that_of_the_work_since_it_began(modules):
    """After much other work, the system may not reset the peak."""
    assert "peak memory" in modules, modules["stderr"]
    assert "stderr" not in modules
