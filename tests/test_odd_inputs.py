"""Captures with the oddities of files that were moved, converted or written by other programs: what must come out.

Positions and counts are known, as the captures are written here. Photos differ in their grey level, so that the level
says which photo was found.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import error_of, nerfcli
from PIL import Image
from views import PINHOLE, capture_of

from nerfcli.cameras.conventions import opengl_from_opencv_pose
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.colmap import write_colmap_text
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.photo_names import find_photos
from nerfcli.captures.formats.registry import recognise
from nerfcli.errors import BAD_INPUT, UserError

CAPTURE = capture_of([PINHOLE])
COUNT = len(CAPTURE.frames)
SIZE = PINHOLE.size


def photos(folder: Path, names: Sequence[str], *, size: tuple[int, int] = SIZE) -> None:
    """Write photos whose grey level is 10 times their number."""
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", size, 10 * index).save(folder / name)


def levels(found: Sequence[Path | None]) -> list[int | None]:
    """Return the numbers of the photos that were found."""
    return [None if path is None else round(float(np.asarray(Image.open(path)).mean()) / 10) for path in found]


def colmap(folder: Path, names: Sequence[str]) -> None:
    named = [replace(frame, name=name) for frame, name in zip(CAPTURE.frames, names, strict=True)]
    write_colmap_text(replace(CAPTURE, frames=tuple(named)), folder / "sparse/0")


def transforms_record(names: Sequence[str], **more: Any) -> dict[str, Any]:
    fx, fy, cx, cy = PINHOLE.params
    head = {"w": SIZE[0], "h": SIZE[1], "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    matrices = [opengl_from_opencv_pose(frame.world_from_cam).tolist() for frame in CAPTURE.frames]
    frames = [{"file_path": n, "transform_matrix": m} for n, m in zip(names, matrices, strict=False)]
    return {**head, "frames": frames, **more}


def transforms(folder: Path, names: Sequence[str]) -> None:
    (folder / "transforms.json").write_text(json.dumps(transforms_record(names)))


def parsed(folder: Path, **given: Any) -> Capture:
    form, found = recognise(folder)
    return form.parse(found, UserInputs(**given))


def numbered(pattern: str) -> list[str]:
    return [pattern.format(index) for index in range(COUNT)]


@pytest.mark.parametrize("write", [colmap, transforms])
@pytest.mark.parametrize(
    ("on_disk", "listed", "note"),
    [
        ("images/left/view_{}.png", "left\\view_{}.png", None),
        ("images/view_{}.png", "C:\\capture\\images\\view_{}.png", "other names: images/view_0.png for C:"),
        ("images/view_{}.png", "\\\\server\\share\\images\\view_{}.png", "other names: images/view_0.png for "),
        ("images/view_{}.png", "/home/user/capture/images/view_{}.png", "other names: images/view_0.png for /home"),
        ("images/view_{}.png", "VIEW_{}.PNG", "other names: images/view_0.png for VIEW_0.PNG"),
        ("images/view_{}.png", "view_{}.jpg", "other names: images/view_0.png for view_0.jpg"),
        ("input/view_{}.png", "view_{}.png", "other names: input/view_0.png for view_0.png"),
        ("images_4/view_{}.png", "view_{}.png", "other names: images_4/view_0.png for view_0.png"),
        ("rgb/ü {}.png", "input/u\u0308 {}.JPG", "other names: rgb/ü 0.png for input/u\u0308 0.JPG"),
        ("view_{}.png", "view_{}.png", None),
    ],
)
def test_photos_under_other_names_are_found_and_said_once(write, on_disk, listed, note, tmp_path):
    photos(tmp_path, numbered(on_disk))
    write(tmp_path, numbered(listed))
    capture = parsed(tmp_path)
    assert levels([frame.image for frame in capture.frames]) == list(range(COUNT))
    np.testing.assert_allclose([f.centre for f in capture.frames], [f.centre for f in CAPTURE.frames], atol=1e-12)
    if note is None and not (write is transforms and "left" in listed):
        assert capture.notes == ()
    elif note is not None:
        assert len(capture.notes) == 1
        assert f"{COUNT} photos found under {note}" in capture.notes[0]


def find(folder: Path, names: Sequence[str], **more: Any) -> Any:
    return find_photos(names, [folder], sizes=[SIZE] * len(names), **more)


def test_the_longest_common_end_wins_and_an_exact_name_comes_first(tmp_path):
    photos(tmp_path, ["images/a.png", "images/left/a.png", "images/A.PNG"])
    assert levels(find(tmp_path, ["D:\\x\\left\\a.png", "A.PNG", "a.png"]).paths) == [1, 2, 0]


@pytest.mark.parametrize(
    ("on_disk", "listed", "two"),
    [
        (["images/left/a.png", "images/right/a.png"], ["/home/x/a.png"], "left/a.png"),
        (["images/a.png", "images/A.PNG"], ["A.png"], "images/A.PNG"),
        (["images/a.png", "images/a.webp"], ["a.jpg"], "images/a.webp"),
        (["images/a.png"], ["left/a.png", "right/a.png"], "fits two names, left/a.png and right/a.png"),
        (["input/a.png", "x/b.png", "rgb/a.png"], ["a.png"], "input/a.png and rgb/a.png"),
    ],
)
def test_two_candidates_are_refused_by_name(on_disk, listed, two, tmp_path):
    photos(tmp_path, on_disk)
    with pytest.raises(UserError) as caught:
        find(tmp_path, listed)
    assert two in caught.value.message


def test_a_folder_of_undistorted_photos_is_not_taken_for_that_of_the_cameras(tmp_path):
    photos(tmp_path / "images", ["0.png", "1.png"], size=(SIZE[0] - 40, SIZE[1] - 11))
    photos(tmp_path / "input", ["0.png", "1.png"])
    assert find(tmp_path, ["0.png", "1.png"]).paths == (tmp_path / "input/0.png", tmp_path / "input/1.png")


def test_photos_of_another_shape_are_not_found(tmp_path):
    """Neither in another folder nor with another suffix; where it is only one, the others are used."""
    photos(tmp_path / "input", ["0.png"], size=(100, 100))
    with pytest.raises(
        UserError, match=r"input/0\.png has 100x100 pixels, which is not the shape of its camera, 640x480"
    ):
        find(tmp_path, ["0.png"])
    photos(tmp_path / "images", ["0.png", "1.png"])
    photos(tmp_path / "images", ["2.png"], size=(100, 100))
    found = find(tmp_path, ["0.jpg", "1.jpg", "2.jpg"])
    assert (levels(found.paths), found.missing) == ([0, 1, None], ("2.jpg",))
    assert found.notes[1].startswith("images/2.png has 100x100 pixels")


def test_a_folder_of_another_name_is_no_other_folder_of_the_same_photo(tmp_path):
    """The photo left/a.png is not right/a.png."""
    photos(tmp_path, ["images/right/a.png"])
    assert find(tmp_path, ["left/a.png"]).paths == (None,)


@pytest.mark.parametrize("write", [colmap, transforms])
def test_a_conversion_names_missing_photos_and_fails_without_any(write, tmp_path):
    photos(tmp_path / "images", numbered("{}.png")[2:])
    write(tmp_path, numbered("images/{}.png"))
    some = nerfcli("convert", tmp_path, tmp_path / "out.json", "--to", "transforms", "--allow-loss")
    assert some.exit_code == 0, some.stderr
    assert f"2 of {COUNT} photos missing: images/0.png, images/1.png" in " ".join(some.stderr.split())
    write(tmp_path, numbered("images/other {}.png"))
    none = nerfcli("convert", tmp_path, tmp_path / "out 2.json", "--to", "transforms", "--allow-loss")
    assert none.exit_code == BAD_INPUT
    assert f"none of the {COUNT} photos of the capture is on disk, such as images/other 0.png" in error_of(none)[0]
    assert not (tmp_path / "out 2.json").exists()


def test_ten_thousand_names_are_looked_up_in_linear_time(tmp_path, monkeypatch):
    """The folder is listed once, and at most as many headers are read as are measured."""
    names = [f"{index}.png" for index in range(2000)]
    (tmp_path / "images").mkdir()
    for name in names:
        (tmp_path / "images" / name).touch()
    listed = []
    monkeypatch.setattr("os.walk", lambda folder: listed.append(folder) or [(str(folder), [], sorted(names))])
    found = find(tmp_path, [name.upper() for name in names])
    assert found.paths == tuple(tmp_path / "images" / name for name in names)
    assert len(listed) == 2  # images/ and the folder itself
