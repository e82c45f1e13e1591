"""The error of every depth convention against true or measured depth, on two captures.

    python benchmarks/depth.py desk -o desk-depth
    python benchmarks/depth.py redkitchen path/to/redkitchen -o kitchen-depth
    python benchmarks/depth.py redkitchen path/to/redkitchen --scene scene-of-nerfcli-poses -o kitchen-depth

desk: sample_scenes/desk with its true cameras, against the true z of its held-out photos. redkitchen: a hand-held RGB-D
video with poses (7-Scenes; images/, depth/ in millimetres with 0 for none, pose/ camera to world), against its sensor,
in the view of its depth camera. A scale from the camera positions converts units to metres; with the capture's own
poses it is 1. The folder OUT gets the scene, the run, a CSV and one picture per held-out view: photo, true z,
conditional z, error. `--scene SCENE` uses the poses of `nerfcli poses`, `--run RUN` an existing run.
"""

import csv
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tifffile
import torch
import typer
from rich.console import Console
from rich.table import Table

from nerfcli import kernels
from nerfcli.cameras.alignment import align
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.formats.run_cameras import read_cameras
from nerfcli.render.depth import CONVENTIONS, DepthRequest, requested
from nerfcli.render.model import Model, load_model
from nerfcli.render.tracing import pixel_rays, render_rays
from nerfcli.training.runs.files import FIELD

DEPTHS = (*CONVENTIONS, "quantile:0.05", "quantile:0.95")
FRACTIONS = (0.5, 0.05, 0.95)
# Every second pixel of every second row is measured, as neighbours are nearly equal.
STRIDE = 2
DESK = Path(__file__).parent.parent / "sample_scenes" / "desk"
# Kinect: focal length of the colour camera, and its pose in the axes of the depth camera, in metres.
COLOUR_FOCAL_PX = 525.0
DEPTH_FROM_COLOUR = np.array([[1.0, 0, 0, 0.025], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
# From the axes of OpenCV to those of OpenGL, as in transforms.json.
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Errors:
    """Errors of one depth over all held-out views, in metres and as fractions."""

    depth: str
    coverage: float
    median: float
    rmse: float
    within_1_percent: float
    within_5_percent: float
    bias: float


def desk_scene(folder: Path) -> None:
    """Write transforms.json with the desk's true cameras."""
    truth = json.loads((DESK / "truth" / "cameras.json").read_text(encoding="utf-8"))
    f, cx, cy, k1, k2 = truth["camera"]["params"]
    lens = {"fl_x": f, "fl_y": f, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "p1": 0.0, "p2": 0.0}
    poses = {DESK / "images" / image["name"]: np.array(image["world_from_cam"]) for image in truth["images"]}
    _write_scene(folder, lens | {"camera_model": "OPENCV", "w": 800, "h": 600}, poses)


def kitchen_scene(folder: Path, capture: Path) -> None:
    """Write transforms.json with the video's colour camera.

    The capture's poses and lens (585 px) are those of the depth camera, to which the colour pictures are not
    registered: with them, matches between colour pictures are 1.9 px (median) off their epipolar lines, with
    `COLOUR_FOCAL_PX` 1.1 px. Points triangulated from these matches are 21 cm (median) off the sensor's depth with the
    former, 12 cm with the latter and 4 cm too near: a field trained on these poses cannot be expected to do much
    better. The poses of `nerfcli poses` (`--scene`) have no such limit.
    """
    cx, cy = np.loadtxt(capture / "camera-intrinsics.txt")[:2, 2]
    lens = {"fl_x": COLOUR_FOCAL_PX, "fl_y": COLOUR_FOCAL_PX, "cx": cx, "cy": cy}
    poses = {path: kitchen_pose(path.name, capture) for path in sorted((capture / "images").glob("*"))}
    _write_scene(folder, lens | {"camera_model": "PINHOLE", "w": 640, "h": 480}, poses)


def _write_scene(folder: Path, lens: dict[str, object], poses: dict[Path, np.ndarray]) -> None:
    frames = [
        {"file_path": str(path.resolve()), "transform_matrix": (pose @ OPENGL).tolist()} for path, pose in poses.items()
    ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), encoding="utf-8")


def desk_truth(frame: Frame) -> np.ndarray:
    """Return the true z (600, 800) in metres."""
    return tifffile.imread(DESK / "truth" / "depth" / f"{Path(frame.name).stem}.tiff").astype(np.float64)


def kitchen_pose(name: str, capture: Path) -> np.ndarray:
    """Return world_from_cam (4, 4) of the colour camera, from the capture's pose, in metres."""
    return np.loadtxt(capture / "pose" / f"{Path(name).stem}.txt") @ DEPTH_FROM_COLOUR


def kitchen_metres(frames: Sequence[Frame], capture: Path) -> float:
    """Return metres per unit: the scale of the similarity that aligns the frames' centres with the capture's."""
    centres = np.array([frame.world_from_cam[:3, 3] for frame in frames])
    return align(centres, np.array([kitchen_pose(frame.name, capture)[:3, 3] for frame in frames])).scale


def kitchen_depth_view(frame: Frame, capture: Path, *, metres: float = 1.0) -> Frame:
    """Return the depth camera's frame for a photo of the colour camera, with `metres` per unit."""
    matrix = np.loadtxt(capture / "camera-intrinsics.txt")
    camera = Camera("PINHOLE", 640, 480, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    colour_from_depth = np.linalg.inv(DEPTH_FROM_COLOUR)
    colour_from_depth[:3, 3] /= metres
    return replace(frame, camera=camera, world_from_cam=frame.world_from_cam @ colour_from_depth)


def kitchen_truth(frame: Frame, capture: Path) -> np.ndarray:
    """Return the measured z (480, 640) in metres; NaN where the sensor has none."""
    levels = cv2.imread(str(capture / "depth" / f"{Path(frame.name).stem}.png"), cv2.IMREAD_UNCHANGED)
    assert levels is not None
    return np.where((levels > 0) & (levels < 65535), levels / 1000.0, np.nan)


def depths(model: Model, frame: Frame, *, min_opacity: float) -> dict[str, np.ndarray]:
    """Render every depth along z once, at the centres of every `STRIDE`-th pixel: (H / STRIDE, W / STRIDE) each."""
    width, height = frame.camera.width, frame.camera.height
    pixels = np.arange(width * height).reshape(height, width)[::STRIDE, ::STRIDE]
    rays = pixel_rays(frame, model.training_from_scene, pixels=pixels.ravel(), device=torch.device("cpu"))
    scale = model.training_from_scene.scale
    requests = [DepthRequest(name, "z", min_opacity, model.marching.far / scale) for name in DEPTHS]
    columns: dict[str, list[torch.Tensor]] = {name: [] for name in DEPTHS}
    for chosen in torch.arange(len(rays.directions)).split(4096):
        directions = rays.directions[chosen]
        seen = render_rays(
            model, rays.origin.expand_as(directions), directions, background=torch.zeros(3), fractions=FRACTIONS
        )
        for request in requests:
            fraction = FRACTIONS.index(request.fraction) if request.fraction is not None else 0
            ends = seen.ends._replace(quantiles=seen.ends.quantiles[:, fraction : fraction + 1])
            far = torch.full_like(ends.mean, model.marching.far)
            along_ray = requested(request, ends, background_distance=far) / scale
            z = torch.where(rays.valid[chosen], along_ray * rays.cosines[chosen], torch.nan)
            columns[request.convention].append(z)
    return {name: torch.cat(column).view(pixels.shape).double().numpy() for name, column in columns.items()}


def measure(maps: list[dict[str, np.ndarray]], truths: list[np.ndarray]) -> list[Errors]:
    """Return the errors of every depth over all pixels of the views with known truth."""
    rows = []
    defined = np.isfinite(np.stack(truths))
    truth = np.stack(truths)
    for name in DEPTHS:
        depth = np.stack([one[name] for one in maps])
        both = defined & np.isfinite(depth)
        error, where = depth[both] - truth[both], truth[both]
        off = np.abs(error)
        rows.append(
            Errors(
                depth=name,
                coverage=float(both.sum() / defined.sum()),
                median=float(np.median(off)),
                rmse=float(np.sqrt((error**2).mean())),
                within_1_percent=float((off < 0.01 * where).mean()),
                within_5_percent=float((off < 0.05 * where).mean()),
                bias=float(np.median(error)),
            )
        )
    return rows


def draw(photo: Path, depth: np.ndarray, truth: np.ndarray, path: Path) -> None:
    """Draw photo, true z, conditional z and its error within +-10 cm (blue too near, red too far), side by side."""
    height, width = truth.shape
    lo, hi = np.nanpercentile(truth, (1, 99))

    def colours(values: np.ndarray, low: float, high: float) -> np.ndarray:
        level = np.where(np.isnan(values), 0.0, (values - low) / (high - low)).clip(0, 1)
        shown = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
        return np.where(np.isnan(values)[..., None], 128, shown).astype(np.uint8)

    pixels = cv2.imread(str(photo))
    assert pixels is not None
    rgb = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    sheets = [rgb, colours(truth, lo, hi), colours(depth, lo, hi), colours(depth - truth, -0.1, 0.1)]
    cv2.imwrite(str(path), np.concatenate(sheets, axis=1))


def errors_of_run(
    run: Path, capture: Path | None, output: Path, *, views: int = 6, min_opacity: float = 0.5
) -> list[Errors]:
    """Return the errors of every depth of a run, and draw a picture per view into the folder `output`.

    Args:
        run: of the desk with its true cameras, or of redkitchen.
        capture: the folder of redkitchen, None for the desk.
        output: for the pictures.
        views: held-out views at most, evenly chosen.
        min_opacity: as in nerfcli render.
    """
    output.mkdir(parents=True, exist_ok=True)
    kernels.prepare(print)
    model = load_model(run / FIELD, "cpu")
    cameras = read_cameras(run)
    test = cameras.test
    metres = 1.0 if capture is None else kitchen_metres([*cameras.train, *test], capture)
    chosen = [test[index] for index in np.unique(np.linspace(0, len(test) - 1, views).round().astype(int))]
    whole = [desk_truth(frame) if capture is None else kitchen_truth(frame, capture) for frame in chosen]
    truths = [truth[::STRIDE, ::STRIDE] for truth in whole]
    looks = chosen if capture is None else [kitchen_depth_view(frame, capture, metres=metres) for frame in chosen]
    maps = [
        {name: metres * depth for name, depth in depths(model, look, min_opacity=min_opacity).items()} for look in looks
    ]
    for frame, one, truth in zip(chosen, maps, truths, strict=True):
        assert frame.image is not None
        draw(frame.image, one["conditional"], truth, output / f"{Path(frame.name).stem}.png")
    return measure(maps, truths)


def main(
    capture: Annotated[str, typer.Argument(help="desk or redkitchen.")],
    folder: Annotated[Path | None, typer.Argument(help="Of the redkitchen capture.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for scene, run, CSV and pictures.")] = Path(
        "depth-benchmark"
    ),
    scene: Annotated[
        Path | None, typer.Option(help="Of nerfcli poses, redkitchen only; else the capture's poses.")
    ] = None,
    run: Annotated[Path | None, typer.Option(help="A run of the same capture, instead of a new one.")] = None,
    budget: Annotated[str, typer.Option(help="Of the training: --budget 60s or, repeatable, --steps 2000.")] = "60s",
    downscale: Annotated[str, typer.Option(help="Of the training.")] = "2",
    views: Annotated[int, typer.Option(help="Held-out views at most, evenly chosen.", min=1)] = 6,
    min_opacity: Annotated[float, typer.Option(help="As in nerfcli render.", min=0, max=1)] = 0.5,
    threads: Annotated[int, typer.Option(min=1)] = 2,
) -> None:
    """Train, render every depth of the held-out views, print the table."""
    if capture not in ("desk", "redkitchen") or (capture == "redkitchen") != (folder is not None):
        raise typer.BadParameter("give desk, or redkitchen and its folder")
    torch.set_num_threads(threads)
    if scene is not None and folder is None:
        raise typer.BadParameter("the desk is measured with its true cameras only", param_hint="--scene")
    if run is None:
        run = output / "run"
        if scene is None:
            scene = output / "scene"
            desk_scene(scene) if folder is None else kitchen_scene(scene, folder)
        limit = ("--budget", budget) if not budget.isdigit() else ("--steps", budget)
        options = (*limit, "--downscale", downscale, "--threads", str(threads), "--overwrite")
        subprocess.run([sys.executable, "-m", "nerfcli", "train", str(scene), "-o", str(run), *options], check=True)
    rows = errors_of_run(run, folder, output, views=views, min_opacity=min_opacity)
    table = Table(
        *("depth along z", "coverage", "median cm", "RMSE cm", "within 1 %", "within 5 %", "bias cm"),
        title=f"{capture}: {views} held-out views at most, opacity >= {min_opacity:g}",
    )
    for row in rows:
        table.add_row(
            row.depth, f"{row.coverage:.1%}", f"{100 * row.median:.2f}", f"{100 * row.rmse:.1f}",
            f"{row.within_1_percent:.1%}", f"{row.within_5_percent:.1%}", f"{100 * row.bias:+.2f}",
        )  # fmt: skip
    Console().print(table)
    with (output / f"{capture}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Errors.__dataclass_fields__)
        writer.writerows(vars(row).values() for row in rows)


if __name__ == "__main__":
    typer.run(main)
