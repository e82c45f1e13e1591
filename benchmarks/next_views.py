"""What the views that `nerfcli doctor RUN` suggests gain in dB, beside random ones: the desk with a sector withheld.

    python benchmarks/next_views.py -o next-views

A third of the ring is withheld. Every fourth of these photos measures, the others are candidates. A field is trained on
the rest, four candidates are chosen by the rule of `doctor`, or at random, and a field is trained with them. Held-out
PSNR is the mean over the photos that measure. Everything that is there already is kept; writes OUT/table.csv.
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table
from uncertainty_scenes import withheld, write_capture

from nerfcli import scene as scenes
from nerfcli.cameras.frame import Frame
from nerfcli.render.visibility import coverage_and_parallax, depth_maps, sees
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings
from nerfcli.surface.extent import scene_box
from nerfcli.surface.grid import Grid
from nerfcli.surface.next_views import next_views, surface_points
from nerfcli.workflows.evaluate import evaluate_run
from nerfcli.workflows.next_views import CANDIDATE_PX, CELLS
from nerfcli.workflows.photo_depths import photo_depths
from nerfcli.workflows.train import train_scene, was_interrupted

SECTORS, ADDED, DRAWS, MEASURES_EVERY = (0, 1, 2), 4, 3, 4
SETTINGS = TrainSettings(budget_seconds=None, steps=800, downscale=4, threads=1)


def suggested(run: Run, candidates: Sequence[Frame]) -> list[str]:
    """Return the names of the candidates that `doctor` would choose from, best first."""
    model = run.model()
    photos = photo_depths(run, model, on_progress=lambda share: None, notify=print)
    views = depth_maps(model, candidates, max_size=CANDIDATE_PX)
    box = scene_box(model, run.cameras.train)
    low, high = np.array(box[:3]), np.array(box[3:])
    points = surface_points([*photos, *views], Grid.over(box, float((high - low).max()) / CELLS))
    coverage, _ = coverage_and_parallax(photos, points)
    seen = np.stack([sees(view, points) for view in views], axis=1)
    return [candidates[index].name for index, _ in next_views(seen, coverage, count=ADDED)]


def field_of(capture: Path, folder: Path, held_out: Sequence[str]) -> Run:
    """Train on all photos but those held out, or return the run that is there."""
    names = folder.with_suffix(".txt")
    names.parent.mkdir(parents=True, exist_ok=True)
    names.write_text("\n".join(held_out), encoding="utf-8")
    resume = was_interrupted(capture, folder, SETTINGS, holdout=str(names))
    return train_scene(capture, folder, SETTINGS, holdout=str(names), resume=resume, notify=lambda text: None)


def measured(run: Run, names: Sequence[str]) -> float:
    """Return the mean PSNR over some of the held-out photos."""
    images = evaluate_run(run.path, threads=1).metrics["images"]
    return float(np.mean([image["psnr"] for image in images if image["name"] in names]))


def main(output: Annotated[Path, typer.Option("--output", "-o", help="Folder for captures, runs and table.")]) -> None:
    """Train, choose, train again; print and write the gains."""
    torch.set_num_threads(1)
    capture, rows = output / "desk", []
    if not (capture / "transforms.json").exists():
        write_capture("desk", capture)
    frames = scenes.load(capture).frames
    for sector in SECTORS:
        inside, _ = withheld(frames, sector=sector)
        measures = inside[1::MEASURES_EVERY]
        candidates = [frame for frame in frames if frame.name in inside and frame.name not in measures]
        base = field_of(capture, output / f"sector-{sector}-base", inside)
        before, rng = measured(base, measures), np.random.default_rng(sector)
        names = [frame.name for frame in candidates]
        choices = {"suggested": suggested(base, candidates)}
        choices |= {f"random {n}": rng.choice(names, ADDED, replace=False).tolist() for n in range(1, DRAWS + 1)}
        for choice, added in choices.items():
            run = field_of(
                capture,
                output / f"sector-{sector}-{choice.replace(' ', '-')}",
                [name for name in inside if name not in added],
            )
            after = measured(run, measures)
            rows.append({"sector": sector, "choice": choice, "before": before, "after": after, "gain": after - before})
            print(sector, choice, added, f"{before:.2f} -> {after:.2f} dB", flush=True)
    with (output / "table.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    table = Table("sector", "before, dB", "suggested", *(f"random {n}" for n in range(1, DRAWS + 1)))
    for sector in SECTORS:
        of = [row for row in rows if row["sector"] == sector]
        table.add_row(str(sector), f"{of[0]['before']:.2f}", *(f"{row['gain']:+.2f}" for row in of))
    Console().print(table)


if __name__ == "__main__":
    typer.run(main)
