"""A scene's folder while the scene is under construction, and the step that turns it into a scene.

    SCENE/work/          the completed stages: see `stages`
    SCENE/database.db    features and matches, for the next call; COLMAP can read it
    SCENE/refused-model/ a model that the checks refused, instead of a scene
    SCENE/scene.json     written last: with it the folder is a scene

The process that works in the folder holds its lock. If it is killed, the lock is released and the next one continues.
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfcli.atomic import atomic_folder, clear_leftovers
from nerfcli.captures.formats.scene_folder import SCENE_FILE
from nerfcli.exclusive import exclusive
from nerfcli.poses.input.job import database_path

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


def is_under_construction(scene_dir: Path) -> bool:
    """Return whether an earlier call worked on a scene here, complete or not."""
    return (scene_dir / "work" / _LOCK).is_file()


def publish(scene_dir: Path, describe: Callable[[], None]) -> None:
    """Copy the worker's model into the scene; then `describe` writes the report and, last, scene.json.

    Until then the folder is not a scene, and another call continues from the complete model.
    """
    work = scene_dir / "work"
    (scene_dir / SCENE_FILE).unlink(missing_ok=True)
    with atomic_folder(scene_dir / "sparse") as sparse:
        shutil.copytree(work / "sparse" / "0", sparse / "0")
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
