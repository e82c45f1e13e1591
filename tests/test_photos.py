"""Which photos of a folder can be used, which share a camera, and what is said about the rest."""

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from captures import put_photos

from nerfcli.doctor.examination import find_subject
from nerfcli.errors import UserError
from nerfcli.photos.exif import Exif
from nerfcli.poses.input.photos import Photo, camera_groups, find_photos
from nerfcli.poses.model.reasons import NO_TRAINING_PHOTO, dominant, reason

NO_EXIF = Exif(64, 48)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Five good photos; b.jpg is stored lying on its side."""
    put_photos(tmp_path / "photos", "a.jpg", "c.jpg", "d.jpg", "e.jpg", noise=True)
    put_photos(tmp_path / "photos", "b.jpg", orientation=6, noise=True)
    return tmp_path / "photos"


def test_photos_are_sorted_and_upright(folder: Path):
    photos = find_photos(folder)
    assert photos.names == ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg")
    assert [(photo.width, photo.height) for photo in photos.photos[:2]] == [(64, 48), (48, 64)]
    assert photos.unreadable == {}


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
@pytest.mark.parametrize("read", [find_photos, find_subject])
def test_a_name_that_is_not_text_is_refused_before_the_work(folder: Path, read: Callable[[Path], object]):
    (folder / "c.jpg").rename(folder / os.fsdecode(b"caf\xe9.jpg"))
    with pytest.raises(UserError, match=r"the name 'caf\\udce9.jpg' is not in UTF-8"):
        read(folder)


def test_progress_counts_every_file(folder: Path):
    (folder / "f.jpg").write_text("not a readable picture")
    reported: list[tuple[int, int]] = []
    find_photos(folder, lambda done, total: reported.append((done, total)))
    assert reported == [(done, 6) for done in range(1, 7)]


def test_text_and_truncated_files_are_left_out_with_their_reason(folder: Path):
    (folder / "note.jpg").write_text("this is text")
    whole = (folder / "e.jpg").read_bytes()
    (folder / "e.jpg").write_bytes(whole[: len(whole) // 2])
    photos = find_photos(folder)
    assert photos.names == ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
    assert photos.unreadable["note.jpg"] == "not a readable picture"
    assert photos.unreadable["e.jpg"].startswith("damaged or truncated")
    assert str(folder) not in " ".join(photos.unreadable.values())


def test_photos_in_formats_that_are_not_read_are_named_and_not_passed_over(folder: Path):
    """A raw file beside its JPEG is not mentioned, nor is what macOS leaves beside files on other disks."""
    for name in ("f.NEF", "g.dng", "a.CR2", "notes.txt", "._h.dng"):
        (folder / name).write_bytes(b"not for Pillow")
    photos = find_photos(folder)
    assert photos.names == ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg")
    assert photos.unreadable == {
        "f.NEF": "a raw file: develop it to JPEG or 16-bit TIFF",
        "g.dng": "a raw file: develop it to JPEG or 16-bit TIFF",
    }


def test_broken_links_are_named_and_not_passed_over(folder: Path):
    (folder / "f.jpg").symlink_to(folder / "elsewhere.jpg")
    (folder / "g.jpg").symlink_to(folder / "a.jpg")
    photos = find_photos(folder)
    assert photos.names == ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg", "g.jpg")
    assert photos.unreadable == {"f.jpg": "a link to a file that does not exist"}


def test_a_folder_of_nothing_but_such_photos_says_so(tmp_path: Path):
    for number in range(4):
        (tmp_path / f"IMG_{number}.DNG").write_bytes(b"not for Pillow")
    with pytest.raises(UserError, match=r"none of 4 photos in .* can be read.*IMG_0.DNG: a raw file") as caught:
        find_photos(tmp_path)
    assert caught.value.hint.startswith("convert these files to JPEG")
    assert [source.name for source in find_subject(tmp_path).sources] == [f"IMG_{number}.DNG" for number in range(4)]


def test_photos_one_level_down_are_pointed_at(folder: Path):
    with pytest.raises(UserError, match="no photos in") as caught:
        find_photos(folder.parent)
    assert str(folder) in caught.value.hint


def taken(*exifs: Exif) -> list[Photo]:
    """Return photos with these EXIF data, named by their number."""
    return [Photo(f"{number}.jpg", exif.width, exif.height, exif) for number, exif in enumerate(exifs)]


def test_photos_share_a_camera_when_all_optics_and_the_size_agree():
    phone = replace(NO_EXIF, make="A", model="B", lens="wide", focal_mm=4.0, focal_35mm=28.0)
    later, large = replace(phone, exposure_seconds=0.5, orientation=6), replace(NO_EXIF, width=128, height=96)
    others = replace(phone, lens="tele"), replace(phone, focal_35mm=56.0), replace(phone, width=48, height=64)
    groups = camera_groups(taken(phone, NO_EXIF, later, *others, NO_EXIF, large))
    assert groups == ((0, 2), (1, 6), (3,), (4,), (5,), (7,))


@pytest.mark.parametrize(
    ("found", "other_model_size", "words"),
    [
        ((83, 0, None), 0, "too few features (83 in 40x30 pixels)"),
        ((4000, 12, "a.jpg"), 0, "matches no other photo well (best 12 verified matches)"),
        ((4000, 41, "a.jpg"), 0, "rejected by the mapper (41 verified matches with a.jpg)"),
        ((4000, 41, "a.jpg"), 7, "in another model of 7 photos"),
    ],
)
def test_reasons(found: tuple[int, int, str | None], other_model_size: int, words: str):
    assert reason(*found, other_model_size=other_model_size, size_px=(40, 30)) == words


def test_the_dominant_reason_brings_its_advice():
    few = reason(10, 0, None, other_model_size=0, size_px=(40, 30))
    alone = reason(4000, 3, "a", other_model_size=0, size_px=(40, 30))
    kind, advice = dominant([few, alone, alone, "unreadable: damaged"])
    assert (kind, "overlap" in advice) == ("matches no other photo well", True)
    assert "--holdout" in dominant([NO_TRAINING_PHOTO])[1]
    assert "overlap" in dominant(["connected to the rest only through a photo that contradicts it"])[1]
    with pytest.raises(ValueError, match="no reasons"):
        dominant([])
