"""The command line: one file per command; each parses, calls one library function and prints what was written."""

import os
import sys
from contextlib import suppress
from io import TextIOWrapper

import typer

from nerfcli import __version__
from nerfcli.cli import (
    ablate,
    bench,
    convert,
    ct,
    doctor,
    evaluate,
    export,
    info,
    poses,
    render,
    report,
    run,
    selftest,
    train,
    view,
)
from nerfcli.cli.usage import PhotoCommand, Program
from nerfcli.errors import INTERRUPTED, TERMINATED
from nerfcli.interrupts import install_handlers
from nerfcli.machine import keep_freed_memory

app = typer.Typer(
    cls=Program,
    no_args_is_help=True,
    rich_markup_mode=None,  # plain text: half the start-up time, and readable in a pipe
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
_COMMANDS = (doctor, poses, train, evaluate, render, view, export, report, run, info, convert, selftest, bench, ablate)
for _module in _COMMANDS:
    _name = _module.__name__.rsplit(".", 1)[-1]
    app.command(_name, cls=PhotoCommand)(getattr(_module, _name))
app.add_typer(ct.app, name="ct")


@app.callback(invoke_without_command=True)
def main_options(version: bool = typer.Option(False, "--version", help="Show the version and exit.")) -> None:
    """Turn photos into a radiance field: camera poses, new views, depth maps, videos.

    \b
    Everything at once:
      nerfcli run photos/
    Check the photos first:
      nerfcli doctor photos/                       -> photos-doctor.html
    Step by step:
      nerfcli poses photos/                        -> photos-scene/
      nerfcli train photos-scene/ --budget 2m      -> photos-scene-run/
      nerfcli evaluate photos-scene-run/           -> photos-scene-run/metrics.json
      nerfcli render photos-scene-run/ --cameras orbit --depth conditional --video
      nerfcli report photos-scene-run/             -> photos-scene-run/report.html
      nerfcli view photos-scene-run/               -> the field in a browser, even during training
      nerfcli export photos-scene-run/ --to page   -> photos-scene-run.html; also splats, mesh, points
    Measure what each component of the model contributes:
      nerfcli ablate photos-scene/                 -> photos-scene-ablation/
    Convert cameras between formats:
      nerfcli convert photos-scene/ transforms.json --to transforms
    X-ray scans instead of photos:
      nerfcli ct --help
    Many captures:
      ls -d captures/*/ | nerfcli poses - -o scenes | nerfcli train - -o runs | nerfcli render -

    Exit codes: 0 done; 1 a bug; 2 wrong usage; 3 bad input; 4 too few photos registered; 5 numbers became
    non-finite; 6 out of memory; 7 a quality gate not met; 8 another process of torchrun
    ended; 130 interrupted; 143 ended by SIGTERM.
    """
    if version:
        typer.echo(f"nerfcli {__version__}")
        raise typer.Exit


def main() -> None:
    """Run the console script."""
    # By default, idle OpenMP threads wait in a busy loop for a long time, which blocks the cores for the other command
    # of a pipeline: 58 training steps in 10 s, instead of 245 with this. libgomp reads it when torch is loaded.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    keep_freed_memory()
    install_handlers()
    _escape_what_stdout_cannot_encode()
    try:
        app(prog_name="nerfcli")  # not "python -m nerfcli", for which no shell has completion
    except SystemExit as ended:
        if ended.code not in (INTERRUPTED, TERMINATED):
            raise
        # A second Ctrl-C makes Python forget threads that still run; if these are in C++, it would abort at its exit.
        with suppress(OSError):
            sys.stdout.flush()
        os._exit(ended.code)


def _escape_what_stdout_cannot_encode() -> None:
    """Print a character that the encoding of stdout lacks as an escape, as Python does on stderr, not as a bug."""
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
