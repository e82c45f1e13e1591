"""Process one input, or several from standard input; refuse X-ray scans in commands for photos."""

import io
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from errno import EACCES, ELOOP, ENAMETOOLONG, EPERM
from pathlib import Path

import typer

from nerfcli.cli.console import out_of_memory_explained, report_error
from nerfcli.ct.recognise import OWN, is_reconstruction, recognise
from nerfcli.errors import UserError, in_shell
from nerfcli.machine import return_freed_memory

# Commands of `nerfcli ct` for a scan in another format, a scan folder and a run; the first is named by the others.
_OF_FORMATS, _OF_SCANS = ("convert", "doctor", "info"), ("train", "doctor", "info")
_OF_RUNS = ("render", "evaluate", "export", "info")


def refuse_scan(path: Path, command: str) -> None:
    """Refuse a scan or its reconstruction in a command for photos.

    Raises:
        UserError: the path is one; the hint is the command line for it.
    """
    if is_reconstruction(path):
        what, commands = "the reconstruction of an X-ray scan", _OF_RUNS
    elif (form := recognise(path)) is not None:
        what, commands = ("an X-ray scan", _OF_SCANS) if form == OWN else (f"an X-ray scan ({form})", _OF_FORMATS)
    else:
        return
    suited = command if command in commands else commands[0]
    line = f"nerfcli ct {suited} {in_shell(path)}{' SCAN' if suited == 'convert' else ''}"
    raise UserError(f"{path} is {what}, and {command} is for photos", f"use {line}")


STDIN = "-"
# Commands that read scenes, and those that read runs; the others read captures.
_READ_SCENES, _READ_RUNS = ("train", "ablate"), ("evaluate", "render", "export", "report", "bench", "info")


@dataclass(frozen=True)
class Given:
    """An input of a command.

    Args:
        path: the file or folder.
        one_of_many: whether it is from standard input, so that an output is the folder of the results.
        taken: the inputs so far, by their results.
    """

    path: Path
    one_of_many: bool = False
    taken: dict[Path, Path] = field(default_factory=dict)

    def refuse_taken(self, result: Path) -> None:
        """Refuse a path that is the result of another input, too; with --overwrite, only the last would stay."""
        if (other := self.taken.setdefault(result, self.path)) != self.path:
            hint = "give these inputs one by one, each with its own -o"
            raise UserError(f"{result} is the result of {other}, which has the same name", hint)


def for_each_input(source: str, work: Callable[[Given], None], *, command: str) -> None:
    """Call `work` for the path, or for each line of standard input as it arrives.

    A path that fails is reported and the remaining ones are processed; the exit code is that of the first failure.

    Raises:
        UserError: the only input failed, or standard input held no path.
    """
    if source != STDIN:
        with _unreadable_explained(Path(source)):
            work(Given(Path(source)))
    elif for_each_path(stdin_paths(), work, command=command) == 0:
        raise no_paths(command)


@contextmanager
def _unreadable_explained(path: Path) -> Iterator[None]:
    """Explain what the system says of paths that must not be read, or that are too long; other errors pass."""
    try:
        yield
    except OSError as error:
        if error.errno not in (EACCES, EPERM, ENAMETOOLONG, ELOOP):
            raise
        raise UserError(f"{error.filename or path}: {error.strerror}", "check the path and its permissions") from error


def for_each_path(paths: Iterable[Path], work: Callable[[Given], None], *, command: str) -> int:
    """Call `work` for each path, see `for_each_input`, and return their number."""
    first_failure: UserError | None = None
    taken, count = dict[Path, Path](), 0
    for path in paths:
        count += 1
        try:
            with out_of_memory_explained(), _unreadable_explained(path):
                if not command.startswith("ct "):
                    refuse_scan(path, command)
                work(Given(path, one_of_many=True, taken=taken))
        except UserError as error:
            report_error(error, about=str(path))
            first_failure = first_failure or error
        return_freed_memory()
    if first_failure is not None:
        raise typer.Exit(first_failure.exit_code)
    return count


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
    for stream in (sys.stdin, sys.stdout):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="surrogateescape")  # names that are not UTF-8 stay as they are
    while line := sys.stdin.readline() if sys.stdin is not None else "":  # None where the parent process has closed it
        if text := line.rstrip("\r\n"):
            yield Path(text)
