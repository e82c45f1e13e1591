"""The commands as a user meets them: help, exit codes, two-line errors, batches, what is kept and what is refused."""

import itertools
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer.main
from captures import put_photos
from commands import completed, error_of, estimated_poses, listing, nerfcli, refusal, started
from present import present
from typer.exceptions import TyperException

from nerfcli import cli
from nerfcli.atomic import write_json
from nerfcli.captures.loading import fingerprint, load_scene
from nerfcli.cli.options import seconds_from_text
from nerfcli.errors import (
    BAD_INPUT,
    GATE_NOT_MET,
    INTERRUPTED,
    OUT_OF_MEMORY,
    TERMINATED,
    TOO_FEW_PHOTOS,
    UserError,
    in_shell,
)
from nerfcli.interrupts import install_handlers
from nerfcli.photos.images import read_image, write_png
from nerfcli.poses import structure_from_motion
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.render.depth import DepthRequest
from nerfcli.render.files.file_facts import depth_meta_of
from nerfcli.render.files.float_maps import read_tiff
from nerfcli.training import loop
from nerfcli.training.loop import Progress
from nerfcli.training.runs import settings
from nerfcli.training.runs.files import append_log, left_out_mask, read_log
from nerfcli.training.runs.run import load_run
from nerfcli.workflows import pipeline
from nerfcli.workflows.splats import file_digest
from nerfcli.workflows.views import Views

BATCH_COMMANDS = ("doctor", "poses", "train", "evaluate", "render", "run", "info", "convert", "bench", "export")
COMMANDS = (*BATCH_COMMANDS, "view")
WITHOUT_INPUT = ("selftest",)
OF_SCANS = ("convert", "doctor", "train", "evaluate", "render", "export", "info")
USAGE = 2
PROJECT = Path(__file__).parent.parent
GUIDES = (PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md")))
# Enough for a command that trains to go through all of its stages.
QUICK = ("--steps", "1", "--downscale", "8", "--log2-rows", "10", "--threads", "2")


@pytest.fixture
def stop_at(monkeypatch) -> Callable[..., list[tuple[tuple[Any, ...], dict[str, Any]]]]:
    """Let functions end a command when it calls them, and return the list of their arguments."""

    def stop_at(*names: str) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
        calls = []

        def stop(*given: Any, **more: Any) -> None:
            calls.append((given, more))
            raise UserError("enough", "of this test")

        for name in names:
            monkeypatch.setattr(f"nerfcli.{name}", stop)
        return calls

    return stop_at


def write_photos(folder: Path, count: int) -> Path:
    put_photos(folder, *(f"photo {index}.jpg" for index in range(count)), noise=True)
    return folder


# Help, examples, README


def check_that_it_parses(line: str) -> None:
    """Check that every `nerfcli ...` of a shell line names an existing command and options, with valid values."""
    for part in line.split("|"):
        words = shlex.split(part.split("->")[0], comments=True)
        if not words or words[0] != "nerfcli":
            continue
        if words[1:] not in (["--help"], ["--version"]) and "--help" not in words:
            command: Any = typer.testing._get_command(cli.app)
            while hasattr(command, "commands"):
                words = words[1:]
                command = command.commands[words[0]]
            command.make_context(words[0], words[1:])


def needed(command: str, folder: Path) -> tuple[Any, ...]:
    """Return the arguments that a command needs besides its input."""
    return {"convert": (folder / "out.json", "--to", "transforms"), "export": ("--to", "mesh")}.get(command, ())


@pytest.mark.parametrize("command", [*COMMANDS, *WITHOUT_INPUT, *(f"ct {command}" for command in OF_SCANS)])
def test_help_has_examples_that_parse(command):
    result = completed(*command.split(), "--help")
    assert "[default: True]" not in " ".join(result.stdout.split())  # of a flag that switches something off
    after = result.stdout.split("Examples:")[1]
    examples = [line.strip() for line in after.splitlines() if re.match(rf"\s+.*nerfcli {command} ", line)]
    assert examples
    for example in examples:
        check_that_it_parses(example)


def test_help_lists_every_command_and_the_exit_codes():
    result = completed("--help")
    assert all(re.search(rf"^\s+{command}\b", result.stdout, re.M) for command in (*COMMANDS, *WITHOUT_INPUT))
    assert "..." not in result.stdout.split("Commands:")[1]  # no description is cut short
    assert "130 interrupted; 143 ended by SIGTERM" in re.sub(r"\s+", " ", result.stdout)
    for line in result.stdout.splitlines():
        if line.strip().startswith("nerfcli "):
            check_that_it_parses(line)


def command_lines(guide: Path) -> list[str]:
    """Return the command lines of a guide's fenced blocks, with continued lines joined."""
    blocks = re.findall(r"^```[a-z]*\n(.*?)^```", guide.read_text(encoding="utf-8"), re.M | re.S)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [line.strip().removeprefix("$ ") for line in lines if re.search(r"(^|\|)\s*(\$ )?nerfcli ", line)]


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.name)
def test_every_command_line_of_a_guide_parses(guide):
    for line in command_lines(guide):
        check_that_it_parses(line)


def test_the_readme_has_an_example_of_every_command():
    lines = command_lines(GUIDES[0])
    assert {line.split("nerfcli ")[1].split()[0] for line in lines} >= {*COMMANDS, *WITHOUT_INPUT, "report", "ablate"}


@pytest.mark.parametrize("guide", [*GUIDES, PROJECT / "CONTRIBUTING.md"], ids=lambda guide: guide.name)
def test_links_of_a_guide_lead_to_files_and_headings_that_exist(guide):
    for link in re.findall(r"\]\(([^)]+)\)", guide.read_text(encoding="utf-8")):
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = guide.parent / path if path else guide
        assert target.exists(), link
        headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.M) if anchor else []
        assert not anchor or anchor in [re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in headings], (
            link
        )


def test_a_line_that_does_not_parse_is_noticed():
    for line, message in (
        ("nerfcli trian x", "trian"),
        ("nerfcli train x --stepz 3", "stepz"),
        ("nerfcli train x --steps 0  # a comment", "give at least 1"),
        ("ls -d */ | nerfcli train", None),
    ):
        with pytest.raises((KeyError, TyperException), match=message):
            check_that_it_parses(line)


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("5m", 300), ("1.5h", 5400), ("45", 45), (" 2 m ", 120)])
def test_times(text, seconds):
    assert seconds_from_text(text) == seconds


@pytest.mark.parametrize("text", ["", "0s", "-5s", "5 minutes", "1e3", "m"])
def test_what_is_no_time(text):
    with pytest.raises(typer.BadParameter, match="is not a time; write 90s, 5m or 1h"):
        seconds_from_text(text)


# Exit codes and errors


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("train", "scene"),
        ("trian x", "trian"),
        ("train x --stepz 3", "--stepz (Possible options: --help, --seed, --steps)"),
        ("poses x --budget 3m", "--budget, which belongs to train, export, run, bench, ablate"),
        ("poses x y", "(y); give one, or several on standard input: ls -d captures/*/ | nerfcli poses -"),
        ("view x y", "unexpected extra argument(s) (y)"),
        ("export x", "'--to'. What to export: page, mesh"),
        ("train x --steps 0", "--steps"),
        ("train x --steps 1.5", "'1.5' is not a whole number. Total optimizer steps"),
        ("train x --threads all", "'all' is not a whole number. Number of CPU threads; 0 uses all."),
        ("train x --budget 2", "'2' has no unit; write 2s or 2m"),
        ("view x --port 80000", "'80000' is too large; give at most 65535"),
        ("ablate x --seeds 0", "'0' is too small; give at least 1"),
        ("ablate x --only magic", "--only: 'magic'; choose from background"),
        ("train x --seed 4294967296", "'4294967296' is too large; give at most 4294967295"),
        ("render x --fps 5", "--fps: it works with --video"),
        ("render x --background-distance 5", "it works with --depth background"),
        ("render x --outputs depth --rgba", "--rgba: it works with --outputs rgb"),
        ("render x --outputs rgb --depth median", "--depth: it works with --outputs depth"),
        ("render x --outputs rgb --depth-axis ray", "--depth-axis: it works with --outputs depth"),
        ("render x --outputs rgb --min-opacity 0.1", "--min-opacity: it works with --outputs depth"),
        ("render x --splats y.ply --step 2", "--step works with a run, not with y.ply"),
        ("render x --count 20", "--count: it works with --cameras orbit, ellipse, spiral, interpolate"),
        ("train x --field mlp --log2-rows 12", "--log2-rows: it works with --field hash"),
        ("export x --to page --faces 100", "--faces: it is for meshes"),
        ("export x --to page --voxel-size 0.1", "--voxel-size: it is for meshes and points"),
        ("export x --to splats --box=0,0,0,1,1,1", "--box: it is for pages, meshes and points"),
        ("export x --to mesh --water 0.2", "--water, which belongs to ct export"),
        ("ct export x --box 1", "--box, which belongs to export"),
        ("export x --to mesh --box 1,2,3", "invalid --box 1,2,3 Hint: expected X0,Y0,Z0,X1,Y1,Z1"),
        ("export x --to mesh --box=1,0,0,0,1,1", "the low corner first"),
        ("export x --to mesh --box 1,2,all", "'1,2,all'; write X0,Y0,Z0,X1,Y1,Z1"),
        ("export x --to mesh --format stl", "'stl'; choose ply, glb or obj"),
        ("export x --to mesh --voxel-size nan", "--voxel-size"),
        ("export x --to voxels", "'voxels'; choose page"),
        ("export x --to mesh --sh 0", "it is for splats"),
        ("export x --to mesh -o a.stl", "not have a suffix of --to mesh"),
        ("ct train x y", "(y); give one, or several on standard input: ls -d scans/*/ | nerfcli ct train -"),
        ("ct convert x", "Missing argument 'SCAN'"),
        ("export x --to mesh --format obj -o x.ply", "'obj' contradicts -o x.ply"),
        ("train x y", "(y); give one, or several on standard input: ls -d *-scene/ | nerfcli train -"),
        ("train x --downscale 3", "'3'; choose auto, 1, 2, 4 or 8"),
        ("train x --field gaussians", "'gaussians'; choose hash, voxels or mlp"),
        ("train x --budget soon", "--budget: 'soon' is not a time"),
        ("train x --field-memory lots", "--field-memory: 'lots' is not an amount"),
        ("convert x y", "--to: missing; choose one of nerfcli, colmap"),
        ("train x --device tpu", "'tpu'"),
        ("poses x --camera-model PERSPECTIVE", "'PERSPECTIVE'; choose auto"),
        ("poses x --intrinsics c.txt --camera-model OPENCV", "remove --camera-model"),
        ("poses x --quality superb", "'superb'; choose fast, default or best"),
        ("poses x --pairing random", "'random'; choose auto, exhaustive, sequential, retrieval or spatial"),
        ("poses x --pairing spatial --pairs p.txt", "cannot be combined with --pairs"),
        ("render x --depth expected", "'expected'; choose conditional, moment"),
        ("render x --depth-axis y", "'y'; choose ray or z"),
        ("render x --outputs rgb,normals", "'normals'; choose from rgb, depth, opacity"),
        ("render x --outputs=", "''; choose from rgb"),
        ("render x --min-opacity 1.5", "--min-opacity"),
        ("render x --video-format avi", "'avi'; choose from mp4, gif"),
        ("render x --video-format gif --fps 60", "60; a gif plays at 50 frames per second at most"),
        ("render x --frames 200:100", "'200:100'; write START:STOP"),
        ("render x --frames 0/8", "'0/8'; write START:STOP"),
        ("render x --frames 9/8", "or K/N, such as 1/8"),
        ("render x --max-size 0", "--max-size"),
        ("run x --budget -1", "'-1' is not a time"),
    ],
)
def test_wrong_usage_is_exit_code_2_and_names_the_value(line, named):
    result = nerfcli(*line.split())
    assert result.exit_code == USAGE
    assert result.stdout == ""
    assert named in re.sub(r"[\s│]+", " ", result.stderr)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("given", ["nö such", "empty", "file.txt"])
def test_what_is_no_input_is_reported_in_two_lines(command, given, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.txt").write_text("hello")
    assert given in refusal(command, tmp_path / given, *needed(command, tmp_path))[0]
    assert listing(tmp_path) == {"file.txt": b"hello"}


@pytest.mark.parametrize("command", ["evaluate", "render", "report"])
def test_a_scene_where_a_run_is_needed_is_reported_with_what_to_do(command, capture, tmp_path):
    error = error_of(nerfcli(command, capture))
    assert error == (f"Error: {capture} is a scene, not a run", f"Hint:  train it first: nerfcli train '{capture}'")
    photos = write_photos(tmp_path / "photos", 1)
    hint = f"Hint:  make a run of it first: nerfcli run {photos}"
    assert error_of(nerfcli(command, photos)) == (f"Error: {photos} is a folder of photos, not a run", hint)
    assert error_of(nerfcli(command, tmp_path / "nowhere"))[0] == f"Error: {tmp_path / 'nowhere'} does not exist"


@pytest.mark.parametrize("command", ["train", "ablate"])
def test_a_run_where_a_scene_is_needed_is_reported_with_what_to_do(command, finished, tmp_path):
    error, hint = error_of(nerfcli(command, finished, "-o", tmp_path / "out"))
    assert error == f"Error: {finished} is a run, not a scene"
    assert hint.endswith(f"to continue it: nerfcli train SCENE -o '{finished}' --resume")


def test_photos_where_cameras_are_needed_are_reported_with_what_to_do(tmp_path):
    photos = write_photos(tmp_path / "my photos", 1)
    error = error_of(nerfcli("convert", photos, tmp_path / "out.json", "--to", "transforms"))
    assert error == (
        f"Error: {photos} has 1 photo but no cameras",
        f"Hint:  estimate them with: nerfcli poses '{photos}'",
    )


def test_paths_in_hints_can_be_typed():
    typed = {"a/b": "a/b", "-a": "./-a", "-a b": "'./-a b'", "it's": """'it'"'"'s'""", "/a b": "'/a b'"}
    assert {name: in_shell(Path(name)) for name in typed} == typed


@pytest.mark.parametrize("command", ["poses", "run"])
def test_two_photos_are_too_few(command, tmp_path):
    write_photos(tmp_path / "photos", 2)
    before = listing(tmp_path)
    error, hint = refusal(command, tmp_path / "photos", exit_code=TOO_FEW_PHOTOS)
    assert "only 2 photos" in error
    assert "at least 4" in error
    assert "20 or more" in hint
    assert listing(tmp_path) == before


def test_damaged_photos_are_named_with_what_is_wrong(tmp_path):
    photos = write_photos(tmp_path / "photos", 4)
    short = photos / "photo 0.jpg"
    short.write_bytes(short.read_bytes()[:1500])
    (photos / "photo 1.jpg").write_text("this is text")
    before = listing(tmp_path)
    error, hint = refusal("poses", photos, exit_code=TOO_FEW_PHOTOS)
    assert "only 2 of 4 photos" in error
    assert "photo 0.jpg: damaged or truncated" in error.replace(" is ", " ")
    assert "copy them again" in hint
    assert listing(tmp_path) == before


def test_an_output_that_cannot_be_written_leaves_nothing(capture, finished, tmp_path):
    (tmp_path / "file").write_text("in the way")
    photos = write_photos(tmp_path / "photos", 5)
    before = listing(tmp_path)
    for arguments in (
        ["poses", photos],
        ["train", capture, *QUICK],
        ["render", finished, "--outputs", "opacity"],
        ["render", finished, "--cameras", "orbit", "--count", "2", "--cameras-only"],
    ):
        assert "cannot write" in refusal(*arguments, "-o", tmp_path / "file" / "result")[0]
        assert listing(tmp_path) == before, arguments
        refusal(*arguments, "-o", tmp_path / "file")
        assert listing(tmp_path) == before, arguments


def test_memory_that_runs_out_is_exit_code_6(monkeypatch, capture, finished):
    def exhausted(*args: object, **kwargs: object) -> None:
        raise RuntimeError("[enforce fail at alloc_cpu.cpp:114] DefaultCPUAllocator: not enough memory: you tried")

    monkeypatch.setattr("nerfcli.training.runs.run.load_model", exhausted)
    assert refusal("evaluate", finished, exit_code=OUT_OF_MEMORY)[0] == "Error: out of memory"
    result = nerfcli("evaluate", "-", stdin=f"{finished}\n{finished}\n")
    assert result.exit_code == OUT_OF_MEMORY
    assert result.stderr.count("out of memory") == 2


def test_a_bug_keeps_its_traceback(monkeypatch, finished):
    def broken(*args: object, **kwargs: object) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr("nerfcli.training.runs.run.load_model", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        nerfcli("evaluate", finished)


# Results, batches, what is kept


@pytest.mark.usefixtures("coarse_steps")
def test_train_evaluate_render_info_in_a_row(capture):
    run = capture.with_name("spheres-run")
    trained = nerfcli("train", capture, *QUICK)
    assert trained.stderr.startswith(f"{capture}: blender (NeRF's synthetic scenes), 5 of 5 photos on disk\n")
    assert (trained.exit_code, trained.stdout) == (0, f"{run}\n")
    evaluated = completed("evaluate", run, "--json")
    metrics = json.loads(evaluated.stdout)
    assert metrics["path"] == str(run / "metrics.json")
    assert set(metrics["mean"]) >= {"psnr", "ssim", "lpips", "psnr_float", "ssim_float", "psnr_colour_aligned"}
    assert metrics["images"][0]["view"]["kind"] in ("interpolation", "extrapolation")
    assert {entry["stage"] for entry in metrics["ledger"]} >= {"poses", "intrinsics", "points", "normalisation"}
    assert [image["name"] for image in metrics["images"]] == ["test/r_000.png"]
    assert metrics["training"]["steps"] == 1
    assert json.loads((run / "metrics.json").read_text()) == {k: v for k, v in metrics.items() if k != "path"}
    rendered = nerfcli("render", run, "--depth", "median", "--depth-axis", "ray", "--quiet")
    assert rendered.stderr == ""
    folder = run / "renders" / "test-median-ray"
    assert rendered.stdout.splitlines() == [str(folder / name) for name in ("rgb", "depth", "opacity")]
    path = folder / "depth" / "test" / "r_000.tiff"
    meta = present(depth_meta_of(path))
    assert read_tiff(path).shape == (9, 12)
    assert (meta.convention, meta.axis, meta.unit) == ("median", "ray", "arbitrary")
    reported = nerfcli("report", run, "--quiet")
    assert (reported.exit_code, reported.stdout) == (0, f"{run / 'report.html'}\n")
    assert f"{metrics['mean']['psnr']:.2f} dB" in (run / "report.html").read_text(encoding="utf-8")
    both = nerfcli("report", run, run, "-o", run / "report.html")
    assert (both.exit_code, "is not a page of this report" in both.stderr) == (3, True)
    facts = json.loads(nerfcli("info", run, "--json").stdout)
    assert [facts[name] for name in ("kind", "photos", "held_out", "step")] == ["run", 4, 1, 1]
    assert facts["metrics"] == metrics["mean"]


def test_info_of_a_scene(capture):
    facts = json.loads(nerfcli("info", capture, "--json").stdout)
    assert [facts[name] for name in ("path", "kind", "photos", "held_out")] == [str(capture), "blender", 5, 1]
    assert facts["fingerprint"] == fingerprint(load_scene(capture))
    plain = nerfcli("info", capture).stdout
    assert plain.splitlines()[0] == str(capture)
    assert "  kind: blender" in plain
    assert "None" not in plain  # the source of the unit was not recorded


def test_the_doctor_writes_a_page_beside_the_photos_and_holds_it_against_a_gate(tmp_path):
    folder = write_photos(tmp_path / "photos", 3)
    before = listing(folder)
    result = nerfcli("doctor", folder, "--json")
    assert (result.exit_code, listing(folder)) == (0, before)
    result_json = json.loads(result.stdout)
    assert result_json["path"] == str(tmp_path / "photos-doctor.html")
    assert {finding["check"]: finding["verdict"] for finding in result_json["findings"]}["count"] == "bad"
    gated = nerfcli("doctor", folder, "--require", "look")  # its own page is replaced
    assert (gated.exit_code, gated.stdout.strip()) == (GATE_NOT_MET, result_json["path"])
    assert "count (bad)" in error_of(gated)[0]
    assert nerfcli("doctor", folder, "--require", "fine").exit_code == USAGE
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 50 10 20 20 25 5\n")
    unlike = nerfcli("doctor", folder, "--intrinsics", tmp_path / "cameras.txt")
    assert (unlike.exit_code, "has no camera for photo" in error_of(unlike)[0]) == (BAD_INPUT, True)
    Path(result_json["path"]).write_text("mine")
    refused = nerfcli("doctor", folder)
    assert (refused.exit_code, Path(result_json["path"]).read_text()) == (BAD_INPUT, "mine")
    error_of(refused)
    assert nerfcli("doctor", "-", "-o", tmp_path / "pages", "-q", stdin=f"{folder}\n").exit_code == 0
    assert (tmp_path / "pages" / "photos-doctor.html").exists()


def test_a_batch_goes_on_after_a_bad_path(capture, tmp_path):
    other = tmp_path / "zweite Szene"
    shutil.copytree(capture, other)
    result = nerfcli("train", "-", *QUICK, stdin=f"{capture}\n{tmp_path / 'missing'}\n\n{other}\n")
    assert result.exit_code == BAD_INPUT
    assert result.stdout.splitlines() == [f"{capture}-run", f"{other}-run"]
    error, _ = error_of(result)
    assert error.startswith(f"Error: {tmp_path / 'missing'}")
    assert (capture.with_name("spheres-run") / "field.safetensors").exists()
    # The results on stdout are the input of the next command, unchanged.
    result = completed("evaluate", "-", "--json", stdin=result.stdout)
    paths = [json.loads(line)["path"] for line in result.stdout.splitlines()]
    assert paths == [f"{capture}-run/metrics.json", f"{other}-run/metrics.json"]


@pytest.mark.parametrize(("given", "used"), [(None, "1000"), ("7", "7")])
def test_openmp_waits_briefly_unless_the_user_says_otherwise(given, used, monkeypatch):
    # Whether it helps two trainings at a time is a matter for benchmarks.
    monkeypatch.setenv("GOMP_SPINCOUNT", given or "")  # so that the old value is restored, whatever main sets
    if given is None:
        monkeypatch.delenv("GOMP_SPINCOUNT")
    monkeypatch.setattr(cli, "app", lambda prog_name: None)
    cli.main()
    assert os.environ["GOMP_SPINCOUNT"] == used


def test_the_program_keeps_freed_memory_before_any_command(monkeypatch):
    order: list[str] = []
    monkeypatch.setattr(cli, "keep_freed_memory", lambda: order.append("memory"))
    monkeypatch.setattr(cli, "app", lambda prog_name: order.append("command"))
    cli.main()
    assert order == ["memory", "command"]


def test_python_m_nerfcli_is_the_program():
    result_json = subprocess.run(
        [sys.executable, "-m", "nerfcli", "--version"], check=True, stdout=subprocess.PIPE, text=True
    )
    assert result_json.stdout == "nerfcli 0.1.0\n"


def test_there_is_no_place_beside_the_root():
    assert refusal("poses", "/") == (
        "Error: cannot write a result next to /",
        "Hint:  choose the output folder with -o",
    )


@pytest.fixture
def exported(monkeypatch) -> list[Path]:
    """The paths to which runs would be exported."""
    paths = []
    export = "nerfcli.workflows.export.export_run"
    monkeypatch.setattr(export, lambda run, output, **more: paths.append(output.path) or output.path)
    return paths


def test_results_of_inputs_of_one_name_do_not_replace_each_other(exported, stop_at, tmp_path):
    lines = "\n".join(("a/run", "b/run", "a/kitchen", "b/kitchen", "a/kitchen"))
    result = nerfcli("export", "-", "--to", "points", "--overwrite", "-o", tmp_path, stdin=lines)
    names = ("a-run-points.ply", "b-run-points.ply", "kitchen-points.ply", "kitchen-points.ply")
    assert exported == [tmp_path / name for name in names]  # the last one is the same input again
    assert error_of(result)[0].endswith("is the result of a/kitchen, which has the same name")

    stop_at("workflows.pipeline.run_pipeline", "workflows.convert.convert_capture", "ct.convert.convert_scan")
    for arguments in (
        ("run", "-", "-o", tmp_path),
        ("convert", "-", tmp_path, "--to", "tum"),
        ("ct", "convert", "-", tmp_path),
    ):
        result = nerfcli(*arguments, stdin="a/kitchen\nb/kitchen\n")
        assert "is the result of a/kitchen, which has the same name" in result.stderr


def test_a_batch_goes_on_after_paths_that_cannot_be_opened(finished, tmp_path):
    """Too long for the system, not text, and evaluated one by one."""
    result = nerfcli("info", "-", stdin=f"{'x' * 5000}\n{finished}\n")
    assert result.exit_code == BAD_INPUT
    assert "File name too long" in result.stderr
    assert finished.name in result.stdout
    result = nerfcli("evaluate", tmp_path / "missing", finished)
    assert result.exit_code == BAD_INPUT
    assert result.stdout.splitlines() == [str(finished / "metrics.json")]


def test_export_adds_the_suffix_of_its_format(exported, tmp_path):
    assert nerfcli("export", "x", "--to", "mesh", "--format", "glb", "-o", tmp_path / "kitchen").exit_code == 0
    assert exported == [tmp_path / "kitchen.glb"]


@pytest.mark.parametrize("command", BATCH_COMMANDS)
@pytest.mark.parametrize("stdin", ["", "\n\n"])
def test_an_empty_batch_is_reported(command, stdin, tmp_path):
    error, hint = refusal(command, "-", *needed(command, tmp_path), stdin=stdin)
    assert "no paths on standard input" in error
    assert hint.endswith(f" | nerfcli {command} -")


def test_a_finished_training_is_kept_another_one_refused_and_overwritten_on_demand(capture):
    run = capture.with_name("spheres-run")
    assert nerfcli("train", capture, *QUICK).exit_code == 0
    before = listing(run)
    again = nerfcli("train", capture, *QUICK)
    assert (again.exit_code, again.stdout) == (0, f"{run}\n")
    assert "is kept" in again.stderr
    assert listing(run) == before
    error, hint = refusal("train", capture, *QUICK, "--seed", "5")
    assert "exists" in error
    assert "add --resume to continue it with its own settings, --overwrite to replace it" in hint
    assert listing(run) == before
    completed("train", capture, *QUICK, "--seed", "5", "--overwrite")
    assert listing(run)["field.safetensors"] != before["field.safetensors"]
    assert [entry["step"] for entry in read_log(run)] == [1]
    longer = completed("train", capture, "--steps", "2", "--downscale", "8", "--seed", "5", "--resume")
    assert "resumed at step 1" in longer.stderr


def test_masks_of_an_earlier_training_are_removed_unless_the_scene_has_them(capture, tmp_path):
    run, masked = capture.with_name("spheres-run"), tmp_path / "masked"
    assert nerfcli("train", capture, *QUICK).exit_code == 0
    first = load_scene(capture).train_frames[0]
    write_png(left_out_mask(run, first.name), np.zeros((first.camera.height, first.camera.width), np.uint8))
    completed("convert", capture, masked, "--to", "nerfcli", "--masks", run / "occluders")
    for option in ("--overwrite", "--resume"):
        assert "holds masks that this scene uses, such as" in refusal("train", masked, *QUICK, "-o", run, option)[0]
    assert len(list(run.glob("*/**/*.png"))) == 1
    assert nerfcli("train", capture, *QUICK, "--overwrite").exit_code == 0
    assert not (run / "occluders").exists()


@pytest.mark.parametrize("left", [None, (), ("cameras.json", "config.json")])
def test_resume_starts_what_was_ended_before_its_first_checkpoint(left, capture, finished, tmp_path):
    """A script that a scheduler starts again gives --resume each time."""
    run = tmp_path / "run"
    if left is not None:
        run.mkdir()
        (run / ".train.lock").touch()
        for name in left:
            shutil.copy(finished / name, run)
    result = nerfcli("train", capture, *QUICK, "--resume", "-o", run)
    assert (result.exit_code, result.stdout) == (0, f"{run}\n")
    assert f"{run} has no checkpoint to resume; the training starts from the beginning" in result.stderr
    assert [entry["step"] for entry in read_log(run)] == [1]


@pytest.mark.parametrize("option", ["--resume", "--overwrite"])
def test_train_does_not_write_into_a_folder_with_other_files(option, capture, tmp_path):
    (tmp_path / "diary").mkdir()
    (tmp_path / "diary" / "monday.txt").write_text("rain")
    result = nerfcli("train", capture, *QUICK, option, "-o", tmp_path / "diary")
    assert result.exit_code == BAD_INPUT
    assert "exists and is not a run folder" in error_of(result)[0]
    assert "from the beginning" not in result.stderr
    assert listing(tmp_path / "diary") == {"monday.txt": b"rain"}


def test_resume_needs_a_run_of_the_same_scene(capture, finished, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(capture, other)
    listed = json.loads((other / "transforms_train.json").read_text())
    listed["frames"].pop()
    (other / "transforms_train.json").write_text(json.dumps(listed))
    assert "a different scene" in refusal("train", other, *QUICK, "--resume", "-o", finished)[0]


def test_a_run_without_its_log_cannot_be_evaluated(finished):
    (finished / "log.jsonl").unlink()
    assert "has no log.jsonl" in refusal("evaluate", finished)[0]


def test_metrics_are_kept_for_the_same_checkpoint_and_refused_for_another(finished):
    first = nerfcli("evaluate", finished)
    assert (first.exit_code, first.stdout) == (0, f"{finished / 'metrics.json'}\n")
    before = listing(finished)
    again = nerfcli("evaluate", finished)
    assert "is kept" in again.stderr
    assert listing(finished) == before
    metrics = json.loads(before["metrics.json"]) | {"checkpoint_sha256": "another"}
    write_json(finished / "metrics.json", metrics)
    assert "earlier checkpoint" in refusal("evaluate", finished)[0]
    assert nerfcli("evaluate", finished, "--overwrite").exit_code == 0


def test_requirements_decide_on_the_exit_code(finished):
    assert nerfcli("evaluate", finished, "--require", "psnr>=1,training_seconds<1e6").exit_code == 0
    result = nerfcli("evaluate", finished, "--require", "psnr>=99,ssim>=-1,registered>=0.5")
    assert (result.exit_code, result.stdout) == (GATE_NOT_MET, f"{finished / 'metrics.json'}\n")
    error, hint = error_of(result)
    assert "does not meet --require psnr>=99 (psnr is " in error
    assert "registered>=0.5 (registered is not known)" in error
    assert "ssim" not in error
    assert "--budget" in hint
    error, hint = error_of(nerfcli("evaluate", finished, "--require", "psnr>=1,registered>=0.5"))
    assert "registered is not known" in error
    assert hint.endswith("leave this requirement out")
    for wrong in ("psnr", "beauty>=1"):
        assert nerfcli("evaluate", finished, "--require", wrong).exit_code == 2
        assert nerfcli("run", finished, "--require", wrong).exit_code == 2


def test_predictions_are_what_was_measured(finished):
    assert nerfcli("evaluate", finished).exit_code == 0
    assert "written without saved predictions" in refusal("evaluate", finished, "--save-predictions", "png")[0]
    assert nerfcli("evaluate", finished, "--save-predictions", "float", "--overwrite").exit_code == 0
    metrics = json.loads((finished / "metrics.json").read_text())
    folder = finished / "predictions"
    (picture,), (photo,) = (list((folder / name).rglob("*.png")) for name in ("color", "gt-color"))
    error = np.square(read_image(picture) / 255.0 - read_image(photo) / 255.0).mean()
    assert -10 * np.log10(error) == pytest.approx(metrics["mean"]["psnr"], abs=1e-9)
    (unrounded,) = (np.load(path) for path in (folder / "color-float").rglob("*.npy"))
    error = np.square(unrounded.astype(np.float64) - read_image(photo) / 255.0).mean()
    assert -10 * np.log10(error) == pytest.approx(metrics["mean"]["psnr_float"], abs=1e-9)
    assert nerfcli("evaluate", finished, "--save-predictions", "png").exit_code == 0


def test_several_runs_are_evaluated_in_one_call(finished, tmp_path):
    other = tmp_path / "other-run"
    shutil.copytree(finished, other)
    result = nerfcli("evaluate", finished, other, "--require", "psnr>=99")
    written = "".join(f"{run / 'metrics.json'}\n" for run in (finished, other))
    assert (result.exit_code, result.stdout) == (GATE_NOT_MET, written)
    for run in (finished, other):
        assert f"Error: {run} does not meet --require psnr>=99" in result.stderr


def test_photos_are_held_out_by_the_rule_that_is_given(capture):
    run = capture.with_name("gap-run")
    given = ("train", capture, *QUICK, "--holdout", "block:0.25", "-o", run)
    assert nerfcli(*given).exit_code == 0
    config = json.loads((run / "config.json").read_text())
    cameras = json.loads((run / "cameras.json").read_text())
    assert config["holdout"] == "block:0.25"
    assert "is kept" in nerfcli(*given).stderr
    assert refusal("train", capture, *QUICK, "--resume", "-o", run)[1].endswith("give --holdout block:0.25")
    assert nerfcli("train", capture, *QUICK, "--holdout", "most", "-o", run).exit_code == 2
    # Cameras whose split differs from that of the training are refused.
    del cameras["blake2b"]
    write_json(run / "cameras.json", {**cameras, "train": cameras["test"], "test": cameras["train"]})
    assert "split_sha256" in refusal("evaluate", run)[0]


def test_a_folder_with_other_files_is_never_replaced_by_renders(finished, tmp_path):
    (tmp_path / "diary").mkdir()
    (tmp_path / "diary" / "monday.txt").write_text("rain")
    for target in (tmp_path / "diary", tmp_path / "diary" / "monday.txt"):
        error, _ = refusal("render", finished, "--outputs", "rgb", "-o", target, "--overwrite")
        assert "does not contain renders" in error
    assert listing(tmp_path / "diary") == {"monday.txt": b"rain"}


def test_renders_are_kept_refused_and_overwritten(finished, tmp_path):
    arguments = ["render", finished, "--outputs", "opacity", "-o", tmp_path / "views"]
    assert nerfcli(*arguments).stdout == f"{tmp_path / 'views' / 'opacity'}\n"
    before = listing(tmp_path / "views")
    assert "is kept" in nerfcli(*arguments).stderr
    assert "exists" in refusal(*arguments, "--max-size", "8")[0]
    assert listing(tmp_path / "views") == before
    assert nerfcli(*arguments, "--max-size", "8", "--overwrite").exit_code == 0
    assert listing(tmp_path / "views") != before


@pytest.mark.parametrize("cameras", ["train", "orbit", "ellipse", "spiral", "interpolate"])
def test_cameras_to_render_from(cameras, finished):
    count = () if cameras == "train" else ("--count", "3")
    arguments = ("--cameras", cameras, *count, "--outputs", "rgb", "--max-size", "10", "--video")
    result = nerfcli("render", finished, *arguments)
    folder = finished / "renders" / cameras
    assert (result.exit_code, result.stdout) == (0, f"{folder / 'rgb.mp4'}\n")
    assert len(list((folder / "rgb").rglob("*.png"))) == (4 if cameras == "train" else 3)


def test_cameras_of_another_file_and_none_at_all(capture, finished, tmp_path):
    arguments = ["render", finished, "--outputs", "rgb", "--max-size", "10", "-o", tmp_path / "views"]
    assert nerfcli(*arguments, "--cameras", capture).exit_code == 0
    assert len(list((tmp_path / "views" / "rgb").rglob("*.png"))) == 5
    assert "no cameras found at somewhere" in refusal(*arguments, "--cameras", "somewhere")[0]
    assert "--through cannot be used" in refusal(*arguments, "--through", "r_001.png", exit_code=USAGE)[0]


def views_of(folder: Path) -> list[dict[str, Any]]:
    """Return pose and camera of each frame that was rendered into a folder."""
    return json.loads((folder / "render.json").read_text())["frames"]


def test_views_are_written_and_rendered_from_again(finished, tmp_path):
    path = ("--cameras", "interpolate", "--through", "r_001,r_003.png", "--count", "3", "--max-size", "10")
    of_views = ("render", finished, *path, "--cameras-only", "-o", tmp_path / "path")
    assert completed(*of_views).stdout == f"{tmp_path / 'path'}\n"
    before = listing(tmp_path / "path")
    assert set(before) == {"camera_path.json", "cameras.json"}
    assert "exists" in refusal(*of_views)[0]
    assert listing(tmp_path / "path") == before
    assert nerfcli("render", finished, *path, "--outputs", "rgb", "-o", tmp_path / "views").exit_code == 0
    for name in ("cameras.json", "camera_path.json"):
        again = ("--cameras", tmp_path / "path" / name, "--outputs", "rgb", "-o", tmp_path / name)
        assert nerfcli("render", finished, *again).exit_code == 0
        for one, other in zip(views_of(tmp_path / "views"), views_of(tmp_path / name), strict=True):
            if name == "cameras.json":  # the other format has square pixels only, and says so
                assert one["camera"] == other["camera"]
            np.testing.assert_allclose(one["world_from_cam"], other["world_from_cam"], rtol=0, atol=1e-12)


@pytest.mark.parametrize("is_archive", [False, True])
def test_run_trains_a_capture_with_the_poses_that_it_has(stop_at, capture, is_archive):
    trained = stop_at("workflows.pipeline.train_scene")
    given = Path(shutil.make_archive(str(capture), "zip", capture)) if is_archive else capture
    result = nerfcli("run", given)
    assert error_of(result)[0] == "Error: enough"
    scene = capture.with_name("spheres-unpacked") if is_archive else capture
    assert [(given[0], given[1].path) for given, _ in trained] == [(scene, capture.with_name("spheres-run"))]
    assert f"{given} has poses (" in result.stderr
    assert result.stdout == ""


def test_run_holds_out_what_is_asked_of_a_capture_and_refuses_options_of_poses(stop_at, capture):
    trained = stop_at("workflows.pipeline.train_scene")
    for more in ((), ("--holdout", "block:0.15"), ("--holdout", "every:8")):
        nerfcli("run", capture, *more)
    for poses, holdout in (
        (PoseSettings(holdout="block:0.15"), None),
        (PoseSettings(), "every:8"),
        (PoseSettings(), None),
    ):
        with pytest.raises(UserError, match="enough"):
            pipeline.run_pipeline(capture, poses=poses, holdout=holdout)
    # Regression: what is usual without poses was ignored, and from Python what `poses` says.
    rules = [None, "block:0.15", "every:8", "block:0.15", "every:8", None]
    assert [more["holdout"] for _, more in trained] == rules
    for more in (("--frames", "9"), ("--quality", "best"), ("--subfolders",)):
        assert "has poses, which are used" in refusal("run", capture, *more, exit_code=2)[0]


def test_run_holds_out_what_is_asked_of_photos(stop_at, capture):
    estimated = stop_at("workflows.pipeline.estimate_poses")
    in_poses = PoseSettings(holdout="block:0.15")
    for settings_of_poses, holdout in ((in_poses, None), (in_poses, "block:0.2"), (PoseSettings(), None)):
        with pytest.raises(UserError, match="enough"):
            pipeline.run_pipeline(capture / "train", poses=settings_of_poses, holdout=holdout)
    assert [given[2].holdout for given, _ in estimated] == ["block:0.15", "block:0.2", "every:8"]


def test_run_makes_no_splats_of_panoramas(monkeypatch, capture, tmp_path):
    """Stages with their arguments; a panorama is a camera of the run."""
    stages = []
    sphere = SimpleNamespace(camera=SimpleNamespace(is_spherical=True))
    files = {"path": tmp_path / "run", "metrics_path": tmp_path / "run" / "metrics.json"}
    run = SimpleNamespace(cameras=SimpleNamespace(train=[sphere]), checkpoint_sha256=lambda: "", **files)
    monkeypatch.setattr(pipeline, "train_scene", lambda *given, **more: run)
    monkeypatch.setattr(pipeline, "usual_depth", lambda run, views: DepthRequest("conditional", "z"))
    for stage in ("evaluate_run", "evaluate_splats", "export_run", "report_runs"):
        monkeypatch.setattr(pipeline, stage, lambda *given, stage=stage, **more: stages.append(stage))
    monkeypatch.setattr(pipeline, "render_run", lambda *given, splats, **more: [tmp_path / str(splats)])
    done = pipeline.run_pipeline(capture)
    assert stages == ["evaluate_run", "report_runs"]
    assert done.splats is None
    assert done.renders == [tmp_path / "None"] * 2


@pytest.mark.usefixtures("coarse_steps")
def test_run_does_all_stages_keeps_them_and_goes_on_where_it_stopped(monkeypatch, capture, tmp_path):
    # Structure from motion has its own tests; here it finds the poses that the capture has.
    def known_poses(folder: Path, target: Path, **more: object) -> SimpleNamespace:
        if not target.exists():
            shutil.copytree(capture, target)
        return estimated_poses()

    monkeypatch.setattr(structure_from_motion, "estimate_poses", known_poses)
    monkeypatch.setattr(settings, "FEWEST_LOG2_ROWS", 10)
    monkeypatch.setattr(pipeline, "Views", partial(Views, count=6))  # instead of 60 on the orbit
    arguments = ["run", capture / "train", "-o", tmp_path / "all", "--budget", "0.2s", "--downscale", "4"]

    def interrupted(*args: Any, on_progress: Callable[[Progress], None], **more: Any) -> None:
        def stop_at_the_first_step(progress: Progress) -> None:
            raise KeyboardInterrupt

        loop_train(*args, on_progress=stop_at_the_first_step, **more)

    loop_train = loop.train
    monkeypatch.setattr(loop, "train", interrupted)
    ticks = itertools.count(step=0.06)  # a fake clock, independent of the speed of this machine
    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: next(ticks)))
    stopped = nerfcli(*arguments)
    assert (stopped.exit_code, stopped.stdout) == (INTERRUPTED, "")
    monkeypatch.setattr(loop, "train", loop_train)

    first = nerfcli(*arguments)
    assert "resumed at step 1" in first.stderr
    run = tmp_path / "all" / "run"
    expected = [
        *(tmp_path / "all" / "scene", run, tmp_path / "all" / "run-splats.ply"),
        *(run / "renders" / "orbit-conditional-z-splats" / f"{name}.mp4" for name in ("rgb", "depth")),
        *(run / "metrics.json", run / "metrics-run-splats.ply.json", run / "report.html"),
        *(run / "renders" / "test-conditional-z" / name for name in ("rgb", "depth", "opacity")),
    ]
    assert first.exit_code == 0, first.stderr
    assert first.stderr.count("LPIPS is not available") <= 1  # none where it is installed
    assert f"report with all results: {run / 'report.html'}" in first.stderr
    assert first.stdout.splitlines() == [str(path) for path in expected]
    assert all(path.exists() for path in expected)
    (film,) = re.findall(r"`nerfcli render \S+ --splats \S+\.ply ([^`]*)`", GUIDES[0].read_text(encoding="utf-8"))
    film = film.replace("photos/", f"{tmp_path}/").replace("--count 240", "--count 6").split()
    assert nerfcli("render", run, "--splats", tmp_path / "all" / "run-splats.ply", *film).exit_code == 0
    before = listing(run)
    again = nerfcli(*arguments)
    assert (again.exit_code, again.stdout) == (0, first.stdout)
    assert listing(run) == before
    assert "report.html is kept" in again.stderr
    (run / "metrics.json").unlink()  # the page now shows numbers that are gone
    nerfcli("evaluate", run)
    assert "report.html is kept" not in nerfcli(*arguments).stderr

    longer = completed(*("0.4s" if argument == "0.2s" else argument for argument in arguments))
    assert f"resumed at step {load_run(run).log[-1]['step']}" not in longer.stderr
    assert "resumed at step" in longer.stderr
    assert longer.stdout == first.stdout
    digest = load_run(run).checkpoint_sha256()
    assert json.loads((run / "metrics.json").read_text())["checkpoint_sha256"] == digest
    of_renders = [json.loads(path.read_text()) for path in run.glob("renders/*/render.json")]
    assert [made["field_sha256"] for made in of_renders] == [digest] * 2
    before = listing(run)
    assert nerfcli(*arguments).exit_code == 0  # a smaller budget than that of the training, which is kept
    assert listing(run) == before
    assert nerfcli("export", run, "--to", "splats", "--sh", "1", "--budget", "0.1s", "--overwrite").exit_code == 0
    completed(*arguments)
    made = json.loads((run / "renders" / "orbit-conditional-z-splats" / "render.json").read_text())
    assert made["splats_sha256"] == file_digest(tmp_path / "all" / "run-splats.ply")
    (run / "splats.safetensors").unlink()  # the file is kept, and only the field that the film names is another
    completed(*("0.6s" if argument == "0.2s" else argument for argument in arguments))


# Processes of their own


SMALL = ("--downscale", "8", "--log2-rows", "10", "--threads", "1", "--model", "default")


def terminated_training(capture: Path, run: Path) -> tuple[int, str, str]:
    """Send SIGTERM twice, as `timeout` does to a command and to its group; return exit code, stdout and stderr."""
    process = started("train", capture, "--budget", "10m", *SMALL)
    deadline = time.monotonic() + 120
    while not (run / "log.jsonl").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    stdout, stderr = process.communicate(timeout=60)
    return process.returncode, stdout, stderr


def interrupted_training(capture: Path, run: Path) -> tuple[int, str, str]:
    """Send SIGINT to a training in this process once it has a log; return exit code, stdout and stderr."""

    def log_and_interrupt(*entry: Any) -> None:
        append_log(*entry)
        signal.raise_signal(signal.SIGINT)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in background suites
    install_handlers()
    try:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(loop, "append_log", log_and_interrupt)
            result = nerfcli("train", capture, "--budget", "10m", *SMALL)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert (run / "log.jsonl").exists()
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.parametrize(
    ("stopped", "exit_code"), [(interrupted_training, INTERRUPTED), (terminated_training, TERMINATED)]
)
def test_ctrl_c_and_sigterm_save_a_checkpoint_and_say_how_to_go_on(stopped, exit_code, capture):
    run = capture.with_name("spheres-run")
    code, stdout, stderr = stopped(capture, run)
    assert code == exit_code, stderr
    assert stdout == ""
    assert not any(word in stderr for word in ("Traceback", "stack trace"))
    saved, ended = stderr.splitlines()[-2:]
    # The command without its other options would continue to another budget, with other components.
    assert saved == f"checkpoint saved in {run}; to continue, add --resume to the same command"
    assert ended.endswith("; completed work is kept.")
    assert {path.name for path in run.iterdir()} >= {"config.json", "field.safetensors", "state.safetensors"}
    assert not list(run.rglob("*partial*"))
    trained = read_log(run)[-1]
    resumed = completed("train", capture, "-o", run, "--resume", "--steps", str(trained["step"] + 2), *SMALL)
    assert f"resumed at step {trained['step']}, " in resumed.stderr
    assert read_log(run)[-1]["step"] == trained["step"] + 2


def test_every_message_of_the_guide_to_failures_is_in_the_program():
    """The parts of a message between what varies, which the guide writes as "..."."""
    guide = (PROJECT / "docs/when-it-goes-wrong.md").read_text(encoding="utf-8")
    messages = re.findall(r"^\| `([^`]+)` \|", guide, re.M)
    source = "".join(path.read_text(encoding="utf-8") for path in (PROJECT / "nerfcli").rglob("*.py"))
    assert len(messages) >= 20
    parts = [part.strip() for message in messages for part in message.split("...") if len(part.strip()) > 6]
    assert [part for part in parts if part not in source] == []
