"""Mutation testing: do the tests notice operations that are broken on purpose, one place at a time?

    python benchmarks/mutants.py -o mutants.csv [--only compositing]

A mutant is one text of one file replaced by another (a sign, an index, a factor, a missing clamp) in a copy of the
program; the tests of that file run against it until the first fails. The mutant is killed if one fails, else it
survives, and needs a test. The mutants, in mutants.toml, are mistakes that a change of these files would most likely
make.
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
import tomllib
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2  # noqa: F401
import numba  # noqa: F401
import pycolmap  # noqa: F401
import pytest
import scipy.interpolate  # noqa: F401
import torch
import typer
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parent.parent
# A broken loop may never end.
SECONDS = 900.0
# pytest's exit codes for an internal error, wrong usage, and no tests.
_NOT_RUN = (3, 4, 5)


@dataclass(frozen=True)
class Group:
    """Mutants of one file.

    Args:
        file: below nerfcli/.
        tests: the files in tests/ that run, with spaces between them.
        mutants: texts that stand once in the file, each with what replaces it.
        selected: pytest's -k; "" for all.
        compiled_into: files whose compiled functions hold those of this file.
    """

    file: str
    tests: str
    mutants: tuple[tuple[str, str], ...]
    selected: str = ""
    compiled_into: str = ""


def read_groups() -> list[Group]:
    """Return the mutants by file."""
    listed = tomllib.loads((ROOT / "benchmarks" / "mutants.toml").read_text(encoding="utf-8"))["group"]
    return [
        Group(
            group["file"],
            group["tests"],
            tuple((old, new) for old, new in group["mutants"]),
            group.get("selected", ""),
            group.get("compiled_into", ""),
        )
        for group in listed
    ]


def tree_with(old: str, new: str, group: Group, folder: Path) -> Path:
    """Return a copy of the program with the text `new` in place of `old`, and links to the unchanged tests."""
    tree = folder / "tree"
    shutil.copytree(ROOT / "nerfcli", tree / "nerfcli")  # with the compiled kernels, known by their timestamps
    for name in ("tests", "sample_scenes", "benchmarks", "pyproject.toml"):
        (tree / name).symlink_to(ROOT / name)
    path = tree / "nerfcli" / group.file
    text = path.read_text(encoding="utf-8")
    if text.count(old) != 1:
        raise ValueError(f"{group.file} has {text.count(old)} places with {old!r}, not one")
    path.write_text(text.replace(old, new), encoding="utf-8")
    for other in group.compiled_into.split():  # they hold a compiled copy of this file's functions
        for cached in (tree / "nerfcli" / other).parent.glob(f"__pycache__/{Path(other).stem}.*.nb*"):
            cached.unlink()
    return tree


def run_tests(tree: Path, group: Group, log: Path) -> None:
    """Run the tests until the first failure, in this child process, and exit with pytest's code."""
    os.setpgid(0, 0)
    os.chdir(tree)
    sys.path[:0] = [str(tree), str(tree / "tests")]
    keep_machine_code(tree / "nerfcli" / "kernels" / "numba_cpu")
    if "triton" in group.tests:
        os.environ |= {"TRITON_INTERPRET": "1", "NERFCLI_KERNELS": "triton_cuda"}
    selected = ("-k", group.selected) if group.selected else ()
    with log.open("w") as file, redirect_stdout(file), redirect_stderr(file):
        code = pytest.main(
            [
                "-x",
                "-q",
                "-p",
                "no:cacheprovider",
                "--tb=line",
                *selected,
                *(f"tests/{test}" for test in group.tests.split()),
            ]
        )
        file.flush()
    os._exit(int(code))


def keep_machine_code(kernels: Path) -> None:
    """Mark the copied machine code as current (that of the mutant is deleted), so that it is not compiled again."""
    spec = importlib.util.spec_from_file_location("machine_code", kernels / "machine_code.py")
    assert spec is not None
    assert spec.loader is not None
    machine_code = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(machine_code)  # without its package, which would discard all compiled code
    machine_code.note_sources(machine_code.sources(), kernels / "__pycache__")


def verdict_of(old: str, new: str, group: Group) -> tuple[str, float]:
    """Return which test killed the mutant, or that it survived, and the seconds that this took."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as temporary:
        folder = Path(temporary)
        tree = tree_with(old, new, group, folder)
        began = time.perf_counter()
        # Forked, so that torch and the other imports above are loaded only once; nothing of the program is loaded yet.
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
    chosen = [(group, *mutant) for group in read_groups() if only in group.file for mutant in group.mutants][skip:]
    rows = []
    for group, old, new in chosen:
        verdict, seconds = verdict_of(old, new, group)
        rows.append((group.file, f"{old.strip()} -> {new.strip()}", verdict, f"{seconds:.0f}"))
        console.print(" | ".join(rows[-1]), markup=False, soft_wrap=True)
        table.add_row(*(cell.replace("[", "\\[") for cell in rows[-1]))
        if output is not None:
            with output.open("w", newline="") as file:
                csv.writer(file).writerows([("file", "what is broken", "verdict", "seconds"), *rows])
    console.print(table)
    survived = sum(row[2] == "survived" for row in rows)
    console.print(f"{len(rows)} mutants: {len(rows) - survived} killed, {survived} survived")
    raise typer.Exit(int(survived > 0))


if __name__ == "__main__":
    typer.run(main)
