"""Held-out PSNR of trainings with several time budgets, and its course within each training.

    python benchmarks/anytime.py photos-scene lego_400 -o anytime
    python benchmarks/anytime.py desk -o desk --budgets 15,60 --seeds 0,1 --clock processor --threads 1

Seconds are of wall-clock time, on an otherwise idle machine, or of processor time, which other programs disturb less;
both clocks pause while held-out pixels are rendered. Each budget needs its own training, as schedules depend on when it
ends. Prints a table, writes OUT.csv and, with the course of each training, OUT-curve.csv.
"""

import csv
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated

import torch
import typer
from representations import Capture
from rich.console import Console
from rich.table import Table

from nerfcli import kernels
from nerfcli.evaluate.protocol import HeldOutPhoto, evaluate_model
from nerfcli.field.cost import field_bytes
from nerfcli.fit.fitting import Fitting
from nerfcli.runs.settings import TrainSettings
from nerfcli.train.waypoints import PIXELS

# Fractions of the budget at which PSNR is measured.
FRACTIONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}


@dataclass(frozen=True)
class Moment:
    """A moment of a training: fraction of the budget, seconds, steps and samples so far, PSNR of held-out pixels."""

    fraction: float
    seconds: float
    step: int
    samples: int
    psnr: float


@dataclass(frozen=True)
class Line:
    """One training.

    PSNR and SSIM are means over whole photos. `dip_db` is the best moment's PSNR minus the last one's, on the same
    held-out pixels.
    """

    scene: str
    budget_s: float
    seed: int
    seconds: float
    steps: int
    samples: int
    megabytes: float
    psnr: float
    ssim: float
    dip_db: float


def fit(capture: Capture, settings: TrainSettings, *, budget: float, clock: str) -> tuple[Fitting, list[Moment]]:
    """Train for `budget` seconds of a clock, and measure PSNR at every fraction of `FRACTIONS`."""
    fitting = Fitting(capture.pool, capture.extent.marching, contraction=capture.extent.contraction, settings=settings)
    now, used, samples, curve = CLOCKS[clock], 0.0, 0, []
    due = list(FRACTIONS)
    while due:
        began = now()
        samples += fitting.advance(used / budget).samples
        used += now() - began
        if used / budget >= due[0]:
            due = [fraction for fraction in due if fraction > used / budget]
            psnr = capture.psnr(capture.model(fitting))
            curve.append(Moment(round(used / budget, 3), round(used, 2), fitting.step, samples, round(psnr, 3)))
    return fitting, curve


def measure(capture: Capture, *, budget: float, seed: int, clock: str, threads: int) -> tuple[Line, list[Moment]]:
    """Train, and evaluate every held-out photo in full."""
    settings = TrainSettings(budget_seconds=budget, seed=seed, threads=threads)
    fitting, curve = fit(capture, settings, budget=budget, clock=clock)
    photos = [HeldOutPhoto(photo.frame, photo.pixels, photo.used) for photo in capture.test_photos]
    mean = evaluate_model(capture.model(fitting), photos, on_image=lambda done, total: None)["mean"]
    last = curve[-1]
    line = Line(
        scene=capture.name,
        budget_s=budget,
        seed=seed,
        seconds=last.seconds,
        steps=last.step,
        samples=last.samples,
        megabytes=round(field_bytes(fitting.field) / 1e6, 2),
        psnr=round(mean["psnr"], 3),
        ssim=round(mean["ssim"], 4),
        dip_db=round(max(moment.psnr for moment in curve) - last.psnr, 3),
    )
    return line, curve


def print_table(lines: list[Line], clock: str, threads: int) -> None:
    """Print one line per training."""
    table = Table(title=f"seconds of {clock} time, {threads} threads")
    names = ("scene", "budget s", "seed", "PSNR dB", "SSIM", "steps", "M samples", "MB", "dip at the end dB")
    for name in names:
        table.add_column(name, justify="left" if name == "scene" else "right")
    for line in lines:
        table.add_row(
            line.scene, f"{line.budget_s:g}", f"{line.seed}", f"{line.psnr:.2f}", f"{line.ssim:.3f}", f"{line.steps}",
            f"{line.samples / 1e6:.1f}", f"{line.megabytes:.2f}", f"{line.dip_db:.2f}",
        )  # fmt: skip
    Console(width=110).print(table)


def main(
    folders: Annotated[list[Path], typer.Argument(help="Scenes, as nerfcli train takes them.")],
    output: Annotated[Path, typer.Option("-o", help="Where to write, without suffix.")],
    budgets: Annotated[str, typer.Option(help="Seconds of training.")] = "15,60,300",
    seeds: Annotated[str, typer.Option(help="Trainings of each budget.")] = "0",
    clock: Annotated[str, typer.Option(help=f"What a second is: {', '.join(CLOCKS)}.")] = "wall",
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 2,
) -> None:
    """Train at several budgets and measure each."""
    if clock not in CLOCKS:
        raise typer.BadParameter(f"{clock!r}; choose from {', '.join(CLOCKS)}", param_hint="--clock")
    torch.set_num_threads(threads)
    kernels.prepare(Console(stderr=True).print)
    lines: list[Line] = []
    curves = output.with_name(f"{output.name}-curve.csv")
    with (
        output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as whole,
        curves.open("w", newline="", encoding="utf-8") as course,
    ):
        table = csv.DictWriter(whole, [field.name for field in fields(Line)])
        moments = csv.DictWriter(course, ["scene", "budget_s", "seed", *(field.name for field in fields(Moment))])
        table.writeheader()
        moments.writeheader()
        for folder in folders:
            capture = Capture(folder, pixels=PIXELS, threads=threads)
            for budget in (float(text) for text in budgets.split(",")):
                for seed in (int(text) for text in seeds.split(",")):
                    line, curve = measure(capture, budget=budget, seed=seed, clock=clock, threads=threads)
                    lines.append(line)
                    table.writerow(asdict(line))
                    which = {"scene": line.scene, "budget_s": budget, "seed": seed}
                    moments.writerows(which | asdict(moment) for moment in curve)
                    whole.flush()
                    course.flush()
                    Console(stderr=True).print(line)
    print_table(lines, clock, threads)


if __name__ == "__main__":
    typer.run(main)
