"""nerfcli.kernels.numba_cpu.machine_code: compiled kernels belong to the current sources."""

import errno
import os
import subprocess
from pathlib import Path

import pytest
import torch

from nerfcli import child
from nerfcli.errors import UserError
from nerfcli.kernels import numba_cpu
from nerfcli.kernels.numba_cpu import compile_all, machine_code
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


def test_machine_code_of_unknown_sources_is_discarded(compiled):
    (compiled / "cache" / "sources.blake2b").unlink()
    discard_outdated(compiled.glob("*.py"), compiled / "cache")
    assert left(compiled) == {".pyc", ".blake2b"}


def test_it_is_looked_for_where_numba_keeps_it():
    numba_cpu.warm_up()
    assert is_there()
    assert list(folder().glob("visible._visible-*.nbi"))
    assert (folder() / "sources.blake2b").is_file()


def test_no_room_for_machine_code_is_reported(monkeypatch):
    def full(*arguments: object, **named: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(compile_all, "visible_samples", full)
    with pytest.raises(UserError, match=r"cannot cache compiled kernels in .*: No space left on device") as caught:
        numba_cpu.warm_up()
    assert "NUMBA_CACHE_DIR" in caught.value.hint


class TestSecondProcess:
    """Nothing is compiled: the kernels are on disk, though `is_there` says that they are not."""

    @pytest.fixture
    def started(self, monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
        monkeypatch.setattr(machine_code, "is_there", lambda: False)
        started, spawn = [], child.spawn

        def record(*arguments, **named):
            started.append(spawn(*arguments, **named))
            return started[-1]

        monkeypatch.setattr(child, "spawn", record)
        return started

    def test_it_runs_the_kernels_that_render_and_ends(self, started):
        numba_cpu.warm_up()
        assert [process.returncode for process in started] == [0]

    def test_what_it_has_not_compiled_is_compiled_without_it(self, monkeypatch, started):
        run = []
        monkeypatch.setattr(compile_all, "RENDERING_PROCESS", "nerfcli.no_such_module")
        monkeypatch.setattr(compile_all, "visible_samples", lambda *a: run.append(1) or numba_cpu.visible_samples(*a))
        numba_cpu.warm_up()
        assert [process.returncode for process in started] == [1]
        assert run

    def test_one_that_cannot_be_started_is_done_without(self, monkeypatch, started):
        def refuse(*arguments, **named):
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

        monkeypatch.setattr(child, "spawn", refuse)
        numba_cpu.warm_up()
        assert not started

    def test_an_interrupt_ends_it(self, monkeypatch, started):
        def interrupt(*arguments, **named):
            raise KeyboardInterrupt

        monkeypatch.setattr(compile_all, "hash_encode", interrupt)
        with pytest.raises(KeyboardInterrupt):
            numba_cpu.warm_up()
        assert [process.returncode for process in started] == [-9]

    def test_one_thread_compiles_alone(self, started):
        torch.set_num_threads(1)
        numba_cpu.warm_up()
        assert not started
