"""Refinement of cameras that are wrong by a known amount: remaining errors, gain in held-out PSNR, and time.

    python benchmarks/component_scenes.py scenes --only poses-balls --only focal-balls --only alpha
    python benchmarks/cameras.py scenes -o cameras
    python benchmarks/cameras.py scenes -o long --only poses-balls --steps 1500 --seeds 2

Each scene is trained with the given cameras, with refined and with true cameras, with the same steps and seeds. Pose
errors are root mean squares over the training photos against the truth, without alignment; translations are in per cent
of the cameras' mean distance from their centre. "picture" is the reprojection error of points at the middle of the
scene: raw, and after the similarity that minimizes it, which no photo can determine. Held-out PSNR is given for whole
photos, at their true poses and at these poses mapped into the refined frame by that similarity ("mapped"). Seconds are
processor time.
"""

import csv
import json
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table

from nerfcli import kernels
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, apply, inverse, rotation_from_vector, vector_from_rotation
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.run_cameras import read_cameras
from nerfcli.captures.loading import load_scene
from nerfcli.evaluate.photos import HeldOutPhoto
from nerfcli.evaluate.protocol import evaluate_model
from nerfcli.photos.loading import load_photos
from nerfcli.render.model import load_model
from nerfcli.training.loop import Progress, train
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.files import FIELD
from nerfcli.training.runs.settings import TrainSettings

# Capture, downscale, and what is refined. The last four need no refinement: their loss in PSNR is its cost.
CASES = (
    ("poses-balls", 1, "poses"),
    ("moves-balls", 1, "poses"),
    ("focal-balls", 1, "focal"),
    ("poses", 2, "poses"),
    ("moves", 2, "poses"),
    ("focal", 2, "focal"),
    ("alpha", 1, "poses"),
    ("alpha", 1, "focal"),
    ("desk", 2, "poses"),
    ("desk", 2, "focal"),
)
MIDDLE_POINTS, MIDDLE_FRACTION = 200, 0.2
ALIGNMENT_ROUNDS, ALIGNMENT_STEP = 4, 1e-4


@dataclass(frozen=True)
class Trained:
    """One training: errors of its cameras, and held-out PSNR in dB."""

    scene: str
    cameras: str
    seed: int
    steps: int
    rotation_deg: float
    translation_percent: float
    picture_px: float
    picture_aligned_px: float
    focal_percent: float
    psnr: float
    psnr_mapped: float
    cpu_seconds: float


def with_truth(capture: Capture, folder: Path) -> Capture:
    """Return the scene with the true cameras of its photos."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    poses, params = truth.get("world_from_cam", {}), truth.get("params")
    frames = tuple(
        replace(
            frame,
            world_from_cam=np.array(poses.get(frame.name, frame.world_from_cam)),
            camera=frame.camera if params is None else replace(frame.camera, params=tuple(params)),
        )
        for frame in capture.frames
    )
    return replace(capture, frames=frames)


class Pictures:
    """Projections of points at the middle of the scene into the true cameras."""

    def __init__(self, true: Sequence[Frame]):
        self.truth = np.array([frame.world_from_cam for frame in true])
        self._cameras = [frame.camera for frame in true]
        centres, ahead = self.truth[:, :3, 3], self.truth[:, :3, 2]
        self.reach = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())
        # The point nearest to all optical axes, in least squares.
        away = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
        self._middle = np.linalg.lstsq(away.sum(0), (away @ centres[:, :, None])[..., 0].sum(0), rcond=None)[0]
        offsets = np.random.default_rng(0).uniform(-1, 1, (MIDDLE_POINTS, 3))
        self._points = self._middle + MIDDLE_FRACTION * self.reach * offsets

    def off(self, poses: np.ndarray) -> np.ndarray:
        """Return the reprojection errors (N, 2) in pixels of the points in cameras with these poses (P, 4, 4)."""
        places = [
            camera.project(apply(inverse(a), self._points))[0] - camera.project(apply(inverse(b), self._points))[0]
            for camera, a, b in zip(self._cameras, poses, self.truth, strict=True)
        ]
        return np.concatenate(places)

    def alignment(self, poses: np.ndarray) -> Similarity:
        """Return the similarity of poses that minimizes the squared reprojection errors of the points."""
        found = Similarity.identity()
        for _ in range(ALIGNMENT_ROUNDS):
            now = self.off(found.apply_pose(poses)).ravel()
            slopes = [
                (self.off(self._small(step).compose(found).apply_pose(poses)).ravel() - now) / ALIGNMENT_STEP
                for step in ALIGNMENT_STEP * np.eye(7)
            ]
            found = self._small(-np.linalg.lstsq(np.stack(slopes, axis=1), now, rcond=None)[0]).compose(found)
        return found

    def _small(self, change: np.ndarray) -> Similarity:
        """Return a similarity from a rotation vector, a translation over `reach` and a log scale, about the middle."""
        turn, scale = rotation_from_vector(change[:3]), float(np.exp(change[6]))
        return Similarity(scale, turn, self._middle + self.reach * change[3:6] - scale * turn @ self._middle)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).sum(axis=-1).mean()))


def fit(given: Capture, truth: Capture, choice: str, *, seed: int, steps: int, downscale: int, samples: int) -> Trained:
    """Train with cameras "fixed", "true" or refined, and measure."""
    settings = TrainSettings(
        budget_seconds=None,
        steps=steps,
        downscale=downscale,
        seed=seed,
        samples_per_step=samples,
        components=Components(cameras="fixed" if choice == "true" else choice),
    )
    began = used = 0.0

    def clock(progress: Progress) -> None:
        nonlocal began, used
        began = began or time.process_time()
        used = time.process_time() - began

    with tempfile.TemporaryDirectory() as folder:
        run, capture = Path(folder), truth if choice == "true" else given
        train(capture, run, settings, resume=False, notify=lambda text: None, on_progress=clock)
        model, cameras = load_model(run / FIELD, "cpu"), read_cameras(run)
        held_out = [  # while the run exists: its photo paths are relative to it
            HeldOutPhoto(photo.frame, photo.pixels, photo.used)
            for photo in load_photos(cameras.test, factor=downscale, threads=1)
        ]
    pictures = Pictures(truth.train_frames)
    found = np.array([frame.world_from_cam for frame in cameras.train])
    alignment = pictures.alignment(found)
    there = [  # held-out cameras, mapped into the frame of the refined ones
        replace(h, frame=replace(h.frame, world_from_cam=alignment.inverse().apply_pose(h.frame.world_from_cam)))
        for h in held_out
    ]
    mean = evaluate_model(model, held_out).mean
    mapped = evaluate_model(model, there).mean
    turns = vector_from_rotation(np.swapaxes(pictures.truth[:, :3, :3], 1, 2) @ found[:, :3, :3])
    focal = [a.camera.focal_px / b.camera.focal_px - 1 for a, b in zip(cameras.train, truth.train_frames, strict=True)]
    return Trained(
        given.root.name,
        choice,
        seed,
        steps,
        float(np.degrees(rms(turns))),
        100 * rms(found[:, :3, 3] - pictures.truth[:, :3, 3]) / pictures.reach,
        rms(pictures.off(found)),
        rms(pictures.off(alignment.apply_pose(found))),
        100 * float(np.abs(focal).mean()),
        mean.psnr,
        mapped.psnr,
        used,
    )


def print_table(trained: list[Trained]) -> None:
    """Print one line per scene and choice, with means over the seeds."""
    table = Table(title=f"{trained[0].steps} steps")
    heads = (
        "scene",
        "cameras",
        "deg",
        "move %",
        "px",
        "px aligned",
        "focal %",
        "PSNR",
        "mapped",
        "CPU s",
    )
    for number, name in enumerate(heads):
        table.add_column(name, justify="left" if number < 2 else "right")
    numbers = [field.name for field in fields(Trained)][4:]
    for key in dict.fromkeys((t.scene, t.cameras) for t in trained):
        mine = [t for t in trained if (t.scene, t.cameras) == key]
        means = [statistics.fmean(getattr(t, name) for t in mine) for name in numbers]
        table.add_row(*key, *(f"{mean:.3f}" for mean in means[:5]), *(f"{mean:.2f}" for mean in means[5:]))
    Console(width=120).print(table)


def main(
    scenes: Annotated[Path, typer.Argument(help="What component_scenes.py wrote.")],
    output: Annotated[Path, typer.Option("-o", help="Where to write, without suffix.")],
    only: Annotated[list[str] | None, typer.Option(help="Scenes; all that are there by default.")] = None,
    choices: Annotated[
        str, typer.Option(help="Of fixed, refined and true, separated by commas.")
    ] = "fixed,refined,true",
    seeds: Annotated[int, typer.Option(help="Trainings of each.")] = 1,
    steps: Annotated[int, typer.Option(help="Of each training.")] = 800,
    samples: Annotated[int, typer.Option(help="Samples of the last steps.")] = 2**14,
) -> None:
    """Compare trainings with wrong, refined and true cameras."""
    torch.set_num_threads(1)
    kernels.prepare(Console(stderr=True).print)
    trained: list[Trained] = []
    with output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Trained)])
        writer.writeheader()
        for name, downscale, kind in CASES:
            if (only and name not in only) or not (scenes / name).is_dir():
                continue
            given = load_scene(scenes / name)
            truth = with_truth(given, scenes / name)
            for seed in range(seeds):
                for choice in choices.split(","):
                    learned = kind if choice == "refined" else choice
                    trained.append(
                        fit(given, truth, learned, seed=seed, steps=steps, downscale=downscale, samples=samples)
                    )
                    writer.writerow(asdict(trained[-1]))
                    file.flush()
                    Console(stderr=True).print(trained[-1])
    print_table(trained)


if __name__ == "__main__":
    typer.run(main)
