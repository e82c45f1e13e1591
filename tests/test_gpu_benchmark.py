"""benchmarks/gpu.py: it runs to its end without a GPU, keeps what it has measured, and goes on from there."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from gpu import Results, table

ROOT = Path(__file__).parent.parent
SPHERES = ROOT / "sample_scenes" / "spheres"


def test_what_has_been_measured_is_not_measured_again(tmp_path, capsys):
    def fail() -> None:
        raise RuntimeError("no memory")

    first = Results(tmp_path, 60.0)
    first.measure("a", lambda: {"psnr": 31.25})
    first.measure("b", fail)
    first.measure("c", lambda: 1, needs=61.0)
    second = Results(tmp_path, 60.0)
    second.measure("a", fail)
    second.measure("c", lambda: 2)
    assert second.values == {"a": {"psnr": 31.25}, "b": {"error": "RuntimeError: no memory"}, "c": 2}
    assert "c: no time left" in capsys.readouterr().out
    assert "| a | psnr 31.25 |" in table(second.values)


@pytest.mark.slow
def test_everything_runs_to_its_end_in_the_interpreter(tmp_path):
    command = [sys.executable, "-P", ROOT / "benchmarks" / "gpu.py", "--capture", SPHERES, "-o", tmp_path, "--dry"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    values = json.loads((tmp_path / "results.json").read_text())
    assert len(values) == 8
    assert (tmp_path / "table.md").read_text().count("\n") == 10
