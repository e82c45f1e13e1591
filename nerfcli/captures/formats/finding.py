"""Locate the capture of a format at a path; each finder returns its file or folder, or None.

A folder is recognised by the names of files in it, a file by its suffix and its beginning.
"""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nerfcli.captures.formats import (
    alicevision,
    bundler,
    camera_path,
    colmap,
    mvsnet,
    neus,
    polycam,
    pose_files,
    record3d,
    run_cameras,
)
from nerfcli.captures.formats.fields import read_json_object
from nerfcli.errors import UserError

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


def folder_of(name: str) -> Callable[[Path], Path | None]:
    """Return a finder of the folder that holds this file, given the folder or the file."""

    def find(path: Path) -> Path | None:
        folder = path.parent if path.name == name else path
        return folder if (folder / name).is_file() else None

    return find


def find_model(path: Path) -> Path | None:
    """Find the folder of a COLMAP model, or the one that a file of it is in."""
    if path.is_file():
        return path.parent if path.name in colmap.MODEL_FILES and colmap.is_model(path.parent) else None
    return next((path / name for name in _MODEL_FOLDERS if colmap.is_model(path / name)), None)


def find_blender(path: Path) -> Path | None:
    """Find a folder with a file of the Blender scenes."""
    return path if any((path / f"transforms_{split}.json").is_file() for split in ("train", "test", "val")) else None


def find_bundler(path: Path) -> Path | None:
    """Find a file .out, Bundler's own in a folder, or the only one in it that begins as a file of Bundler does."""
    return by_suffix(".out", "bundle.out", "bundle/bundle.out")(path) or _only(path, "*.out", bundler.BEGINS)


def find_reality_capture(path: Path) -> Path | None:
    """Find a file .csv, or the only one in a folder that begins with the header of such a table."""
    return by_suffix(".csv")(path) or _only(path, "*.csv", "#name,")


def _only(folder: Path, pattern: str, begins: str) -> Path | None:
    """Return the file in a folder that matches a pattern and begins with a text, if there is only one."""
    found = [path for path in sorted(folder.glob(pattern)) if path.is_file() and _begins(path, begins)]
    return found[0] if len(found) == 1 else None


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


def find_alicevision(path: Path) -> Path | None:
    """Find a file .sfm, or a .json that is a reconstruction of AliceVision."""
    found = by_suffix(".sfm", *alicevision.FILES)(path)
    if found is None and path.is_file() and path.suffix.lower() == ".json":
        return path if _has_keys(path, b'"featuresFolders"', alicevision.is_alicevision) else None
    return found


def find_transforms(path: Path) -> Path | None:
    """Find transforms.json in a folder, or a JSON file of an object that is none of another format."""
    others = (run_cameras.find_run, find_camera_path, find_alicevision, find_record3d)
    if path.is_file() and any(find(path) is not None for find in others):
        return None
    return find_json(path, opening="{", name="transforms.json")


def find_record3d(path: Path) -> Path | None:
    """Find the file metadata.json, or metadata, of a capture by Record3D."""
    found = path if path.is_file() and path.name in record3d.FILES else named(*record3d.FILES)(path)
    return found if found is not None and _has_keys(found, b'"poses"', record3d.is_record3d) else None


def _has_keys(path: Path, text: bytes, test: Callable[[dict[str, Any]], bool]) -> bool:
    """Return whether a JSON object passes a test; it is parsed only if it contains a text."""
    try:
        return text in path.read_bytes() and test(read_json_object(path))
    except UserError:  # damaged, or another program's file of this name
        return False


def find_polycam(path: Path) -> Path | None:
    """Find the folder that holds the keyframes of Polycam, or the one that they are in."""
    folder = path.parent if path.name == polycam.KEYFRAMES else path
    return folder if polycam.polycam_folders(folder) is not None else None


def find_neus(path: Path) -> Path | None:
    """Find a file .npz with the projections of IDR and NeuS, or a folder's file with one of their names."""
    found = named(*neus.FILES)(path) if path.is_dir() else path
    if found is None or found.suffix.lower() != ".npz" or not zipfile.is_zipfile(found):
        return None
    with zipfile.ZipFile(found) as archive:
        return found if f"{neus.FIRST}.npy" in archive.namelist() else None


def find_mvsnet(path: Path) -> Path | None:
    """Find the folder that holds cams/ of MVSNet."""
    return path if any((path / mvsnet.CAMERA_FOLDER).glob(mvsnet.CAMERA_FILES)) else None


def find_pose_files(path: Path) -> Path | None:
    """Find a folder with a text file for each pose, or the one that the folder of these files is in."""
    folder = path.parent if path.name in pose_files.POSE_FOLDERS else path
    files = pose_files.pose_files(folder) if folder.is_dir() else []
    return folder if files and pose_files.is_pose(files[0]) else None


def find_camera_path(path: Path) -> Path | None:
    """Find a JSON file that has the key camera_path and no frames, or the file camera_path.json of a folder."""
    found = find_json(path, opening="{", name="camera_path.json")
    if found is None or path.is_dir():
        return found
    return found if _has_keys(found, b'"camera_path"', camera_path.is_camera_path) else None


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
