"""HEIC photos, as phones take them: pixels, orientation, colours, EXIF, damage, and their way into `nerfcli poses`.

The files are written by pillow-heif, another library than the one that reads them. Lossless ones read back exactly.
"""

import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
import pytest
from commands import completed, nerfcli
from PIL import ExifTags, Image, ImageOps
from test_images import P3, exif_with, icc_profile, linear_from_srgb, noise

from nerfcli.captures.loading import load_scene
from nerfcli.errors import UserError
from nerfcli.photos.exif import read_exif
from nerfcli.photos.images import image_size, read_image
from nerfcli.photos.masks import read_mask
from nerfcli.poses.input.layout import lay_out_photos
from nerfcli.poses.input.photos import find_photos

WIDTH, HEIGHT = 96, 64


def write_heic(path: Path, pixels: np.ndarray | Image.Image, *, exact: bool = True, **options: Any) -> Path:
    """Write a HEIC file; losslessly, as RGB without a change of colour space, if it has to be exact."""
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    how = {"quality": -1, "chroma": 444, "matrix_coefficients": 0} if exact else {"quality": 40}
    pillow_heif.from_pillow(image).save(path, **how, **options)
    return path


@pytest.mark.parametrize("tile_size", [None, 64])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_picture_is_turned_once(tmp_path: Path, orientation: int, tile_size: int | None):
    """A file says twice how it is turned, by a property of HEIF and in EXIF; phones store it in tiles."""
    pixels, exif = noise(HEIGHT, WIDTH, 3), exif_with({ExifTags.Base.Orientation: orientation})
    path = write_heic(tmp_path / "a.heic", pixels, exif=exif.tobytes(), tile_size=tile_size)
    same = tmp_path / "same.png"
    Image.fromarray(pixels).save(same, exif=exif)
    with Image.open(same) as stored:
        expected = np.asarray(ImageOps.exif_transpose(stored))
    np.testing.assert_array_equal(read_image(path), expected)
    size = (expected.shape[1], expected.shape[0])
    found = read_exif(path)
    assert image_size(path) == (found.width, found.height) == size
    assert found.orientation == 1


def test_its_exif_is_that_of_a_jpeg(tmp_path: Path):
    tags, gps = ExifTags.Base, ExifTags.GPS
    phone = {tags.Make: "Apple", tags.Model: "iPhone 13 Pro Max"}
    shot = {tags.FocalLength: 5.7, tags.FocalLengthIn35mmFilm: 26, tags.ExposureTime: 1 / 100, tags.ISOSpeedRatings: 80}
    file = {tags.DateTimeOriginal: "2026:11:27 10:00:00", tags.ExifImageWidth: WIDTH, tags.ExifImageHeight: HEIGHT}
    north = {gps.GPSLatitudeRef: "N", gps.GPSLatitude: (43.0, 39.0, 0.0)}
    west = {gps.GPSLongitudeRef: "W", gps.GPSLongitude: (79.0, 23.0, 0.0)}
    above = {gps.GPSAltitudeRef: b"\0", gps.GPSAltitude: 520.5}
    exif = exif_with(phone, {ExifTags.IFD.Exif: shot | file, ExifTags.IFD.GPSInfo: north | west | above})
    pixels = noise(HEIGHT, WIDTH, 3)
    Image.fromarray(pixels).save(tmp_path / "a.jpg", exif=exif)
    found = read_exif(write_heic(tmp_path / "b.heic", pixels, exif=exif.tobytes()))
    assert found == read_exif(tmp_path / "a.jpg")
    assert found.focal_35mm == 26
    assert found.gps == pytest.approx((43.65, -79 - 23 / 60, 520.5), abs=1e-9)


def test_colours_of_display_p3_become_those_of_srgb(tmp_path: Path):
    """As for a PNG file with the same profile; without a change, saturated colours would differ by 30 levels."""
    profile = icc_profile(P3, linear_from_srgb)
    pixels = noise(HEIGHT, WIDTH, 3)
    image = Image.fromarray(pixels)
    image.save(tmp_path / "a.png", icc_profile=profile)
    image.info["icc_profile"] = profile
    converted = read_image(write_heic(tmp_path / "b.heic", image))
    np.testing.assert_array_equal(converted, read_image(tmp_path / "a.png"))
    assert np.abs(converted.astype(int) - pixels).max() > 30


def test_transparency_is_kept(tmp_path: Path):
    pixels = noise(HEIGHT, WIDTH, 4)
    np.testing.assert_array_equal(read_image(write_heic(tmp_path / "a.heic", pixels)), pixels)


@pytest.mark.parametrize(
    ("cut", "what"),
    [(0.0, "empty"), (1e-4, "not a readable picture"), *((cut, "damaged or truncated") for cut in (0.01, 0.5, 0.999))],
)
def test_a_truncated_file_is_named(tmp_path: Path, cut: float, what: str):
    path = write_heic(tmp_path / "a.heic", noise(HEIGHT, WIDTH, 3))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * cut)])
    with pytest.raises(UserError, match=rf"a\.heic is {what}"):
        read_image(path)


def test_sixty_corruptions_are_read_or_named(tmp_path: Path):
    path = write_heic(tmp_path / "a.heic", noise(HEIGHT, WIDTH, 3), exif=exif_with({}).tobytes())
    whole, draw, named = path.read_bytes(), random.Random(0), 0
    for _ in range(60):
        damaged = bytearray(whole)
        for _ in range(draw.randint(1, 8)):
            damaged[draw.randrange(600)] = draw.randrange(256)  # most of what is not pixels stands there
        path.write_bytes(damaged)
        for reader in (read_image, image_size, read_exif):
            try:
                reader(path)
            except UserError:
                named += 1
    assert named > 30


def test_a_mask_in_heic_has_no_grey_edge(tmp_path: Path):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    levels = np.where((x - 40) ** 2 + (y - 30) ** 2 < 500, np.uint8(255), np.uint8(0))
    mask = write_heic(tmp_path / "a.heic", np.repeat(levels[..., None], 3, axis=2), exact=False)
    Image.fromarray(noise(HEIGHT, WIDTH, 3)).save(tmp_path / "photo.png")
    assert np.abs(read_image(mask)[..., 0].astype(int) - levels).max() > 0
    np.testing.assert_array_equal(read_mask(mask, tmp_path / "photo.png"), levels)


def test_structure_from_motion_gets_upright_jpegs(tmp_path: Path):
    photos = tmp_path / "photos"
    photos.mkdir()
    exif = exif_with({ExifTags.Base.Orientation: 6}).tobytes()
    smooth = np.linspace(0, 255, WIDTH * HEIGHT * 3).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
    for number in range(4):
        write_heic(photos / f"IMG_{number}.HEIC", smooth, exif=exif)
    found = find_photos(photos)
    assert found.names == tuple(f"IMG_{number}.HEIC" for number in range(4))
    assert {(photo.width, photo.height) for photo in found.photos} == {(HEIGHT, WIDTH)}
    for laid_out in lay_out_photos(found, tmp_path / "work"):
        with Image.open(tmp_path / "work" / "photos" / laid_out.file) as copy:
            assert (copy.format, copy.size) == ("JPEG", (HEIGHT, WIDTH))
            assert np.abs(np.asarray(copy).astype(int) - read_image(photos / "IMG_0.HEIC")).mean() < 3


def test_a_capture_of_heic_photos_is_trained_evaluated_and_converted(capture: Path, tmp_path: Path):
    """The spheres, whose photos become HEIC files: what is rendered is compared with their pixels."""
    for path in [*capture.rglob("*.png")]:
        write_heic(path.with_suffix(".heic"), read_image(path))
        path.unlink()
    for path in capture.glob("transforms_*.json"):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            frame["file_path"] += ".heic"
        path.write_text(json.dumps(content))
    loaded = load_scene(capture)
    assert {frame.image.suffix for frame in loaded.frames if frame.image} == {".heic"}
    run = tmp_path / "run"
    assert nerfcli("train", capture, "--steps", "3", "--model", "default", "-o", run).exit_code == 0
    assert nerfcli("evaluate", run).exit_code == 0
    converted = completed("convert", capture, tmp_path / "colmap", "--to", "colmap", "--allow-loss")
    assert "the photos are .heic files, which many other programs cannot read" in converted.stderr
    assert "HEIC" not in nerfcli("convert", capture, tmp_path / "scene", "--to", "nerfcli").stderr
    (measured,) = json.loads((run / "metrics.json").read_text())["images"]
    assert measured["pixels"] == 96 * 72
