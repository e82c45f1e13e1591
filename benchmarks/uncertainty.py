"""Does the spread over seeds predict the error of depth, and does it where no photo looked?

    python benchmarks/uncertainty.py desk -o desk-uncertainty
    python benchmarks/uncertainty.py redkitchen path/to/redkitchen -o kitchen-uncertainty

The quarter of the photos that look most to one side is withheld, and every 8th photo. The first seed is the field that
would be deployed: its median depth in small views of the withheld photos is compared with the true depth (desk, every
8th photo) or a depth sensor (redkitchen). The other seeds have a spread. Coverage is that of the deployed field, as
`nerfcli render --outputs coverage` writes it. Complete trainings are kept, so that the same command goes on.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from depth import DESK, desk_scene, desk_truth, kitchen_depth_view, kitchen_scene, kitchen_truth
from rich.console import Console
from rich.table import Table
from scipy import stats

from nerfcli.cameras.frame import Frame
from nerfcli.captures.loading import load_scene
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.render.coverage import coverage_and_parallax, depth_maps, small_frame
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.workflows.train import train_scene

# Fraction of the photos that is withheld on one side; every how many photos is, too.
WITHHELD, CONTROL_EVERY = 0.25, 8
DESK_DEPTHS = DESK / "truth" / "depth"
# Longer side in pixels of the views in which depth is compared.
VIEW_PX = 64
# Depth is wrong if it is off by more than this fraction of the true depth.
WRONG = 0.05
LEVEL = 0.9
# Fewer pixels than this, of either kind, have no area under the ROC and no correlation.
LEAST_PIXELS = 50


def withheld(frames: Sequence[Frame]) -> list[str]:
    """Return the names of the photos that look most to the side of the middle one, and of every 8th photo."""
    ahead = np.array([frame.world_from_cam[:3, 2] for frame in frames])
    nearest = np.argsort(-(ahead @ ahead[len(ahead) // 2]))
    inside = {frames[index].name for index in nearest[: round(WITHHELD * len(frames))]}
    return sorted(inside | {frame.name for frame in frames[::CONTROL_EVERY]})


def true_distances(views: Sequence[Frame], truths: Sequence[np.ndarray]) -> np.ndarray:
    """Return the true distances (P,) along the rays of all views, NaN where they are unknown.

    Args:
        truths: of each view, z in each pixel of the whole picture.
    """
    columns = []
    for view, z in zip(views, truths, strict=True):
        bearings, _ = view.camera.pixel_bearings()
        step = z.shape[1] // view.camera.width
        nearest = z[step // 2 :: step, step // 2 :: step][: view.camera.height, : view.camera.width]
        columns.append(nearest.ravel() / bearings[:, 2])
    return np.concatenate(columns)


def distances(model: Model, views: Sequence[Frame]) -> np.ndarray:
    """Return the median depths (P,) along the rays of all views, NaN where there is none."""
    columns = []
    for view in views:
        picture = render_picture(model, view, background=model.background, depth=DepthRequest("median", "ray"))
        assert picture.depth is not None
        columns.append(picture.depth.ravel())
    return np.concatenate(columns)


def coverage(model: Model, training: Sequence[Frame], views: Sequence[Frame], found: np.ndarray) -> np.ndarray:
    """Return the number of training photos (P,) that see the points at the distances `found`; NaN where these are."""
    seen, columns = depth_maps(model, training), []
    for view, along in zip(views, np.split(found, len(views)), strict=True):
        rays, _ = view.camera.pixel_bearings()
        points = view.centre + (rays * along[:, None]) @ view.world_from_cam[:3, :3].T
        columns.append(coverage_and_parallax(seen, points)[0])
    return np.concatenate(columns)


def held_by_interval(seeds: np.ndarray, true: np.ndarray, *, level: float) -> float:
    """Return the fraction of true values (P,) in m +- t s sqrt(1 + 1/M), m and s mean and spread of seeds (M, P).

    t is Student's quantile with M - 1 degrees of freedom: the interval of a further draw from the same Gaussian.
    """
    count = len(seeds)
    reach = stats.t.ppf(0.5 * (1.0 + level), count - 1) * seeds.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / count)
    return float((np.abs(seeds.mean(axis=0) - true) <= reach).mean())


def area_under_roc(values: np.ndarray, positive: np.ndarray) -> float:
    """Return the probability that a positive has a larger value than a negative, ties counting half."""
    ones, zeros = int(positive.sum()), int((~positive).sum())
    if min(ones, zeros) < LEAST_PIXELS:
        return float("nan")
    return float((stats.rankdata(values)[positive].mean() - 0.5 * (ones + 1)) / zeros)


def rank_correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Return Spearman's correlation; NaN for few pixels or constant values."""
    if len(one) < LEAST_PIXELS or np.ptp(one) == 0 or np.ptp(other) == 0:
        return float("nan")
    return float(stats.spearmanr(one, other).statistic)


def summary(seeds: np.ndarray, true: np.ndarray, photos: np.ndarray) -> dict[str, dict[str, float]]:
    """Return the numbers of all pixels with a true and a rendered depth, and of those that few photos see.

    Args:
        seeds: (M, P) distances; the first is the deployed field.
        true: (P,) distances.
        photos: (P,) numbers of photos that see the deployed field's depth.
    """
    used = np.isfinite(true) & np.isfinite(seeds).all(axis=0)
    seeds, true, photos = seeds[:, used], true[used], photos[used]
    deployed, others = seeds[0], seeds[1:]
    error, spread = np.abs(deployed - true), others.std(axis=0, ddof=1)
    groups = {"all": photos >= 0, "no photo": photos == 0, "1 photo": photos == 1, "2 and more": photos >= 2}
    found = {}
    for name, rows in groups.items():
        if rows.any():
            wrong = error[rows] > WRONG * true[rows]
            found[name] = {
                "pixels": float(rows.sum()),
                "mean error": float(error[rows].mean()),
                "mean spread": float(spread[rows].mean()),
                "wrong": float(wrong.mean()),
                "ROC spread": area_under_roc(spread[rows], wrong),
                "ROC coverage": area_under_roc(-photos[rows], wrong),
                "correlation": rank_correlation(spread[rows], error[rows]),
                "interval holds": held_by_interval(others[:, rows], true[rows], level=LEVEL),
            }
    return found


def main(
    capture: Annotated[str, typer.Argument(help="desk or redkitchen.")],
    folder: Annotated[Path | None, typer.Argument(help="Of the redkitchen capture.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the scene and the runs.")] = Path(
        "uncertainty"
    ),
    seeds: Annotated[int, typer.Option(help="Fields to train, the deployed one included.", min=3)] = 6,
    steps: Annotated[int, typer.Option(help="Of each training.", min=1)] = 800,
    downscale: Annotated[int, typer.Option(help="Of each training.")] = 4,
    threads: Annotated[int, typer.Option(min=1)] = 1,
) -> None:
    """Train the seeds that are missing, and print the table."""
    if capture not in ("desk", "redkitchen") or (capture == "redkitchen") != (folder is not None):
        raise typer.BadParameter("give desk, or redkitchen and its folder")
    torch.set_num_threads(threads)
    place, names = output / "scene", output / "held_out.txt"
    desk_scene(place) if folder is None else kitchen_scene(place, folder)
    names.write_text("\n".join(withheld(load_scene(place).frames)), encoding="utf-8")
    scene = load_scene(place, holdout=str(names))
    if folder is None:
        whole = [frame for frame in scene.test_frames if (DESK_DEPTHS / f"{Path(frame.name).stem}.tiff").exists()]
        truths = [desk_truth(frame) for frame in whole]
    else:
        whole = [kitchen_depth_view(frame, folder) for frame in scene.test_frames]
        truths = [kitchen_truth(frame, folder) for frame in scene.test_frames]
    views = [small_frame(frame, VIEW_PX) for frame in whole]
    rendered, photos = [], np.empty(0)
    for seed in range(seeds):
        settings = TrainSettings(
            budget_seconds=None, steps=steps, downscale=downscale, seed=seed, threads=threads, model="default"
        )
        path = output / f"seed-{seed}"
        model = train_scene(
            place, Output(path), settings, holdout=str(names), resume=None, reporter=Reporter(note=print)
        ).model()
        rendered.append(distances(model, views))
        if seed == 0:
            photos = coverage(model, scene.train_frames, views, rendered[0])
    numbers = summary(np.stack(rendered), true_distances(views, truths), photos)
    table = Table("", *numbers, title=f"{capture}: spread of {seeds - 1} seeds against the error of another, metres")
    for name in numbers["all"]:
        digits = 0 if name == "pixels" else 3
        table.add_row(name, *(f"{of_group[name]:.{digits}f}" for of_group in numbers.values()))
    Console(width=110).print(table)


if __name__ == "__main__":
    typer.run(main)
