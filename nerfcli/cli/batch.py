"""Process one input, or several from standard input."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import typer

from nerfcli.cli.console import out_of_memory_explained, report_error
from nerfcli.cli.scans import refuse_scan
from nerfcli.errors import UserError
from nerfcli.memory import return_freed_memory

STDIN = "-"
# Commands that read scenes, and those that read runs; the others read captures.
_READ_SCENES, _READ_RUNS = ("train", "ablate"), ("evaluate", "render", "export", "report", "bench", "info")


def for_each_input(source: str, work: Callable[[Path, bool], None], *, command: str) -> None:
    """Call `work(path, one_of_many)` for the path, or for each line of standard input as it arrives.

    A path that fails is reported and the remaining ones are processed; the exit code is that of the first failure.

    Args:
        source: a path, or "-".
        work: runs the whole command on one input.
        command: name of the command, for the hint.

    Raises:
        UserError: the only input failed, or standard input held no path.
    """
    if source != STDIN:
        work(Path(source), False)
        return
    first_failure: UserError | None = None
    count = 0
    for path in stdin_paths():
        count += 1
        try:
            with out_of_memory_explained():
                if not command.startswith("ct "):
                    refuse_scan(path, command)
                work(path, True)
        except UserError as error:
            report_error(error, about=str(path))
            first_failure = first_failure or error
        return_freed_memory()
    if count == 0:
        raise no_paths(command)
    if first_failure is not None:
        raise typer.Exit(first_failure.exit_code)


def no_paths(command: str) -> UserError:
    """Return the error of a command that found no path on standard input."""
    return UserError("no paths on standard input", f"give one path per line, for example: {example_of_many(command)}")


def example_of_many(command: str) -> str:
    """Return an example of a command line with several inputs."""
    captures = "scans/*/" if command.startswith("ct ") else "captures/*/"
    inputs = "*-scene/" if command in _READ_SCENES else "*-run/" if command.split()[-1] in _READ_RUNS else captures
    return f"ls -d {inputs} | nerfcli {command} -"


def stdin_paths() -> Iterator[Path]:
    """Yield the lines of standard input as paths, each as soon as it is complete; skip empty lines."""
    while line := sys.stdin.readline() if sys.stdin is not None else "":  # None where the parent process has closed it
        if text := line.rstrip("\r\n"):
            yield Path(text)


def result_path(source: Path, *, suffix: str, output: Path | None, one_of_many: bool) -> Path:
    """Return the output path for `source`.

    The default is beside the source, with `suffix` added to its name. If `output` is given, it is `output`, or a path
    inside `output` if there are many sources.

    Raises:
        UserError: the source is the root of the file system, beside which nothing can be written.
    """
    if source.name in ("", ".."):  # "." and ".." have a name only once they are resolved
        source = source.resolve()
    if not source.name and (output is None or one_of_many):
        raise UserError(f"cannot write a result next to {source}", "choose the output folder with -o")
    name = source.name + suffix
    if output is None:
        return source.with_name(name)
    return output / name if one_of_many else output
