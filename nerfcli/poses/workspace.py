"""A scene's folder while the scene is under construction, and the step that turns it into a scene.

    SCENE/work/          the completed stages: see `input.job`
    SCENE/database.db    features and matches, for the next call; COLMAP can read it
    SCENE/refused-model/ a model that the checks refused, instead of a scene
    SCENE/scene.json     written last: with it the folder is a scene

The process that works in the folder holds its lock. If it is killed, the lock is released and the next one continues.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nerfcli.atomic import atomic_folder, clear_leftovers, exclusive, refuse_read_only
from nerfcli.captures.calibration import Calibration
from nerfcli.captures.formats.scene_folder import SCENE_FILE
from nerfcli.errors import UserError
from nerfcli.photos.images import list_photos, name_in
from nerfcli.photos.masks import find_mask
from nerfcli.poses.input.job import database_path, file_key, stage_key
from nerfcli.poses.input.settings import PoseSettings

_LOCK = "poses.lock"
# Folder of a model that the checks refused; nothing takes a folder of this name for a scene.
REFUSED = "refused-model"
POINTS_FILE = "points.ply"


@contextmanager
def workspace(scene_dir: Path) -> Iterator[int]:
    """Open the work folder of a scene, for one process at a time.

    Yields a descriptor of the lock that the worker inherits, so that the lock lasts until both have ended.

    Raises:
        UserError: another process is working there, or the folder cannot be written.
    """
    folder = scene_dir / "work"
    with exclusive(folder / _LOCK, f"nerfcli poses is working on {scene_dir}") as lock:
        for place in (scene_dir, folder):
            clear_leftovers(place)
        yield lock


def publish(scene_dir: Path, describe: Callable[[], None]) -> None:
    """Copy the worker's model into the scene; then `describe` writes the report and, last, scene.json.

    In between, the folder is not a scene, and another call continues from the complete model.
    """
    work = scene_dir / "work"
    with atomic_folder(scene_dir / "sparse") as sparse:
        shutil.copytree(work / "sparse" / "0", sparse / "0")
        (scene_dir / SCENE_FILE).unlink(missing_ok=True)  # an earlier scene stays if the disk is full
    describe()
    shutil.rmtree(scene_dir / REFUSED, ignore_errors=True)
    for path in work.iterdir():
        if path.suffix in (".json", ".lock") and path.stem not in ("job", "result"):
            continue
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def keep_refused(scene_dir: Path, folder: Path) -> Path:
    """Copy the worker's model to `folder`/refused-model, with its points as PLY, and return that folder."""
    import pycolmap

    found = scene_dir / "work" / "sparse" / "0"
    with atomic_folder(folder / REFUSED) as target:
        shutil.copytree(found, target, dirs_exist_ok=True)
        pycolmap.Reconstruction(found).export_PLY(target / POINTS_FILE)
    return folder / REFUSED


def database_bytes(scene_dir: Path) -> int:
    """Return the size of the database of features and matches, 0 if there is none."""
    path = database_path(scene_dir / "work")
    return path.stat().st_size if path.exists() else 0


def check_destination(scene_dir: Path, photos_dir: Path, *, subfolders: bool) -> None:
    """Refuse a destination that cannot be written, or contains anything but a scene, since the scene replaces it."""
    scene_path, photos_path = scene_dir.resolve(), photos_dir.resolve()
    hint = "choose another folder with -o"
    if photos_path.is_relative_to(scene_path):
        raise UserError(f"the scene {scene_dir} would overwrite the photos in {photos_dir}", hint)
    if subfolders and scene_path.is_relative_to(photos_path):
        raise UserError(
            f"the pictures in {scene_dir} would count as photos, as it is a subfolder of {photos_dir}", hint
        )
    if scene_dir.exists() and not scene_dir.is_dir():
        raise UserError(f"cannot write the scene {scene_dir}: a file with this name exists", hint)
    ours = (scene_dir / SCENE_FILE).is_file() or (scene_dir / "work" / _LOCK).is_file()
    if scene_dir.is_dir() and any(scene_dir.iterdir()) and not ours:
        raise UserError(f"cannot write the scene {scene_dir}: the folder contains other files", hint)
    refuse_read_only(scene_dir / "work")


def is_same_scene(
    scene_dir: Path, photos_dir: Path, settings: PoseSettings, *, given: Calibration | None = None
) -> bool:
    """Return whether a scene was made from these photos with these settings, apart from threads and accept_refused."""
    try:
        report = read_json(scene_dir / "poses_report.json")
        made = scene_dir.resolve() / read_json(scene_dir / SCENE_FILE)["image_folder"]
        listed = list_photos(photos_dir, subfolders=settings.subfolders)
        names = [name_in(photos_dir, path) for path in (*listed.pictures, *listed.unreadable)]
        earlier = report.get("intrinsics")
        files = {key: value for key, value in report["matching"].items() if key.endswith("_key")}
        made_with = asdict(PoseSettings()) | report["settings"]  # settings newer than the report had their defaults
        if "search" not in report and made_with["max_features"] == 4096:
            made_with["max_features"] = None  # it was the default
        wanted = {key: value for key, value in asdict(settings).items() if key not in ("threads", "accept_refused")}
        return (
            made.resolve() == photos_dir.resolve()
            and sorted(image["name"] for image in report["images"]) == sorted(names)
            and (earlier and earlier["key"]) == (given and given.key)
            and all(made_with[key] == value for key, value in wanted.items())
            and files.items() <= hash_inputs(photos_dir, settings).items()
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, UserError):  # a file is missing or damaged
        return False


def hash_inputs(photos_dir: Path, settings: PoseSettings) -> dict[str, str]:
    """Return hashes of the photos, of their masks, and of the files that the settings name, for the report."""
    pictures = list_photos(photos_dir, subfolders=settings.subfolders).pictures
    named = {"pairs_file_key": settings.pairs_file, "holdout_key": settings.holdout}
    keys = {key: file_key(Path(file)) for key, file in named.items() if file is not None and Path(file).is_file()}
    of_many = {"photos_key": pictures}
    if settings.masks is not None:
        masks = (find_mask(name_in(photos_dir, path), Path(settings.masks)) for path in pictures)
        of_many["masks_key"] = [path for path in masks if path is not None]

    def named_key(path: Path) -> tuple[str, str]:
        return path.name, file_key(path) if os.access(path, os.R_OK) else ""

    with ThreadPoolExecutor() as readers:
        return keys | {key: stage_key(*readers.map(named_key, paths)) for key, paths in of_many.items()}


def read_json(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))
