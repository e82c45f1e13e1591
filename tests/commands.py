"""Run commands in this process or a separate one, and inspect their output and files."""

import subprocess
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import typer.testing
from typer.testing import CliRunner, Result

from nerfcli import cli
from nerfcli.errors import BAD_INPUT

# Otherwise each call of the runner would rebuild all commands, which takes as long as most refusals of an input.
typer.testing._get_command = cache(typer.testing._get_command)


def nerfcli(*arguments: str | Path, stdin: str | None = None) -> Result:
    """Run a command in this process; a bug keeps its traceback."""
    result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments], input=stdin)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def completed(*arguments: str | Path, stdin: str | None = None) -> Result:
    """Return the result of a command that succeeds, after checking its exit code."""
    result = nerfcli(*arguments, stdin=stdin)
    assert result.exit_code == 0, (arguments, result.stderr)
    return result


def error_of(result: Result) -> tuple[str, str]:
    """Return the error and the hint of a failed command, after checking that stderr has exactly one of each."""
    lines = [line for line in result.stderr.splitlines() if line.startswith(("Error:", "Hint:"))]
    assert len(lines) == 2, result.stderr
    assert "Traceback" not in result.stderr
    return lines[0], lines[1]


def refusal(*arguments: str | Path, exit_code: int = BAD_INPUT, stdin: str | None = None) -> tuple[str, str]:
    """Return the error and the hint of a command that is refused, after checking its exit code."""
    result = nerfcli(*arguments, stdin=stdin)
    assert result.exit_code == exit_code, (arguments, result.stderr)
    assert result.stdout == "", arguments
    return error_of(result)


def estimated_poses() -> SimpleNamespace:
    """Return what `nerfcli.poses.structure_from_motion.estimate_poses` reports of five photos."""
    return SimpleNamespace(images=[], registered=5, total=5, seconds={"total": 1.0}, mean_reprojection_error_px=0.5)


def listing(folder: Path) -> dict[str, bytes]:
    """Return the content of every file below a folder, including hidden ones, by relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def in_python(program: str) -> subprocess.CompletedProcess[str]:
    """Run a program in a Python process of its own, and return its exit code and what it printed."""
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def started(*arguments: str | Path) -> subprocess.Popen[str]:
    """Start a command that reacts to Ctrl-C as in a terminal, even if a suite in the background ignores SIGINT."""
    program = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    program += "from nerfcli.__main__ import start; start()"
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
