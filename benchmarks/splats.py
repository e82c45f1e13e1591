"""Splats of runs against their fields: held-out quality by seconds of refinement, size of files, time of a picture.

    python benchmarks/splats.py fox-run lego-run fern-run -o splats --budgets 30,60,120

For each run, one refinement goes on from budget to budget, as `nerfcli export --to splats --resume` does. Prints rows
and writes OUT.csv, a line as soon as it is done. The runs are copied, so that they keep no splats. Run nothing else
meanwhile.
"""

import csv
import shutil
import statistics
import tempfile
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated

import torch
import typer

from nerfcli import evaluate_run, export_run, load_run, load_splats
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.splats.refine import load_splat_state
from nerfcli.training.runs.files import SPLATS
from nerfcli.workflows.evaluate import evaluate_splats
from nerfcli.workflows.splats import SplatSettings


@dataclass(frozen=True)
class Row:
    """A refinement after a budget; `start_s` is what the first export takes beside it."""

    run: str
    train_s: float
    field_psnr: float
    field_ssim: float
    field_ms: float
    budget_s: float
    start_s: float
    count: int
    steps: int
    psnr: float
    ssim: float
    ply_mb: float
    spz_mb: float
    spz_psnr: float
    ms_one_thread: float
    ms_two_threads: float


def picture_ms(path: Path, run: Path, threads: int) -> float:
    """Return the median time of the first held-out picture, of nine."""
    scene, frame, before = load_splats(path), load_run(run).cameras.test[0], torch.get_num_threads()
    torch.set_num_threads(threads)
    seconds = []
    for _ in range(9):
        began = time.perf_counter()
        scene.render(frame)
        seconds.append(time.perf_counter() - began)
    torch.set_num_threads(before)
    return 1000 * statistics.median(seconds)


def measure(run: Path, budget: float, field: dict[str, float], *, resume: bool, count: int | None) -> Row:
    """Refine to a budget, write both files, and evaluate them."""
    settings = SplatSettings(count=count, budget_seconds=budget, resume=resume)
    began = time.perf_counter()
    again = Output(run.with_name("a.ply"), overwrite=True)
    ply = export_run(run, again, to="splats", splats=settings, reporter=Reporter(note=print))
    seconds = time.perf_counter() - began
    small = Output(run.with_name("a.spz"), overwrite=True)
    spz = export_run(run, small, to="splats", splats=SplatSettings(count, budget))
    found, of_spz = (evaluate_splats(run, path, Output(overwrite=True)).metrics.to_json() for path in (ply, spz))
    return Row(
        **field,
        run=run.name,
        budget_s=budget,
        start_s=seconds - budget,
        count=found["splats"]["count"],
        steps=load_splat_state(run / SPLATS).refinement.steps,
        psnr=found["mean"]["psnr"],
        ssim=found["mean"]["ssim"],
        ply_mb=ply.stat().st_size / 1e6,
        spz_mb=spz.stat().st_size / 1e6,
        spz_psnr=of_spz["mean"]["psnr"],
        ms_one_thread=picture_ms(ply, run, 1),
        ms_two_threads=picture_ms(ply, run, 2),
    )


def main(
    runs: list[Path],
    output: Annotated[Path, typer.Option("-o", help="Name of the CSV file, without suffix.")],
    budgets: str = "30,60,120",
    count: int | None = None,
) -> None:
    """Measure and print."""
    with output.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)])
        writer.writeheader()
        for run in runs:
            with tempfile.TemporaryDirectory() as folder:
                copy = Path(shutil.copytree(run, Path(folder) / run.name, ignore=shutil.ignore_patterns("splats.*")))
                metrics = evaluate_run(copy).metrics.to_json()
                field = {
                    "train_s": metrics["training"]["seconds"],
                    "field_psnr": metrics["mean"]["psnr"],
                    "field_ssim": metrics["mean"]["ssim"],
                    "field_ms": 1000 * metrics["render"]["seconds_per_image"],
                }
                for index, budget in enumerate(map(float, budgets.split(","))):
                    row = measure(copy, budget, field, resume=index > 0, count=count)
                    writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in asdict(row).items()})
                    file.flush()
                    print({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in asdict(row).items()}, flush=True)


if __name__ == "__main__":
    typer.run(main)
