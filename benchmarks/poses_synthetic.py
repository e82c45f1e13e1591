"""Poses from features and matches of known synthetic cameras, from the mapper to the verdict.

    python benchmarks/poses_synthetic.py
    python benchmarks/poses_synthetic.py --seeds 3 -o poses_synthetic.csv
    python benchmarks/poses_synthetic.py --only town    # 1,000 photos, some minutes; not among the others

A pair's error is the larger of the errors of its relative rotation and of its baseline's direction, infinite if one of
its photos was not placed. AUC is the area under the cumulative fraction of pairs by error, up to a bound, as a
percentage of the largest possible. Captures that cannot be solved must be refused, with the reason.
"""

import csv
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
import pycolmap
import synthetic_captures as synthetic
import typer
from rich.console import Console
from rich.table import Table
from synthetic_captures import FISHEYE, LONG, PHONE, UNKNOWN_FISHEYE, WIDE, Noise, Scene, View

from nerfcli.poses.engine.attempts import map_with_fallbacks
from nerfcli.poses.judge.examine import examine

BOUNDS_DEG = (1, 3, 5, 10)
TOWN = "town of 1,000 photos"
USUAL = Noise()


@dataclass(frozen=True)
class Capture:
    """Views of a scene, the noise of their features, and the pairs to compare.

    refused: words that the verdict must contain; None if the capture must be accepted. missing: number of photos, at
    the end, that show nothing that others do.
    """

    views: list[View]
    scene: Scene
    noise: Noise = USUAL
    pairs: Callable[[int, int], bool] = lambda i, j: True
    refused: str | None = None
    missing: int = 0


@dataclass(frozen=True)
class Result:
    """A capture's row of the table."""

    capture: str
    seed: int
    photos: int
    placed: int
    auc_1: float
    auc_3: float
    auc_5: float
    auc_10: float
    reprojection_px: float
    focal_percent: float
    lens: str
    attempts: int
    cpu_seconds: float
    verdict: str


def captures(seed: int) -> dict[str, Capture]:
    """Return the captures by name. Some can be solved; some can only be recognised as unsolvable."""
    ball = synthetic.boulder(1500, seed=seed)
    far = (40.0, 0.0, 0.0)
    apart = synthetic.together(ball, synthetic.boulder(1500, seed=seed + 1, centre=far))
    rooms = synthetic.together(synthetic.boulder(800, seed=seed), synthetic.room(800, seed=seed + 1))
    ring, plane = synthetic.ring, synthetic.wall(1500, seed=seed, size=9.0)
    twelve = ring(12, [WIDE], seed=seed)
    streets, houses = synthetic.town(1000, WIDE, seed=seed)
    centres = np.array([view.centre for view in streets])
    return {
        TOWN: Capture(streets, houses, pairs=lambda i, j: bool(np.linalg.norm(centres[i] - centres[j]) < 6)),
        "plain": Capture(ring(16, [WIDE], seed=seed), ball),
        "noise 1.5 px": Capture(ring(16, [WIDE], seed=seed), ball, Noise(features_px=1.5)),
        "40 % wrong matches": Capture(ring(16, [WIDE], seed=seed), ball, Noise(outliers=0.4)),
        "two cameras": Capture(ring(16, [WIDE, LONG], seed=seed), ball),
        "phone lens": Capture(ring(24, [PHONE], seed=seed), ball),
        "fisheye": Capture(ring(16, [FISHEYE], seed=seed, radius=2.0), rooms),
        "unknown fisheye": Capture(ring(16, [UNKNOWN_FISHEYE], seed=seed, radius=2.0), rooms),
        "low overlap": Capture(ring(12, [WIDE], seed=seed), ball, pairs=lambda i, j: (j - i) % 12 in (1, 11)),
        "disconnected": Capture(
            [*ring(10, [WIDE], seed=seed), *ring(7, [WIDE], seed=seed + 1, at=far)], apart, refused="parts of 10 + 7"
        ),
        "repeated structure": Capture(
            ring(24, [WIDE], seed=seed), synthetic.twofold(2400, seed=seed), refused="look alike"
        ),
        "pure rotation": Capture(
            synthetic.panorama(16, WIDE), synthetic.room(4000, seed=seed), refused="pure rotation"
        ),
        "one place": Capture([twelve[0]] * 12, ball, refused="baseline"),
        "photos of nothing": Capture([*twelve, *synthetic.turned_away(twelve[::3])], ball, missing=4),
        "a camera per photo": Capture(synthetic.each_its_own(ring(16, [WIDE], seed=seed), seed=seed), ball),
        "duplicated photos": Capture([*twelve, *twelve], ball),
        "walk with a loop": Capture(synthetic.walk(40, WIDE), synthetic.courtyard(6000, seed=seed)),
        "small angles": Capture(ring(12, [WIDE], seed=seed, turn_deg=15), ball),
        "shallow depth": Capture(
            synthetic.above(16, WIDE, seed=seed, tilt=0.3), synthetic.wall(1500, seed=seed, size=9.0, depth=0.3)
        ),
        "plane, tilted views": Capture(synthetic.above(16, WIDE, seed=seed, tilt=0.5), plane),
        "plane from above": Capture(synthetic.above(16, WIDE, seed=seed), plane),
    }


def solve(name: str, capture: Capture, *, seed: int) -> Result:
    """Map a capture from its database, examine the result, and measure it against the truth."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        synthetic.write_database(
            folder / "database.db",
            capture.views,
            capture.scene,
            noise=capture.noise,
            seed=seed,
            pairs=capture.pairs,
        )
        job = synthetic.synthetic_job(folder, capture.views, seed=seed)
        start = time.process_time()
        mapped = map_with_fallbacks(job, lambda *reported: None)
        examined = examine(mapped.models, mapped.job, lambda *reported: None, located=mapped.located)
        seconds = time.process_time() - start
        model = examined.model
        failures = [f"{failure.kind}: {failure.evidence}" for failure in examined.verdict.failures]
        parts = examined.details["parts"]
        if len(parts) > 1:
            failures.append("parts of " + " + ".join(map(str, parts)))
        errors = (
            np.full(1, np.inf)
            if model is None
            else pair_errors_deg(model, capture.views[: len(capture.views) - capture.missing])
        )
        cameras = [] if model is None else [camera.model.name for camera in model.cameras.values()]
        return Result(
            name,
            seed,
            len(capture.views),
            0 if model is None else model.num_reg_images(),
            *(auc(errors, bound) for bound in BOUNDS_DEG),
            reprojection_px=np.nan if model is None else model.compute_mean_reprojection_error(),
            focal_percent=np.nan if model is None else worst_focal_percent(model, capture.views),
            lens=", ".join(dict.fromkeys(cameras)),
            attempts=len(mapped.attempts),
            cpu_seconds=seconds,
            verdict="; ".join(failures) or "accepted",
        )


def pair_errors_deg(model: pycolmap.Reconstruction, views: list[View]) -> np.ndarray:
    """Return the pose error of every pair of views; infinite if one of them was not placed."""
    placed = set(model.reg_image_ids())
    errors: list[float] = []
    for i, j in combinations(range(len(views)), 2):
        if i + 1 not in placed or j + 1 not in placed:
            errors.append(np.inf)
            continue
        found = model.image(j + 1).cam_from_world() * model.image(i + 1).cam_from_world().inverse()
        one, other = (pycolmap.Rigid3d(views[k].cam_from_world) for k in (i, j))
        truth = other * one.inverse()
        turned = np.degrees((found.rotation * truth.rotation.inverse()).angle())
        cosine = found.translation @ truth.translation
        cosine /= np.linalg.norm(found.translation) * np.linalg.norm(truth.translation) + 1e-300
        errors.append(max(turned, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))))
    return np.array(errors)


def worst_focal_percent(model: pycolmap.Reconstruction, views: list[View]) -> float:
    """Return the largest error of a focal length, over photos whose lens has the true kind of projection; else NaN."""
    errors = []
    for image_id in model.reg_image_ids():
        camera, lens = model.camera(model.image(image_id).camera_id), views[image_id - 1].lens
        if ("FISHEYE" in camera.model.name) == ("FISHEYE" in lens.model):
            errors.append(100 * (camera.mean_focal_length() / lens.params[0] - 1))
    return float(max(errors, key=abs, default=np.nan))


def auc(errors: np.ndarray, bound: float) -> float:
    """Return the area under the cumulative fraction of errors to a bound in per cent: mean of max(1 - e / bound, 0)."""
    return float(100 * np.maximum(1 - errors / bound, 0).mean())


def main(
    output: Annotated[Path | None, typer.Option("-o", help="Write a CSV too.")] = None,
    seeds: Annotated[int, typer.Option(help="How many of each.", min=1)] = 1,
    only: Annotated[str, typer.Option(help="Captures whose name contains this.")] = "",
) -> None:
    """Solve every capture and print a table."""
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    console = Console()
    table = Table(
        "capture", "placed", "AUC 1", "3", "5", "10 deg", "px", "focal %", "lens", "attempts", "CPU s", "verdict"
    )
    results, wrong = [], []
    for seed in range(seeds):
        for name, capture in captures(seed).items():
            if only not in name or (name == TOWN and not only):
                continue
            result = solve(name, capture, seed=seed)
            results.append(result)
            aucs = [f"{value:.1f}" for value in (result.auc_1, result.auc_3, result.auc_5, result.auc_10)]
            placed = f"{result.placed}/{result.photos}"
            focal, px = f"{result.focal_percent:+.2f}", f"{result.reprojection_px:.2f}"
            numbers = [px, focal, result.lens, str(result.attempts), f"{result.cpu_seconds:.1f}"]
            table.add_row(name, placed, *aucs, *numbers, result.verdict)
            if capture.refused is None:
                expected = result.verdict == "accepted" and result.placed == result.photos - capture.missing
            else:
                expected = capture.refused in result.verdict
            if not expected:
                wrong.append(f"{name} (seed {seed})")
    console.print(table)
    console.print("verdicts as they should be" if not wrong else f"wrong verdicts: {', '.join(wrong)}")
    if output:
        with output.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [field.name for field in fields(Result)])
            writer.writeheader()
            writer.writerows(asdict(result) for result in results)
    raise typer.Exit(1 if wrong else 0)


if __name__ == "__main__":
    typer.run(main)
