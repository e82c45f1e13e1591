"""Convert a scan in any format to a scan folder."""

import os
from pathlib import Path
from typing import Any

from nerfcli.ct.describe import facts_of, in_words
from nerfcli.ct.formats.read import read_scan
from nerfcli.ct.formats.statement import ScanOptions
from nerfcli.ct.recognise import is_scan
from nerfcli.ct.scan import save_scan
from nerfcli.errors import UserError
from nerfcli.notices import Reporter
from nerfcli.output import Output

# Suffixes of scan files, which the name of a scan folder may not have.
_FILE_SUFFIXES = (".h5", ".hdf5", ".nxs", ".mat", ".npy", ".txt", ".json", ".tif", ".tiff", ".xtekct", ".log")


def convert_scan(
    source: Path,
    output: Output,
    *,
    given: ScanOptions = ScanOptions(),
    reporter: Reporter = Reporter(),
) -> dict[str, Any]:
    """Write a scan as a scan folder, and return its record as plain values.

    Args:
        source: a file or folder in a known format.
        output: the folder, whose path is given.

    Raises:
        UserError: the scan cannot be read or written, or the output exists.
    """
    target = output.at(source)
    if target.suffix.lower() in _FILE_SUFFIXES:
        raise UserError(f"{target}: a scan is written as a folder", f"give a folder, such as {target.stem}")
    if os.path.exists(target) and not (output.overwrite and is_scan(target)):
        what = "add --overwrite to replace it" if is_scan(target) else "choose another output path"
        raise UserError(f"{target} exists", what)
    if os.path.exists(target) and target.resolve() == source.resolve():
        raise UserError(f"{target} is the input itself", "choose another output path")
    scan = read_scan(source, given)
    reporter.note(f"{source}: {scan.history.get('format')}, {in_words(scan)}")
    for note in scan.history.get("notes", ()):
        reporter.note(note)
    save_scan(target, scan)
    return {"from": scan.history.get("format"), **facts_of(scan)}
