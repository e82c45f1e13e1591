"""Effects of kills: poses, train, render and evaluate, killed repeatedly at random moments.

    python benchmarks/kills.py --count 20 -o kills.csv

SIGKILL is sent at a random moment after the first file has appeared; every second time it also waits until a file is
being written. The same command is then run and killed again (train with --resume if there is a state). If it completes,
its result is compared file by file with that of an undisturbed command, and the next one starts from scratch. After the
last kill, the command is left to complete and is compared, too. Captures are small, and training saves a checkpoint
every 0.3 s instead of every 30 s, so that kills hit that as well.
"""

import csv
import json
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
import nerfcli.training.loop
nerfcli.training.loop.CHECKPOINT_SECONDS = {CHECKPOINT_SECONDS}
from nerfcli.cli import main
main()
"""
# Files to compare; the other files of these results contain times of day and durations.
COMPARED = {
    "poses": ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"),
    "train": ("field.safetensors", "cameras.json", "config.json"),
}
VOLATILE_FIELDS = ("seconds", "written_at", "blake2b")  # fields of JSON files
VOLATILE_FILES = ("metrics.json",)  # of the other commands
WRITING = (".partial-", "-journal", "-wal")  # parts of file names; the last two are of SQLite
LOOK_EVERY_SECONDS = 0.002

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@dataclass(frozen=True)
class TimedCommand:
    """A command without its output folder, and the inputs that it must not change."""

    name: str
    words: tuple[object, ...]
    inputs: tuple[Path, ...]


def commands(place: Path, run: Path | None) -> list[TimedCommand]:
    """Write the captures and return the commands.

    These are: poses of 12 small photos of the desk; 200 steps on spheres; 60 small pictures of a run on spheres, or of
    a copy of `run`; evaluation of a copy of that run, with its pictures, which stand in the run.
    """
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
        TimedCommand("poses", ("poses", photos, "--quality", "fast", "--seed", "1"), (photos,)),
        TimedCommand("train", ("train", capture / "scene", "--steps", "200"), (capture / "scene", capture / "photos")),
        TimedCommand("render", ("render", shown, *views), (shown,)),
        TimedCommand("evaluate", ("evaluate", "--save-predictions", "png"), (shown,)),
    ]


def started(given: TimedCommand, output: Path) -> subprocess.Popen[str]:
    """Start the command in a separate process; a training resumes if there is a state."""
    words = [*given.words, "--threads", "1", "--quiet"]
    if given.name != "evaluate":
        words += ["-o", output]
    else:
        words.append(output)
        if not output.exists():
            shutil.copytree(given.inputs[0], output, ignore=shutil.ignore_patterns("metrics.json", "predictions"))
    if given.name == "train" and (output / "state.safetensors").exists():
        words.append("--resume")
    command = [sys.executable, "-c", PROGRAM, *map(str, words)]
    environment = {**os.environ, "GOMP_SPINCOUNT": "1000"}
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def files_around(output: Path) -> set[str]:
    """Return all files in the output folder and beside it."""
    found = set[str]()
    for folder, _, files in os.walk(output.parent):
        found.update(os.path.join(folder, file) for file in files)
    return found


def undisturbed(given: TimedCommand, output: Path) -> tuple[float, float]:
    """Run a command to its end; return the seconds until it began to write, and in total.

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
    """Kill a process after some seconds or, if `writing`, as soon as a file is being written after that.

    Returns:
        "done" if it completed before, "exit CODE: ..." if it failed, else what it was doing: "writing" or "working".
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


def stable_json(folder: Path) -> dict[str, str]:
    """Return the content of the JSON files of a run, without times, places, and digests of these."""

    def stable(content: object) -> object:
        if isinstance(content, dict):
            return {key: stable(value) for key, value in content.items() if key not in VOLATILE_FIELDS}
        return [stable(value) for value in content] if isinstance(content, list) else content

    paths = [folder / name for name in COMPARED["train"] if name.endswith(".json")]
    return {path.name: json.dumps(stable(json.loads(path.read_text()))) for path in paths if path.exists()}


def differing(name: str, whole: Path, part: Path) -> list[str]:
    """Return the files that differ between two results or are missing, and leftovers of unfinished writing."""
    one, other = (digests(folder) | stable_json(folder) for folder in (whole, part))
    names = COMPARED.get(name) or sorted(
        file for file in one.keys() | other.keys() if Path(file).name not in VOLATILE_FILES
    )
    leftovers = [file for file in other if "partial" in file or "unfinished" in file]
    return [file for file in names if one.get(file) != other.get(file) or file not in one] + leftovers


@app.command()
def kills(
    count: Annotated[int, typer.Option(help="Kills of each command.", min=1)] = 20,
    seed: int = 0,
    only: Annotated[str, typer.Option(help="Some of them.")] = "poses,train,render,evaluate",
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
            outcomes = ", ".join(f"{times} {outcome}" for outcome, times in sorted(table.items()))
            kept = before == [digests(path) for path in given.inputs]
            beside = sorted(path.name for path in part.parent.iterdir() if path != part)
            typer.echo(
                f"{given.name}: begins at {begins:.1f} s, takes {seconds:.1f} s; {outcomes}; then exit "
                f"{process.returncode} {said.strip()[-200:]}; differing: {wrong or 'none'}; "
                f"beside it: {beside or 'nothing'}; inputs {'unchanged' if kept else 'CHANGED'}"
            )


if __name__ == "__main__":
    app()
