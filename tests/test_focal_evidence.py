"""The focal length in EXIF, and whether it is valid for the file: against known cameras and edits."""

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import ExifTags, Image
from test_photos import NO_EXIF, taken

from nerfcli.photos.exif import Exif, read_exif
from nerfcli.photos.focal_evidence import focal_evidence, with_digital_zoom
from nerfcli.poses.engine.database import camera_of_group
from nerfcli.poses.input.photos import Photos, camera_groups, find_photos
from nerfcli.poses.model.cameras import PhotoGroups, group_photos

# A full-frame camera with a lens of 50 mm, by its own numbers: 50 / 36 * 5472 = 7600 pixels.
CAMERA = replace(
    NO_EXIF, make="A", model="B", focal_mm=50.0, sensor_px_per_mm=152.0, width=5472, height=3648, taken_px=(5472, 3648)
)
PHONE = replace(NO_EXIF, make="A", model="P", focal_mm=4.0, focal_35mm=28.0, width=4032, height=3024)


def sized(exif: Exif, width: int, height: int) -> Exif:
    return replace(exif, width=width, height=height)


def grouped(*exifs: Exif) -> PhotoGroups:
    """Return the cameras of photos with these EXIF data."""
    return group_photos(Photos(Path(), tuple(taken(*exifs)), {}), model="auto")


@pytest.mark.parametrize(
    ("exif", "focal_px"),
    [
        (CAMERA, 7600.0),
        (sized(CAMERA, 3648, 5472), 7600.0),  # held upright
        (sized(CAMERA, 1600, 1067), 7600.0 * 1600 / 5472),  # resized: the resolution is that of the original pixels
        (replace(CAMERA, focal_35mm=50.0), 7600.0),
        (PHONE, 28 / 43.27 * 5040),  # by the diagonal; by the width it would be 3136 px, not 3261
        (replace(PHONE, taken_px=(4032, 3024)), 28 / 43.27 * 5040),
        (replace(sized(PHONE, 1008, 756), taken_px=(4032, 3024)), 28 / 43.27 * 1260),
        (replace(sized(PHONE, 1600, 1200), taken_px=(3024, 4032)), 28 / 43.27 * 2000),
        # Squares as high as the photo was: cut, but not resized.
        (sized(CAMERA, 3648, 3648), 7600.0),
        (replace(sized(PHONE, 3024, 3024), taken_px=(4032, 3024)), 28 / 43.27 * 5040),
        (NO_EXIF, None),
        (replace(CAMERA, focal_mm=None), None),
        (replace(CAMERA, taken_px=None), None),
    ],
)
def test_a_focal_length_that_holds(exif: Exif, focal_px: float | None):
    """Closed form: 36 mm or 43.27 mm of film are the width or the diagonal of the whole picture."""
    found = focal_evidence(exif)
    assert (found.holds, found.doubt) == (True, "")
    assert found.focal_px == (None if focal_px is None else pytest.approx(focal_px, rel=2e-3))


@pytest.mark.parametrize(
    ("exif", "focal_px", "words"),
    [
        (sized(CAMERA, 640, 640), 7600.0 * 640 / 3648, "EXIF is for 5472x3648 pixels, but the file has 640x640"),
        (replace(sized(PHONE, 1280, 720), taken_px=(4032, 3024)), 28 / 43.27 * 1600, "cropped after the shot"),
        (sized(PHONE, 640, 640), 28 / 43.27 * 640 * 2**0.5, "an unusual size of 640x640 pixels"),
    ],
)
def test_a_focal_length_of_another_picture(exif: Exif, focal_px: float, words: str):
    """Cropped and resized: the result is the focal length of the largest possible crop, and it is doubted."""
    found = focal_evidence(exif)
    assert not found.holds
    assert words in found.doubt
    assert found.focal_px == pytest.approx(focal_px, rel=2e-3)


@pytest.mark.parametrize("exif", [replace(CAMERA, sensor_px_per_mm=3000.0), replace(CAMERA, sensor_px_per_mm=20.0)])
def test_a_resolution_that_no_sensor_has_is_ignored(exif: Exif):
    """5472 pixels on a sensor of 1.8 or 274 mm: the tag is for another image size."""
    assert focal_evidence(exif).focal_px is None


def test_an_absurd_focal_length_is_doubted():
    found = focal_evidence(replace(PHONE, focal_35mm=4000.0))
    assert (found.focal_px, found.holds) == (None, False)
    assert "EXIF gives" in found.doubt


def test_the_recorded_size_and_resolution_are_read(tmp_path: Path):
    exif, tags = Image.Exif(), ExifTags.Base
    camera = exif.get_ifd(ExifTags.IFD.Exif)
    camera[tags.ExifImageWidth], camera[tags.ExifImageHeight], camera[tags.FocalLength] = 5472, 3648, 50.0
    camera[tags.FocalPlaneXResolution], camera[tags.FocalPlaneResolutionUnit] = 152 * 25.4, 2
    Image.new("RGB", (60, 40)).save(tmp_path / "a.jpg", exif=exif)
    found = read_exif(tmp_path / "a.jpg")
    assert found.taken_px == (5472, 3648)
    assert found.sensor_px_per_mm == pytest.approx(152.0)
    assert focal_evidence(found).focal_px == pytest.approx(7600 * 60 / 5472, rel=1e-6)
    camera[tags.ExifImageWidth], camera[tags.FocalPlaneResolutionUnit] = 0, 9
    Image.new("RGB", (60, 40)).save(tmp_path / "b.jpg", exif=exif)
    odd = read_exif(tmp_path / "b.jpg")
    assert (odd.taken_px, odd.sensor_px_per_mm) == (None, None)


@pytest.mark.parametrize(
    ("equivalents", "zooms", "expected"),
    [
        ((23, 23, 23), (1.0, 1.09, 2.41), (23, 25.07, 55.43)),  # Samsung leaves digital zoom out
        ((26, 28, 52), (1.0, 1.09, 2.0), (26, 28, 52)),  # Apple includes it, in whole millimetres
        ((23, 23, 23), (2.0, 2.0, 2.0), (23, 23, 23)),  # one zoom alone does not tell
        ((23, 23, 23), (1.0, 1.02, 1.01), (23, 23, 23)),  # nor do zooms within the rounding
        ((23, 23, 23), (None, None, None), (23, 23, 23)),
        ((None, None, None), (1.0, 1.5, 2.0), (None, None, None)),
    ],
)
def test_digital_zoom_counts_once(equivalents, zooms, expected):
    taken = [
        replace(PHONE, focal_35mm=equivalent, digital_zoom=zoom)
        for equivalent, zoom in zip(equivalents, zooms, strict=True)
    ]
    other = replace(PHONE, model="Q", focal_35mm=40.0, digital_zoom=3.0)
    *found, last = with_digital_zoom([*taken, other])
    assert [exif.focal_35mm for exif in found] == [None if one is None else pytest.approx(one) for one in expected]
    assert [exif.focal_mm for exif in found] == pytest.approx([4.0 * (zoom or 1.0) for zoom in zooms])
    assert (last.focal_35mm, last.focal_mm) == (40.0, 12.0)


@pytest.mark.parametrize(("ratio", "zoom"), [(1.44, 1.44), (0, None), (0.5, None), (1000, None), (None, None)])
def test_photos_with_other_digital_zooms_have_other_cameras(ratio, zoom, tmp_path):
    for index in range(5):
        exif, tags = Image.Exif(), ExifTags.Base
        camera = exif.get_ifd(ExifTags.IFD.Exif)
        camera[tags.FocalLength], camera[tags.FocalLengthIn35mmFilm] = 5.4, 23
        if index != 4:
            camera[tags.DigitalZoomRatio] = 1.0
        elif ratio is not None:
            camera[tags.DigitalZoomRatio] = ratio
        Image.new("RGB", (80, 60)).save(tmp_path / f"{index}.jpg", exif=exif)
    found = find_photos(tmp_path)
    assert read_exif(tmp_path / "4.jpg").digital_zoom == zoom
    groups = group_photos(found, model="auto").groups
    assert [len(group.photos) for group in groups] == ([4, 1] if zoom else [5])
    expected = [23 / 43.27 * 100 * (z or 1) for z in (1, zoom)]
    assert [group.focal_px for group in groups] == pytest.approx(expected[: len(groups)])


def test_cameras_start_from_exif_only_where_it_holds():
    found = grouped(CAMERA, sized(CAMERA, 640, 640), sized(NO_EXIF, 640, 480))
    cameras = [camera_of_group(group) for group in found.groups]
    assert [camera.has_prior_focal_length for camera in cameras] == [True, False, False]
    assert [camera.mean_focal_length() for camera in cameras] == pytest.approx([7600, 7600 * 640 / 3648, 768])
    assert found.notes[1:] == (
        "EXIF's focal length is only a starting value for 1.jpg: EXIF is for 5472x3648 pixels, but the file has "
        "640x640: cropped after the shot",
    )
    bare = [camera_of_group(replace(group, focal_px=None, focal_is_prior=False)) for group in found.groups]
    assert [camera.mean_focal_length() for camera in bare] == pytest.approx([1.2 * 5472, 768, 768])
    assert not any(camera.has_prior_focal_length for camera in bare)


def test_cameras_are_listed():
    big, small = sized(NO_EXIF, 4000, 3000), sized(NO_EXIF, 640, 480)
    assert grouped(big, big).notes == ()
    assert grouped(big, big, small).notes == (
        "2 cameras, by EXIF and size: 2 photos of 4000x3000 (SIMPLE_RADIAL), 1 photo of 640x480 (SIMPLE_RADIAL)",
    )
    zooms = [replace(CAMERA, focal_mm=float(20 * n)) for n in range(1, 8)]
    (note,) = grouped(*zooms, replace(zooms[0], lens="8mm Fisheye")).notes
    assert note == (
        "8 cameras, by EXIF and size: 1 photo of 5472x3648 (OPENCV_FISHEYE), 7 photos of 5472x3648 (SIMPLE_RADIAL)"
    )
    (note,) = grouped(replace(CAMERA, lens="8mm Fisheye"), *(sized(NO_EXIF, 600 + n, 480) for n in range(22))).notes
    assert note.startswith("23 cameras, by EXIF and size: 1 photo of 5472x3648 (OPENCV_FISHEYE), 1 photo of 600x480 (")
    assert note.endswith("1 photo of 604x480 (SIMPLE_RADIAL) and 17 more")


def test_doubts_about_exif_are_one_note_for_a_reason_and_few_in_all():
    _, *doubts = grouped(*(sized(CAMERA, 640 + 8 * (n // 2), 640) for n in range(14))).notes
    assert len(doubts) == 5
    first = "EXIF's focal length is only a starting value for 0.jpg and 1 more photo: EXIF is for 5472x3648"
    assert doubts[0].startswith(first)
    assert doubts[-1] == "and for 6 more photos, for reasons like these"


def test_crops_of_other_pictures_are_other_cameras_and_autofocus_is_not():
    a, b = sized(CAMERA, 640, 640), replace(sized(CAMERA, 640, 640), taken_px=(4000, 3000))
    photos = taken(a, b, replace(a, focal_mm=50.6), replace(a, focal_mm=52.0))
    assert camera_groups(photos) == ((0, 2), (1,), (3,))
