"""Gain of `--model auto` compared with that of the right component, in the same total time, on scenes that need one.

    python benchmarks/recovery.py -o recovery
    python benchmarks/recovery.py -o recovery --budget 200s --only poses --seeds 3

Three trainings of each scene (see component_scenes.py): the default model, `auto` with its search in the budget, and
the right component forced. Prints a table of held-out PSNR and writes OUT.csv, a line per training as soon as it is
done; existing lines are not computed again. Speed affects the results: run nothing else meanwhile.
"""

import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer
from component_scenes import make
from rich.console import Console
from rich.table import Table
from selection import NEEDED

COLUMNS = ["scene", "seed", "model", "psnr", "steps", "kept"]
MODELS = ("default", "auto", "right")


def training(name: str, seed: int, model: str, budget: str) -> dict[str, object]:
    """Train once and return a line of the table."""
    options = ["--model", "auto" if model == "auto" else "default"]
    if model == "right":
        options += [word for key, value in NEEDED[name].items() for word in ("--with", f"{key}={value}")]
    with tempfile.TemporaryDirectory() as folder:
        scene, run = Path(folder) / name, Path(folder) / "run"
        make(name, scene, seed)
        command = [sys.executable, "-m", "nerfcli", "train", str(scene), "-o", str(run), "--budget", budget]
        command += ["--threads", "1", "--seed", str(seed), "--downscale", "1", "--quiet", *options]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        last = [json.loads(line) for line in (run / "log.jsonl").read_text(encoding="utf-8").splitlines()][-1]
        selection = json.loads((run / "config.json").read_text(encoding="utf-8")).get("selection") or {}
    kept = [f"{one['component']}={one['value']}" for one in selection.get("decisions", []) if one["kept"]]
    return {
        "scene": name,
        "seed": seed,
        "model": model,
        "psnr": round(last["heldout_psnr"], 3),
        "steps": last["step"],
        "kept": " ".join(kept),
    }


def print_table(lines: list[dict[str, str]], budget: str) -> None:
    """Print one line per scene: means over the seeds that have all three trainings."""
    table = Table(title=f"held-out PSNR in dB after {budget}, search included")
    for column in ("scene", "needs", "seeds", *MODELS, "auto - right", "kept by auto"):
        table.add_column(column)
    for name in dict.fromkeys(line["scene"] for line in lines):
        own = [line for line in lines if line["scene"] == name]
        by_model = {m: {line["seed"]: float(line["psnr"]) for line in own if line["model"] == m} for m in MODELS}
        seeds = sorted(set.intersection(*(set(psnrs) for psnrs in by_model.values())))
        if not seeds:
            continue
        means = {model: sum(by_model[model][seed] for seed in seeds) / len(seeds) for model in MODELS}
        kept = [line["kept"] or "nothing" for line in own if line["model"] == "auto"]
        table.add_row(
            name,
            " ".join(f"{key}={value}" for key, value in NEEDED[name].items()) or "nothing",
            str(len(seeds)),
            *(f"{means[model]:.2f}" for model in MODELS),
            f"{means['auto'] - means['right']:+.2f}",
            ", ".join(f"{kept.count(one)} x {one}" for one in dict.fromkeys(kept)),
        )
    Console(width=140).print(table)


def main(
    output: Annotated[Path, typer.Option("-o", help="Where to write, without suffix.")],
    only: Annotated[list[str] | None, typer.Option(help=f"Scenes: {', '.join(NEEDED)}.")] = None,
    seeds: Annotated[int, typer.Option(help="Trainings of each scene and model.")] = 1,
    budget: Annotated[str, typer.Option(help="Of each training.")] = "100s",
) -> None:
    """Train scenes three times, and compare."""
    path = output.with_suffix(".csv")
    if not path.exists():
        path.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    with path.open(newline="", encoding="utf-8") as file:
        done = {(line["scene"], line["seed"], line["model"]) for line in csv.DictReader(file)}
    for seed in range(seeds):
        for name in only or NEEDED:
            for model in MODELS:
                if (name, str(seed), model) in done:
                    continue
                line = training(name, seed, model, budget)
                with path.open("a", newline="", encoding="utf-8") as file:
                    csv.DictWriter(file, COLUMNS).writerow(line)
    with path.open(newline="", encoding="utf-8") as file:
        print_table(list(csv.DictReader(file)), budget)


if __name__ == "__main__":
    typer.run(main)
