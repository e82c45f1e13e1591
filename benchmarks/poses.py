"""Structure from motion on captures with known poses: time and error, for each quality.

    python benchmarks/poses.py captures/fox captures/dtu24 -o poses
    python benchmarks/poses.py captures/redkitchen/handheld_video.mp4 captures/banana -o poses --qualities default

A capture is a folder with photos in images/, or a video. Its truth is read from a file or folder beside them:
transforms.json, cameras_sphere.npz (projection matrices, as in IDR and NeuS), pose/ with a camera-to-world matrix per
frame, or truth/cameras.json of sample_scenes/desk. Without truth only the counts are printed. Calls `nerfcli poses`,
to measure what users get; existing scenes in OUT-scenes/ are reused. Writes OUT.csv and prints a table.

How to read it: ATE is the RMS distance of camera centres from the true ones after the best similarity, over the RMS
distance of the true ones from their mean. Rotations are compared after the same similarity. "own axes" is the rotation
error that all cameras have in common in their own axes, plus the remaining error: a different principal point in truth
and result rotates all cameras alike, with the same projections. AUC is over all pairs of photos, for the larger of the
errors of relative rotation and of baseline direction; a photo that is not placed counts as wrong.
"""

import csv
import json
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from scipy.interpolate import CubicSpline
from scipy.linalg import rq
from scipy.spatial.transform import Rotation, RotationSpline

from nerfcli.cameras import rigid
from nerfcli.cameras.alignment import align
from nerfcli.captures.loading import load_scene
from nerfcli.errors import TOO_FEW_PHOTOS
from nerfcli.photos.images import image_size, list_images

NAN = float("nan")
# Frames of a video between two known poses at most this far apart get an interpolated pose.
MOST_FRAMES_BETWEEN = 10


@dataclass(frozen=True)
class Truth:
    """Known poses, and focal lengths in pixels of the photos, by the photos' names."""

    world_from_cam: dict[str, np.ndarray]
    focal_px: dict[str, float]


@dataclass(frozen=True)
class Accuracy:
    """Errors of poses: see the module's docstring. NaN if fewer than three photos have both poses."""

    compared: int = 0
    ate: float = NAN
    rotation_median_deg: float = NAN
    rotation_worst_deg: float = NAN
    own_axes_deg: float = NAN
    own_axes_median_deg: float = NAN
    auc_1: float = NAN
    auc_3: float = NAN
    auc_5: float = NAN
    auc_10: float = NAN


@dataclass(frozen=True)
class Row:
    """One capture at one quality."""

    capture: str
    quality: str
    registered: int
    total: int
    extract_s: float = NAN
    match_s: float = NAN
    map_s: float = NAN
    total_s: float = NAN
    reprojection_px: float = NAN
    focal_error_percent: float = NAN
    accuracy: Accuracy = Accuracy()


def compare_poses(truth: Sequence[np.ndarray], found: Sequence[np.ndarray], *, missing: int = 0) -> Accuracy:
    """Return the errors of poses.

    Args:
        truth, found: world_from_cam (4, 4) of the same photos; the two worlds differ by a similarity.
        missing: number of photos with a true pose that were not placed.
    """
    if len(truth) < 3:
        return Accuracy(compared=len(truth))
    t, f = np.array(truth), np.array(found)
    truth_from_found = align(f[:, :3, 3], t[:, :3, 3])
    aligned = np.array([truth_from_found.apply_pose(pose) for pose in f])
    distances = np.linalg.norm(aligned[:, :3, 3] - t[:, :3, 3], axis=1)
    radii = np.linalg.norm(t[:, :3, 3] - t[:, :3, 3].mean(axis=0), axis=1)
    off = np.swapaxes(t[:, :3, :3], 1, 2) @ aligned[:, :3, :3]  # in the axes of each true camera
    shared = Rotation.from_matrix(off).mean()
    angles = np.degrees(Rotation.from_matrix(off).magnitude())
    left = np.degrees((Rotation.from_matrix(off) * shared.inv()).magnitude())
    errors = np.concatenate([_relative_errors(t, f), np.full(_pairs(len(t) + missing) - _pairs(len(t)), np.inf)])
    return Accuracy(
        compared=len(t),
        ate=float(np.sqrt(np.mean(distances**2) / np.mean(radii**2))),
        rotation_median_deg=float(np.median(angles)),
        rotation_worst_deg=float(angles.max()),
        own_axes_deg=float(np.degrees(shared.magnitude())),
        own_axes_median_deg=float(np.median(left)),
        auc_1=area_under_curve(errors, 1),
        auc_3=area_under_curve(errors, 3),
        auc_5=area_under_curve(errors, 5),
        auc_10=area_under_curve(errors, 10),
    )


def area_under_curve(errors: np.ndarray, limit: float) -> float:
    """Return the mean, over thresholds from 0 to `limit`, of the fraction of errors below; 1 if all errors are 0."""
    return float(np.mean(np.clip(1 - errors / limit, 0, 1)))


def _relative_errors(t: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Return for each pair, in degrees, the larger of the errors of relative rotation and baseline direction."""
    one, other = np.triu_indices(len(t), 1)

    def relative(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cam1_from_cam0 = np.array([rigid.inverse(poses[j]) @ poses[i] for i, j in zip(one, other, strict=True)])
        return cam1_from_cam0[:, :3, :3], cam1_from_cam0[:, :3, 3]

    (rt, tt), (rf, tf) = relative(t), relative(f)
    rotation = Rotation.from_matrix(np.swapaxes(rt, 1, 2) @ rf).magnitude()
    across, along = np.linalg.norm(np.cross(tt, tf), axis=1), np.sum(tt * tf, axis=1)
    return np.degrees(np.maximum(rotation, np.arctan2(across, along)))


def _pairs(count: int) -> int:
    return count * (count - 1) // 2


def read_truth(capture: Path, photos: Path) -> Truth:
    """Return the known poses of the photos in the folder `photos` of a capture; empty if there are none."""
    home = capture if capture.is_dir() else capture.parent
    names = [path.name for path in list_images(photos)]
    if (home / "pose").is_dir():
        return _truth_of_matrices(home / "pose", photos, names)
    if (home / "cameras_sphere.npz").is_file():
        return _truth_of_projections(home / "cameras_sphere.npz", photos, names)
    if (home / "truth" / "cameras.json").is_file():
        known = json.loads((home / "truth" / "cameras.json").read_text(encoding="utf-8"))
        poses = {image["name"]: np.array(image["world_from_cam"]) for image in known["images"]}
        return Truth(poses, dict.fromkeys(poses, known["camera"]["params"][0]))
    if (home / "transforms.json").is_file():
        frames = load_scene(home / "transforms.json").frames
        poses = {Path(frame.name).name: frame.world_from_cam for frame in frames}
        return Truth(poses, {Path(frame.name).name: frame.camera.focal_px for frame in frames})
    return Truth({}, {})


def _truth_of_projections(path: Path, photos: Path, names: Sequence[str]) -> Truth:
    """Read poses from world_mat_i = K [R | t] of photo i, in pixels of a picture centred near K's principal point."""
    matrices, poses, focals = np.load(path), {}, {}
    for index, name in enumerate(names):
        k, rotation = rq(matrices[f"world_mat_{index}"][:3, :3])
        signs = np.diag(np.sign(np.diag(k)))
        k, rotation = k @ signs, signs @ rotation
        translation = np.linalg.solve(k, matrices[f"world_mat_{index}"][:3, 3])
        if np.linalg.det(rotation) < 0:
            rotation, translation = -rotation, -translation
        poses[name] = rigid.inverse(rigid.from_parts(rotation, translation))
        k = k / k[2, 2]
        # The pictures may have been reduced by an integer factor since calibration.
        factor = round(2 * k[0, 2] / image_size(photos / name)[0])
        focals[name] = float(k[0, 0] + k[1, 1]) / 2 / factor
    return Truth(poses, focals)


def _truth_of_matrices(folder: Path, photos: Path, names: Sequence[str]) -> Truth:
    """Read a 4 x 4 camera-to-world matrix per numbered frame; interpolate frames in between by splines."""
    given = {int(path.stem.split("-")[-1]): np.loadtxt(path) for path in sorted(folder.glob("*.txt"))}
    numbers = np.array(sorted(given))
    rotations = rigid.nearest_rotation(np.array([given[n][:3, :3] for n in numbers]))
    centres = CubicSpline(numbers, [given[n][:3, 3] for n in numbers])
    turns = RotationSpline(numbers, Rotation.from_matrix(rotations))
    poses = {}
    for name in names:
        number = int("".join(filter(str.isdigit, Path(name).stem)))
        after = int(np.searchsorted(numbers, number))
        if number in given or (0 < after < len(numbers) and numbers[after] - numbers[after - 1] <= MOST_FRAMES_BETWEEN):
            poses[name] = rigid.from_parts(turns(number).as_matrix(), centres(number))
    intrinsics = folder.parent / "camera-intrinsics.txt"
    focal = float(np.loadtxt(intrinsics)[0, 0]) if intrinsics.is_file() else NAN
    return Truth(poses, dict.fromkeys(poses, focal))


def measure(capture: Path, quality: str, folder: Path, *, seed: int, threads: int) -> Row:
    """Find the poses of a capture, unless they exist already, and compare them with its truth."""
    name = capture.stem if capture.is_file() else capture.name
    target = folder / f"{name}-{quality}"
    source = capture if capture.is_file() or not (capture / "images").is_dir() else capture / "images"
    options = ["--quality", quality, "--seed", str(seed), "--threads", str(threads), "--min-registered", "0"]
    command = [sys.executable, "-m", "nerfcli", "poses", str(source), "-o", str(target), *options]
    done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode
    if done == TOO_FEW_PHOTOS:
        return Row(name, quality, registered=0, total=0)
    if done != 0:
        raise SystemExit(done)
    found = load_scene(target)
    report = json.loads((target / "poses_report.json").read_text(encoding="utf-8"))
    truth = read_truth(capture, found.frames[0].image.parent if found.frames[0].image else source)
    both = [frame for frame in found.frames if frame.name in truth.world_from_cam]
    focal_errors = [frame.camera.focal_px / truth.focal_px[frame.name] - 1 for frame in both]
    seconds = report["seconds"]
    return Row(
        capture=name,
        quality=quality,
        extract_s=seconds["extract"],
        match_s=seconds["match"],
        map_s=seconds["map"],
        total_s=seconds["total"],
        registered=report["registered"],
        total=report["total"],
        reprojection_px=report["mean_reprojection_error_px"],
        focal_error_percent=100 * statistics.median(focal_errors) if focal_errors else NAN,
        accuracy=compare_poses(
            [truth.world_from_cam[frame.name] for frame in both],
            [frame.world_from_cam for frame in both],
            missing=len(truth.world_from_cam) - len(both) if both else 0,
        ),
    )


def print_table(rows: Sequence[Row]) -> None:
    """Print one line per capture and quality."""
    table = Table(title="nerfcli poses against known poses")
    for name in ("capture", "quality", "extract s", "match s", "map s", "total s", "placed", "ATE", "rotation deg"):
        table.add_column(name, justify="left" if name in ("capture", "quality") else "right")
    for name in ("worst deg", "own axes deg", "AUC 1/3/5/10", "focal %", "px"):
        table.add_column(name, justify="right")
    for row in rows:
        a = row.accuracy
        table.add_row(
            *(row.capture, row.quality),
            *(f"{value:.0f}" for value in (row.extract_s, row.match_s, row.map_s, row.total_s)),
            f"{row.registered}/{row.total}",
            f"{a.ate:.4f}",
            f"{a.rotation_median_deg:.3f}",
            f"{a.rotation_worst_deg:.2f}",
            f"{a.own_axes_deg:.2f} + {a.own_axes_median_deg:.3f}",
            "/".join(f"{100 * value:.0f}" for value in (a.auc_1, a.auc_3, a.auc_5, a.auc_10)),
            f"{row.focal_error_percent:+.2f}",
            f"{row.reprojection_px:.2f}",
        )
    Console(width=160).print(table)


def main(
    captures: Annotated[list[Path], typer.Argument(help="Folders with images/, or videos.", exists=True)],
    output: Annotated[Path, typer.Option("-o", help="Where to write, without suffix.")],
    qualities: Annotated[str, typer.Option(help="As nerfcli poses has them.")] = "fast,default,best",
    seed: Annotated[int, typer.Option(help="As nerfcli poses has it.")] = 0,
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 2,
) -> None:
    """Measure seconds and accuracy of structure from motion."""
    rows: list[Row] = []
    flat = [field.name for field in fields(Row) if field.name != "accuracy"]
    with output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*flat, *(field.name for field in fields(Accuracy))])
        writer.writeheader()
        for capture in captures:
            for quality in qualities.split(","):
                scenes_folder = output.with_name(output.name + "-scenes")
                rows.append(measure(capture, quality, scenes_folder, seed=seed, threads=threads))
                content = asdict(rows[-1])
                writer.writerow({**{name: content[name] for name in flat}, **content["accuracy"]})
                file.flush()
    print_table(rows)


if __name__ == "__main__":
    typer.run(main)
