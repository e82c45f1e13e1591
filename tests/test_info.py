"""nerfcli info on files: descriptions in our own, facts about those of other programs, two-line errors for damage."""

import json
import subprocess
from dataclasses import replace
from functools import partial

import imageio_ffmpeg
import numpy as np
import OpenEXR
import pytest
import tifffile
from commands import in_python, nerfcli
from depth_maps import ALL, FULL_META, META, plain_depth
from every_format import WITH_PHOTOS
from PIL import Image
from test_every_format import VIEWS

from nerfcli.cli.info import lines_of
from nerfcli.photos.images import write_png
from nerfcli.render.files.depth_meta import KEY
from nerfcli.render.files.file_facts import NOT_STATED, RENDERS, description_of
from nerfcli.render.files.float_maps import write_exr, write_png16
from nerfcli.splats.files import write_splats
from nerfcli.splats.gaussians import Gaussians
from nerfcli.training.runs.settings import CPU_SAMPLES

info = partial(nerfcli, "info")


def test_a_depth_file_is_described_without_torch(tmp_path):
    """Regression: the facts about meshes loaded what makes them, 3 of 5 seconds of the command."""
    write_png16(tmp_path / "a.png", np.ones((2, 2), np.float32), META, units_per_level=1e-3)
    program = (
        "import sys; from nerfcli.cli import app\n"
        f"try: app(['info', {str(tmp_path / 'a.png')!r}])\n"
        "finally: print(*{'torch', 'skimage'} & set(sys.modules))"
    )
    done = in_python(program)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "")


def test_facts_fit_the_lines_of_a_terminal():
    facts = {
        "kind": "run",
        "held_out": 1,
        "loss": 0.015097633935511112,
        "settings": {"seed": 0, "steps": None, "log2_rows": 18, "fixed": ["points", "view"]}
        | {f"setting_{i}": i for i in range(9)},
        "components": {"view": 3, "stereo": True, "points": 0.1},
        "low": [-3.550517134718522, 1.0],
        "decisions": ["view=0: kept", "points=0.1: " + "not kept " * 30],
        "maps": {"depth": {"dtype": "float32", "min": 1.5}},
        "versions": {},
    }
    assert lines_of(facts) == [
        "kind: run",
        "held out: 1",
        "loss: 0.0150976",
        'settings: seed=0, log2_rows=18, fixed=["points", "view"], setting_0=0, setting_1=1, setting_2=2, setting_3=3,',
        "  setting_4=4, setting_5=5, setting_6=6, setting_7=7, setting_8=8",
        "components: view=3, stereo=true, points=0.1",
        "low:",
        "  -3.55052",
        "  1",
        "decisions:",
        "  view=0: kept",
        "  points=0.1: " + "not kept " * 30,
        "maps:",
        "  depth: dtype=float32, min=1.5",
    ]


@pytest.mark.parametrize("suffix", ALL)
def test_info_shows_everything_a_depth_file_records(suffix, tmp_path):
    path, depth = tmp_path / f"a{suffix}", plain_depth()
    ALL[suffix](path, depth, FULL_META)
    printed = json.loads(info(path, "--json").stdout)
    assert printed["kind"] == "depth"
    assert (printed["width"], printed["height"]) == (53, 37)
    meaning = printed["meaning"]
    for name in ("convention", "axis", "unit", "unit_source", "opacity_floor", "background_distance", "view"):
        assert meaning[name] == getattr(FULL_META, name)
    assert meaning["provenance"] == FULL_META.provenance
    tolerance = 0.5e-3 + 1e-5 if suffix == ".png" else 1e-6
    numbers = printed["maps"]["depth"]
    assert numbers["valid_share"] == pytest.approx(np.isfinite(depth).mean())
    for name, expected in (("min", np.nanmin), ("max", np.nanmax), ("median", np.nanmedian)):
        assert numbers[name] == pytest.approx(float(expected(depth)), abs=tolerance)
    text = info(path).stdout
    for expected in (
        "background depth along the optical axis (z), in metres (from: GPS, ± 0.3 %)",
        "opacity floor: 0.333333",
        "invalid: " + ("0" if suffix == ".png" else "nan"),
        "background distance: 12.25",
        "error bounds: ",
        "name: Küche 北.jpg",
        "run=kitchen",
    ):
        assert expected in text, expected


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_splats_state_their_count_degree_extent_and_frame(suffix, tmp_path):
    means = np.linspace(0.0, 1.0, 101)[:, None] * [1.0, 2.0, -4.0]
    rows, path = np.ones((101, 1)), tmp_path / f"a{suffix}"
    gaussians = Gaussians(means, -3.0 * rows * np.ones(3), rows * [1.0, 0, 0, 0], 0 * rows[:, 0], np.zeros((101, 4, 3)))
    write_splats(path, gaussians, description={"frame": "that of the scene", "unit": "metre"}, notify=pytest.fail)
    printed = json.loads(info(path, "--json").stdout)
    expected = {"kind": "splats", "format": suffix[1:].upper(), "splats": 101, "degree": 1, "unit": "metre"}
    assert expected.items() <= printed.items()
    assert printed["median_opacity"] == pytest.approx(0.5, abs=1 / 255)
    assert printed["98_percent_between"] == [
        pytest.approx([0.01, 0.02, -3.96], abs=1e-3),
        pytest.approx([0.99, 1.98, -0.04], abs=1e-3),
    ]
    assert "frame: that of the scene" in info(path).stdout
    write_splats(path, gaussians, description=None, notify=pytest.fail)
    assert "not stated: unit and frame" in info(path).stdout


def test_levels_state_their_scale_and_rounding(tmp_path):
    write_png16(tmp_path / "a.png", plain_depth(), META, units_per_level=2e-3)
    text = info(tmp_path / "a.png").stdout
    assert "units per level: 0.002" in text
    assert "error bounds: rounding_max=0.001" in text
    assert "unit: arbitrary" in text


def test_each_map_of_a_file_is_described(tmp_path):
    depth = plain_depth()
    meta = replace(META, layers={"spread": {"convention": "standard-deviation", "opacity_floor": 0.5}})
    write_exr(tmp_path / "a.exr", {"depth": depth, "spread": depth / 10, "opacity": np.ones_like(depth)}, meta)
    printed = json.loads(info(tmp_path / "a.exr", "--json").stdout)
    assert set(printed["maps"]) == {"depth", "spread", "opacity"}
    assert printed["maps"]["spread"]["max"] == pytest.approx(np.nanmax(depth) / 10)
    assert "spread: convention=standard-deviation, opacity_floor=0.5" in info(tmp_path / "a.exr").stdout


def test_depth_of_another_program_is_shown_with_what_it_does_not_state(tmp_path):
    depth = plain_depth()
    tifffile.imwrite(tmp_path / "a.tif", depth)
    np.save(tmp_path / "a.npy", depth)
    Image.fromarray((np.nan_to_num(depth) * 1000).astype(np.uint16)).save(tmp_path / "a.png")
    OpenEXR.File({}, {"V": depth}).write(str(tmp_path / "a.exr"))
    for path in sorted(tmp_path.iterdir()):
        printed = json.loads(info(path, "--json").stdout)
        assert printed["meaning"] is None, path
        assert printed["not_stated"] == NOT_STATED, path
        assert (printed["width"], printed["height"]) == (53, 37), path
        (numbers,) = printed["maps"].values()
        assert numbers["max"] == pytest.approx(np.nanmax(depth) * (1000 if path.suffix == ".png" else 1), rel=1e-4)
        assert f"not stated: {NOT_STATED}" in info(path).stdout, path


def test_arrays_that_are_not_pictures_are_described_by_their_shape(tmp_path):
    for name, array in (("poses", np.zeros((5, 3, 4))), ("names", np.array(["a", "b"])), ("empty", np.zeros((0, 3)))):
        np.save(tmp_path / f"{name}.npy", array)
        printed = json.loads(info(tmp_path / f"{name}.npy", "--json").stdout)
        assert printed["maps"]["array"]["shape"] == list(array.shape)


def test_a_preview_is_not_taken_for_numbers(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((4, 5, 3), np.uint8), metadata={KEY: META.to_text(), "range": "1.0 2.0"})
    text = info(tmp_path / "a.png").stdout
    assert "kind: preview" in text
    assert "conditional depth along the ray" in text
    assert "range=1.0 2.0" in text


def test_the_comment_of_a_video_is_read_back(tmp_path):
    """Includes everything that ffmpeg escapes: =, ;, #, backslash, line ends."""
    path = tmp_path / "a;b #1.mp4"
    printed = {**META.to_json(), "provenance": {"run": "a=b;c#d\\e\nf 北"}}
    frames = np.zeros((3, 16, 16, 3), np.uint8).tobytes()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "16x16"]
    command += ["-r", "12", "-i", "-", "-metadata", f"comment={json.dumps(printed, indent=1)}", f"file:{path}"]
    subprocess.run(command, input=frames, check=True)
    assert description_of(path) == printed
    content = json.loads(info(path, "--json").stdout)
    assert (content["kind"], content["width"], content["height"], content["frames"]) == ("video", 16, 16, 3)
    assert content["meaning"]["provenance"]["run"] == "a=b;c#d\\e\nf 北"


@pytest.mark.parametrize("suffix", [".tiff", ".exr", ".npy", ".png", ".mp4"])
def test_a_damaged_file_is_reported_in_two_lines(suffix, tmp_path, capfd):
    """A file cut anywhere is refused: no half of a map, no traceback, and no messages of libraries."""
    path = tmp_path / f"a{suffix}"
    if suffix == ".mp4":
        path.write_bytes(bytes(range(256)) * 40)
    else:
        ALL[suffix](path, plain_depth(), META)
    whole = path.read_bytes()
    for fraction in (0.0, 0.001, 0.02, 0.3, 0.6, 0.9, 0.99):
        path.write_bytes(whole[: int(fraction * len(whole))])
        result = info(path)
        assert (result.exit_code, result.stdout) == (3, ""), fraction
        lines = result.stderr.splitlines()
        assert len(lines) == 2, lines
        assert lines[0].startswith("Error: ")
        assert str(path) in lines[0]
        assert lines[1].startswith("Hint:  ")
        assert capfd.readouterr() == ("", "")


def test_what_is_no_file_of_depth_is_refused(tmp_path):
    assert "does not exist" in info(tmp_path / "a.tiff").stderr
    (tmp_path / "a.txt").write_text("depth 1.0")
    assert "is not a supported depth, picture or video file" in info(tmp_path / "a.txt").stderr
    tifffile.imwrite(
        tmp_path / "b.tiff", plain_depth(), metadata=None, description=META.to_text().replace("depth 2", "depth 9")
    )
    assert "is of format 'nerfcli depth 9'" in info(tmp_path / "b.tiff").stderr


def test_renders_show_the_definition_of_their_depth(tmp_path):
    description = {"frames": [{}, {}], "settings": {"outputs": ["depth"]}, "depth_meaning": META.to_json(), "run": "r"}
    (tmp_path / RENDERS).write_text(json.dumps(description))
    printed = json.loads(info(tmp_path / RENDERS, "--json").stdout)
    assert (printed["kind"], printed["frames"], printed["meaning"]["axis"]) == ("renders", 2, "ray")
    assert "depth: conditional depth along the ray" in info(tmp_path).stdout
    (tmp_path / RENDERS).write_text("{}")
    assert "render again with --overwrite" in info(tmp_path).stderr


def test_a_text_file_of_a_run_shows_the_run(finished, capture):
    whole = json.loads(info(finished, "--json").stdout)
    assert whole["kind"] == "run"
    assert (whole["settings"]["first_samples_per_step"], whole["settings"]["samples_per_step"]) == CPU_SAMPLES
    for name in ("config.json", "cameras.json"):
        of_file = json.loads(info(finished / name, "--json").stdout)
        assert {**of_file, "path": whole["path"]} == whole
    (capture / "metrics.json").write_text("{}")  # not of a run
    assert "has no list of frames" in info(capture / "metrics.json").stderr


@pytest.mark.parametrize("name", ["alicevision", "pose-files", "neus"])
def test_captures_of_other_programs_show_their_photos_and_cameras(name, tmp_path):
    path = WITH_PHOTOS[name](VIEWS, tmp_path)
    place = tmp_path if name == "pose-files" else path
    facts = json.loads(info(place, "--json").stdout)
    assert (facts["kind"], facts["photos"], facts["held_out"], facts["missing"]) == (name, 3, 1, 0)
    assert any("focal" in line for line in info(place).stdout.splitlines())
    if name == "alicevision":  # its file alone
        for photo in (tmp_path / "images").iterdir():
            photo.unlink()
        facts = json.loads(info(path, "--json").stdout)
        assert (facts["kind"], facts["photos"], facts["missing"], len(facts["cameras"])) == (name, 0, 3, 1)


def test_headers_of_arrays_that_python_cannot_parse_are_damage(tmp_path):
    """NumPy passes on what Python's tokenizer raises at a header without an end."""
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((2, 3)))
    path.write_bytes(path.read_bytes().replace(b"}", b"("))
    assert f"{path} is damaged or does not contain an array" in info(path).stderr.splitlines()[0]
