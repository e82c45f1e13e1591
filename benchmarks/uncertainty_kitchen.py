"""The question of `uncertainty.py` on a real capture, against a depth sensor: redkitchen of 7-Scenes.

    python benchmarks/uncertainty_kitchen.py path/to/redkitchen -o uncertainty-kitchen

A quarter of the photos, those that look into one sector of the room, is withheld, and every 8th of the others. A
training photo counts as seeing a point if the sensor's depth in it agrees with the point within 5 cm.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from depth import kitchen_depth_view, kitchen_scene, kitchen_truth
from rich.console import Console
from rich.table import Table
from uncertainty import MEMBERS, keep_distances, measures, read_pixels
from uncertainty_scenes import CONTROL_EVERY, STRATA, TruePixels, looks

from nerfcli import scene as scenes
from nerfcli.cameras.frame import Frame
from nerfcli.render.visibility import largest_angle_deg
from nerfcli.runs.settings import TrainSettings

KINDS, STEPS, DOWNSCALE, WITHHELD, SAME_METRES = ("seeds", "photos"), 800, 4, 0.25, 0.05


def withheld(frames: Sequence[Frame]) -> tuple[list[str], list[str]]:
    """Return the names of the quarter of the photos that look most to one side, and of the controls.

    The side is that of the photo in the middle of the video.
    """
    ahead = np.array([frame.world_from_cam[:3, 2] for frame in frames])
    nearest = np.argsort(-(ahead @ ahead[len(ahead) // 2]))
    inside = {frames[index].name for index in nearest[: round(WITHHELD * len(frames))]}
    others = [frame.name for frame in frames if frame.name not in inside]
    return sorted(inside), others[::CONTROL_EVERY]


def sensor_sees(photo: Frame, points: np.ndarray, capture: Path) -> np.ndarray:
    """Return which points (N, 3) the depth camera of a photo sees: its depth is theirs within `SAME_METRES`."""
    view = kitchen_depth_view(photo, capture)
    pose = view.world_from_cam
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    pixels, valid = view.camera.project(local)
    size = (view.camera.width, view.camera.height)
    rows = np.flatnonzero(valid & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1))
    column, row = np.floor(pixels[rows]).astype(int).T
    seen = np.zeros(len(points), dtype=bool)
    seen[rows] = np.abs(kitchen_truth(photo, capture)[row, column] - local[rows, 2]) < SAME_METRES  # False at NaN
    return seen


def measured_pixels(
    capture: Path, test: Sequence[Frame], views: Sequence[Frame], training: Sequence[Frame]
) -> TruePixels:
    """Return the sensor's distances for the pixels of views (infinite where it has none), and who sees the points."""
    columns = []
    for frame, view in zip(test, views, strict=True):
        bearings, _ = view.camera.pixel_bearings()
        z = kitchen_truth(frame, capture)
        step = z.shape[1] // view.camera.width
        distance = z[step // 2 :: step, step // 2 :: step].ravel() / bearings[:, 2]
        there = np.flatnonzero(np.isfinite(distance))
        points = view.centre + (distance[:, None] * bearings)[there] @ view.world_from_cam[:3, :3].T
        seen = np.stack([sensor_sees(photo, points, capture) for photo in training], axis=1)
        photos, parallax = np.zeros(len(distance), int), np.zeros(len(distance))
        photos[there] = seen.sum(axis=1)
        parallax[there] = largest_angle_deg(seen, points, np.stack([photo.centre for photo in training]))
        columns.append((np.where(np.isfinite(distance), distance, math.inf), photos, parallax))
    return TruePixels(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def main(
    capture: Annotated[Path, typer.Argument(help="Folder of redkitchen.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for scene, distances and table.")],
) -> None:
    """Train what is missing, and print the numbers of each kind."""
    torch.set_num_threads(1)
    place, folder = output / "capture", output / "redkitchen"
    folder.mkdir(parents=True, exist_ok=True)
    kitchen_scene(place, capture)
    inside, controls = withheld(scenes.load(place).frames)
    (folder / "held_out.txt").write_text("\n".join([*inside, *controls]), encoding="utf-8")
    scene = scenes.load(place, holdout=str(folder / "held_out.txt"))
    views = looks([kitchen_depth_view(frame, capture) for frame in scene.test_frames])
    if not (folder / "truth.npz").exists():
        true = measured_pixels(capture, scene.test_frames, views, scene.train_frames)
        np.savez_compressed(folder / "truth.npz", allow_pickle=False, **vars(true))
    first = TrainSettings(budget_seconds=None, steps=STEPS, downscale=DOWNSCALE, threads=1)
    for kind in ("deployed", *KINDS):
        keep_distances(folder, kind, place, views, first=first, members=MEMBERS)
    numbers = {kind: measures(read_pixels(folder, kind)) for kind in KINDS}
    shown = Table("", *KINDS)
    of_strata = ("pixels", "error", "v", "held 50 %", "held 90 %", "Spearman spread", "Spearman coverage")
    names = [
        *("mean error", "AUROC U0 against D, spread", "AUROC U0 against D, coverage"),
        *(f"{name} {stratum}" for name in of_strata for stratum in STRATA),
        *(f"{area} {name}" for area in ("AUSE", "AUSE of views") for name in ("spread", "coverage", "random")),
    ]
    for name in names:
        shown.add_row(name, *(f"{numbers[kind].get(name, math.nan):.4g}" for kind in KINDS))
    Console(width=110).print(shown)


if __name__ == "__main__":
    typer.run(main)
