"""Cache of compiled kernels on disk, invalidated when the sources change.

Numba recompiles a kernel when its own file has changed, but not when functions that it calls in other files have. After
sources were replaced in place, as by `git pull`, old machine code worked on buffers of a new shape: a segmentation
fault, or wrong numbers. So all machine code is removed as soon as one of the sources has changed.
"""

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numba

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError

# The digest of the sources, beside the machine code.
_NOTE = "sources.blake2b"


@numba.njit(cache=True)
def _nothing() -> None:
    """Never called; it knows the folder where Numba caches the kernels of this folder."""


def folder() -> Path:
    """Return the cache folder: next to the kernels or, if that is not writable, in the user's cache."""
    # numba does not say what `njit` returns, and pyrefly infers a plain function.
    place = _nothing.stats.cache_path  # pyrefly: ignore[missing-attribute]
    assert place is not None  # it has cache=True
    return Path(place)


def is_there() -> bool:
    """Return whether compiled kernels are cached on disk."""
    return any(folder().glob("*.nbi"))


def sources() -> list[Path]:
    """Return the source files from which the machine code is compiled."""
    return list(Path(__file__).parent.parent.rglob("*.py"))


def discard_outdated(made_of: Iterable[Path], compiled: Path) -> None:
    """Remove the machine code in a folder unless it was compiled from exactly these sources."""
    made_of = list(made_of)
    try:
        if (compiled / _NOTE).read_text() == _digest(made_of):
            return
    except (OSError, ValueError):  # unknown sources
        pass
    for pattern in ("*.nbi", "*.nbc"):
        for path in compiled.glob(pattern):
            path.unlink(missing_ok=True)
    note_sources(made_of, compiled)


def note_sources(made_of: Iterable[Path], compiled: Path) -> None:
    """Record that the machine code in a folder is compiled from these sources."""
    with suppress(UserError), atomic_path(compiled / _NOTE) as partial:  # else machine code cannot be kept there either
        partial.write_text(_digest(made_of))


def _digest(made_of: Iterable[Path]) -> str:
    content = hashlib.blake2b()
    for path in sorted(made_of):
        content.update(path.name.encode() + b"\0" + path.read_bytes())
    return content.hexdigest()
