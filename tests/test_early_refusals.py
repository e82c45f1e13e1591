"""Commands refuse before any work what they can know by then: wrong inputs, read-only folders, nothing left to do."""

import shutil
from pathlib import Path

import pytest
from commands import error_of, listing, nerfcli

from nerfcli.errors import BAD_INPUT

PHANTOM = Path(__file__).parent.parent / "sample_scenes" / "phantom"


@pytest.mark.parametrize("command", ["view", "bench", "ablate"])
def test_a_scan_where_photos_are_needed_is_named(command, tmp_path):
    phantom = PHANTOM
    output = () if command == "view" else ("-o", tmp_path / "out")
    error, hint = error_of(nerfcli(command, phantom, *output))
    assert error == f"Error: {phantom} is an X-ray scan, not a scene of photos"
    assert hint.startswith(f"Hint:  {command} is for photos; commands for scans: convert, doctor, train")
    assert listing(tmp_path) == {}


def test_json_nested_too_deeply_is_refused_and_not_a_traceback(tmp_path):
    """Before the format of IN is known, each reader looks into it."""
    (tmp_path / "reconstruction.json").write_text("[" * 100_000)
    result = nerfcli("convert", tmp_path / "reconstruction.json", tmp_path / "out", "--to", "transforms")
    assert result.exit_code == BAD_INPUT
    assert "not valid JSON" in error_of(result)[0]


def test_doctor_refuses_a_run(finished):
    error, hint = error_of(nerfcli("doctor", finished))
    assert error == f"Error: {finished} is a run: doctor examines photos, scenes and scans"
    assert hint.startswith("Hint:  nerfcli report RUN shows how many photos see what")


@pytest.mark.parametrize("command", ["evaluate", "report", "export"])
def test_a_folder_that_cannot_be_written_is_found_before_the_work(command, finished, tmp_path, monkeypatch):
    run = shutil.copytree(finished, tmp_path / "run")
    (run / "metrics.json").unlink(missing_ok=True)
    before = listing(tmp_path)
    monkeypatch.setattr("nerfcli.atomic.os.access", lambda path, mode: False)
    result = nerfcli(command, run, *(("--to", "mesh") if command == "export" else ()))
    assert result.exit_code == BAD_INPUT
    error, hint = error_of(result)
    assert error.startswith("Error: cannot write ")
    assert error.endswith(": no write permission")
    assert hint.startswith("Hint:  make ")
    assert hint.endswith(" writable, or use a folder that is")
    assert listing(tmp_path) == before


def test_resuming_what_has_used_its_budget_changes_nothing(capture, tmp_path):
    """Regression: photos were read and matched again only to find that no step was left."""
    train = ("train", capture, "--steps", "1", "--downscale", "8", "--log2-rows", "10", "-o", tmp_path / "run")
    assert nerfcli(*train).exit_code == 0
    before = {path: path.read_bytes() for path in (tmp_path / "run").iterdir() if path.is_file()}
    result = nerfcli(*train, "--resume")
    assert result.exit_code == 0, result.stderr
    assert result.stderr.splitlines()[1:] == [
        f"{tmp_path / 'run'} is kept: its training has used this budget; give a larger --budget or --steps"
    ]
    assert {path: path.read_bytes() for path in (tmp_path / "run").iterdir() if path.is_file()} == before
