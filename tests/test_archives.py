"""Archives of captures: what is unpacked, where, and what is refused, since archives come from others."""

import shutil
import stat
import zipfile
from collections import namedtuple
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from captures import refused
from clips import encode
from every_format import WITH_PHOTOS, Views
from test_new_formats import PLACES, POSES

from nerfcli.cameras.camera import Camera
from nerfcli.captures.archives import unpacked
from nerfcli.captures.conversion import TargetOptions
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import format_named, recognise
from nerfcli.captures.loading import load_scene
from nerfcli.errors import UserError
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.images import read_image
from nerfcli.workflows.convert import convert_capture
from nerfcli.workflows.describe import describe

Disk = namedtuple("Disk", "free")
VIEWS = Views(Camera.pinhole(64, 48, 70.0), POSES)


def packed(folder: Path, path: Path, *, inside: str = "") -> Path:
    """Pack the files of a folder, in a folder of this name if there is one."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            archive.write(file, f"{inside}{file.relative_to(folder)}")
    return path


def zipped(path: Path, *entries: str | zipfile.ZipInfo, content: str | bytes = "a") -> Path:
    """Pack files of the same content."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for each in entries:
            archive.writestr(each, content)
    return path


def unpack(path: Path, result: Path, *, overwrite: bool = False) -> Path:
    return unpacked(path, Output(result, overwrite), reporter=Reporter())


def entry(name: str, *, mode: int = stat.S_IFREG | 0o644) -> zipfile.ZipInfo:
    made = zipfile.ZipInfo(name)
    made.external_attr = mode << 16
    return made


@pytest.mark.parametrize("inside", ["", "my scan/", "exports/my scan/"])
@pytest.mark.parametrize("name", ["kapture", "polycam", "record3d", "euroc", "nerfies"])
def test_a_capture_in_an_archive_is_unpacked_beside_the_result(tmp_path, name, inside):
    WITH_PHOTOS[name](VIEWS, tmp_path / "made")
    suffix = ".r3d" if name == "record3d" else ".zip"
    path = packed(tmp_path / "made", tmp_path / f"downloads.{name}{suffix}", inside=inside)
    result = tmp_path / "results/scene"
    folder = unpack(path, result)
    assert folder.is_relative_to(tmp_path / f"results/downloads.{name}-unpacked")
    assert recognise(folder)[0].name == name
    scene = load_scene(folder)
    np.testing.assert_allclose(sorted(f.centre.tolist() for f in scene.frames), sorted(PLACES.tolist()), atol=1e-12)
    assert {item.name for item in tmp_path.iterdir()} == {"made", path.name, "results"}


def test_a_conversion_of_an_archive_and_its_repetition(tmp_path):
    WITH_PHOTOS["kapture"](VIEWS, tmp_path / "made")
    path = packed(tmp_path / "made", tmp_path / "walk.zip")
    notes: list[str] = []
    reporter = Reporter(note=notes.append)
    wanted = TargetOptions(format_named("nerfcli"))
    convert_capture(path, tmp_path / "out/scene", wanted, reporter=reporter)
    assert notes[0] == f"{tmp_path}/out/walk-unpacked: 5 files of walk.zip"
    assert len(load_scene(tmp_path / "out/scene").frames) == 2
    again = TargetOptions(format_named("nerfcli"), overwrite=True)
    convert_capture(path, tmp_path / "out/scene", again, reporter=reporter)
    assert f"{tmp_path}/out/walk-unpacked is kept: it has the files of walk.zip" in notes


def test_another_archive_of_this_name_replaces_the_files_only_if_it_may(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a/one.txt").write_text("one")
    path = packed(tmp_path / "a", tmp_path / "walk.zip")
    folder = unpack(path, tmp_path / "scene")
    (tmp_path / "a/one.txt").rename(tmp_path / "a/two.txt")
    packed(tmp_path / "a", path)
    with pytest.raises(UserError, match=r"walk-unpacked contains the files of another walk.zip") as caught:
        unpack(path, tmp_path / "scene")
    assert "--overwrite" in caught.value.hint
    assert unpack(path, tmp_path / "scene", overwrite=True) == folder
    assert sorted(item.name for item in folder.iterdir()) == ["archive.json", "two.txt"]
    (folder / "archive.json").unlink()
    with pytest.raises(UserError, match=r"cannot unpack .*: it contains other files"):
        unpack(path, tmp_path / "scene", overwrite=True)


def test_a_note_beside_the_folder_of_a_capture_is_passed_over(tmp_path):
    WITH_PHOTOS["kapture"](VIEWS, tmp_path / "made")
    path = packed(tmp_path / "made", tmp_path / "scan.zip", inside="my scan/")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("README.txt", "a scan")
    assert unpack(path, tmp_path / "scene") == tmp_path / "scan-unpacked/my scan"


def test_a_folder_of_nothing_but_an_archive_says_so(tmp_path):
    zipped(tmp_path / "scan.ZIP", entry("a.txt"), content="")
    with pytest.raises(UserError, match="contains no capture") as caught:
        recognise(tmp_path)
    assert caught.value.hint == f"there is an archive in it: nerfcli convert {tmp_path / 'scan.ZIP'} SCENE --to nerfcli"


def test_separators_of_windows_are_read(tmp_path):
    folder = unpack(zipped(tmp_path / "scan.zip", entry("scan\\images\\a.txt"), content="good"), tmp_path / "scene")
    assert (folder / "a.txt").read_text() == "good"
    assert folder == tmp_path / "scan-unpacked/scan/images"


def test_an_archive_in_an_archive_is_named(tmp_path):
    path = zipped(tmp_path / "outer.zip", entry("scan/inner.zip"), content="")
    with pytest.raises(UserError, match=r"outer\.zip contains only archives, such as scan/inner\.zip"):
        unpack(path, tmp_path / "scene")
    assert not (tmp_path / "outer-unpacked").exists()


@pytest.mark.parametrize(
    "name", ["../out.txt", "a/../../out.txt", "/tmp/out.txt", "C:/out.txt", "..\\out.txt", "a\nb.txt", "\\\\host\\out"]
)
def test_names_that_lead_elsewhere_are_refused(tmp_path, name):
    path = zipped(tmp_path / "bad.zip", entry("good.txt"), entry(name))
    with refused("is not safe to unpack: it has a file named", path):
        unpack(path, tmp_path / "results/scene")
    assert [item.name for item in tmp_path.iterdir()] == ["bad.zip"]


def test_links_encrypted_files_and_equal_names_are_refused(tmp_path):
    path = tmp_path / "bad.zip"
    for made, what in (
        ([entry("link", mode=stat.S_IFLNK | 0o777)], "link is a link or a device"),
        ([entry("a/B.txt"), entry("a/b.txt")], "a/b.txt is in it twice"),
        ([], "contains no files"),
    ):
        with pytest.raises(UserError, match=what):
            unpack(zipped(path, *made, content="/etc"), tmp_path / "scene")
    data = bytearray(zipped(path, "a.txt").read_bytes())
    data[6] |= 1  # bit 0 of the flags, in both headers
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"bad.zip is encrypted"):
        unpack(path, tmp_path / "scene")


def test_a_compression_that_is_not_supported_is_not_called_damage(tmp_path):
    """Explorer packs files of more than 2 GB with Deflate64, method 9."""
    path = zipped(tmp_path / "walk.zip", "a.txt")
    data = bytearray(path.read_bytes())
    data[8] = data[data.index(b"PK\x01\x02") + 10] = 9
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"walk.zip cannot be unpacked: .*compression") as caught:
        unpack(path, tmp_path / "scene")
    assert caught.value.hint.startswith("unpack it with another program")
    assert [item.name for item in tmp_path.iterdir()] == ["walk.zip"]


def test_a_bomb_is_refused_before_anything_is_written(tmp_path):
    path = zipped(tmp_path / "bomb.zip", *(f"{index}.txt" for index in range(11)), content=bytes(10 << 20))
    assert path.stat().st_size < 200_000  # 115 MB of zeros
    with pytest.raises(UserError, match=r"is not safe to unpack: it claims to hold 11 files \(0.1 GB\) in 0.1 MB"):
        unpack(path, tmp_path / "scene")
    assert [item.name for item in tmp_path.iterdir()] == ["bomb.zip"]


def test_sizes_that_are_stated_too_small_and_full_disks_leave_nothing(tmp_path, monkeypatch):
    path = zipped(tmp_path / "liar.zip", "a.txt", content=bytes(1 << 20))
    data = bytearray(path.read_bytes())
    place = data.index(b"PK\x01\x02") + 24  # the size in the central directory
    data[place : place + 4] = (1000).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"liar.zip is not a readable zip archive"):
        unpack(path, tmp_path / "scene")
    zipped(path, "a.txt", content="abc")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Disk(free=2))
    with pytest.raises(UserError, match=r"would need 0.0 GB, and .* has only 0.0 GB"):
        unpack(path, tmp_path / "scene")
    assert [item.name for item in tmp_path.iterdir()] == ["liar.zip"]


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_truncated_archive_is_refused_and_leaves_nothing(tmp_path, share):
    WITH_PHOTOS["kapture"](VIEWS, tmp_path / "made")
    path = packed(tmp_path / "made", tmp_path / "walk.zip")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(UserError, match=r"walk.zip is not a readable zip archive"):
        unpack(path, tmp_path / "scene")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["made", "walk.zip"]


def test_what_systems_add_is_left_out(tmp_path):
    names = ("walk/a.txt", "__MACOSX/walk/._a.txt", "walk/.DS_Store", "walk/._a.txt")
    folder = unpack(zipped(tmp_path / "mac.zip", *names), tmp_path / "scene")
    assert [item.name for item in folder.iterdir()] == ["a.txt"]


def test_commands_without_a_result_say_how_to_unpack(tmp_path):
    path = packed(WITH_PHOTOS["nerfies"](VIEWS, tmp_path / "made").parent, tmp_path / "walk.zip")
    for refuse in (recognise, describe, load_scene):
        with pytest.raises(UserError, match=r"walk.zip is an archive") as caught:
            refuse(path)
        assert "nerfcli convert" in caught.value.hint


def write_scan_with_video(folder: Path, levels: Sequence[int]) -> None:
    """Write a capture of Stray Scanner without photos, and its video, with frames of these grey levels."""
    WITH_PHOTOS["stray-scanner"](Views(VIEWS.camera, np.tile(POSES, (3, 1, 1))), folder)
    for photo in (folder / "rgb").iterdir():
        photo.unlink()
    encode(folder / "rgb.mp4", [np.full((48, 64, 3), level, np.uint8) for level in levels])


def test_frames_of_a_video_are_written_beside_the_result(tmp_path):
    """Each photo is the video's frame of its number: its brightness says which."""
    levels = [20, 60, 100, 140, 180, 220]
    write_scan_with_video(tmp_path / "scan", levels)
    with pytest.raises(UserError, match=r"none of its 6 photos is on disk") as caught:
        load_scene(tmp_path / "scan")
    assert "they are frames of rgb.mp4; nerfcli convert" in caught.value.hint
    wanted = TargetOptions(format_named("nerfcli"))
    with pytest.raises(UserError, match="stray-scanner captures have their own cameras"):
        convert_capture(tmp_path / "scan", tmp_path / "out", wanted, given=UserInputs(camera=VIEWS.camera))
    assert [path.name for path in tmp_path.iterdir()] == ["scan"]
    convert_capture(tmp_path / "scan", tmp_path / "out/room-scene", wanted)
    scene = load_scene(tmp_path / "out/room-scene")
    assert [frame.name for frame in scene.frames] == [f"frame_{index:06d}.jpg" for index in range(6)]
    for index, frame in enumerate(scene.frames):
        assert frame.image is not None
        assert frame.image.parent == tmp_path / "out/room-frames"
        assert abs(read_image(frame.image).mean() - levels[index]) < 3
        np.testing.assert_allclose(frame.centre, PLACES[index % 2], rtol=0, atol=1e-12)
    kept = sorted(item.name for item in (tmp_path / "scan").iterdir())
    assert kept == ["camera_matrix.csv", "odometry.csv", "rgb", "rgb.mp4"]


@pytest.mark.parametrize(
    ("target", "form", "more", "message"),
    [
        ("room", "nerfcli", {"masks": Path("nowhere")}, "the mask folder nowhere does not exist"),
        ("room.json", "transforms", {}, r"it would lose: the unit of length \(metre\)"),
        ("scan", "colmap", {}, "scan/cameras.bin exists"),
        ("room", "stray-scanner", {}, "stray-scanner can be read, not written"),
    ],
)
def test_no_video_is_decoded_for_a_conversion_that_is_refused(target, form, more, message, tmp_path, monkeypatch):
    """Regression: with --overwrite, it had replaced the frames of the earlier result by then."""
    write_scan_with_video(tmp_path / "scan", [20, 60])
    (tmp_path / "scan/cameras.bin").touch()
    monkeypatch.setattr("nerfcli.workflows.convert.extract_frames", lambda *_, **__: pytest.fail("decoded"))
    wanted = TargetOptions(format_named(form), overwrite=target == "room")
    with pytest.raises(UserError, match=message):
        convert_capture(tmp_path / "scan", tmp_path / target, wanted, given=UserInputs(**more))


def test_results_whose_names_have_a_dot_have_frames_of_their_own(tmp_path):
    """Regression: the frames of room.2 replaced those of room.1."""
    write_scan_with_video(tmp_path / "scan", [20, 60, 100, 140, 180, 220])
    for name in ("room.1", "room.2"):
        convert_capture(tmp_path / "scan", tmp_path / name, TargetOptions(format_named("nerfcli")))
    unitless, silent = TargetOptions(format_named("transforms"), allow_loss=True), Reporter(warn=lambda text: None)
    convert_capture(tmp_path / "scan", tmp_path / "room.3.json", unitless, reporter=silent)
    folders = sorted(path.name for path in tmp_path.iterdir() if path.is_dir())
    assert folders == ["room.1", "room.1-frames", "room.2", "room.2-frames", "room.3-frames", "scan"]
