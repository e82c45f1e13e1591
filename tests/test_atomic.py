"""nerfcli.atomic: files and folders appear whole or not at all."""

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import listing

from nerfcli import atomic
from nerfcli.atomic import atomic_folder, atomic_path, clear_leftovers, read_json, replace_folder, write_json
from nerfcli.errors import BAD_INPUT, UserError


def names(folder) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("name", ["a.json", "with space ä.tar.gz"])
def test_a_file_appears_when_the_block_ends(tmp_path, name):
    path = tmp_path / "deep" / "folder" / name
    with atomic_path(path) as partial:
        assert partial.parent == path.parent
        assert partial.suffix == path.suffix
        assert partial.name.startswith(".")
        partial.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert names(path.parent) == [name]


@pytest.mark.parametrize("context", [atomic_path, atomic_folder])
@pytest.mark.parametrize("problem", [ValueError("ours"), KeyboardInterrupt(), UserError("wrong", "mend it")])
def test_an_exception_leaves_the_old_file_or_folder_and_nothing_else(tmp_path, problem, context):
    def written(place: Path, content: str) -> None:
        (place / content if context is atomic_folder else place).write_text(content)

    def interrupted():
        with context(path) as partial:
            written(partial, "half")
            raise problem

    path = tmp_path / "a.txt"
    if context is atomic_folder:
        path.mkdir()
    written(path, "old")
    before = listing(tmp_path)
    with pytest.raises(type(problem)) as caught:
        interrupted()
    assert caught.value is problem
    assert listing(tmp_path) == before
    assert names(tmp_path) == ["a.txt"]


def test_an_exception_before_anything_is_written(tmp_path):
    with pytest.raises(ZeroDivisionError), atomic_path(tmp_path / "a.txt"):
        _ = 1 / 0
    assert names(tmp_path) == []


def test_a_folder_in_the_place_of_the_file_is_reported(tmp_path):
    path = tmp_path / "folder"
    path.mkdir()
    with pytest.raises(UserError, match=r"folder: Is a directory") as caught, atomic_path(path) as partial:
        partial.write_text("new")
    assert caught.value.exit_code == BAD_INPUT
    assert names(tmp_path) == ["folder"]


@pytest.mark.parametrize("context", [atomic_path, atomic_folder])
def test_a_file_in_the_place_of_the_parent_folder_is_reported(tmp_path, context):
    (tmp_path / "file").write_text("I am no folder")
    with pytest.raises(UserError, match=r"cannot write .*result: "), context(tmp_path / "file" / "result"):
        pass
    assert names(tmp_path) == ["file"]


def test_a_block_that_writes_nothing_is_an_error(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(UserError, match=r"cannot write .*a\.txt: No such file"), atomic_path(path):
        pass
    assert names(tmp_path) == []


def test_a_folder_appears_when_the_block_ends_and_replaces_the_old_one(tmp_path):
    path = tmp_path / "deep" / "run ä"
    for content in ("first", "second"):
        with atomic_folder(path) as partial:
            assert partial.parent == path.parent
            (partial / f"{content}.txt").write_text(content)
            assert not (path / f"{content}.txt").exists()
        assert names(path) == [f"{content}.txt"]
        assert names(path.parent) == ["run ä"]


def test_json_is_written_whole_and_without_nan(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"name": "Küche", "values": [1, 0.1, None]})
    assert json.loads(path.read_text(encoding="utf-8")) == {"name": "Küche", "values": [1, 0.1, None]}
    assert "Küche" in path.read_text(encoding="utf-8")
    for number in (math.nan, math.inf):
        with pytest.raises(ValueError, match="JSON compliant"):
            write_json(path, {"value": number})
    assert json.loads(path.read_text(encoding="utf-8"))["values"] == [1, 0.1, None]
    assert names(tmp_path) == ["a.json"]


def test_json_of_a_path_that_is_not_utf_8_is_valid_and_comes_back(tmp_path):
    """Regression: a traceback in a folder that was unpacked from an old archive, whose names are Latin-1."""
    path = os.fsdecode(b"K\xfcche/photos")
    write_json(tmp_path / "a.json", {"scene": path, "name": "Küche"})
    assert b'"scene": "K\\udcfcche/photos"' in (tmp_path / "a.json").read_bytes()
    assert read_json(tmp_path / "a.json", needed=(), hint="") == {"scene": path, "name": "Küche"}


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{}", b'{"mean": 1', b"\xff\xfe", b'{"mean": "a\x00"}', b'{"nean": 1}']
)
def test_json_of_ours_that_is_damaged_is_reported(content, tmp_path):
    path = tmp_path / "metrics.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"cannot read .*metrics\.json"):
        read_json(path, needed=("mean",), hint="measure again")
    write_json(path, {"mean": 1})
    with pytest.raises(UserError, match=r"metrics\.json: it has no images, seconds$"):
        read_json(path, needed=("mean", "images", "seconds"), hint="measure again")
    write_json(path, {"mean": 1})
    assert read_json(path, needed=("mean",), hint="measure again") == {"mean": 1}


def test_a_link_to_another_disk_stays_and_the_folder_behind_it_is_replaced(tmp_path):
    """Regression: the link was moved aside and never removed, and the results were written where it had been."""
    big, place = tmp_path / "big", tmp_path / "small" / "renders"
    (big / "renders").mkdir(parents=True)
    (big / "renders" / "old.txt").write_text("old")
    place.parent.mkdir()
    place.symlink_to(big / "renders")
    for content in ("first", "second"):
        with atomic_folder(place) as partial:
            assert partial.parent == big
            (partial / f"{content}.txt").write_text(content)
        assert place.is_symlink()
        assert names(place) == [f"{content}.txt"]
        assert names(big) == names(place.parent) == ["renders"]


# Leftovers of killed processes


@pytest.fixture(scope="module")
def dead() -> str:
    """What hidden files of a process that has ended have in their names."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        pass
    return f"{atomic._host()}-{process.pid}"


def test_leftovers_of_the_dead_are_cleared_and_those_of_the_living_stay(tmp_path, dead):
    (tmp_path / f".predictions.partial-{dead}").mkdir()
    (tmp_path / f".predictions.partial-{dead}" / "a.png").write_text("half")
    (tmp_path / f".field.partial-{dead}.safetensors").write_text("half")
    (tmp_path / f".rgb.partial-{dead}.gif-x7f").mkdir()
    kept = {f".field.partial-{atomic._own()}.safetensors", ".theirs.partial-x", f"field.partial-{dead}", ".git"}
    for name in kept:
        (tmp_path / name).write_text("not ours")
    clear_leftovers(tmp_path)
    assert set(names(tmp_path)) == kept
    clear_leftovers(tmp_path / "nowhere")


def test_what_another_machine_writes_stays_for_two_days(tmp_path, dead):
    """Machines that share a folder know only their own processes."""
    other = tmp_path / f".1-frames.partial-{'0' * 6}-{dead.partition('-')[2]}"
    other.mkdir()
    clear_leftovers(tmp_path)
    assert other.exists()
    two_days_ago = time.time() - 2 * 24 * 3600 - 1
    os.utime(other, (two_days_ago, two_days_ago))
    clear_leftovers(tmp_path)
    assert not other.exists()


def test_a_result_that_was_put_aside_comes_back_where_its_place_is_empty(tmp_path, dead):
    """A kill between the two renames of `replace_folder`, and one after them."""
    for name in ("lost", "replaced"):
        (tmp_path / f".{name}.old-{dead}").mkdir()
        (tmp_path / f".{name}.old-{dead}" / "old.txt").write_text("old")
    (tmp_path / "replaced").mkdir()
    (tmp_path / "new").mkdir()
    replace_folder(tmp_path / "new", tmp_path / "another")
    assert names(tmp_path) == ["another", "lost", "replaced"]
    assert names(tmp_path / "lost") == ["old.txt"]
    assert names(tmp_path / "replaced") == []


def test_the_next_folder_clears_what_the_last_left(tmp_path, dead):
    (tmp_path / f".run.partial-{dead}").mkdir()
    with atomic_folder(tmp_path / "run"):
        pass
    assert names(tmp_path) == ["run"]
