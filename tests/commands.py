"""Commands in this process or in one of their own, and what they said and left."""

import subprocess
import sys
from functools import cache
from pathlib import Path

import typer.testing
from typer.testing import CliRunner, Result

from nerfcli import cli

# Each call of the runner would build all commands again, which takes as long as most of them do to refuse an input.
typer.testing._get_command = cache(typer.testing._get_command)  # pyright: ignore[reportPrivateUsage, reportPrivateImportUsage]


def nerfcli(*arguments: str | Path, stdin: str | None = None) -> Result:
    """Run a command in this process; a bug keeps its traceback."""
    result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments], input=stdin)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def error_of(result: Result) -> tuple[str, str]:
    """Error and hint of a failed command, which are all that it said besides notes."""
    lines = [line for line in result.stderr.splitlines() if line.startswith(("Error:", "Hint:"))]
    assert len(lines) == 2, result.stderr
    assert "Traceback" not in result.stderr
    return lines[0], lines[1]


def listing(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with its content, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def started(*arguments: str | Path) -> subprocess.Popen[str]:
    """The command as a terminal starts it; a suite that runs in the background hands on that Ctrl-C is ignored."""
    program = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    program += "from nerfcli.cli import main; main()"
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
