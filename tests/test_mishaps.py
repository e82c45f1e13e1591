"""What happens around a command: a full disk, Ctrl-C, SIGTERM, another command on the folder, photos that are gone.

Each ends with its exit code and a line or two, and leaves everything that existed before unchanged.
"""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import error_of, in_python, listing, nerfcli, refusal, started
from full_disk import files_of_at_most

from nerfcli import atomic, kernels
from nerfcli.atomic import exclusive
from nerfcli.errors import BAD_INPUT, INTERRUPTED, OUT_OF_MEMORY, TERMINATED
from nerfcli.interrupts import Terminated, install_handlers
from nerfcli.training.runs.files import LOCK, PHOTO_DEPTHS
from nerfcli.workflows import describe

ONE_STEP = ("--steps", "1", "--downscale", "8", "--log2-rows", "10", "--threads", "2")
FEW = ("--cameras", "test", "--max-size", "16", "--threads", "2")

# Commands that write: their arguments, from the capture and a run of it, and the bytes that a file may have.
Words = Callable[[Path, Path], tuple[Any, ...]]
WRITERS: dict[str, tuple[Words, int]] = {
    "train": (lambda capture, run: ("train", capture, "-o", run.with_name("new"), *ONE_STEP), 50_000),
    "render": (lambda capture, run: ("render", run, *FEW), 300),
    "evaluate": (lambda capture, run: ("evaluate", run, "--threads", "2"), 300),
    "predictions": (lambda capture, run: ("evaluate", run, "--save-predictions", "png"), 80),
    "report": (lambda capture, run: ("report", run), 5000),
    "convert": (lambda capture, run: ("convert", capture, run.with_name("a.json"), "--to", "transforms"), 300),
}


def with_leftovers(folder: Path, before: dict[str, bytes]) -> dict[str, bytes]:
    """Return files that are new or changed, except locks and those from which the same command resumes."""
    kept = ("unfinished", LOCK, PHOTO_DEPTHS, "new/")
    return {
        name: content
        for name, content in listing(folder).items()
        if before.get(name) != content and not any(mark in name for mark in kept)
    }


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_reported_and_earlier_files_stay_intact(name, finished, capture):
    words, size = WRITERS[name]
    kernels.prepare(lambda text: None)  # compiled kernels are written beside the program
    before = listing(capture.parent)
    with files_of_at_most(size):
        result = nerfcli(*words(capture, finished))
    assert result.exit_code == BAD_INPUT, result.stderr
    error, hint = error_of(result)
    assert error.startswith("Error: cannot write ")
    assert "free some disk space" in hint
    assert result.stdout == ""
    assert with_leftovers(capture.parent, before) == {}
    assert before.items() <= listing(capture.parent).items()
    assert not list(capture.parent.rglob("*partial*"))


@pytest.fixture(params=[signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "sigterm"])
def interrupted_when_written(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[list[str]]:
    """Send Ctrl-C or SIGTERM when the first result is about to get its name, which the list then contains."""
    met: list[str] = []
    replace = os.replace

    def replace_and_interrupt(source: Any, target: Any) -> None:
        if not met:
            met.append(str(target))
            signal.raise_signal(request.param)
        replace(source, target)

    monkeypatch.setattr(atomic.os, "replace", replace_and_interrupt)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background ignore it
    install_handlers()
    yield met
    signal.signal(signal.SIGINT, before)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "train"])
def test_ctrl_c_and_sigterm_end_a_command_in_one_line(name, finished, capture, interrupted_when_written):
    before = listing(capture.parent)
    result = nerfcli(*WRITERS[name][0](capture, finished))
    assert interrupted_when_written
    assert result.stdout == ""
    assert (result.exit_code, result.stderr.splitlines()[-1]) in (
        (INTERRUPTED, "Interrupted; completed work is kept."),
        (TERMINATED, "Ended by SIGTERM; completed work is kept."),
    )
    assert not any(word in result.stderr for word in ("Traceback", "Error:"))
    assert with_leftovers(capture.parent, before) == {}
    assert before.items() <= listing(capture.parent).items()
    assert not list(capture.parent.rglob("*partial*"))


@pytest.mark.parametrize("name", ["info", pytest.param("render", marks=pytest.mark.slow)])
def test_a_reader_that_goes_away_loses_nothing(name, finished, capture):
    """As with `| true`: the results are complete, and there is no message."""
    process = started("info", capture, "--json") if name == "info" else started("render", finished, *FEW, "--quiet")
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    with process:
        assert process.stderr.read() == ""
    assert process.returncode == 0
    assert len(list(finished.glob("renders/*/render.json"))) == (name == "render")


def test_a_second_training_of_a_run_is_refused_while_the_first_is_at_work(capture):
    run = capture.with_name("new")
    with exclusive(run / LOCK, "nerfcli train is working"):
        result = nerfcli("train", capture, "-o", run, *ONE_STEP)
    assert result.exit_code == BAD_INPUT
    assert error_of(result) == (
        f"Error: another nerfcli train is working on {run}",
        "Hint:  wait until it has finished, or choose another folder with -o",
    )
    assert [path.name for path in run.iterdir()] == [LOCK]


def test_a_refused_training_leaves_no_trace(capture, finished):
    """For lack of memory: no new folder, no lock in one that was there, and nothing is missing from a run."""
    (finished / "metrics.json").write_text("{}")
    there, new, run = capture.with_name("there"), capture.with_name("new"), listing(finished)
    there.mkdir()
    for folder in (there, new, finished):
        line = ("train", capture, "-o", folder, "--overwrite", "--memory", "1MB", *ONE_STEP)
        assert nerfcli(*line).exit_code == OUT_OF_MEMORY
    assert not new.exists()
    assert list(there.iterdir()) == []
    assert run.items() <= listing(finished).items()


def test_a_run_whose_photos_were_moved_elsewhere_says_which_and_how_to_mend_it(finished, capture):
    moved = capture.parent / "elsewhere" / "run"
    shutil.copytree(finished, moved)
    photos = capture.rename(capture.with_name("photos elsewhere"))
    error, hint = refusal("evaluate", moved)
    missing = moved.parent / "spheres" / "test" / "r_000.png"
    assert error == f"Error: photo not found: {missing}"
    assert "put a link to the photo folder there" in hint
    (moved.parent / "spheres").symlink_to(photos)  # as the hint says
    assert nerfcli("evaluate", moved).exit_code == 0


def test_what_a_killed_evaluation_left_goes_with_the_next(finished):
    with subprocess.Popen([sys.executable, "-c", ""]) as dead:
        pass
    left = finished / f".predictions.partial-{atomic._host()}-{dead.pid}"
    left.mkdir()
    (left / "half.png").write_bytes(b"half")
    assert nerfcli("evaluate", finished, "--threads", "2").exit_code == 0
    assert not left.exists()


def test_ctrl_c_while_the_program_is_imported_ends_in_one_line():
    program = """
import sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "nerfcli.cli":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupting())
from nerfcli.__main__ import start
start()
"""
    ended = in_python(program)
    assert (ended.returncode, ended.stderr) == (INTERRUPTED, "Interrupted; nothing was begun.\n")


@pytest.mark.parametrize(("came", "code"), [(KeyboardInterrupt, INTERRUPTED), (Terminated, TERMINATED)])
def test_an_interrupt_that_c_code_reports_as_a_failure_is_one(came, code, capture, monkeypatch):
    """Regression: Ctrl-C while pycolmap was imported ended with a traceback, which blamed the installation."""

    def imported(path):
        try:
            raise ImportError("initialization failed") from came()
        except ImportError as error:
            raise RuntimeError("Cannot import the C++ backend") from error

    monkeypatch.setattr(describe, "describe", imported)
    result = nerfcli("info", capture)
    assert (result.exit_code, result.stdout) == (code, "")
    assert result.stderr.endswith("; completed work is kept.\n")
    assert len(result.stderr.splitlines()) == 1


def test_sigterm_before_a_command_begins_ends_with_its_own_code():
    """Regression: it ended silently, with the code of Ctrl-C."""
    program = """
import os, signal, sys
from nerfcli.__main__ import start
from nerfcli.cli import usage

def terminated(self, ctx, args):
    os.kill(os.getpid(), signal.SIGTERM)
    signal.pause()

usage.Command.parse_args = terminated
sys.argv = ["nerfcli", "info", "photos"]
start()
"""
    ended = in_python(program)
    assert (ended.returncode, ended.stderr) == (TERMINATED, "Ended by SIGTERM; completed work is kept.\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("options", [("info",), ("info", "--json"), ("info", "--help")])
def test_a_full_disk_behind_stdout_is_an_error_of_two_lines(options, capture):
    paths = [] if "--help" in options else [capture]
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "nerfcli", *options, *paths]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == BAD_INPUT
    assert [line.split(":")[0] for line in done.stderr.splitlines()] == ["Error", "Hint"]
    assert "disk is full" in done.stderr


def test_a_closed_stdin_holds_no_paths():
    """As with `<&-`, and for some services."""
    command = [sys.executable, "-m", "nerfcli", "info", "-"]
    done = subprocess.run(
        ["sh", "-c", '"$@" <&-', "sh", *command], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout) == (BAD_INPUT, "")
    assert done.stderr.startswith("Error: no paths on standard input\nHint:  ")


def test_a_path_that_stdout_cannot_encode_is_escaped(capture, tmp_path):
    given = capture.rename(tmp_path / "k\u00fcche")
    command = [sys.executable, "-m", "nerfcli", "convert", given, tmp_path / "\u00fc.json", "--to", "transforms"]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60, env=environment)
    assert (done.returncode, done.stdout) == (0, f"{tmp_path}/\\xfc.json\n"), done.stderr
