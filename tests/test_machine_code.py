"""nerfcli.kernels.numba_cpu.machine_code: compiled kernels belong to the current sources."""

import errno
import os
from pathlib import Path

import pytest

from nerfcli.errors import UserError
from nerfcli.kernels import numba_cpu
from nerfcli.kernels.numba_cpu.machine_code import discard_outdated, folder, is_there


@pytest.fixture
def compiled(tmp_path: Path) -> Path:
    """A folder with two sources and a cache with the machine code compiled from them."""
    for name in ("caller.py", "called.py"):
        (tmp_path / name).write_text(f"# {name}\n")
    (tmp_path / "cache").mkdir()
    discard_outdated(tmp_path.glob("*.py"), tmp_path / "cache")
    compile_again(tmp_path)
    return tmp_path


def compile_again(place: Path) -> None:
    for name in ("caller.f-1.py311.nbi", "caller.f-1.py311.1.nbc", "caller.cpython-311.pyc"):
        (place / "cache" / name).write_text("code")


def left(place: Path) -> set[str]:
    return {path.suffix for path in (place / "cache").iterdir()}


def test_machine_code_of_these_sources_stays(compiled):
    discard_outdated(compiled.glob("*.py"), compiled / "cache")
    assert left(compiled) == {".nbi", ".nbc", ".pyc", ".blake2b"}


@pytest.mark.parametrize("change", ["edited", "renamed", "added", "removed"])
def test_a_change_of_any_source_discards_the_machine_code_of_all(compiled, change):
    if change == "edited":  # as long as before: Numba itself compares only size and time
        (compiled / "called.py").write_text("# callee.py\n"[: len("# called.py\n")])
    elif change == "renamed":
        (compiled / "called.py").rename(compiled / "other.py")
    elif change == "added":
        (compiled / "new.py").write_text("")
    else:
        (compiled / "called.py").unlink()
    discard_outdated(compiled.glob("*.py"), compiled / "cache")
    assert left(compiled) == {".pyc", ".blake2b"}
    compile_again(compiled)
    discard_outdated(compiled.glob("*.py"), compiled / "cache")
    assert ".nbi" in left(compiled)


def test_machine_code_of_nobody_knows_what_is_discarded(compiled):
    (compiled / "cache" / "sources.blake2b").unlink()
    discard_outdated(compiled.glob("*.py"), compiled / "cache")
    assert left(compiled) == {".pyc", ".blake2b"}


def test_it_is_looked_for_where_numba_keeps_it():
    numba_cpu.warm_up()
    assert is_there()
    assert list(folder().glob("visible._visible-*.nbi"))
    assert (folder() / "sources.blake2b").is_file()


def test_no_room_for_what_is_compiled_is_told(monkeypatch):
    def full(*arguments: object, **named: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(numba_cpu, "visible_samples", full)
    with pytest.raises(UserError, match=r"cannot cache compiled kernels in .*: No space left on device") as caught:
        numba_cpu.warm_up()
    assert "NUMBA_CACHE_DIR" in caught.value.hint
