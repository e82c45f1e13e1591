"""From a folder of photos to a scene folder: poses, intrinsics and points by structure from motion.

The photos are not copied into the scene and not changed. The cameras refer to upright pictures, as
`media.images.read_image` gives them: pycolmap 4.2 does not apply the EXIF orientation, so it gets upright copies
of the photos that are stored lying down, in a temporary folder.
"""

import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from PIL import Image

import nerfcli
from nerfcli import scene
from nerfcli.atomic import atomic_folder, write_json
from nerfcli.errors import TOO_FEW_PHOTOS, UserError
from nerfcli.media.images import list_images, read_image
from nerfcli.poses.job import CameraGroup, Job, write_job
from nerfcli.poses.pairs import choose_pairs, estimated_seconds
from nerfcli.poses.photos import MIN_PHOTOS, Photo, Photos, camera_groups, find_photos
from nerfcli.poses.reasons import Evidence, dominant, reason
from nerfcli.poses.supervise import run_worker

# What may be asked for as `camera_model`.
CAMERA_MODELS = (
    "auto",
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
)
# From this many photos in a group on, OPENCV's eight intrinsics are well held; below, SIMPLE_RADIAL's four are.
_OPENCV_FROM = 20
# What pycolmap reads as we do, if stored upright. Of all else (CMYK, 16 bit, alpha, TIFF) it gets a JPEG copy.
_PLAIN = {("JPEG", ".jpg"), ("JPEG", ".jpeg"), ("MPO", ".jpg"), ("MPO", ".jpeg"), ("PNG", ".png")}

# Each holds a decoded photo.
_COPIERS = 4


@dataclass(frozen=True)
class PoseSettings:
    """What may be asked of structure from motion.

    max_image_size: longer side of the pictures that features are sought in, pixels. max_features: per photo.
    threads: -1 for all; with 1 thread the same seed gives the same poses. camera_model: one of `CAMERA_MODELS`.
    min_registered: the share of photos that must be placed, 0...1.
    """

    max_image_size: int = 1600
    max_features: int = 4096
    seed: int = 0
    threads: int = -1
    camera_model: str = "auto"
    min_registered: float = 0.5


@dataclass(frozen=True)
class ImageReport:
    """A photo, whether it was registered, and if not why."""

    name: str
    registered: bool
    reason: str | None


@dataclass(frozen=True)
class PosesReport:
    """What `poses_report.json` holds, under the same names.

    models: the sizes of all models found, the kept one first. attempts: what each run of the mapper gave.
    matching: the rule for pairs, and their number. points: how many the kept model has.
    """

    registered: int
    total: int
    seconds: dict[str, float]
    images: tuple[ImageReport, ...]
    mean_reprojection_error_px: float
    principal_point_refined: bool
    points: int
    cameras: tuple[dict[str, Any], ...]
    models: tuple[int, ...]
    attempts: tuple[dict[str, Any], ...]
    matching: dict[str, Any]
    settings: PoseSettings
    versions: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """Plain lists and dictionaries."""
        return asdict(self)


def estimate_poses(
    photos_dir: Path,
    scene_dir: Path,
    *,
    settings: PoseSettings,
    notify: Callable[[str], None],
    progress: Callable[[str, int, int], None],
) -> PosesReport:
    """Estimate where the photos of a folder were taken, and write a scene.

    Writes sparse/0 (the model with the most photos), scene.json and poses_report.json, all or nothing. A scene that
    stands at `scene_dir` is replaced.

    Args:
        photos_dir: the folder with the photos.
        scene_dir: the folder to write.
        settings: see `PoseSettings`.
        notify: told what the user should know, one sentence at a time.
        progress: told (stage, done, total); the stages are "read", "extract", "match" and "map", in this order.

    Raises:
        ValueError: a setting is out of its range.
        UserError: the photos are too few or cannot be read, too few of them could be placed (exit code 4), the
            scene cannot be written, or pycolmap died.
    """
    _check(settings)
    start = time.perf_counter()
    photos = find_photos(photos_dir, lambda done, total: progress("read", done, total))
    _check_destination(scene_dir, photos_dir)
    for name, why in photos.unreadable.items():
        notify(f"{name} is left out: {why}")
    with atomic_folder(scene_dir) as folder:
        work = folder / "work"
        work.mkdir()
        matching, job = _prepare(photos, settings, work=work, notify=notify)
        write_job(work / "job.json", job)
        run_worker(work / "job.json", threads=settings.threads, progress=progress)
        result = _read_json(work / "result.json")
        result["seconds"]["total"] = round(time.perf_counter() - start, 3)
        report = _report(photos, settings, result=result, matching=matching)
        _require_enough(report, photos_dir)
        (work / "sparse").rename(folder / "sparse")
        shutil.rmtree(work)
        write_json(folder / "poses_report.json", report.to_json())
        provenance = {"command": "poses", "settings": asdict(settings), "versions": report.versions}
        scene.save(folder, image_folder=photos_dir, provenance=provenance, unit="arbitrary")
    for size in report.models[1:]:
        notify(f"{size} photos form another model, which shares too little with the kept one of {report.models[0]}")
    return report


def is_same_scene(scene_dir: Path, photos_dir: Path, settings: PoseSettings) -> bool:
    """Whether `scene_dir` was made from the photos that are in `photos_dir` now, with these settings, threads aside."""
    try:
        report = _read_json(scene_dir / "poses_report.json")
        made = scene_dir.resolve() / _read_json(scene_dir / scene.SCENE_FILE)["image_folder"]
        names = [path.name for path in list_images(photos_dir)]
    except (OSError, ValueError, KeyError, UserError):
        return False
    wanted = {key: value for key, value in asdict(settings).items() if key != "threads"}
    return (
        made.resolve() == photos_dir.resolve()
        and sorted(image["name"] for image in report["images"]) == sorted(names)
        and all(report["settings"].get(key) == value for key, value in wanted.items())
    )


def auto_camera_model(photos: int) -> str:
    """The COLMAP camera model that this many photos of one camera can hold."""
    return "OPENCV" if photos >= _OPENCV_FROM else "SIMPLE_RADIAL"


def _prepare(
    photos: Photos, settings: PoseSettings, *, work: Path, notify: Callable[[str], None]
) -> tuple[dict[str, Any], Job]:
    """Decide on cameras and pairs, and lay out the photos for the worker."""
    numbers = {name: number for number, name in enumerate(photos.names)}
    groups = tuple(
        _camera_group([numbers[name] for name in names], photos.photos, model=settings.camera_model)
        for names in camera_groups(photos.photos)
    )
    if len(groups) > 1:
        notify(f"{len(groups)} cameras, by EXIF and size: {', '.join(_described(group) for group in groups)}")
    pairing = choose_pairs(photos.names)
    threads = settings.threads if settings.threads > 0 else os.cpu_count() or 1
    seconds = estimated_seconds(len(pairing.pairs), max_features=settings.max_features, threads=threads)
    notify(f"{len(pairing.pairs)} pairs of photos to compare ({pairing.rule}), about {_duration(seconds)}")
    files = _lay_out(photos, work / "photos")
    job = Job(
        folder=str(work.absolute()),
        files=files,
        originals=str(photos.folder.absolute()),
        names=photos.names,
        groups=groups,
        pairs=pairing.pairs,
        max_image_size=settings.max_image_size,
        max_features=settings.max_features,
        seed=settings.seed,
        threads=settings.threads,
    )
    return {"rule": pairing.rule, "pairs": len(pairing.pairs)}, job


def _camera_group(members: Sequence[int], photos: Sequence[Photo], *, model: str) -> CameraGroup:
    first = photos[members[0]]
    model = auto_camera_model(len(members)) if model == "auto" else model
    return CameraGroup(photos=tuple(members), model=model, width=first.width, height=first.height)


def _lay_out(photos: Photos, folder: Path) -> tuple[str, ...]:
    """Give the worker each photo, upright, under its number: a link where the file will do, else a copy."""
    folder.mkdir()

    def lay_out(numbered: tuple[int, Photo]) -> str:
        number, photo = numbered
        original = (photos.folder / photo.name).absolute()
        if _is_plain(original, photo):
            target = folder / f"{number:05d}{original.suffix.lower()}"
            try:
                target.symlink_to(original)
            except OSError:  # Windows without the right to make links
                shutil.copyfile(original, target)
        else:
            target = folder / f"{number:05d}.jpg"
            upright = Image.fromarray(read_image(original)).convert("RGB")
            upright.save(target, quality=97, subsampling=0)
        return target.name

    with ThreadPoolExecutor(_COPIERS) as copiers:
        return tuple(copiers.map(lay_out, enumerate(photos.photos)))


def _is_plain(path: Path, photo: Photo) -> bool:
    with Image.open(path) as image:
        known = (image.format, path.suffix.lower()) in _PLAIN and image.mode in ("L", "RGB")
    return known and photo.exif.orientation == 1


def _report(photos: Photos, settings: PoseSettings, *, result: dict[str, Any], matching: dict[str, Any]) -> PosesReport:
    """Put what the worker found into words."""
    models: list[list[int]] = result["models"]
    images = {name: ImageReport(name, False, f"unreadable: {why}") for name, why in photos.unreadable.items()}
    for number, name in enumerate(photos.names):
        if models and number in models[0]:
            images[name] = ImageReport(name, True, None)
        else:
            elsewhere = max((len(model) for model in models[1:] if number in model), default=0)
            known = Evidence(**result["evidence"][number], other_model_size=elsewhere)
            images[name] = ImageReport(name, False, reason(known))
    return PosesReport(
        registered=len(models[0]) if models else 0,
        total=len(images),
        seconds=result["seconds"],
        images=tuple(images[name] for name in sorted(images)),
        mean_reprojection_error_px=result.get("mean_reprojection_error_px", 0.0),
        principal_point_refined=result.get("principal_point_refined", False),
        points=result.get("points", 0),
        cameras=tuple(result.get("cameras", ())),
        models=tuple(len(model) for model in models),
        attempts=tuple(result["attempts"]),
        matching=matching,
        settings=settings,
        versions={"nerfcli": nerfcli.__version__, **result["versions"]},
    )


def _require_enough(report: PosesReport, photos_dir: Path) -> None:
    if report.registered >= max(MIN_PHOTOS, report.settings.min_registered * report.total):
        return
    reasons = [image.reason for image in report.images if image.reason]
    kind, advice = dominant(reasons)
    example = next(text for text in reasons if text.startswith(kind))
    placed = f"only {report.registered} of {report.total} photos could be placed ({photos_dir})"
    raise UserError(f"{placed}; most of the others: {example}", advice, TOO_FEW_PHOTOS)


def _check(settings: PoseSettings) -> None:
    """Refuse values that pycolmap would die of."""
    if settings.max_image_size < 1 or settings.max_features < 1:
        raise ValueError(
            f"image size and features must be positive, got {settings.max_image_size} and {settings.max_features}"
        )
    if settings.camera_model not in CAMERA_MODELS:
        raise ValueError(f"camera_model must be one of {', '.join(CAMERA_MODELS)}, got {settings.camera_model}")
    if not 0 <= settings.min_registered <= 1:
        raise ValueError(f"min_registered must be within 0...1, got {settings.min_registered}")


def _check_destination(scene_dir: Path, photos_dir: Path) -> None:
    """Writing a scene replaces its folder: it must be no folder that holds something else, the photos least of all."""
    scene_path, photos_path = scene_dir.resolve(), photos_dir.resolve()
    hint = "choose another folder with -o"
    if photos_path.is_relative_to(scene_path):
        raise UserError(f"the scene {scene_dir} would take the place of the photos in {photos_dir}", hint)
    if scene_dir.exists() and not scene_dir.is_dir():
        raise UserError(f"cannot write the scene {scene_dir}: a file has this name", hint)
    if scene_dir.is_dir() and any(scene_dir.iterdir()) and not (scene_dir / "scene.json").is_file():
        raise UserError(f"cannot write the scene {scene_dir}: the folder holds something that is no scene", hint)


def _described(group: CameraGroup) -> str:
    return f"{len(group.photos)} photos {group.width}x{group.height} {group.model}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def _read_json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))
