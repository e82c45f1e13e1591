"""Captures in zip archives, as phones and cloud drives give them; also Record3D's .r3d, which are zip archives.

An archive is unpacked whole into a folder beside the result that the user asked for, never beside the archive unless
the result goes there. It comes from somebody else: nothing is written outside that folder, no links, and no more than
an archive of photos can hold.
"""

import hashlib
import re
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from nerfcli.atomic import atomic_folder, write_json
from nerfcli.captures.formats.fields import read_json_object
from nerfcli.captures.formats.registry import ARCHIVES, photo_folder, recognised
from nerfcli.errors import UserError, several
from nerfcli.notices import Progress, Reporter
from nerfcli.output import Output

# What is in the folder of an unpacked archive besides its files.
ARCHIVE_FILE = "archive.json"

# Photos hardly shrink when packed, and tables of text to a tenth: more than this is an attack ("zip bomb").
MOST_RATIO = 50
# Characters that a listing does not show as they are: controls, parts of characters, changes of the writing direction.
_HIDDEN = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff\u202a-\u202e\u2066-\u2069]")
_SMALL_BYTES = 100 << 20
MOST_FILES = 1_000_000
_BLOCK_BYTES = 1 << 20
# What macOS and Windows add to archives.
_LITTER = ("__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini")
_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, ValueError, RuntimeError),
    *(OverflowError, KeyError, IndexError),
)


def is_archive(path: Path) -> bool:
    """Return whether a path is a file with the suffix of such an archive."""
    return path.suffix.lower() in ARCHIVES and path.is_file()


def unpacked(path: Path, output: Output, *, reporter: Reporter) -> Path:
    """Return the folder of a capture: that of an archive's files, unpacked unless they are there; else the path itself.

    Args:
        output: where the result that is made of the capture goes; the files go to NAME-unpacked beside it, all or
            nothing. If it may be replaced, so may files of another archive; nothing else is ever replaced.

    Raises:
        UserError: the archive is damaged, encrypted, or not safe to unpack; or the folder contains something else.
    """
    if not is_archive(path):
        return path
    folder = output.at(path).absolute().parent / f"{path.stem}-unpacked"
    with _opened(path) as archive, reporter.stage(f"unpack {path.name}") as stage:
        members = _checked(path, archive.infolist())
        content = {"archive": path.name, "bytes": path.stat().st_size, "files": _digest(members)}
        if not _is_kept(folder, content, path, overwrite=output.overwrite):
            _extract(archive, members, folder, content, stage.progress)
            stage.note(f"{folder}: {several(len(members), 'file')} of {path.name}")
        else:
            stage.note(f"{folder} is kept: it has the files of {path.name}")
    return _innermost(folder)


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except NotImplementedError as error:  # a method of compression, such as Deflate64
        hint = "unpack it with another program, and give the folder"
        raise UserError(f"{path} cannot be unpacked: {error}", hint) from error
    except _DAMAGED as error:
        raise UserError(f"{path} is not a readable zip archive: {error}", "copy or download it again") from error


def _checked(path: Path, entries: list[zipfile.ZipInfo]) -> list[zipfile.ZipInfo]:
    """Return the files of an archive, without those that systems add, or refuse one that is not safe to unpack."""
    hint = "unpack it yourself if you trust its source, and give the folder"
    members: dict[str, zipfile.ZipInfo] = {}
    for entry in entries:
        entry.filename = entry.filename.replace("\\", "/")  # as some programs on Windows write it
        parts = PurePosixPath(entry.filename).parts
        wrong = not parts or ":" in entry.filename or entry.filename.startswith("/")
        if wrong or ".." in parts or _HIDDEN.search(entry.filename):
            raise UserError(f"{path} is not safe to unpack: it has a file named {entry.filename!r:.80}", hint)
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise UserError(f"{path} is not safe to unpack: {entry.filename} is a link or a device", hint)
        if entry.flag_bits & 1:
            raise UserError(f"{path} is encrypted", "unpack it with its password, and give the folder")
        if entry.is_dir() or parts[0] in _LITTER or parts[-1] in _LITTER or parts[-1].startswith("._"):
            continue
        if members.setdefault(entry.filename.casefold(), entry) is not entry:
            raise UserError(f"{path} is not safe to unpack: {entry.filename} is in it twice", hint)
    total = sum(entry.file_size for entry in members.values())
    if len(members) > MOST_FILES or total > max(_SMALL_BYTES, MOST_RATIO * path.stat().st_size):
        what = f"{several(len(members), 'file')} ({total / 1e9:.1f} GB) in {path.stat().st_size / 1e6:.1f} MB"
        raise UserError(f"{path} is not safe to unpack: it claims to hold {what}", hint)
    if not members:
        raise UserError(f"{path} contains no files", "copy or download it again")
    if all(PurePosixPath(name).suffix in ARCHIVES for name in members):
        inner = next(iter(members.values())).filename
        raise UserError(f"{path} contains only archives, such as {inner}", "unpack it, and give the archive in it")
    return list(members.values())


def _digest(members: list[zipfile.ZipInfo]) -> str:
    """Return a hash of the names, sizes and checksums of files."""
    lines = (f"{entry.filename}\t{entry.file_size}\t{entry.CRC}\n" for entry in members)
    return hashlib.blake2b("".join(lines).encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()


def _is_kept(folder: Path, content: dict[str, Any], path: Path, *, overwrite: bool) -> bool:
    """Return whether a folder has the files of an archive already; refuse one that must not be replaced."""
    if not folder.exists():
        return False
    record = folder / ARCHIVE_FILE
    found = read_json_object(record) if record.is_file() else None
    if found == content:
        return True
    if found is None or set(found) != set(content):
        hint = "choose another output, or move it away"
        raise UserError(f"cannot unpack {path} to {folder}: it contains other files", hint)
    if not overwrite:
        raise UserError(f"{folder} contains the files of another {found['archive']}", "add --overwrite to replace them")
    return False


def _extract(
    archive: zipfile.ZipFile, members: list[zipfile.ZipInfo], folder: Path, content: dict[str, Any], progress: Progress
) -> None:
    total = sum(entry.file_size for entry in members)
    home = next(parent for parent in folder.parents if parent.exists())
    if total > (free := shutil.disk_usage(home).free):
        hint = "free some space, or choose another output"
        raise UserError(f"{folder} would need {total / 1e9:.1f} GB, and {home} has only {free / 1e9:.1f} GB", hint)
    done = 0
    with atomic_folder(folder) as partial:
        for entry in members:
            place = partial / entry.filename
            place.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(entry) as source, place.open("xb") as target:
                while block := source.read(_BLOCK_BYTES):  # never more than the size that was checked
                    target.write(block)
                    done += len(block)
            progress(done / max(total, 1), "unpacking")
        write_json(partial / ARCHIVE_FILE, content)


def _innermost(folder: Path) -> Path:
    """Return the folder that has the capture: archives often hold one folder, which holds the files, and a note."""
    while recognised(folder) is None and photo_folder(folder) is None:
        inside = [path for path in folder.iterdir() if path.is_dir()]
        if len(inside) != 1:
            break
        folder = inside[0]
    return folder
