"""Whether the tests notice a broken kernel: every operation is broken on purpose, one place at a time.

    python benchmarks/mutants.py -o mutants.csv [--only compositing]

A mutant is one text of one file replaced by another (a sign, an index, a factor, a missing clamp) in a copy of the
program; the tests of that file run against it until the first fails. It is killed if one fails, survives if none does.
What survives needs a test, or a reason why no test can tell. The lists of mutants stand in `mutant_list.py`,
`mutant_list_training.py` and `mutant_list_triton.py`.
"""

import csv
import importlib.util
import multiprocessing
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Annotated

import cv2  # noqa: F401
import numba  # noqa: F401
import pycolmap  # noqa: F401
import pytest
import scipy.interpolate  # noqa: F401
import torch
import typer
from mutant_list import GROUPS, Group, Mutant
from mutant_list_training import TRAINING
from mutant_list_triton import TRITON
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parent.parent
# A broken loop may never end.
SECONDS = 900.0
# pytest's exit codes for an error of its own, wrong usage, and no tests.
_NOT_RUN = (3, 4, 5)


def tree_with(mutant: Mutant, group: Group, folder: Path) -> Path:
    """A copy of the program with the mutant in it, beside the tests as they are."""
    tree = folder / "tree"
    shutil.copytree(ROOT / "nerfcli", tree / "nerfcli")  # with the compiled kernels, and the times they are known by
    for name in ("tests", "sample_scenes", "benchmarks", "pyproject.toml"):
        (tree / name).symlink_to(ROOT / name)
    path = tree / "nerfcli" / group.file
    text = path.read_text(encoding="utf-8")
    if text.count(mutant.old) != 1:
        raise ValueError(f"{group.file} has {text.count(mutant.old)} places with {mutant.old!r}, not one")
    path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
    for other in group.compiled_into:  # they hold a compiled copy of this file's functions
        for cached in (tree / "nerfcli" / other).parent.glob(f"__pycache__/{Path(other).stem}.*.nb*"):
            cached.unlink()
    return tree


def run_tests(tree: Path, group: Group, log: Path) -> None:
    """In a process of its own: the tests until the first that fails; its exit code says whether one did."""
    os.setpgid(0, 0)
    os.chdir(tree)
    sys.path[:0] = [str(tree), str(tree / "tests")]
    keep_machine_code(tree / "nerfcli" / "kernels" / "numba_cpu")
    if any("triton" in test for test in group.tests):
        os.environ["TRITON_INTERPRET"] = "1"
    selected = ("-k", group.selected) if group.selected else ()
    with log.open("w") as file, redirect_stdout(file), redirect_stderr(file):
        code = pytest.main(["-x", "-q", "-p", "no:cacheprovider", "--tb=line", *selected, *group.tests])
        file.flush()
    os._exit(int(code))


def keep_machine_code(kernels: Path) -> None:
    """Vouch for what is compiled: what the mutant is in has been taken away, and the rest is not compiled each time."""
    spec = importlib.util.spec_from_file_location("machine_code", kernels / "machine_code.py")
    assert spec is not None
    assert spec.loader is not None
    machine_code = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(machine_code)  # by itself: the package would discard all at once
    machine_code.note_sources(machine_code.sources(), kernels / "__pycache__")


def verdict_of(mutant: Mutant, group: Group) -> tuple[str, float]:
    """Which test killed it, or that none did, and the seconds that it took."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as temporary:
        folder = Path(temporary)
        tree = tree_with(mutant, group, folder)
        began = time.perf_counter()
        # Forked, so that torch and what stands above need not be loaded each time; nothing of the program is yet.
        process = multiprocessing.get_context("fork").Process(target=run_tests, args=(tree, group, folder / "log"))
        process.start()
        process.join(SECONDS)
        seconds = time.perf_counter() - began
        if process.is_alive():
            assert process.pid is not None
            os.killpg(process.pid, signal.SIGKILL)
            return "killed: does not end", seconds
        log = (folder / "log").read_text(errors="replace")
    if process.exitcode == 0:
        return "survived", seconds
    failed = re.search(r"^(?:FAILED|ERROR) (?:tests/)?(\S+?)(?:\[.*| - .*)?$", log, re.MULTILINE)
    if failed is None and process.exitcode in (1, *_NOT_RUN):
        raise RuntimeError(log)
    return f"killed: {failed[1]}" if failed else f"killed: the process ended with {process.exitcode}", seconds


def main(
    output: Annotated[Path | None, typer.Option("-o", help="CSV of the table.")] = None,
    only: Annotated[str, typer.Option(help="Only files whose name contains this.")] = "",
    skip: Annotated[int, typer.Option(help="Leave out so many of the first.")] = 0,
) -> None:
    torch.set_num_threads(2)
    console, table = Console(), Table("file", "what is broken", "verdict", "s")
    chosen = [
        (group, mutant) for group in (*GROUPS, *TRAINING, *TRITON) if only in group.file for mutant in group.mutants
    ][skip:]
    rows = []
    for group, mutant in chosen:
        verdict, seconds = verdict_of(mutant, group)
        if verdict == "survived" and mutant.equivalent:
            verdict = f"no test can tell: {mutant.equivalent}"
        rows.append((group.file, f"{mutant.old.strip()} -> {mutant.new.strip()}", verdict, f"{seconds:.0f}"))
        console.print(" | ".join(rows[-1]), markup=False, soft_wrap=True)
        table.add_row(*(cell.replace("[", "\\[") for cell in rows[-1]))
        if output is not None:
            with output.open("w", newline="") as file:
                csv.writer(file).writerows([("file", "what is broken", "verdict", "seconds"), *rows])
    console.print(table)
    killed = sum(row[2].startswith("killed") for row in rows)
    survived = sum(row[2] == "survived" for row in rows)
    console.print(f"{len(rows)} mutants: {killed} killed, {survived} survived, {len(rows) - killed - survived} equal")
    raise typer.Exit(int(survived > 0))


if __name__ == "__main__":
    typer.run(main)
