"""Output of commands: results on stdout, everything else on stderr, errors in two lines with their exit code."""

import errno
import functools
import inspect
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, ParamSpec, TextIO, TypeVar

import typer

from nerfcli.errors import INTERRUPTED, OUT_OF_MEMORY, TERMINATED, UserError, duration
from nerfcli.interrupts import Terminated
from nerfcli.notices import Reporter, no_progress

P = ParamSpec("P")
R = TypeVar("R")

# Without a terminal, progress is a plain line at most this often.
PLAIN_LINE_SECONDS = 10.0
# Details may state a better estimate of the time left.
STATES_LEFT = " left"
# Of a stage, before its speed says how long the rest takes.
_LEAST_DONE = 0.02
# Error numbers of a full disk and of an exhausted quota. Files that commands write have errors of their own for these.
_FULL = (errno.ENOSPC, errno.EDQUOT)
# Names of files may have control characters, which would act on the terminal.
_CONTROLS = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"}
# Width of tables in a file or a pipe, which have no width of their own.
TABLE_WIDTH = 200


class Console:
    """Output of a command.

    Args:
        quiet: print no notes, tables for the user or progress; warnings and errors are still printed.
        json_lines: print results as JSON Lines instead of paths.
    """

    def __init__(self, *, quiet: bool, json_lines: bool):
        self.quiet = quiet
        self.json_lines = json_lines

    def result(self, path: Path, content: dict[str, Any] | None = None) -> None:
        """Print one result on stdout: its path, or with --json a line of JSON with the path and `content`."""
        line = json.dumps({"path": str(path), **(content or {})}) if self.json_lines else str(path)
        print(line, flush=True)  # noqa: T201 - the one place that writes results

    def address(self, url: str) -> None:
        """Print the address of a page as a result on stdout."""
        print(url, flush=True)  # noqa: T201 - a result, as above

    def facts(self, path: Path, content: dict[str, Any], text: str) -> None:
        """Print facts about a path on stdout: `text`, or with --json the same as `result`."""
        if self.json_lines:
            self.result(path, content)
        else:
            print(text, flush=True)  # noqa: T201 - a result, as above

    def fact(self, content: dict[str, Any]) -> None:
        """Print one result that is not a file, as a line of JSON on stdout."""
        print(json.dumps(content), flush=True)  # noqa: T201 - a result, as above

    def fact_table(self, columns: Sequence[str], rows: Sequence[Sequence[str]], *, styles: Mapping[str, str]) -> None:
        """Print results that are not files as a table on stdout; `styles` gives the styles of cells by their text."""
        _print_table(columns, rows, styles, sys.stdout)

    def note(self, text: str) -> None:
        """Print a line for the user."""
        if not self.quiet:
            _stderr(text)

    def warn(self, text: str) -> None:
        """Print a warning for the user."""
        _stderr(f"Warning: {text}")

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[str]], *, styles: Mapping[str, str]) -> None:
        """Print a table for the user; `styles` gives the styles of cells by their text."""
        if self.quiet:
            return
        _print_table(columns, rows, styles, sys.stderr)

    @property
    def reporter(self) -> Reporter:
        """The reporter of a workflow, which shows the progress of its stages only."""
        return Reporter(self.note, self.warn, titled=self.stage)

    @contextmanager
    def stage(self, title: str) -> Iterator[Reporter]:
        """Provide the reporter of a stage: a progress bar on a terminal, or an occasional plain line elsewhere.

        The bar appears with the first progress.
        """
        with ExitStack() as stack:
            bar: Callable[[float, str], None] | None = None

            def update(fraction: float, detail: str) -> None:
                nonlocal bar
                if bar is None:
                    bar = stack.enter_context(_bar(title)) if sys.stderr.isatty() else _plain_lines(title)
                bar(fraction, detail)

            yield Reporter(self.note, self.warn, no_progress if self.quiet else update)


def _print_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], styles: Mapping[str, str], file: TextIO
) -> None:
    from rich.box import SIMPLE
    from rich.console import Console as RichConsole
    from rich.table import Table
    from rich.text import Text

    table = Table(*columns, box=SIMPLE, pad_edge=False)
    for row in rows:
        table.add_row(*(Text(cell, style=styles.get(cell, "")) for cell in row))
    RichConsole(file=file, width=None if file.isatty() else TABLE_WIDTH).print(table)


@contextmanager
def _bar(title: str) -> Iterator[Callable[[float, str], None]]:
    from rich.console import Console as RichConsole
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[detail]}"),
    )
    clock = _Clock()
    with Progress(*columns, console=RichConsole(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=1.0, detail="")
        yield lambda fraction, detail: bar.update(
            task, completed=fraction, detail=clock.with_time_left(fraction, detail)
        )


def _plain_lines(title: str) -> Callable[[float, str], None]:
    last, clock = time.monotonic(), _Clock()

    def update(fraction: float, detail: str) -> None:
        nonlocal last
        text = clock.with_time_left(fraction, detail)
        if time.monotonic() - last >= PLAIN_LINE_SECONDS:
            last = time.monotonic()
            _stderr(f"{title}: {100 * fraction:.0f} % {text}".rstrip())

    return update


class _Clock:
    """Estimate of the time left in a stage, from its speed since the first progress.

    Work before that, such as compiling, does not count. A training that is resumed does not begin at 0.
    """

    def __init__(self) -> None:
        self._at: float | None = None
        self._began: float | None = None

    def with_time_left(self, fraction: float, detail: str) -> str:
        """Return the detail and the time that is left at this fraction, unless it states that itself."""
        if self._at is None:
            self._at = fraction
        if self._began is None and fraction > self._at:
            self._at, self._began = fraction, time.monotonic()
        done = fraction - self._at
        if self._began is None or done < _LEAST_DONE or STATES_LEFT in detail:
            return detail
        seconds = (time.monotonic() - self._began) * (1.0 - fraction) / done
        return f"{detail}, about {duration(seconds)} left"


def _stderr(text: str) -> None:
    print(text.translate(_CONTROLS), file=sys.stderr, flush=True)  # noqa: T201 - the one place that writes to the user


def report_error(error: UserError, about: str | None = None) -> None:
    """Print the two lines of an error; `about` is the input that it concerns, if there are several."""
    prefix = "" if about is None or error.message.startswith(about) else f"{about}: "
    for line in (f"Error: {prefix}{error.message}", f"Hint:  {error.hint}"):
        _stderr(line.replace("\n", "\\n"))


def command(function: Callable[..., R]) -> Callable[..., R]:
    """Make a command of a function: its options are its parameters, and the fields of those that are dataclasses.

    Exceptions become two lines and an exit code, see `errors_explained`.
    """
    parameters = list(inspect.signature(function).parameters.values())
    records = {each.name: each.annotation for each in parameters if is_dataclass(each.annotation)}
    options = [
        option
        for each in parameters
        for option in (inspect.signature(each.annotation).parameters.values() if each.name in records else (each,))
    ]

    @errors_explained
    @functools.wraps(function)
    def parsed(**given: Any) -> R:
        for name, record in records.items():
            given[name] = record(**{field.name: given.pop(field.name) for field in fields(record)})
        return function(**given)

    # Typer reads these.
    keywords = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    setattr(parsed, "__signature__", inspect.Signature(keywords))  # noqa: B010 - functions do not declare it
    parsed.__annotations__ = {option.name: option.annotation for option in options}
    return parsed


def errors_explained(function: Callable[P, R]) -> Callable[P, R]:
    """Turn the exceptions of a function into two lines and an exit code; bugs keep their traceback."""

    @functools.wraps(function)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with _interrupts_unwrapped(), out_of_memory_explained():
                return function(*args, **kwargs)
        except UserError as error:
            report_error(error)
            raise typer.Exit(error.exit_code) from error
        except Terminated as error:
            _stderr("Ended by SIGTERM; completed work is kept.")
            raise typer.Exit(TERMINATED) from error
        except KeyboardInterrupt as error:
            _stderr("Interrupted; completed work is kept.")
            raise typer.Exit(INTERRUPTED) from error
        except BrokenPipeError as error:
            # The reader of stdout has gone: end quietly, and keep Python from complaining when it closes stdout.
            _discard_stdout()
            raise typer.Exit(0) from error
        except OSError as error:
            if error.errno not in _FULL:
                raise
            _discard_stdout()
            hint = "free some space, or send stdout elsewhere; completed files are kept"
            full = UserError("the disk is full: the output could not be written", hint)
            report_error(full)
            raise typer.Exit(full.exit_code) from error

    return guarded


def _discard_stdout() -> None:
    """Send what is left to write to nowhere, so that Python does not fail when it closes stdout."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _interrupts_unwrapped() -> Iterator[None]:
    """Raise the interrupt that caused an exception, if one did.

    C code that an interrupt reaches may fail because of it; pycolmap then reports a broken installation.
    """
    try:
        yield
    except typer.Exit:
        raise
    except Exception as error:
        cause = error.__cause__
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from None


@contextmanager
def out_of_memory_explained() -> Iterator[None]:
    """Turn out-of-memory errors into a UserError.

    Torch raises a RuntimeError that only its text identifies on the CPU, and a subclass of RuntimeError on a GPU.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        text = str(error).lower()
        if not isinstance(error, MemoryError) and "not enough memory" not in text and "out of memory" not in text:
            raise
        hint = "use --downscale 4, smaller pictures (--max-size) or fewer photos; of scans, a larger --voxel-size"
        raise UserError("out of memory", hint, OUT_OF_MEMORY) from error
