"""Held-out quality against training time, and `--model auto` against the default model in the same time.

    python benchmarks/training.py photos-scene lego_400 -o budgets --budgets 15,60,300,1800 --models auto
    python benchmarks/training.py fox fern banana -o models --budgets 100 --seeds 0,1,2 --threads 1

There is a separate training for each budget, scene, model and seed; the search of `auto` is part of its budget. Calls
`nerfcli train` and `nerfcli evaluate`, to measure what users get, peak memory included. Prints a table and writes
OUT.csv, a line per training as soon as it is done; existing lines are not computed again. Run nothing else meanwhile.
"""

import csv
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

NAN = float("nan")


@dataclass(frozen=True)
class Training:
    """One training, and its results of `evaluate` over whole held-out photos.

    `lpips` is NaN where it is not installed; `dip_db` is the best logged PSNR of some held-out pixels minus the last
    one; `kept` lists the changes that the search kept.
    """

    scene: str
    budget_s: float
    model: str
    seed: int
    psnr: float
    ssim: float
    lpips: float
    dip_db: float
    kept: str
    search_s: float
    steps: int
    samples_per_s: float
    peak_memory_gb: float
    render_s: float


def nerfcli(*arguments: str) -> str:
    """Run a command and return its standard output; its stderr is shown."""
    command = [sys.executable, "-m", "nerfcli", *arguments]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def measure(
    scene: Path, budget: float, model: str, seed: int, *, threads: int, run: Path, downscale: str = "auto"
) -> Training:
    """Train into the folder `run`, and evaluate once."""
    common = ("--threads", str(threads), "--quiet")
    options = ("--budget", f"{budget}s", "--model", model, "--seed", str(seed), "--downscale", downscale)
    nerfcli("train", str(scene), "-o", str(run), *options, *common)
    metrics: dict[str, Any] = json.loads(nerfcli("evaluate", str(run), "--json", *common))
    log = [json.loads(line) for line in (run / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    selection = json.loads((run / "config.json").read_text(encoding="utf-8")).get("selection") or {}
    course = [entry["heldout_psnr"] for entry in log if "heldout_psnr" in entry]
    kept = [f"{one['component']}={one['value']}" for one in selection.get("decisions", []) if one["kept"]]
    training = metrics["training"]
    return Training(
        scene=scene.name,
        budget_s=budget,
        model=model,
        seed=seed,
        psnr=round(metrics["mean"]["psnr"], 3),
        ssim=round(metrics["mean"]["ssim"], 4),
        lpips=NAN if metrics["mean"]["lpips"] is None else round(metrics["mean"]["lpips"], 4),
        dip_db=round(max(course) - course[-1], 3),
        kept=" ".join(kept),
        search_s=round(selection.get("seconds", 0.0), 1),
        steps=training["steps"],
        samples_per_s=round(training["samples_per_second"]),
        peak_memory_gb=round(training["peak_memory_bytes"] / 1e9, 2),
        render_s=round(metrics["render"]["seconds_per_image"], 2),
    )


def mean(trainings: Iterable[Training], name: str) -> float:
    return statistics.fmean(getattr(training, name) for training in trainings)


def print_tables(trainings: list[Training]) -> None:
    """Print means over seeds per scene, budget and model, and the gains of auto where both models were trained."""
    table = Table(title="held-out photos")
    for name in (
        "scene",
        "budget s",
        "model",
        "seeds",
        "PSNR dB",
        "spread",
        "SSIM",
        "dip",
        "GB",
        "s a picture",
        "kept",
    ):
        table.add_column(name)
    gains = Table(title="auto against default, in the same time with its search")
    for name in ("scene", "budget s", "default dB", "auto dB", "gain dB", "of each seed"):
        gains.add_column(name)
    for scene, budget in dict.fromkeys((t.scene, t.budget_s) for t in trainings):
        here = [t for t in trainings if (t.scene, t.budget_s) == (scene, budget)]
        for model in dict.fromkeys(t.model for t in here):
            own = [t for t in here if t.model == model]
            psnrs = [t.psnr for t in own]
            kept = [t.kept or "nothing" for t in own] if model == "auto" else []
            table.add_row(
                scene, f"{budget:g}", model, str(len(own)), f"{statistics.fmean(psnrs):.2f}",
                f"{max(psnrs) - min(psnrs):.2f}", f"{mean(own, 'ssim'):.3f}", f"{mean(own, 'dip_db'):.2f}",
                f"{max(t.peak_memory_gb for t in own):.2f}", f"{mean(own, 'render_s'):.2f}",
                ", ".join(f"{kept.count(one)} x {one}" for one in dict.fromkeys(kept)),
            )  # fmt: skip
        by_seed = {(t.model, t.seed): t.psnr for t in here}
        both = [seed for model, seed in by_seed if model == "auto" and ("default", seed) in by_seed]
        if both:
            pairs = [(by_seed["default", seed], by_seed["auto", seed]) for seed in both]
            means = [statistics.fmean(column) for column in zip(*pairs, strict=True)]
            each = ", ".join(f"{auto - default:+.2f}" for default, auto in pairs)
            gains.add_row(
                scene, f"{budget:g}", f"{means[0]:.2f}", f"{means[1]:.2f}", f"{means[1] - means[0]:+.2f}", each
            )
    console = Console(width=150)
    console.print(table)
    if gains.row_count:
        console.print(gains)


def main(
    scenes: Annotated[list[Path], typer.Argument(help="Scene folders, as nerfcli train takes them.")],
    output: Annotated[Path, typer.Option("-o", help="Where to write, without suffix.")],
    budgets: Annotated[str, typer.Option(help="Seconds of training.")] = "15,30,60,120,300",
    models: Annotated[str, typer.Option(help="Of auto and default, separated by commas.")] = "auto,default",
    seeds: Annotated[str, typer.Option(help="Trainings of each budget and model.")] = "0",
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 2,
) -> None:
    """Measure held-out quality against training time."""
    path, names = output.with_suffix(".csv"), [field.name for field in fields(Training)]
    if not path.exists():
        path.write_text(",".join(names) + "\n", encoding="utf-8")
    with path.open(newline="", encoding="utf-8") as file:
        done = [typed(line) for line in csv.DictReader(file)]
    finished = {(t.scene, t.budget_s, t.model, t.seed) for t in done}
    for seed in (int(text) for text in seeds.split(",")):
        for scene in scenes:
            for budget in (float(text) for text in budgets.split(",")):
                for model in models.split(","):
                    if (scene.name, budget, model, seed) in finished:
                        continue
                    with tempfile.TemporaryDirectory() as folder:
                        run = Path(folder) / "run"
                        done.append(measure(scene, budget, model, seed, threads=threads, run=run))
                    with path.open("a", newline="", encoding="utf-8") as file:
                        csv.DictWriter(file, names).writerow(asdict(done[-1]))
                    Console(stderr=True).print(done[-1])
    print_tables(done)


def typed(line: dict[str, str]) -> Training:
    """Return the training of a line of OUT.csv."""
    return Training(**{field.name: field.type(line[field.name]) for field in fields(Training)})  # type: ignore[operator]


if __name__ == "__main__":
    typer.run(main)
