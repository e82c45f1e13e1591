"""Read a scan in any format."""

import os
from collections.abc import Callable
from pathlib import Path

from nerfcli.ct.formats import hdf5, heltomo, nikon, r2_gaussian, skyscan, stated_stack, transmission_transforms
from nerfcli.ct.formats.assemble import ReaderOutput, scan_of
from nerfcli.ct.formats.statement import ScanOptions
from nerfcli.ct.recognise import OWN, files_of, recognise
from nerfcli.ct.scan import Scan, load_scan
from nerfcli.errors import UserError

# Reader of each format; its UserError says what cannot be read, is missing, or does not fit the rest.
READERS: dict[str, Callable[[Path], ReaderOutput]] = {
    "data-exchange": hdf5.read_data_exchange,
    "nxtomo": hdf5.read_nxtomo,
    "r2-gaussian": r2_gaussian.read_r2_gaussian,
    "nikon": nikon.read_nikon,
    "skyscan": skyscan.read_skyscan,
    "heltomo": heltomo.read_heltomo,
    "stack": stated_stack.read_stated_stack,
    "transmission-transforms": transmission_transforms.read_transmission_transforms,
}


def read_scan(path: Path, given: ScanOptions = ScanOptions()) -> Scan:
    """Read a scan in any supported format.

    Raises:
        UserError: it is no scan, or cannot be read.
    """
    form = recognise(path)
    if form is None:
        if not os.path.exists(path):
            raise UserError(f"{path} does not exist", "give the file or folder of a scan")
        formats = ", ".join((OWN, *READERS))
        raise UserError(f"{path} is not a scan in a supported format", f"supported formats: {formats}")
    if form == OWN:
        if given != ScanOptions():
            raise UserError(f"{path} is a scan that was converted already", "set options when converting it")
        return load_scan(path if path.is_dir() else path.parent)
    files = files_of(path, form) if path.is_dir() else []
    return scan_of(READERS[form](files[0] if files else path), given)
