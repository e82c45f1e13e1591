"""Gain of the views that `nerfcli doctor RUN` suggests, in surface seen and in dB, compared with random views.

    python benchmarks/next_views.py desk -o next-views-desk
    python benchmarks/next_views.py path/to/fox -o next-views-fox --downscale 8

Photos are sorted by their direction from the middle, and a contiguous third is withheld. Every fourth of these is a
test photo, the others are candidates. A field is trained on the rest; four candidates are chosen by the rule of
`doctor` or at random; and a field is trained with them added. Held-out PSNR is the mean over the test photos. The
surface consists of the points that any photo sees, by the depths of a field trained on all photos but a few; the table
has the fraction of it that at least two of the photos in use see. Existing runs are kept; writes OUT/table.csv.
"""

import csv
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from depth import desk_scene
from rich.console import Console
from rich.table import Table

from nerfcli import scene as scenes
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import focus_point, up_direction
from nerfcli.render.visibility import coverage_and_parallax, depth_maps, sees
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings
from nerfcli.surface.extent import Grid, scene_box
from nerfcli.surface.next_views import next_views, surface_points
from nerfcli.workflows.evaluate import evaluate_run
from nerfcli.workflows.next_views import CANDIDATE_PX, CELLS
from nerfcli.workflows.photo_depths import photo_depths
from nerfcli.workflows.train import train_scene, was_interrupted

THIRDS, ADDED, DRAWS, MEASURES_EVERY, STEPS = 3, 4, 3, 4, 800


def around(frames: Sequence[Frame]) -> list[Frame]:
    """Return frames in the order of their directions from the point they look at, from the largest gap on."""
    middle, up = focus_point(frames), up_direction(frames)
    right = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    offsets = np.array([frame.centre for frame in frames]) - middle
    angles = np.arctan2(offsets @ np.cross(up, right), offsets @ right)
    order = np.argsort(angles)
    gaps = np.diff(angles[order], append=angles[order[0]] + 2 * np.pi)
    return [frames[index] for index in np.roll(order, -1 - int(gaps.argmax()))]


def suggested(run: Run, candidates: Sequence[Frame]) -> list[str]:
    """Return the names of the candidates that `doctor` would suggest, best first."""
    model = run.model()
    photos = photo_depths(run, model, on_progress=lambda fraction: None, notify=print)
    views = depth_maps(model, candidates, max_size=CANDIDATE_PX)
    box = scene_box(model, run.cameras.train)
    low, high = np.array(box[:3]), np.array(box[3:])
    points = surface_points([*photos, *views], Grid.over(box, float((high - low).max()) / CELLS))
    coverage, _ = coverage_and_parallax(photos, points)
    seen = np.stack([sees(view, points) for view in views], axis=1)
    return [candidates[index].name for index, _ in next_views(seen, coverage, count=ADDED)]


def surface_of(run: Run, frames: Sequence[Frame]) -> dict[str, np.ndarray]:
    """Return for each photo, by name, which points (N,) of the surface it sees, by the depths of one field."""
    model = run.model()
    views = depth_maps(model, frames, max_size=CANDIDATE_PX)
    low, high = np.array(scene_box(model, frames)).reshape(2, 3)
    points = surface_points(views, Grid.over((*low, *high), float((high - low).max()) / CELLS))
    return {frame.name: sees(view, points) for frame, view in zip(frames, views, strict=True)}


def seen_twice(surface: dict[str, np.ndarray], without: Sequence[str]) -> float:
    """Return the fraction of the surface that at least two photos see, not counting the photos in `without`."""
    return float((np.sum([seen for name, seen in surface.items() if name not in without], axis=0) >= 2).mean())


def field_of(capture: Path, folder: Path, held_out: Sequence[str], settings: TrainSettings) -> Run:
    """Train on all photos but those held out, or return the existing run."""
    names = folder.with_suffix(".txt")
    names.parent.mkdir(parents=True, exist_ok=True)
    names.write_text("\n".join(held_out), encoding="utf-8")
    resume = was_interrupted(capture, folder, settings, holdout=str(names))
    return train_scene(capture, folder, settings, holdout=str(names), resume=resume, notify=lambda text: None)


def measured(run: Run, names: Sequence[str]) -> float:
    """Return the mean PSNR over some of the held-out photos."""
    images = evaluate_run(run.path, threads=1).metrics["images"]
    return float(np.mean([image["psnr"] for image in images if image["name"] in names]))


def main(
    capture: Annotated[str, typer.Argument(help="desk, or the folder of a capture with poses.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for captures, runs and table.")],
    downscale: Annotated[int, typer.Option(help="Of the training.")] = 4,
    thirds: Annotated[int, typer.Option(help="Of the photos that are withheld, one after the other.", max=3)] = THIRDS,
) -> None:
    """Train, choose, train again; print and write the gains."""
    torch.set_num_threads(1)
    settings = TrainSettings(budget_seconds=None, steps=STEPS, downscale=downscale, threads=1)
    place, rows = output / "desk" if capture == "desk" else Path(capture), []
    if capture == "desk" and not (place / "transforms.json").exists():
        desk_scene(place)
    frames = around(scenes.load(place).frames)
    bounds = np.linspace(0, len(frames), THIRDS + 1).astype(int)
    parts = [frames[low:high] for low, high in pairwise(bounds)]
    every = field_of(place, output / "all", [frame.name for frame in parts[0][1::MEASURES_EVERY]], settings)
    surface = surface_of(every, frames)
    for number, part in enumerate(parts[:thirds]):
        inside = [frame.name for frame in part]
        measures = inside[1::MEASURES_EVERY]
        candidates = [frame for frame in part if frame.name not in measures]
        base = field_of(place, output / f"third-{number}-base", inside, settings)
        before, rng = measured(base, measures), np.random.default_rng(number)
        names = [frame.name for frame in candidates]
        choices = {"suggested": suggested(base, candidates)}
        choices |= {f"random {n}": rng.choice(names, ADDED, replace=False).tolist() for n in range(1, DRAWS + 1)}
        for choice, added in choices.items():
            left = [name for name in inside if name not in added]
            run = field_of(place, output / f"third-{number}-{choice.replace(' ', '-')}", left, settings)
            after = measured(run, measures)
            seen = [seen_twice(surface, without) for without in (inside, left)]
            row = {"third": number, "choice": choice, "before": before, "after": after, "gain": after - before}
            rows.append({**row, "seen before": seen[0], "seen after": seen[1]})
            print(number, choice, added, f"{before:.2f} -> {after:.2f} dB, {seen[0]:.1%} -> {seen[1]:.1%}", flush=True)
    with (output / "table.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    table = Table("third", "before", "suggested", *(f"random {n}" for n in range(1, DRAWS + 1)))
    for number in range(thirds):
        of = [row for row in rows if row["third"] == number]
        gains = [f"{row['gain']:+.2f} dB, {100 * (row['seen after'] - row['seen before']):+.1f} %" for row in of]
        table.add_row(str(number), f"{of[0]['before']:.2f} dB, {of[0]['seen before']:.1%}", *gains)
    Console(width=140).print(table)


if __name__ == "__main__":
    typer.run(main)
