"""Blocks compared with one table of the same total size, on a loop of 192 m through the town of `town_capture.py`.

    python benchmarks/blocks.py -o blocks --rows 17 --steps 1500

Writes the capture (154 photos of 240x180, with true poses, and points with the photos that see them), trains four
blocks, and one field with four times as many rows per table on as many samples. Prints PSNR of held-out pixels for each
block, by the ground that they show, and for pixels near a border; writes OUT/table.csv.
"""

import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from PIL import Image
from rich.console import Console
from rich.table import Table
from town_capture import hit, photo, walk

from nerfcli import scene as scenes
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.colmap import write_colmap_binary
from nerfcli.cameras.frame import Capture, Frame, Observations
from nerfcli.cameras.rigid import apply, inverse
from nerfcli.field.background import colours_behind
from nerfcli.media.images import read_image
from nerfcli.render.model import Model
from nerfcli.render.rays import CENTRES, pixel_rays
from nerfcli.render.tracing import render_rays
from nerfcli.runs.blocks import divide
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings
from nerfcli.workflows.blocks import train_blocks
from nerfcli.workflows.train import train_scene

SIZE, FOCAL_PX = (240, 180), 168.0
# Every second photo of the second loop of the walk, around four blocks of houses.
PHOTOS = range(151, 459, 2)
POINTS_PER_PHOTO = 80
BLOCKS, BORDER_METRES, PIXELS_PER_PHOTO = 4, 2.0, 2000


def write_town(folder: Path, *, seed: int = 0) -> None:
    """Write images/ and sparse/0, a COLMAP model of the true poses, true points and their observations."""
    rng, (width, height) = np.random.default_rng(seed), SIZE
    camera = Camera("PINHOLE", width, height, (FOCAL_PX, FOCAL_PX, width / 2, height / 2))
    poses = walk(max(PHOTOS) + 1)[list(PHOTOS)]
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames, points = [], []
    for number, pose in enumerate(poses):
        name = f"frame_{number:04d}.png"
        picture = photo(pose, size=SIZE, focal_px=FOCAL_PX) + rng.normal(scale=2.0, size=(height, width, 3))
        Image.fromarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8)).save(folder / "images" / name)
        frames.append(Frame(name, camera, pose))
        bearings, _ = camera.bearings(rng.uniform((0, 0), SIZE, (POINTS_PER_PHOTO, 2)))
        for direction in bearings @ pose[:3, :3].T:
            distance, wall = hit(pose[:3, 3].copy(), direction)
            if wall >= 0:
                points.append(pose[:3, 3] + distance * direction)
    places, seen = np.array(points), []
    for index, pose in enumerate(poses):
        in_camera = apply(inverse(pose), places)
        ahead = np.flatnonzero(in_camera[:, 2] > 0.1)
        pixels, valid = camera.project(in_camera[ahead])
        inside = valid & (pixels >= 0).all(1) & (pixels < SIZE).all(1)
        for point, pixel in zip(ahead[inside].tolist(), pixels[inside], strict=True):
            distance, _ = hit(pose[:3, 3].copy(), places[point] - pose[:3, 3])
            if abs(distance - 1.0) < 1e-3:
                seen.append((index, point, *pixel))
    table = np.array(seen)
    observations = Observations(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])
    capture = Capture(tuple(frames), places, (), None, "colmap", observations=observations)
    write_colmap_binary(capture, folder / "sparse/0")


def true_ground(frame: Frame, pixels: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Return the ground coordinates (N, 2) of what pixels (N,) of a frame show; NaN for the sky."""
    centres = np.stack([pixels % frame.camera.width, pixels // frame.camera.width], axis=-1) + 0.5
    bearings, _ = frame.camera.bearings(centres)
    places = np.full((len(pixels), 3), np.nan)
    for index, direction in enumerate(bearings @ frame.world_from_cam[:3, :3].T):
        distance, wall = hit(frame.centre.copy(), direction)
        if wall >= 0:
            places[index] = frame.centre + distance * direction
    return places @ ground.T


@torch.no_grad()
def squared_errors(model: Model, frame: Frame, pixels: np.ndarray) -> np.ndarray:
    """Return the mean squared error (N,) of pixels (N,) over their channels."""
    assert frame.image is not None
    rays = pixel_rays(frame, model.training_from_scene, pixels=pixels, places=CENTRES, device=model.device)
    behind = colours_behind(model.background, rays.directions)
    seen = render_rays(model, rays.origin.expand_as(rays.directions), rays.directions, background=behind)
    levels = np.rint(255 * seen.rgb.clamp(0, 1).numpy())
    return np.square((levels - read_image(frame.image).reshape(-1, 3)[pixels]) / 255).mean(axis=1)


def psnr(errors: np.ndarray) -> float:
    """Return the PSNR in dB of squared errors."""
    return float(-10 * np.log10(errors.mean()))


def main(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the capture, runs and table.")],
    rows: Annotated[int, typer.Option(help="Rows of each table of a block, as a power of two.")] = 17,
    steps: Annotated[int, typer.Option(help="Steps of each block.")] = 1500,
) -> None:
    """Train both; print and write PSNR by place."""
    capture = output / "town"
    if not (capture / "sparse/0").exists():
        write_town(capture)
    settings = TrainSettings(budget_seconds=None, steps=steps, log2_rows=rows, threads=1)
    samples, whole_steps = BLOCKS * settings.expected_samples, steps
    while replace(settings, steps=whole_steps).expected_samples < samples:
        whole_steps += 1
    whole = replace(settings, steps=whole_steps, log2_rows=rows + int(math.log2(BLOCKS)))
    torch.set_num_threads(1)
    train_blocks(capture, output / "four", settings, count=BLOCKS, notify=print)
    train_scene(capture, output / "whole", whole, notify=print)

    loaded = scenes.load(capture)
    division, frames = divide(loaded, BLOCKS), loaded.test_frames
    rng = np.random.default_rng(0)
    pixels = [rng.choice(SIZE[0] * SIZE[1], PIXELS_PER_PHOTO, replace=False) for _ in frames]
    places = np.concatenate(
        [true_ground(frame, chosen, division.ground) for frame, chosen in zip(frames, pixels, strict=True)]
    )
    groups = {f"block {number}": cell.contains(places) for number, cell in enumerate(division.cells, start=1)}
    at_border = np.sum([cell.contains(places, BORDER_METRES) for cell in division.cells], axis=0) > 1
    groups |= {
        f"within {BORDER_METRES:g} m of a border": at_border,
        "sky": np.isnan(places).any(axis=1),
        "all": np.ones(len(places), dtype=bool),
    }
    errors = {}
    for name in ("whole", "four"):
        model = Run(output / name).model()
        each = [squared_errors(model, frame, chosen) for frame, chosen in zip(frames, pixels, strict=True)]
        errors[name] = np.concatenate(each)
    table = [
        (name, f"{inside.mean():.3f}", *(f"{psnr(errors[run][inside]):.2f}" for run in errors))
        for name, inside in groups.items()
    ]
    shown_table = Table("pixels", "fraction", "one table (dB)", "four blocks (dB)")
    for row in table:
        shown_table.add_row(*row)
    Console().print(shown_table)
    with (output / "table.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("pixels", "fraction", "whole_psnr", "blocks_psnr"), *table])


if __name__ == "__main__":
    typer.run(main)
