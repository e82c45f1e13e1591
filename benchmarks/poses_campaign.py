"""Structure from motion on a list of captures, as a new user runs it: `nerfcli poses PHOTOS` with defaults.

    python benchmarks/poses_campaign.py captures.toml -o before
    python benchmarks/poses_campaign.py captures.toml -o after --only fountain --limit 900

The list is a TOML file with a table per capture; paths are relative to the list's folder:

    [fountain]
    photos = "fountain-P11/images"             # a folder or a video
    truth = "fountain-P11/gt_dense_cameras"    # optional
    options = ["--quality", "fast"]            # optional, added to the command

Truth is any of: a COLMAP model, transforms.json or another file that `nerfcli convert` reads; a folder of .camera
files (Strecha's multi-view evaluation); a file of P matrices "name K R t" (Middlebury's *_par.txt); a folder with a
3 x 4 matrix per photo named PHOTO_P.txt. True cameras are resized to the photos' size.

Scenes, the output of each command (NAME.log) and its row (NAME.json) are kept in the folder OUT, and a capture that has
a row is not run again. Writes OUT.csv and prints a table. The command is `-m nerfcli` as found by PYTHONPATH, so that
two versions can be compared by two calls.

How to read it: CPU seconds are those of the command and its children, and vary little on a shared machine. ATE and
rotations are as in poses.py. If centres are nearly collinear or clumped, the similarity does not fix the rotations, and
"rel. deg", the median error of the rotation between two photos, is more informative. The lens error is the distance by
which pixels move when the lens found replaces the true one, over a grid of the photo and after the best-fitting
rotation: RMS, and the largest.
"""

import csv
import json
import os
import resource
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from poses import NAN, compare_poses
from rich.console import Console
from rich.table import Table
from scipy.linalg import rq
from scipy.spatial.transform import Rotation

from nerfcli import scene as scenes
from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.convert.conversion import ConventionOverrides, load
from nerfcli.convert.formats import UserInputs
from nerfcli.errors import UserError
from nerfcli.media.images import image_size, list_images

# Seconds that the command may take to save its work after SIGTERM.
GRACE_S = 30
GRID = 24


@dataclass(frozen=True)
class Capture:
    """A capture of the list, with absolute paths."""

    name: str
    photos: Path
    truth: Path | None
    options: tuple[str, ...]


@dataclass(frozen=True)
class View:
    """The truth of a photo: world_from_cam (4, 4), and its camera if that applies to the photo's pixels."""

    camera: Camera | None
    world_from_cam: np.ndarray


@dataclass(frozen=True)
class Row:
    """The results of one capture. exit_code is -1 if the time limit ended the command."""

    capture: str
    photos: int
    size: str
    exit_code: int
    seconds: float
    cpu_seconds: float
    registered: int
    reprojection_px: float
    verdict: str
    lens: str
    compared: int = 0
    ate: float = NAN
    rotation_median_deg: float = NAN
    rotation_worst_deg: float = NAN
    relative_rotation_deg: float = NAN
    focal_percent: float = NAN
    principal_point_px: float = NAN
    lens_rms_px: float = NAN
    lens_worst_px: float = NAN


def read_list(path: Path) -> list[Capture]:
    """Return the captures of a list."""
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    home = path.resolve().parent
    return [
        Capture(
            name,
            home / entry["photos"],
            home / entry["truth"] if "truth" in entry else None,
            tuple(entry.get("options", ())),
        )
        for name, entry in content.items()
    ]


def read_truth(path: Path, photos: Mapping[str, tuple[int, int]]) -> dict[str, View]:
    """Return the true cameras by photo name, resized to the photos' sizes (width, height)."""
    if path.is_dir() and any(path.glob("*.camera")):
        views = _strecha(path)
    elif path.is_dir() and any(path.glob("*_P.txt")):
        views = _projections(path, photos)
    elif path.name.endswith("_par.txt"):
        views = _middlebury(path, photos)
    else:
        _, _, capture = load(path, UserInputs(), ConventionOverrides())
        views = {Path(frame.name).name: View(frame.camera, frame.world_from_cam) for frame in capture.frames}
    return {name: _resized(views[name], size) for name, size in photos.items() if name in views}


def _resized(view: View, size: tuple[int, int]) -> View:
    try:
        camera = None if view.camera is None else view.camera.resized(*size)
    except UserError:  # the photos were cropped or undistorted after their poses were found
        camera = None
    return View(camera, view.world_from_cam)


def _strecha(folder: Path) -> dict[str, View]:
    """Read NAME.camera: K (3 rows), three zeros, world_from_cam's rotation (3 rows), the centre, width and height."""
    views = {}
    for path in sorted(folder.glob("*.camera")):
        numbers = np.array(path.read_text(encoding="utf-8").split(), dtype=np.float64)
        k, rotation = numbers[:9].reshape(3, 3), numbers[12:21].reshape(3, 3)
        camera = Camera("PINHOLE", int(numbers[24]), int(numbers[25]), (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        views[path.stem] = View(camera, rigid.from_parts(rigid.nearest_rotation(rotation), numbers[21:24]))
    return views


def _middlebury(path: Path, photos: Mapping[str, tuple[int, int]]) -> dict[str, View]:
    """Read a line per photo: its name, K, cam_from_world's rotation and translation."""
    views = {}
    for line in path.read_text(encoding="utf-8").splitlines()[1:]:
        name, *words = line.split()
        numbers = np.array(words, dtype=np.float64)
        if name in photos:
            views[name] = _pinhole_view(
                numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:], size=photos[name]
            )
    return views


def _projections(folder: Path, photos: Mapping[str, tuple[int, int]]) -> dict[str, View]:
    """Read PHOTO_P.txt: K [R | t] up to scale, perhaps after a line CONTOUR; PHOTO may lack its suffix."""
    views = {}
    for name, size in photos.items():
        path = next(folder.glob(f"{Path(name).stem.split('.')[0]}_P.txt"), None)
        if path is not None:
            words = path.read_text(encoding="utf-8").replace("CONTOUR", "").split()
            p = np.array(words[:12], dtype=np.float64).reshape(3, 4)
            k, rotation = rq(p[:, :3])
            signs = np.diag(np.sign(np.diag(k)))
            k, rotation = k @ signs, signs @ rotation
            translation = np.linalg.solve(k, p[:, 3])
            if np.linalg.det(rotation) < 0:
                rotation, translation = -rotation, -translation
            views[name] = _pinhole_view(k / k[2, 2], rotation, translation, size=size)
    return views


def _pinhole_view(k: np.ndarray, rotation: np.ndarray, translation: np.ndarray, *, size: tuple[int, int]) -> View:
    # In these formats the centre of the first pixel is 0; here it is 0.5.
    camera = Camera("PINHOLE", *size, (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5))
    return View(camera, rigid.inverse(rigid.from_parts(rigid.nearest_rotation(rotation), translation)))


def lens_error(true: Camera, found: Camera) -> tuple[float, float]:
    """Return the distance in pixels (RMS, largest) between two lenses of one photo, after the best-fitting rotation."""
    axes = [(np.arange(GRID) + 0.5) * length / GRID for length in (true.width, true.height)]
    pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    (seen, valid), (other, other_valid) = true.bearings(pixels), found.bearings(pixels)
    both = valid & other_valid
    if both.sum() < 3:
        return NAN, NAN
    rotation = Rotation.align_vectors(other[both], seen[both])[0]
    again, projected = found.project(rotation.apply(seen[both]))
    distances = np.linalg.norm(again - pixels[both], axis=1)[projected]
    return float(np.sqrt(np.mean(distances**2))), float(distances.max())


def relative_rotation_deg(truth: Sequence[np.ndarray], found: Sequence[np.ndarray]) -> float:
    """Return the median error, over all pairs of photos, of the rotation between them."""
    one, other = np.triu_indices(len(truth), 1)

    def between(poses: Sequence[np.ndarray]) -> Rotation:
        rotations = np.array(poses)[:, :3, :3]
        return Rotation.from_matrix(np.swapaxes(rotations[one], 1, 2) @ rotations[other])

    return float(np.degrees(np.median((between(truth).inv() * between(found)).magnitude())))


def run(capture: Capture, folder: Path, *, limit_s: float) -> tuple[int, float, float]:
    """Call `nerfcli poses` into folder/NAME; return exit code (-1: stopped), seconds and CPU seconds."""
    command = [sys.executable, "-P", "-m", "nerfcli", "poses", str(capture.photos), "-o", str(folder / capture.name)]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    with (folder / f"{capture.name}.log").open("w", encoding="utf-8") as log:
        child = subprocess.Popen(
            [*command, "--threads", "1", *capture.options],
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "COLUMNS": "200"},
        )
        try:
            code = child.wait(limit_s)
        except subprocess.TimeoutExpired:
            child.send_signal(signal.SIGTERM)
            try:
                child.wait(GRACE_S)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
            code = -1
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return code, time.monotonic() - start, cpu


def measure(capture: Capture, folder: Path, *, limit_s: float) -> Row:
    """Run a capture and compare its result with its truth."""
    code, seconds, cpu = run(capture, folder, limit_s=limit_s)
    return judge(capture, folder, exit_code=code, seconds=seconds, cpu_seconds=cpu)


def judge(capture: Capture, folder: Path, *, exit_code: int, seconds: float, cpu_seconds: float) -> Row:
    """Return the row of a capture whose command has ended."""
    sizes = _photo_sizes(capture)
    shapes = sorted({f"{width}x{height}" for width, height in sizes.values()})
    target = folder / capture.name
    content = _report(target)
    row = Row(
        capture=capture.name,
        photos=len(sizes),
        size=shapes[0] if len(shapes) == 1 else f"{len(shapes)} sizes",
        exit_code=exit_code,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        registered=content.get("registered", 0),
        reprojection_px=content.get("mean_reprojection_error_px") or NAN,
        verdict="accepted" if exit_code == 0 else _error_text(folder / f"{capture.name}.log"),
        lens=" ".join(dict.fromkeys(camera["model"] for camera in content.get("cameras", ()))),
    )
    if capture.truth is None or not (target / scenes.SCENE_FILE).exists():
        return row
    try:
        truth = read_truth(capture.truth, sizes)
    except UserError as error:
        return replace(row, verdict=f"{row.verdict} (no truth: {error})")
    found = {frame.name: frame for frame in scenes.load(target).frames}
    both = [name for name in found if name in truth]
    if len(both) < 3:
        return row
    accuracy = compare_poses(
        [truth[name].world_from_cam for name in both],
        [found[name].world_from_cam for name in both],
        missing=len(truth) - len(both),
    )
    lenses = np.array([_lens_numbers(truth[name].camera, found[name].camera) for name in both])
    estimated = lenses[~np.isnan(lenses).all(axis=1)]
    focal, centre, rms, worst = np.nanmedian(estimated, axis=0).tolist() if len(estimated) else [NAN] * 4
    return replace(
        row,
        compared=len(both),
        ate=accuracy.ate,
        rotation_median_deg=accuracy.rotation_median_deg,
        rotation_worst_deg=accuracy.rotation_worst_deg,
        relative_rotation_deg=relative_rotation_deg(
            [truth[name].world_from_cam for name in both], [found[name].world_from_cam for name in both]
        ),
        focal_percent=focal,
        principal_point_px=centre,
        lens_rms_px=rms,
        lens_worst_px=worst,
    )


def _lens_numbers(true: Camera | None, found: Camera) -> tuple[float, float, float, float]:
    if true is None:
        return NAN, NAN, NAN, NAN
    centre = float(np.hypot(*np.subtract(found.principal_point, true.principal_point)))
    return 100 * (found.focal_px / true.focal_px - 1), centre, *lens_error(true, found)


def _photo_sizes(capture: Capture) -> dict[str, tuple[int, int]]:
    if capture.photos.is_file():
        return {}
    sizes = {}
    for path in list_images(capture.photos):
        try:
            sizes[path.name] = image_size(path)
        except (UserError, OSError):  # the command reports it
            continue
    return sizes


def _report(target: Path) -> dict[str, Any]:
    """Return poses_report.json, which is also written on refusal; empty if the command ended before writing it."""
    path = target / "poses_report.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _error_text(log: Path) -> str:
    """Return the error and its hint, as the command printed them, or the last lines if there is none."""
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    first = next((number for number, line in enumerate(lines) if line.startswith("Error")), max(len(lines) - 2, 0))
    return " ".join(lines[first:])[:600]


def print_table(rows: Iterable[Row]) -> None:
    """Print one line per capture."""
    table = Table(title="nerfcli poses, capture by capture")
    names = (
        "capture",
        "photos",
        "size",
        "exit",
        "s",
        "CPU s",
        "placed",
        "px",
        "ATE",
        "deg",
        "rel. deg",
        "focal %",
        "lens px",
    )
    for name in names:
        table.add_column(name, justify="left" if name == "capture" else "right")
    table.add_column("verdict", overflow="fold")
    for row in rows:
        table.add_row(
            *(row.capture, str(row.photos), row.size, str(row.exit_code)),
            *(f"{row.seconds:.0f}", f"{row.cpu_seconds:.0f}", str(row.registered)),
            *(_text(row.reprojection_px, ".2f"), _text(row.ate, ".4f"), _text(row.rotation_median_deg, ".3f")),
            _text(row.relative_rotation_deg, ".3f"),
            *(_text(row.focal_percent, "+.2f"), _text(row.lens_rms_px, ".2f"), row.verdict),
        )
    Console(width=200).print(table)


def _text(value: float, form: str) -> str:
    return "" if np.isnan(value) else format(value, form)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write all numbers of all rows."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def main(
    captures: Annotated[Path, typer.Argument(help="The list, TOML.", exists=True, dir_okay=False)],
    output: Annotated[Path, typer.Option("-o", help="Folder of the scenes and rows; OUT.csv stands beside it.")],
    only: Annotated[str, typer.Option(help="Names of captures, with commas; all by default.")] = "",
    limit: Annotated[float, typer.Option(help="Seconds after which a command is stopped.")] = 900,
    again: Annotated[bool, typer.Option("--judge-again", help="Compare with the truth again; run nothing.")] = False,
) -> None:
    """Run captures that have no row yet, and print all rows."""
    output.mkdir(parents=True, exist_ok=True)
    rows = []
    for capture in read_list(captures):
        kept = output / f"{capture.name}.json"
        if kept.exists():
            row = Row(**json.loads(kept.read_text(encoding="utf-8")))
            if again:
                row = judge(
                    capture,
                    output,
                    exit_code=row.exit_code,
                    seconds=row.seconds,
                    cpu_seconds=row.cpu_seconds,
                )
        elif not again and (not only or capture.name in only.split(",")):
            row = measure(capture, output, limit_s=limit)
        else:
            continue
        kept.write_text(json.dumps(asdict(row)), encoding="utf-8")
        rows.append(row)
    write_csv(output.with_name(f"{output.name}.csv"), rows)
    print_table(rows)


if __name__ == "__main__":
    typer.run(main)
