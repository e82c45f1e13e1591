"""Recognise the format of a scan and read it."""

import json
from collections.abc import Callable
from pathlib import Path

from nerfcli.ct.formats import hdf5, heltomo, nikon, r2_gaussian, skyscan, stated_stack, transmission_transforms
from nerfcli.ct.formats.scan_options import ScanOptions
from nerfcli.ct.scan import SCENE_FILE, Scan, is_scan, load_scan
from nerfcli.errors import UserError

Reader = Callable[[Path, ScanOptions], Scan]
READERS: dict[str, Reader] = {
    "data-exchange": hdf5.read_data_exchange,
    "nxtomo": hdf5.read_nxtomo,
    "r2-gaussian": r2_gaussian.read_r2_gaussian,
    "nikon": nikon.read_nikon,
    "skyscan": skyscan.read_skyscan,
    "heltomo": heltomo.read_heltomo,
    "stack": stated_stack.read_stated_stack,
    "transmission-transforms": transmission_transforms.read_transmission_transforms,
}
OWN = "nerfcli-scan"
FORMATS_READ = (OWN, *READERS)


def recognise(path: Path) -> str | None:
    """Return the format of a scan; None for anything else, such as a folder of photos.

    Raises:
        UserError: it looks like a scan and cannot be read, or a folder holds several.
    """
    if path.is_dir():
        return OWN if is_scan(path) else _of_folder(path)
    suffix = path.suffix.lower()
    if not path.is_file():
        return None
    if suffix in hdf5.SUFFIXES:
        return hdf5.hdf5_form(path)
    if suffix in nikon.SUFFIXES:
        return "nikon"
    if suffix in skyscan.SUFFIXES:
        return "skyscan" if b"Object to Source" in path.read_bytes() else None
    if suffix == ".mat":
        return "heltomo"
    if path.name == r2_gaussian.NAME:
        return "r2-gaussian"
    if path.name == stated_stack.NAME or (suffix == ".json" and _states_stack(path)):
        return "stack"
    if path.name == SCENE_FILE and is_scan(path.parent):
        return OWN
    if (suffix == ".npy" or path.name in transmission_transforms.TRANSFORMS) and _has_transforms(path.parent):
        return "transmission-transforms"
    return None


def read_scan(path: Path, given: ScanOptions = ScanOptions()) -> Scan:
    """Read a scan in any supported format.

    Raises:
        UserError: it is no scan, or cannot be read.
    """
    form = recognise(path)
    if form is None:
        raise UserError(f"{path} is not a scan in a supported format", f"supported formats: {', '.join(FORMATS_READ)}")
    if form == OWN:
        if given != ScanOptions():
            raise UserError(f"{path} is a scan that was converted already", "set options when converting it")
        return load_scan(path if path.is_dir() else path.parent)
    return READERS[form](_file_of(path, form), given)


def _of_folder(path: Path) -> str | None:
    if (path / r2_gaussian.NAME).is_file():
        return "r2-gaussian"
    if (path / stated_stack.NAME).is_file():
        return "stack"
    if _has_transforms(path):
        return "transmission-transforms"
    for form, suffixes in (("nikon", nikon.SUFFIXES), ("skyscan", skyscan.SUFFIXES)):
        files = _with_suffix(path, suffixes)
        if form == "skyscan":
            files = [file for file in files if b"Object to Source" in file.read_bytes()]
        if len(files) > 1:
            raise UserError(f"{path} holds several scans: {files[0].name}, {files[1].name}", "give the file of one")
        if files:
            return form
    return None


def _file_of(path: Path, form: str) -> Path:
    """Return the file that describes the scan of a folder."""
    suffixes = {"nikon": nikon.SUFFIXES, "skyscan": skyscan.SUFFIXES}.get(form)
    return path if suffixes is None or path.is_file() else _with_suffix(path, suffixes)[0]


def _with_suffix(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes and file.is_file())


def _has_transforms(folder: Path) -> bool:
    """Return whether the transforms of a folder describe transmissions; those of photos do not state a measurement."""
    file = folder / transmission_transforms.TRANSFORMS[0]
    if not file.is_file() or not (folder / transmission_transforms.NAME).is_file():
        return False
    try:
        return "transmission" in str(json.loads(file.read_text(encoding="utf-8")).get("measurement"))
    except (OSError, ValueError, AttributeError, RecursionError):
        return False


def _states_stack(path: Path) -> bool:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and {"projections", "kind", "beam"} <= set(content)
