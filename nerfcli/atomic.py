"""Files and folders that are written completely or not at all; locks of files; JSON with a digest of its content.

Everything is written under a hidden name beside its destination and renamed when complete, so that a killed
command or a full disk leaves nothing behind that a later command would take for a result.
"""

import functools
import hashlib
import json
import os
import re
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EDQUOT, EFBIG, ENOSPC
from pathlib import Path
from typing import Any

from nerfcli.errors import UserError
from nerfcli.machine import is_running

# Leftovers of a killed process: a partial result, or an old result that it had just moved aside.
_LEFTOVER = re.compile(
    r"\.(?P<name>.+)\.(?P<kind>partial|old)-(?P<host>[0-9a-f]{6})-(?P<process>\d+)(\D.*)?", re.DOTALL
)
# Several machines may write into one folder, and know only their own processes. After this time, the leftovers of
# another machine, such as a container that has ended, count as such.
_ABANDONED_S = 48 * 3600.0


@functools.cache
def _host() -> str:
    """Return what tells this machine from others, as six characters."""
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:6]


def _own() -> str:
    """Return what tells this process from others, on this machine and on others."""
    return f"{_host()}-{os.getpid()}"


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Provide a temporary path with the suffix of `path`; renamed to `path` on success, removed on any exception.

    Raises:
        UserError: the folder cannot be created or written, or the disk is full.
    """
    partial = path.with_name(f".{path.stem}.partial-{_own()}{path.suffix}")
    with _write_errors_explained(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            yield partial
            os.replace(partial, path)
        finally:
            with suppress(OSError):  # the original error is more informative
                partial.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Provide a temporary folder that replaces `path` on success and is removed on any exception.

    A folder at `path` is replaced only in the last step; callers ask the user before. A link stays, and the folder that
    it leads to is replaced.

    Raises:
        UserError: as for `atomic_path`.
    """
    path = path.resolve()  # "." has no name, and a link to another disk stays
    partial = path.with_name(f".{path.name}.partial-{_own()}")
    with _write_errors_explained(path):
        try:
            clear_leftovers(path.parent)
            partial.mkdir(parents=True)
            yield partial
            replace_folder(partial, path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def replace_folder(complete: Path, path: Path) -> None:
    """Replace a folder by another, on the same disk; the old one is kept until the new one is in place.

    Raises:
        UserError: it cannot be moved.
    """
    path = path.resolve()
    old = path.with_name(f".{path.name}.old-{_own()}")
    with _write_errors_explained(path):
        try:
            clear_leftovers(path.parent)
            if path.exists():
                os.replace(path, old)
            try:
                os.replace(complete, path)
            except OSError:
                if old.exists():
                    os.replace(old, path)
                raise
        finally:
            shutil.rmtree(old, ignore_errors=True)


def clear_leftovers(folder: Path) -> None:
    """Remove leftovers of killed processes in a folder: partial results, and old results moved aside, which are
    restored if nothing has replaced them. Files of running processes are kept."""
    hidden = [path.name for path in folder.glob(".*")]
    for match in map(_LEFTOVER.fullmatch, hidden):
        if match is None:
            continue
        path, place = folder / match.string, folder / match["name"]
        with suppress(OSError):  # another command is doing the same, or the file does no harm
            if match["host"] != _host():
                if time.time() - path.stat().st_mtime < _ABANDONED_S:
                    continue
            elif is_running(int(match["process"])):
                continue
            if match["kind"] == "old" and not place.exists():
                os.replace(path, place)
            elif path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


@contextmanager
def exclusive(path: Path, holder: str) -> Iterator[int]:
    """Hold the lock of a file, which is created with its folder if necessary, until this process ends or is killed.

    Args:
        path: the file; its content is unused.
        holder: description of the holder for the error message: "nerfcli poses is at work on photos-scene".

    Yields:
        The descriptor. A child process that inherits it also holds the lock, until both have ended.

    Raises:
        UserError: another process holds the lock, or the file cannot be created.
    """
    from filelock import lock_descriptor

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise cannot_write(path.parent, error) from error
    try:
        if not lock_descriptor(lock, blocking=False):
            raise UserError(f"another {holder}", "wait until it has finished, or choose another folder with -o")
        yield lock
    finally:
        os.close(lock)


def write_json(path: Path, content: Any) -> None:
    """Write `content` as indented JSON, atomically. NaN and infinity are refused, since JSON cannot hold them."""
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    with atomic_path(path) as partial:
        # Names of files that are not UTF-8 have surrogates, whose escapes are those of JSON.
        partial.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def read_json(path: Path, *, needed: tuple[str, ...], hint: str) -> dict[str, Any]:
    """Read a JSON object from a file.

    Args:
        path: the file.
        needed: required keys.
        hint: advice for the error.

    Raises:
        UserError: it cannot be read, is not a JSON object, or lacks a key.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}", hint) from error
    except ValueError as error:
        raise UserError(f"cannot read {path}: it is not JSON: {error}", hint) from error
    if not isinstance(content, dict):
        raise UserError(f"cannot read {path}: it is not a JSON object", hint)
    if missing := [key for key in needed if key not in content]:
        raise UserError(f"cannot read {path}: it has no {', '.join(missing)}", hint)
    return content


def refuse_read_only(path: Path) -> None:
    """Refuse a path that cannot be written, before the work rather than after it.

    Raises:
        UserError: the nearest existing folder above `path` is not writable.
    """
    home = next(folder for folder in path.absolute().parents if folder.exists())
    if not os.access(home, os.W_OK):
        raise UserError(f"cannot write {path}: no write permission", f"make {home} writable, or use a folder that is")


def cannot_write(path: Path, error: OSError) -> UserError:
    """Return the two-line error for a result that could not be written."""
    reason = error.strerror or str(error)
    return UserError(
        f"cannot write {path}: {reason}",
        "choose a writable folder with -o or free some disk space, and run the same command again",
    )


@contextmanager
def _write_errors_explained(path: Path) -> Iterator[None]:
    """Convert errors of writing `path` to UserError; errors about other files pass through."""
    try:
        yield
    except OSError as error:
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        about_destination = any(Path(name).is_relative_to(path.parent) or path.is_relative_to(name) for name in names)
        if about_destination or not names or error.errno in (ENOSPC, EDQUOT, EFBIG):
            raise cannot_write(path, error) from error
        raise


SEAL = "blake2b"


def digest(value: Any) -> str:
    """Hash plain values; equal values have equal digests in every process and on every machine."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()


def write_sealed(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON object with the digest of its content, atomically.

    Raises:
        UserError: it cannot be written.
    """
    write_json(path, {**content, SEAL: digest(content)})


def read_sealed(path: Path) -> dict[str, Any]:
    """Read an object that `write_sealed` wrote; a file without a digest is accepted unchecked.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not a JSON object, or its content has changed.
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")
    if (seal := content.pop(SEAL, None)) is not None and seal != digest(content):
        raise ValueError("its content has changed since it was written")
    return content
