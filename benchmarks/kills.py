"""What a kill does: poses, train and render, killed at random moments of their work, again and again.

    python benchmarks/kills.py --count 20 -o kills.csv

SIGKILL comes at a random moment after the first file has appeared; every second time it waits for a file that is just
being written. The same command is given again (train with --resume where a state is there) and killed again. One that
comes to its end is compared with a command that nobody disturbed, file by file, and the next begins from nothing. After
the last kill one is left alone and compared, too. Captures are small, and training saves a checkpoint several times a
second instead of every 30, so that kills meet it.
"""

import csv
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from faults import SPHERES, digests, make_capture
from PIL import Image

DESK = SPHERES.with_name("desk") / "images"
CHECKPOINT_SECONDS = 0.3
PROGRAM = f"""
import nerfcli.train.loop
nerfcli.train.loop.CHECKPOINT_SECONDS = {CHECKPOINT_SECONDS}
from nerfcli.cli import main
main()
"""
# Beside these, results hold times of day and durations.
TOLD = {
    "poses": ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"),
    "train": ("field.safetensors", "cameras.json", "config.json"),
}
WRITING = (".partial-", "-journal", "-wal")  # in the names of files; the last two are SQLite's
LOOK_EVERY_SECONDS = 0.002

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@dataclass(frozen=True)
class Given:
    """A command without its output folder, and what it must not touch."""

    name: str
    words: tuple[object, ...]
    inputs: tuple[Path, ...]


def commands(place: Path, run: Path | None) -> list[Given]:
    """Poses of 12 small photos of the desk, 200 steps on spheres, 60 small pictures of those or of a copy of `run`; and
    the captures for them."""
    make_capture(place / "capture")
    photos, capture = place / "photos", place / "capture"
    photos.mkdir()
    for path in sorted(DESK.iterdir())[:12]:
        with Image.open(path) as picture:
            picture.reduce(3).save(photos / f"{path.stem}.jpg", quality=95)
    shown = capture / "run"
    if run is not None:
        shown = Path(
            shutil.copytree(run, place / "copy" / run.name, ignore=shutil.ignore_patterns("renders", "state.*"))
        )
    views = ("--cameras", "orbit", "--count", "60", "--max-size", "48")
    return [
        Given("poses", ("poses", photos, "--quality", "fast", "--seed", "1"), (photos,)),
        Given("train", ("train", capture / "scene", "--steps", "200"), (capture / "scene", capture / "photos")),
        Given("render", ("render", shown, *views), (shown,)),
    ]


def started(given: Given, output: Path) -> subprocess.Popen[str]:
    """The command in a process of its own; it goes on where there is something to go on from."""
    words = [*given.words, "-o", output, "--threads", "1", "--quiet"]
    if given.name == "train" and (output / "state.safetensors").exists():
        words.append("--resume")
    command = [sys.executable, "-c", PROGRAM, *map(str, words)]
    environment = {**os.environ, "GOMP_SPINCOUNT": "1000"}
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def files_around(output: Path) -> set[str]:
    """Everything in the output folder and in hidden ones beside it."""
    found = set[str]()
    for folder, _, files in os.walk(output.parent):
        found.update(os.path.join(folder, file) for file in files)
    return found


def undisturbed(given: Given, output: Path) -> tuple[float, float]:
    """Run a command to its end: seconds until it had begun to write, and in all.

    Raises:
        SystemExit: it fails.
    """
    began, first = time.monotonic(), 0.0
    process = started(given, output)
    while process.poll() is None:
        if not first and files_around(output):
            first = time.monotonic() - began
        time.sleep(LOOK_EVERY_SECONDS)
    if process.returncode != 0:
        raise SystemExit(f"{given.name}: {process.stderr.read() if process.stderr else ''}")
    return first, time.monotonic() - began


def killed(process: subprocess.Popen[str], output: Path, *, after: float, writing: bool) -> str:
    """Kill a process after some seconds or, `writing`, as soon as a file is being written then.

    Returns:
        "done" where it came to its end before, else what was going on: "writing" or "working".
    """
    end = time.monotonic() + after
    while process.poll() is None:
        partial = writing and any(mark in file for file in files_around(output) for mark in WRITING)
        if time.monotonic() >= end and (partial or not writing):
            process.kill()
            break
        time.sleep(LOOK_EVERY_SECONDS)
    said = process.stderr.read() if process.stderr else ""
    code = process.wait()
    if code not in (0, -9):
        return f"exit {code}: {said.strip()[-300:]}"
    return "done" if code == 0 else "writing" if writing else "working"


def differing(name: str, whole: Path, part: Path) -> list[str]:
    """The files that are not the same in two results, or missing, times and places of runs aside."""
    one, other = digests(whole), digests(part)
    names = TOLD.get(name) or sorted(one.keys() | other.keys())
    leftovers = [file for file in other if "partial" in file or "unfinished" in file]
    return [file for file in names if one.get(file) != other.get(file) or file not in one] + leftovers


@app.command()
def kills(
    count: Annotated[int, typer.Option(help="Kills of each command.", min=1)] = 20,
    seed: int = 0,
    only: Annotated[str, typer.Option(help="Some of poses,train,render.")] = "poses,train,render",
    run: Annotated[Path | None, typer.Option(help="A run to render, in place of a small one; it is copied.")] = None,
    output: Annotated[Path, typer.Option("-o", help="CSV with a line per kill.")] = Path("kills.csv"),
) -> None:
    """Kill commands at random moments and go on."""
    draw = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder, output.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("command", "kill", "after_seconds", "outcome", "differing"))
        for given in commands(Path(folder), run):
            if given.name not in only.split(","):
                continue
            whole, part = Path(folder) / f"{given.name}-whole" / "out", Path(folder) / f"{given.name}-part" / "out"
            before = [digests(path) for path in given.inputs]
            whole.parent.mkdir()
            part.parent.mkdir()
            begins, seconds = undisturbed(given, whole)
            table, number = Counter[str](), 0
            while (hits := table["working"] + table["writing"]) < count:
                after = draw.uniform(begins, seconds)
                outcome = killed(started(given, part), part, after=after, writing=hits % 2 == 1)
                wrong = differing(given.name, whole, part) if outcome == "done" else []
                number += 1
                table["different" if wrong else outcome] += 1
                writer.writerow((given.name, number, f"{after:.2f}", outcome, " ".join(wrong)))
                file.flush()
                if outcome == "done":  # start afresh, so that the next kill has something to hit
                    shutil.rmtree(part.parent)
                    part.parent.mkdir()
            process = started(given, part)
            said = process.communicate()[1]
            wrong = differing(given.name, whole, part)
            told = ", ".join(f"{times} {outcome}" for outcome, times in sorted(table.items()))
            kept = before == [digests(path) for path in given.inputs]
            beside = sorted(path.name for path in part.parent.iterdir() if path != part)
            typer.echo(
                f"{given.name}: begins at {begins:.1f} s, takes {seconds:.1f} s; {told}; then exit "
                f"{process.returncode} {said.strip()[-200:]}; differing: {wrong or 'none'}; "
                f"beside it: {beside or 'nothing'}; inputs {'unchanged' if kept else 'CHANGED'}"
            )


if __name__ == "__main__":
    app()
