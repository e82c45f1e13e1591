"""Held-out quality against training time: every budget is a training of its own, for each seed.

    python benchmarks/training.py photos-scene -o fox --budgets 15,30,60,120,300 --seeds 3
    python benchmarks/training.py lego_400 -o lego --downscale 1

Calls `nerfcli train` and `nerfcli evaluate`, so that what is measured is what users get, peak memory included. Writes
OUT.csv and OUT.png and prints a table. Let nothing else run meanwhile.
"""

import csv
import json
import statistics
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Training:
    """One training: its budget and seed, and what `evaluate` said of it."""

    budget_s: float
    seed: int
    psnr: float
    ssim: float
    samples_per_s: float
    rays_per_s: float
    steps: int
    peak_memory_gb: float
    render_s: float


def nerfcli(*arguments: str) -> str:
    """Standard output of a command; its progress goes where ours goes."""
    command = [sys.executable, "-m", "nerfcli", *arguments]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def measure(scene: Path, budget: float, seed: int, downscale: str, threads: int) -> Training:
    """Train and evaluate once."""
    with tempfile.TemporaryDirectory() as folder:
        run = str(Path(folder) / "run")
        common = ("--threads", str(threads), "--quiet")
        nerfcli(
            "train", str(scene), "-o", run, "--budget", f"{budget}s", "--seed", str(seed), "--downscale", downscale,
            *common,
        )  # fmt: skip
        metrics: dict[str, Any] = json.loads(nerfcli("evaluate", run, "--json", *common))
    training = metrics["training"]
    return Training(
        budget_s=budget,
        seed=seed,
        psnr=metrics["mean"]["psnr"],
        ssim=metrics["mean"]["ssim"],
        samples_per_s=training["samples_per_second"],
        rays_per_s=training["rays_per_second"],
        steps=training["steps"],
        peak_memory_gb=training["peak_memory_bytes"] / 1e9,
        render_s=metrics["render"]["seconds_per_image"],
    )


def print_table(trainings: list[Training], title: str) -> None:
    """A line per budget: means over the seeds, and their spread."""
    table = Table(title=title)
    for name in ("budget s", "PSNR dB", "spread dB", "SSIM", "M samples/s", "k rays/s", "peak GB", "s a picture"):
        table.add_column(name, justify="right")
    for budget in sorted({t.budget_s for t in trainings}):
        of_budget = [t for t in trainings if t.budget_s == budget]
        psnrs = [t.psnr for t in of_budget]
        table.add_row(
            f"{budget:g}",
            f"{statistics.fmean(psnrs):.2f}",
            f"{max(psnrs) - min(psnrs):.2f}",
            f"{statistics.fmean(t.ssim for t in of_budget):.3f}",
            f"{statistics.fmean(t.samples_per_s for t in of_budget) / 1e6:.2f}",
            f"{statistics.fmean(t.rays_per_s for t in of_budget) / 1e3:.1f}",
            f"{max(t.peak_memory_gb for t in of_budget):.2f}",
            f"{statistics.fmean(t.render_s for t in of_budget):.2f}",
        )
    Console(width=120).print(table)


def plot(trainings: list[Training], title: str, path: Path) -> None:
    """PSNR over the budget, a dot per training and a line through the means."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    budgets = sorted({t.budget_s for t in trainings})
    means = [statistics.fmean(t.psnr for t in trainings if t.budget_s == budget) for budget in budgets]
    axes.plot(budgets, means)
    axes.plot([t.budget_s for t in trainings], [t.psnr for t in trainings], "o", markersize=4)
    axes.set(xscale="log", xlabel="training time (s)", ylabel="held-out PSNR (dB)", title=title)
    axes.set_xticks(budgets, [f"{budget:g}" for budget in budgets], minor=False)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)


def main(
    scene: Annotated[Path, typer.Argument(help="A scene folder, as nerfcli train takes it.")],
    output: Annotated[Path, typer.Option("-o", help="Where to write, without suffix.")],
    budgets: Annotated[str, typer.Option(help="Seconds of training.")] = "15,30,60,120,300",
    seeds: Annotated[int, typer.Option(help="Trainings per budget.")] = 3,
    downscale: Annotated[str, typer.Option(help="As nerfcli train has it.")] = "auto",
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 2,
) -> None:
    """Measure held-out quality against training time."""
    trainings: list[Training] = []
    names = [field.name for field in fields(Training)]
    with output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        for budget in (float(part) for part in budgets.split(",")):
            for seed in range(seeds):
                trainings.append(measure(scene, budget, seed, downscale, threads))
                writer.writerow(asdict(trainings[-1]))
                file.flush()
                Console(stderr=True).print(trainings[-1])
    title = f"{scene.name}, {threads} threads"
    print_table(trainings, title)
    plot(trainings, title, output.with_suffix(".png"))


if __name__ == "__main__":
    typer.run(main)
