"""Locate the capture of a format at a path; each finder returns its file or folder, or None.

A folder is recognised by the names of files in it, a file by its suffix and its beginning.
"""

from collections.abc import Callable
from pathlib import Path

from nerfcli.cameras.formats.bundler import BEGINS as BUNDLER_BEGINS
from nerfcli.cameras.formats.camera_path import is_camera_path
from nerfcli.cameras.formats.colmap import is_model
from nerfcli.cameras.formats.fields import read_json_object
from nerfcli.scene import SCENE_FILE

MODEL_FILES = tuple(
    f"{name}{suffix}" for name in ("cameras", "images", "points3D", "rigs", "frames") for suffix in (".bin", ".txt")
)

_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", ".")


def named(*names: str) -> Callable[[Path], Path | None]:
    """Return a finder of the first of these files in a folder."""

    def find(path: Path) -> Path | None:
        return next((path / name for name in names if (path / name).is_file()), None)

    return find


def by_suffix(suffix: str, *names: str) -> Callable[[Path], Path | None]:
    """Return a finder of a file by its suffix, or of the first of these files in a folder."""
    in_folder = named(*names)
    return lambda path: path if path.is_file() and path.suffix.lower() == suffix else in_folder(path)


def find_scene(path: Path) -> Path | None:
    """Find the folder of a nerfcli scene."""
    folder = path.parent if path.name == SCENE_FILE else path
    return folder if (folder / SCENE_FILE).is_file() else None


def find_model(path: Path) -> Path | None:
    """Find the folder of a COLMAP model, or the one that a file of it is in."""
    if path.is_file():
        return path.parent if path.name in MODEL_FILES and is_model(path.parent) else None
    return next((path / name for name in _MODEL_FOLDERS if is_model(path / name)), None)


def find_blender(path: Path) -> Path | None:
    """Find a folder with a file of the Blender scenes."""
    return path if any((path / f"transforms_{split}.json").is_file() for split in ("train", "test", "val")) else None


def find_llff(path: Path) -> Path | None:
    """Find the folder of a poses_bounds.npy."""
    if path.is_file():
        return path.parent if path.name == "poses_bounds.npy" else None
    return path if (path / "poses_bounds.npy").is_file() else None


def find_bundler(path: Path) -> Path | None:
    """Find a file .out, Bundler's own in a folder, or the only one in it that begins as a file of Bundler does."""
    found = by_suffix(".out", "bundle.out", "bundle/bundle.out")(path)
    if found is not None or not path.is_dir():
        return found
    others = [other for other in sorted(path.glob("*.out")) if other.is_file() and _begins(other, BUNDLER_BEGINS)]
    return others[0] if len(others) == 1 else None


def _begins(path: Path, text: str) -> bool:
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        return stream.read(len(text)) == text


def find_json(path: Path, *, opening: str, name: str) -> Path | None:
    """Find a JSON file that begins with a bracket or a brace, or the one with this name in a folder."""
    if not path.is_file():
        return path / name if (path / name).is_file() else None
    if path.suffix.lower() != ".json":
        return None
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        return path if stream.read(1000).lstrip().startswith(opening) else None


def find_camera_path(path: Path) -> Path | None:
    """Find a JSON file that has the key camera_path and no frames, or the file camera_path.json of a folder."""
    found = find_json(path, opening="{", name="camera_path.json")
    if found is None or path.is_dir():
        return found
    # First searched as text, so that a large transforms.json is not parsed twice.
    if b'"camera_path"' not in found.read_bytes():
        return None
    return found if is_camera_path(read_json_object(found)) else None


def find_lines(path: Path, *, columns: int) -> Path | None:
    """Find a text file whose first line that is neither empty nor a comment has `columns` words."""
    if not path.is_file() or path.suffix.lower() != ".txt":
        return None
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        for _ in range(1000):
            line = stream.readline(10_000)
            if line.strip() and not line.lstrip().startswith("#"):
                return path if len(line.split()) == columns else None
    return None
