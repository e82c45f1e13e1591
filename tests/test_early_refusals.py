"""Commands refuse before any work what they can know by then: wrong inputs, read-only folders, nothing left to do."""

import os
import shutil
import sys
from pathlib import Path

import pytest
from commands import completed, error_of, in_python, listing, nerfcli, refusal
from test_cli import COMMANDS

from nerfcli.errors import BAD_INPUT

PHANTOM = Path(__file__).parent.parent / "sample_scenes" / "phantom"


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """A scan folder, and a reconstruction as far as its first words."""
    folder = tmp_path_factory.mktemp("scanned")
    assert nerfcli("ct", "convert", PHANTOM, folder / "scan").exit_code == 0
    (folder / "run").mkdir()
    (folder / "run" / "reconstruction.json").write_text('{"measurement": "transmission"}')
    return folder


@pytest.mark.parametrize("command", [*COMMANDS, "report", "ablate"])
def test_commands_for_photos_name_the_command_for_a_scan(command, scanned, tmp_path):
    same = {kind: command if command in commands else commands[0] for kind, commands in SUITED.items()}
    for path, what, suited in (
        (PHANTOM, "an X-ray scan (stack)", f"{same['raw']} {PHANTOM}{' SCAN' if same['raw'] == 'convert' else ''}"),
        (scanned / "scan", "an X-ray scan", f"{same['scan']} {scanned / 'scan'}"),
        (scanned / "run", "the reconstruction of an X-ray scan", f"{same['run']} {scanned / 'run'}"),
    ):
        error = f"Error: {path} is {what}, and {command} is for photos"
        given = (command, path, *(("--to", "mesh") if command == "export" else ()))
        assert refusal(*given) == (error, f"Hint:  use nerfcli ct {suited}")
    if command in ("train", "render", "convert"):
        result = nerfcli(
            command, "-", *((tmp_path / "out", "--to", "colmap") if command == "convert" else ()), stdin=f"{PHANTOM}\n"
        )
        assert f"an X-ray scan (stack), and {command} is for photos" in result.stderr


SUITED = {
    "raw": ("convert", "doctor", "info"),
    "scan": ("train", "doctor", "info"),
    "run": ("render", "evaluate", "export", "info"),
}


def test_a_scan_is_recognised_before_anything_heavy_is_loaded():
    """Regression: `train` loaded torch, 4 s of processor time, to say that a scan has to be converted."""
    program = (
        "import sys; from nerfcli.cli import app\n"
        f"try: app(['train', {str(PHANTOM)!r}])\n"
        "finally: print(*{'torch', 'numpy', 'scipy', 'h5py'} & set(sys.modules))"
    )
    done = in_python(program)
    assert (done.returncode, done.stdout.split()) == (BAD_INPUT, [])


def test_json_nested_too_deeply_is_refused_and_not_a_traceback(tmp_path):
    """Before the format of IN is known, each reader looks into it."""
    (tmp_path / "reconstruction.json").write_text("[" * 100_000)
    error, _ = refusal("convert", tmp_path / "reconstruction.json", tmp_path / "out", "--to", "transforms")
    assert "not valid JSON" in error


@pytest.mark.parametrize(
    ("command", "name", "options", "said"),
    [
        ("poses", "clip.mp4", ("--masks", "nowhere"), "the mask folder {0}/nowhere does not exist"),
        ("poses", "clip.mp4", ("-o", "."), "cannot write the scene .: the folder contains other files"),
        pytest.param(
            *("poses", os.fsdecode(b"caf\xe9.mp4"), (), "the name 'caf\\udce9-frames' is not in UTF-8"),
            marks=pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names"),
        ),
        ("poses", "photos.zip", ("--masks", "nowhere"), "the mask folder {0}/nowhere does not exist"),
        ("poses", "clip.mp4", ("--pairs", "nowhere"), "cannot read the pairs in {0}/nowhere: No such file"),
        ("poses", "photos.zip", ("--intrinsics", "nowhere"), "nowhere does not exist"),
        ("run", "clip.mp4", ("--intrinsics", "nowhere"), "nowhere does not exist"),
    ],
)
def test_no_video_is_read_and_no_photos_are_unpacked_for_a_scene_that_is_refused(
    command, name, options, said, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(b"x")
    result = nerfcli(command, name, *options)
    assert (result.exit_code, error_of(result)[0]) == (BAD_INPUT, f"Error: {said.format(tmp_path)}")
    assert list(tmp_path.iterdir()) == [tmp_path / name]


@pytest.mark.parametrize("name", ["clip.mp4", "photos.zip"])
def test_poses_do_not_replace_the_frames_of_a_scene_by_those_of_one_that_is_refused(name, tmp_path, monkeypatch):
    """Regression: the scene that stayed named frames that were gone."""
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(b"x")
    Path(f"{Path(name).stem}-scene").mkdir()
    Path(f"{Path(name).stem}-scene", "scene.json").write_text("{}")
    result = nerfcli("poses", name, "--masks", "nowhere", "--overwrite")
    assert error_of(result)[0] == f"Error: the mask folder {tmp_path}/nowhere does not exist"


def test_doctor_refuses_a_run(finished):
    error, hint = error_of(nerfcli("doctor", finished))
    assert error == f"Error: {finished} is a run: doctor examines photos and scenes"
    assert hint.startswith("Hint:  nerfcli report RUN shows how many photos see what")


@pytest.mark.parametrize("command", ["evaluate", "report", "export"])
def test_a_folder_that_cannot_be_written_is_found_before_the_work(command, finished, tmp_path, monkeypatch):
    run = shutil.copytree(finished, tmp_path / "run")
    (run / "metrics.json").unlink(missing_ok=True)
    before = listing(tmp_path)
    monkeypatch.setattr("nerfcli.atomic.os.access", lambda path, mode: False)
    error, hint = refusal(command, run, *(("--to", "mesh") if command == "export" else ()))
    assert error.startswith("Error: cannot write ")
    assert error.endswith(": no write permission")
    assert hint.startswith("Hint:  make ")
    assert hint.endswith(" writable, or use a folder that is")
    assert listing(tmp_path) == before


def test_resuming_what_has_used_its_budget_changes_nothing(capture, tmp_path):
    """Regression: photos were read and matched again only to find that no step was left."""
    run = tmp_path / "run"
    train = ("train", capture, "--steps", "2", "-o", run)
    options = ("--downscale", "8", "--log2-rows", "10", "--seed", "3", "--with", "antialias")
    assert nerfcli(*train, *options).exit_code == 0
    before = listing(run)
    for again in ((*train, *options), train, ("train", capture, "--steps", "1", "-o", run)):
        result = completed(*again, "--resume")
        assert result.stderr.splitlines()[1:2] == [
            f"{run} is kept: its training has used this budget; give a larger --budget or --steps"
        ]
    error, hint = refusal(*train, "--seed", "4", "--resume")
    assert error.endswith(f"{run} was trained with seed=3, not seed=4")
    assert hint.endswith("train into a new folder with -o, or replace it: --overwrite without --resume")
    assert listing(run) == before
