"""Components that `--model auto` picks on scenes that each need one: how often the right one, how often others.

    python benchmarks/selection.py -o selection
    python benchmarks/selection.py -o selection --only glossy --seeds 3

Every seed gives another scene (see component_scenes.py) and another training. Budgets are in steps, so that other work
on the machine changes nothing. Prints a table and writes OUT.csv, a line per scene and seed as soon as it is known;
existing lines are not computed again.
"""

import csv
import tempfile
import time
from pathlib import Path
from typing import Annotated

import torch
import typer
from component_scenes import make
from rich.console import Console
from rich.table import Table

from nerfcli import kernels, scene
from nerfcli.runs.components import differences
from nerfcli.runs.settings import TrainSettings
from nerfcli.search.selection import SEARCH_FRACTION
from nerfcli.train.preparation import prepare

# Components that each scene needs beyond the default. Points help wherever photos share any, and are counted
# separately; the view may be left out, except in `NEEDS_VIEW`.
NEEDED: dict[str, dict[str, object]] = {
    "exposure-balls": {"exposure": "learned"},
    "exposure-exif-balls": {"exposure": "exif"},
    "unbounded": {"background": "sphere"},
    "glossy": {},
    "alpha": {},
    "poses": {"cameras": "poses"},
    "focal": {"cameras": "focal"},
    "desk": {},
    "poses-balls": {"cameras": "poses"},
}
NEEDS_VIEW = ("glossy",)
SEARCH_STEPS = 1000
COLUMNS = ["scene", "seed", "picked", "points", "view", "right", "cpu_seconds", "decisions"]


def search(name: str, seed: int, steps: int) -> dict[str, object]:
    """Search components on the scene of a seed and return a line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        make(name, Path(folder) / name, seed)
        settings = TrainSettings(
            budget_seconds=None, steps=round(steps / SEARCH_FRACTION), downscale=1, seed=seed, model="auto"
        )
        began = time.process_time()
        prepared = prepare(
            scene.load(Path(folder) / name),
            settings,
            run=Path(folder) / "run",
            memory_bytes=None,
            begun=None,
            notify=lambda text: None,
        )
    assert prepared.selection is not None
    changed = differences(prepared.selection.components)
    changed.pop("view", None)
    points = changed.pop("points", 0.0)
    view = prepared.selection.components.view
    right = changed == NEEDED[name] and (view > 0 or name not in NEEDS_VIEW)
    return {
        "scene": name,
        "seed": seed,
        "picked": " ".join(f"{key}={value}" for key, value in changed.items()),
        "points": points,
        "view": view,
        "right": right,
        "cpu_seconds": round(time.process_time() - began, 1),
        "decisions": "; ".join(decision.in_words() for decision in prepared.selection.decisions),
    }


def print_table(lines: list[dict[str, str]]) -> None:
    """Print one line per scene."""
    table = Table(title="picked by --model auto")
    for column in ("scene", "needs", "right", "points", "view kept", "picked", "CPU s"):
        table.add_column(column)
    for name in dict.fromkeys(line["scene"] for line in lines):
        own = [line for line in lines if line["scene"] == name]
        picked = [line["picked"] or "nothing" for line in own]
        needs = [f"{key}={value}" for key, value in NEEDED[name].items()] + ["view"] * (name in NEEDS_VIEW)
        table.add_row(
            name,
            " ".join(needs) or "nothing",
            f"{sum(str(line['right']) == 'True' for line in own)} of {len(own)}",
            f"{sum(float(line['points']) > 0 for line in own)} of {len(own)}",
            f"{sum(int(line['view']) > 0 for line in own)} of {len(own)}",
            ", ".join(f"{picked.count(one)} x {one}" for one in dict.fromkeys(picked)),
            f"{sum(float(line['cpu_seconds']) for line in own) / len(own):.0f}",
        )
    Console(width=120).print(table)


def main(
    output: Annotated[Path, typer.Option("-o", help="Where to write, without suffix.")],
    only: Annotated[list[str] | None, typer.Option(help=f"Scenes: {', '.join(NEEDED)}.")] = None,
    seeds: Annotated[int, typer.Option(help="Scenes and searches of each.")] = 10,
    steps: Annotated[int, typer.Option(help="Of each search.")] = SEARCH_STEPS,
) -> None:
    """Let scenes decide, and count."""
    torch.set_num_threads(1)
    kernels.prepare(Console(stderr=True).print)
    path = output.with_suffix(".csv")
    if not path.exists():
        path.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    with path.open(newline="", encoding="utf-8") as file:
        done = {(line["scene"], line["seed"]) for line in csv.DictReader(file)}
    for seed in range(seeds):
        for name in only or NEEDED:
            if (name, str(seed)) in done:
                continue
            line = search(name, seed, steps)
            with path.open("a", newline="", encoding="utf-8") as file:
                csv.DictWriter(file, COLUMNS).writerow(line)
    with path.open(newline="", encoding="utf-8") as file:
        print_table(list(csv.DictReader(file)))


if __name__ == "__main__":
    typer.run(main)
