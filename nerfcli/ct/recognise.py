"""What a path is to the commands for scans: a scan folder, a scan in a scanner's format, or a reconstruction.

Only names and the beginnings of files are read, and nothing heavy is imported but h5py for HDF5: commands for photos
ask this before they load anything.
"""

import os
from pathlib import Path
from typing import Any

from nerfcli.errors import UserError

MEASUREMENT = "transmission"
# The files that make a folder a scan, or a reconstruction of one.
SCENE_FILE, DESCRIPTION = "scene.json", "reconstruction.json"
_MEASURED = f'"measurement": "{MEASUREMENT}"'
# Formats of scans: that of nerfcli, and those of files with these names, or these suffixes, that have these words.
OWN = "nerfcli-scan"
STACK, R2_GAUSSIAN = "scan.json", "meta_data.json"
TRANSFORMS, TRANSFORMS_GEOMETRY = ("transforms_train.json", "transforms_test.json"), "geometry.json"
_NAMED = {STACK: ("stack", '"projections"'), R2_GAUSSIAN: ("r2-gaussian", '"scanner"'), SCENE_FILE: (OWN, _MEASURED)}
_SUFFIXES = {"nikon": (".xtekct", ""), "skyscan": (".log", "Object to Source")}
_HDF5 = (".h5", ".hdf5", ".hdf", ".nxs", ".nx")
# Suffixes of volumes, the default first.
VOLUMES = (".nrrd", ".mha", ".nii", ".tif")
_BEGINNING_BYTES = 2**20


def is_scan(path: Path) -> bool:
    """Return whether a folder holds a scan that `save_scan` wrote."""
    return _has(path / SCENE_FILE, _MEASURED)


def is_reconstruction(run: Path) -> bool:
    """Return whether a folder is a run that `save_reconstruction` wrote."""
    return _has(run / DESCRIPTION, _MEASURED)


def recognise(path: Path) -> str | None:
    """Return the format of a scan; None for anything else, such as a folder of photos.

    Raises:
        UserError: it looks like a scan and cannot be read, or a folder holds several.
    """
    if not os.path.isdir(path):  # names may be too long for Path.is_dir
        return _of_file(path) if os.path.isfile(path) else None
    for name, (form, word) in _NAMED.items():
        if _has(path / name, word):
            return form
    if _has_transforms(path):
        return "transmission-transforms"
    for form in _SUFFIXES:
        files = files_of(path, form)
        if len(files) > 1:
            raise UserError(f"{path} holds several scans: {files[0].name}, {files[1].name}", "give one of these files")
        if files:
            return form
    return None


def files_of(folder: Path, form: str) -> list[Path]:
    """Return the files of a folder that describe a scan in the format of a scanner; none for other formats.

    Raises:
        UserError: the folder cannot be read.
    """
    suffix, word = _SUFFIXES.get(form, ("/", ""))
    try:
        files = sorted(folder.iterdir())
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror}", "make the folder readable") from error
    return [file for file in files if file.suffix.lower() == suffix and _has(file, word)]


def open_hdf5(path: Path) -> Any:
    """Open an HDF5 file to read.

    Raises:
        UserError: it does not exist, or is damaged.
    """
    import h5py

    try:
        return h5py.File(path, "r")
    except OSError as error:
        if not path.exists():
            raise UserError(f"{path} does not exist", "give the path of an HDF5 file") from error
        raise UserError(f"{path} cannot be read as HDF5: {error}", "it is damaged: copy it again") from error


def datasets_in(file: Any) -> list[str]:
    """Return the names of all datasets of an HDF5 file, in the order of the file."""
    import h5py

    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return names


def _of_file(path: Path) -> str | None:
    suffix = path.suffix.lower()
    if suffix in _HDF5:
        return _hdf5_form(path)
    if suffix == ".mat":
        return "heltomo"
    for form, (own, word) in _SUFFIXES.items():
        if suffix == own and _has(path, word):
            return form
    form, word = _NAMED.get(path.name, ("stack", '"beam"'))
    if suffix == ".json" and _has(path, word) and (form != "stack" or _has(path, '"projections"')):
        return form
    if (suffix == ".npy" or path.name in TRANSFORMS) and _has_transforms(path.parent):
        return "transmission-transforms"
    return None


def _hdf5_form(path: Path) -> str | None:
    """Return "data-exchange", "nxtomo", or None for other HDF5 files."""
    with open_hdf5(path) as file:
        if "exchange/data" in file or "exchange" in file:
            return "data-exchange"
        return "nxtomo" if any(name.rpartition("/")[2] == "image_key" for name in datasets_in(file)) else None


def _has_transforms(folder: Path) -> bool:
    """Return whether the transforms of a folder describe transmissions; those of photos do not state a measurement."""
    return os.path.isfile(folder / TRANSFORMS_GEOMETRY) and _has(folder / TRANSFORMS[0], '"measurement"', MEASUREMENT)


def _has(path: Path, *words: str) -> bool:
    """Return whether a file can be read and the beginning of it has all of the words."""
    try:
        with path.open("rb") as file:
            beginning = file.read(_BEGINNING_BYTES)
    except (OSError, ValueError):  # a ValueError for a name with a null byte
        return False
    return all(word.encode() in beginning for word in words)
