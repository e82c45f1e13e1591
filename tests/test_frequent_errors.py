"""The errors that users of nerfstudio, COLMAP and OpenSplat report most often: each has a folder, and words that help.

Models of which several hold the same photos are in `test_odd_inputs`.
"""

import shutil
from pathlib import Path

import pytest
from commands import completed, error_of, listing, nerfcli, refusal
from every_format import WITH_PHOTOS, Views
from test_odd_inputs import CAMERA, POSES, photos

from nerfcli.errors import OUT_OF_MEMORY


def project(folder: Path) -> Path:
    """Write a COLMAP project with its photos in images/."""
    WITH_PHOTOS["colmap"](Views(CAMERA, POSES), folder)
    return folder


@pytest.mark.parametrize("command", ["poses", "doctor", "run"])
@pytest.mark.parametrize(
    ("files", "said"),
    [
        ((), "expected photos, such as .jpg, .png, .heic, "),
        (
            ("a.raw", "b.raw", "c.ptx", "notes.txt"),
            "there are only 2 .raw, 1 .ptx, 1 .txt; expected photos, such as .jpg, ",
        ),
        (("DCIM/a.jpg",), "there are photos in {0}/DCIM; give that folder"),
    ],
)
def test_no_photos_are_found(command, files, said, tmp_path):
    for name in files:
        if name.endswith(".jpg"):
            photos(tmp_path, [name])
        else:
            (tmp_path / name).write_bytes(b"x")
    before = listing(tmp_path)
    error, hint = refusal(command, tmp_path)
    assert f"no photos and no scene in {tmp_path}" in error or f"no photos in {tmp_path}" in error
    assert said.format(tmp_path) in hint
    assert listing(tmp_path) == before


@pytest.mark.parametrize("command", ["train", "info"])
def test_the_folder_around_a_capture_is_given(command, tmp_path):
    one = project(tmp_path / "one")
    assert refusal(command, tmp_path) == (
        f"Error: {tmp_path} contains no capture",
        f"Hint:  there is one in {one}: give that folder",
    )
    shutil.copytree(one, tmp_path / "two")
    hint = f"Hint:  there is one in {one} and in 1 other folder: give that folder"
    assert error_of(nerfcli(command, tmp_path))[1] == hint


def test_a_capture_two_folders_down_is_pointed_at(tmp_path):
    """Such as a model in sparse/aligned, where sparse/0 is expected."""
    one = project(tmp_path / "one")
    (one / "sparse/0").rename(one / "sparse/aligned")
    hint = f"Hint:  there is one in {one / 'sparse/aligned'}: give that folder"
    assert refusal("train", one) == (f"Error: {one} contains no capture", hint)


def test_a_scene_is_pointed_at_before_runs(tmp_path):
    """In folders as the README names them, runs/ comes before scenes/."""
    WITH_PHOTOS["run"](Views(CAMERA, POSES), tmp_path / "runs/one")
    one = project(tmp_path / "scenes/one")
    hint = f"Hint:  there is one in {one} and in 1 other folder: give that folder"
    assert refusal("train", tmp_path)[1] == hint


def test_the_folder_of_photos_in_a_capture_is_given(tmp_path):
    one = project(tmp_path / "one")
    inside = next(path for path in one.iterdir() if path.name != "sparse")
    assert refusal("train", inside) == (
        f"Error: {inside} has 8 photos but no cameras",
        f"Hint:  those of {one} are used if you give that folder, or estimate them with: nerfcli poses {inside}",
    )


@pytest.mark.parametrize("given", ["sparse", "sparse/0", "sparse/0/images.bin"])
def test_a_folder_or_file_of_the_model_is_given(given, tmp_path):
    """The photos above it are found."""
    one = project(tmp_path / "one")
    result = completed("convert", one / given, tmp_path / "out.json", "--to", "transforms", "--allow-loss")
    assert "missing" not in result.stderr


def test_photos_and_field_do_not_fit_into_memory(capture, tmp_path):
    before = listing(capture)
    arguments = ("train", capture, "-o", tmp_path / "run", "--memory", "10MB", "--budget", "1s")
    error, hint = refusal(*arguments, exit_code=OUT_OF_MEMORY)
    assert "of memory in addition to the photos, but the limit is 0.01 GB" in error
    assert "--downscale 4" in hint
    assert listing(capture) == before
    assert set(listing(tmp_path / "run")) <= {".train.lock"}
