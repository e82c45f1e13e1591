"""`nerfcli render` of other sizes, parts and lenses, and of files of cameras that are wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import completed, nerfcli, refusal
from PIL import Image
from present import present

from nerfcli.render.files.file_facts import depth_meta_of
from nerfcli.render.files.float_maps import read_tiff
from nerfcli.workflows.views import file_fps

USAGE = 2
ONE = ("--cameras", "orbit", "--count", "2", "--threads", "1")


def rendered(run: Path, *options: str | Path, outputs: str = "rgb") -> Path:
    result = completed("render", run, *ONE, "--outputs", outputs, *options)
    return Path(result.stdout.splitlines()[0])


def pixels(folder: Path) -> np.ndarray:
    return np.asarray(Image.open(min(folder.glob("*.png"))))


def test_a_part_is_cut_out_of_the_whole_picture(finished):
    whole = pixels(rendered(finished, "--width", "40", "--height", "30"))
    assert whole.shape == (30, 40, 3)
    assert whole.std() > 1  # there is something in it
    part = pixels(rendered(finished, "--width", "40", "--height", "30", "--crop", "5,7,20,10"))
    np.testing.assert_array_equal(part, whole[7:17, 5:25])


def test_parts_of_an_array_job_together_equal_one_rendering(finished, tmp_path):
    orbit = ("--cameras", "orbit", "--count", "5", "--max-size", "32", "--outputs", "rgb,depth", "--threads", "1")
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert nerfcli("render", finished, *orbit, "-o", whole).exit_code == 0
    for task in ("1/3", "3/3", "2/3"):
        result = nerfcli("render", finished, *orbit, "-o", parts, "--frames", task)
        assert not parts.exists()
    assert "5 of 5 frames are complete" in result.stderr
    assert "resuming: 5 of 5 frames" in nerfcli("render", finished, *orbit, "-o", parts).stderr
    files = [path.relative_to(whole) for path in whole.rglob("*.*") if path.suffix in (".png", ".tiff")]
    assert len(files) == 15
    assert all((whole / file).read_bytes() == (parts / file).read_bytes() for file in files)


def test_depth_of_all_directions_is_along_the_rays(finished):
    error, _ = refusal(
        "render", finished, *ONE, "--lens", "equirectangular", "--width", "32", "--depth-axis", "z", exit_code=USAGE
    )
    assert "half of their directions are behind the camera" in error
    folder = rendered(finished, "--lens", "equirectangular", "--width", "32", outputs="depth")
    path = min(folder.glob("*.tiff"))
    depth = read_tiff(path)
    assert (depth.shape, present(depth_meta_of(path)).axis) == ((16, 32), "ray")
    # The fog stands in front of the camera, in the middle; behind it, at the left and right edge, is nothing.
    assert np.isfinite(depth[8, 16])
    assert np.isnan(depth[8, [0, 1, -2, -1]]).all()


def test_pixels_without_a_ray_are_invalid(finished):
    folder = rendered(finished, "--lens", "fisheye", "--fov", "360", "--width", "17", "--height", "17", outputs="depth")
    depth = read_tiff(min(folder.glob("*.tiff")))
    assert np.isnan(depth[[0, 0, -1, -1], [0, -1, 0, -1]]).all()
    assert np.isfinite(depth[8, 8])


def test_a_fisheye_that_sees_behind_has_no_z_there_and_says_so(finished):
    result = completed("render", finished, *ONE, "--lens", "fisheye", "--fov", "200", "--width", "16", "--height", "16")
    assert "have no z (NaN)" in result.stderr


@pytest.mark.parametrize(
    "options",
    [
        ("--width", "0"),
        ("--lens", "plenoptic"),
        ("--fov", "90"),
        ("--lens", "pinhole", "--fov", "180"),
        ("--lens", "equirectangular", "--width", "100", "--height", "60"),
        ("--crop", "1,2,3"),
        ("--crop", "0,0,0,5"),
        ("--crop", "0,0,5000,5"),
        ("--max-size", "100", "--width", "50"),
    ],
    ids=" ".join,
)
def test_values_that_say_nothing(options, finished):
    result = nerfcli("render", finished, *ONE, *options)
    assert result.exit_code == USAGE
    assert not (finished / "renders").exists()


def test_the_frame_rate_of_a_camera_path_is_the_default(tmp_path):
    path, view = tmp_path / "path.json", {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50}
    path.write_text(json.dumps({"render_width": 64, "render_height": 48, "camera_path": [view], "fps": 12}))
    assert file_fps(str(path)) == 12
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    path.write_text(json.dumps({"w": 64, "h": 48, "fl_x": 50.0, "frames": [frame]}))
    assert file_fps(str(path)) is None
    assert file_fps("orbit") is None
