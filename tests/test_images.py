"""nerfcli.photos.images: orientation, colour, damage, exact downscaling, EXIF, PNG."""

import io
import math
import struct
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pillow_heif
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image, ImageCms, ImageOps, TiffImagePlugin
from PIL.TiffImagePlugin import IFDRational

from nerfcli.errors import BAD_INPUT, UserError
from nerfcli.photos.exif import read_exif
from nerfcli.photos.images import (
    HEIC_SUFFIXES,
    IMAGE_SUFFIXES,
    downscale,
    image_size,
    list_images,
    list_photos,
    read_image,
    write_png,
)
from nerfcli.poses.input.photos import find_photos

# Linear red, green, blue to XYZ (D50), Bradford-adapted, a column each: IEC 61966-2-1 and SMPTE EG 432-1.
SRGB = ((0.43607, 0.22250, 0.01393), (0.38506, 0.71688, 0.09710), (0.14308, 0.06062, 0.71417))
P3 = ((0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407))


def linear_from_srgb(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)


Curve = Callable[[np.ndarray], np.ndarray]


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def exif_with(entries: Mapping[Any, Any], ifds: Mapping[Any, Mapping[Any, Any]] | None = None) -> Image.Exif:
    exif = Image.Exif()
    exif.update(entries)
    for which, content in (ifds or {}).items():
        exif.get_ifd(which).update(content)
    return exif


def icc_profile(columns: tuple, curve: Curve) -> bytes:
    """Return an ICC v2 matrix profile, built by hand: header, tags, one curve of 1024 values for all channels."""

    def s15(number: float) -> bytes:
        return round(number * 65536).to_bytes(4, "big", signed=True)

    xyz = [b"XYZ \0\0\0\0" + b"".join(s15(part) for part in c) for c in ((0.9642, 1.0, 0.8249), *columns)]
    values = np.rint(65535 * curve(np.linspace(0, 1, 1024))).astype(">u2").tobytes()
    table_curve = b"curv\0\0\0\0" + (1024).to_bytes(4, "big") + values
    description = b"desc\0\0\0\0" + (5).to_bytes(4, "big") + b"test\0" + bytes(79)
    tags = [
        *((b"desc", description), (b"cprt", b"text\0\0\0\0none\0\0\0\0")),
        *zip((b"wtpt", b"rXYZ", b"gXYZ", b"bXYZ"), xyz, strict=True),
        *((name, table_curve) for name in (b"rTRC", b"gTRC", b"bTRC")),
    ]
    table, body = len(tags).to_bytes(4, "big"), b""
    start = 128 + 4 + 12 * len(tags)
    for name, data in tags:
        table += name + (start + len(body)).to_bytes(4, "big") + len(data).to_bytes(4, "big")
        body += data
    size = (start + len(body)).to_bytes(4, "big")
    header = size + bytes(4) + b"\x02\x40\0\0mntrRGB XYZ " + bytes(12) + b"acsp" + bytes(28) + s15(0.9642)
    return (header + s15(1.0) + s15(0.8249)).ljust(128, b"\0") + table + body


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        (".png", {}),
        (".jpg", {"quality": 95}),
        (".webp", {"lossless": True}),
        (".tif", {}),
        (".tif", {"compression": "tiff_lzw"}),
    ],
)
def test_every_orientation_is_applied_once_as_pillow_does(tmp_path, orientation, suffix, options):
    path = tmp_path / f"photo{suffix}"
    exif = exif_with({ExifTags.Base.Orientation: orientation})
    Image.fromarray(noise(5, 7, 3)).save(path, exif=exif, **options)
    with Image.open(path) as stored:
        expected = np.asarray(ImageOps.exif_transpose(stored))
    picture = read_image(path)
    np.testing.assert_array_equal(picture, expected)
    assert image_size(path) == (picture.shape[1], picture.shape[0]) == ((7, 5) if orientation < 5 else (5, 7))
    found = read_exif(path)
    assert (found.orientation, found.width, found.height) == (orientation, *image_size(path))


@pytest.mark.parametrize("mode", ["L", "I;16", "P", "RGB", "RGBA", "CMYK"])
def test_an_uncompressed_tiff_is_turned_in_every_mode(tmp_path, mode):
    """Pillow maps some of them into memory, with width and height exchanged."""
    path, stored = tmp_path / "photo.tif", Image.fromarray(noise(5, 7, 3)).convert("L" if mode == "I;16" else mode)
    stored.convert(mode).save(path)
    expected = np.rot90(read_image(path), -1)
    stored.convert(mode).save(path, tiffinfo={ExifTags.Base.Orientation: 6})
    np.testing.assert_array_equal(read_image(path), expected)


@pytest.mark.parametrize("orientation", [0, 9, 65535])
def test_an_orientation_out_of_range_reads_as_upright(tmp_path, orientation):
    path, stored = tmp_path / "photo.png", noise(2, 3, 3)
    Image.fromarray(stored).save(path, exif=exif_with({ExifTags.Base.Orientation: orientation}))
    np.testing.assert_array_equal(read_image(path), stored)
    assert read_exif(path).orientation == 1


@pytest.mark.parametrize("name", ["with space.png", "Küche 北.png", "UPPER.PNG", "a:b%d.png"])
@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 3), (4, 5, 4), (1, 1, 3)])
def test_png_round_trip_is_bit_exact_with_its_metadata(tmp_path, name, shape):
    path, pixels = tmp_path / "new folder" / name, noise(*shape)
    metadata = {"convention": "conditional", "scene": "Küche 北", "empty": ""}
    write_png(path, pixels, metadata=metadata)
    expected = np.repeat(pixels[..., None], 3, axis=2) if len(shape) == 2 else pixels
    picture = read_image(path)
    np.testing.assert_array_equal(picture, expected)
    assert picture.flags.writeable
    assert picture.dtype == np.uint8
    with Image.open(path) as image:
        assert image.info == metadata
    assert [p.name for p in path.parent.iterdir()] == [name]


def test_write_png_refuses_what_is_no_8_bit_picture(tmp_path):
    for wrong in (np.zeros((4, 5, 3)), np.zeros((4, 5, 2), np.uint8), np.zeros(4, np.uint8)):
        with pytest.raises(ValueError, match=r"image must be uint8 \(H, W\[, 3\|4\]\), got"):
            write_png(tmp_path / "a.png", wrong)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
def test_grey_pixels_of_16_bits_keep_their_high_byte(tmp_path, suffix):
    path = tmp_path / f"grey{suffix}"
    wide = np.array([[0, 255, 256, 257], [32768, 65279, 65280, 65535]], dtype=np.uint16)
    Image.fromarray(wide).save(path)
    np.testing.assert_array_equal(read_image(path), np.repeat((wide >> 8)[..., None], 3, axis=2))


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_colours_of_16_bits_that_were_8_come_back_exactly(tmp_path, suffix):
    cv2 = pytest.importorskip("cv2")
    path, pixels = tmp_path / f"colour{suffix}", noise(6, 5, 3)
    cv2.imwrite(str(path), pixels[..., ::-1].astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_image(path), pixels)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("prefix", [b"II*\0", b"MM\0*"])
def test_a_tiff_with_a_plane_for_each_colour(tmp_path, bits, prefix):
    path, pixels = tmp_path / "planes.tif", noise(5, 7, 3)
    plane = 35 * bits // 8
    header = TiffImagePlugin.ImageFileDirectory_v2(prefix + bytes(4))
    size = {"ImageWidth": 7, "ImageLength": 5, "RowsPerStrip": 5}
    kind = {"Compression": 1, "PhotometricInterpretation": 2, "SamplesPerPixel": 3, "PlanarConfiguration": 2}
    planes = {"BitsPerSample": [bits] * 3, "StripByteCounts": [plane] * 3, "StripOffsets": [0, plane, 2 * plane]}
    for name, value in {**size, **kind, **planes}.items():
        header[ExifTags.Base[name]] = value
    with path.open("wb") as file:
        header.save(file)
        samples = pixels if bits == 8 else pixels.astype("<u2" if prefix[:1] == b"I" else ">u2") * 257
        file.write(np.moveaxis(samples, 2, 0).tobytes())
    np.testing.assert_array_equal(read_image(path), pixels)


def test_palette_one_bit_and_grey_with_alpha(tmp_path):
    palette = Image.fromarray(noise(5, 4)).convert("P")
    palette.putpalette(noise(768).tolist())
    colours = np.asarray(palette.convert("RGB"))
    palette.save(tmp_path / "palette.png")
    np.testing.assert_array_equal(read_image(tmp_path / "palette.png"), colours)

    alphas = noise(256, seed=1)
    palette.save(tmp_path / "alpha.png", transparency=alphas.tobytes())
    expected = np.dstack([colours, alphas[np.asarray(palette)]])
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png"), expected)

    bits = noise(5, 4) > 127
    Image.fromarray(bits).save(tmp_path / "bits.png")
    expected = np.repeat(255 * bits[..., None], 3, axis=2)
    np.testing.assert_array_equal(read_image(tmp_path / "bits.png"), expected)

    grey_alpha = noise(5, 4, 2)
    Image.fromarray(grey_alpha, mode="LA").save(tmp_path / "la.png")
    np.testing.assert_array_equal(read_image(tmp_path / "la.png"), grey_alpha[..., [0, 0, 0, 1]])


def test_cmyk_becomes_rgb(tmp_path):
    path = tmp_path / "print.tif"
    inks = np.array([[[0, 0, 0, 0], [255, 0, 0, 0], [0, 0, 0, 255]]], np.uint8)
    Image.fromarray(inks, mode="CMYK").save(path)
    np.testing.assert_array_equal(read_image(path), [[[255, 255, 255], [0, 255, 255], [0, 0, 0]]])


@pytest.mark.parametrize(("dtype", "kind"), [(np.float32, "float"), (np.int32, "integer")])
def test_pixels_without_a_known_white_are_refused(tmp_path, dtype, kind):
    path = tmp_path / "depth.tif"
    Image.fromarray(np.ones((3, 4), dtype)).save(path)
    with pytest.raises(UserError, match=rf"depth\.tif has 32-bit {kind} pixels, whose white level is unknown"):
        read_image(path)


@pytest.mark.parametrize(("columns", "curve"), [(P3, linear_from_srgb), (SRGB, lambda value: value)])
@pytest.mark.parametrize("channels", [3, 4])
def test_colours_of_another_profile_are_converted_as_by_the_formula(tmp_path, columns, curve, channels):
    """Display P3 and linear sRGB, against the formula in float64; alpha is unchanged."""
    path, pixels = tmp_path / "other.png", noise(9, 8, channels)
    Image.fromarray(pixels).save(path, icc_profile=icc_profile(columns, curve))
    picture = read_image(path)
    linear = curve(pixels[..., :3] / 255) @ np.array(columns) @ np.linalg.inv(SRGB)
    expected = 255 * srgb_from_linear(linear.clip(0, 1))
    assert np.abs(picture[..., :3] - expected).max() < 1.5  # the colour engine works in 8 to 16 bits
    assert np.abs(picture[..., :3].astype(int) - pixels[..., :3]).max() > 20
    np.testing.assert_array_equal(picture[..., 3:], pixels[..., 3:])


def test_srgb_and_broken_and_foreign_profiles_leave_the_pixels_alone(tmp_path):
    """The second sRGB profile has a table, as cameras write it: converting would change colours by one level."""
    pixels = noise(99, 80, 3)
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    for name, profile in {
        "srgb": srgb,
        "table": icc_profile(SRGB, linear_from_srgb),
        "broken": srgb[:200],
        "lab": lab,
        "text": b"no profile",
    }.items():
        path = tmp_path / f"{name}.png"
        Image.fromarray(pixels).save(path, icc_profile=profile)
        np.testing.assert_array_equal(read_image(path), pixels, err_msg=name)


def encoded(kind: str, *, side: int = 64, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(noise(side, side, 3)).save(buffer, kind, **options)
    return buffer.getvalue()


def test_unreadable_files_are_reported_by_name(tmp_path):
    jpeg, png, tiff, webp = (encoded(kind) for kind in ("JPEG", "PNG", "TIFF", "WEBP"))
    contents = {
        "zero.jpg": (b"", "is empty \\(0 bytes\\)"),
        "text.jpg": (b"this is no photo\n" * 20, "is not a readable picture"),
        "head.png": (png[:12], "is not a readable picture"),
        "cut.jpg": (jpeg[: len(jpeg) // 2], "is damaged or truncated"),
        "cut.png": (png[:3000], "is damaged or truncated"),
        "cut.tif": (tiff[:3000], "is damaged or truncated|is not a readable picture"),
        "cut.webp": (webp[:2000], "is damaged or truncated|is not a readable picture"),
        "flipped.png": (png[:100] + b"\0" * 500 + png[600:], "is damaged or truncated"),
        "größe 1.jpg": (b"\xff\xd8\xff\xe0", "is not a readable picture"),
    }
    for name, (content, message) in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=f"{name}.*({message})") as caught:
            read_image(tmp_path / name)
        assert caught.value.exit_code == BAD_INPUT
        assert caught.value.hint
    for reader in (read_image, image_size, read_exif):
        with pytest.raises(UserError, match=r"cannot read .*missing\.jpg: No such file"):
            reader(tmp_path / "missing.jpg")
        with pytest.raises(UserError, match=f"cannot read {tmp_path}: Is a directory"):
            reader(tmp_path)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
@settings(examples(30), derandomize=True)
@given(data=st.data())
def test_a_photo_with_any_byte_changed_is_read_or_refused(data, tmp_path_factory, kind):
    """Damage to header or EXIF raises nothing but a UserError, and no warning (an error in tests)."""
    lens = {ExifTags.Base.FocalLength: IFDRational(35, 2)}
    exif = exif_with({ExifTags.Base.Make: "Maker"}, {ExifTags.IFD.Exif: lens})
    content = bytearray(encoded(kind, side=8, exif=exif))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "changed"
    path.write_bytes(content)
    for reader in (image_size, read_exif, read_image):
        with suppress(UserError):
            reader(path)


@pytest.mark.parametrize(("width", "height", "is_read"), [(16_320, 12_240, True), (40_000, 20_000, False)])
def test_a_photo_of_200_megapixels_is_no_attack_and_one_of_800_is_not_damaged(tmp_path, width, height, is_read):
    """The header of a small PNG, rewritten: Pillow's own limit would call it an attack."""
    path = tmp_path / "large.png"
    write_png(path, noise(2, 2, 3))
    content = path.read_bytes()
    header = b"IHDR" + struct.pack(">II", width, height) + content[24:29]
    path.write_bytes(content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:])
    if is_read:
        assert image_size(path) == (width, height)
    else:
        with pytest.raises(UserError, match=r"large\.png has more than 536 megapixels"):
            image_size(path)


def test_list_images_is_sorted_and_takes_pictures_only(tmp_path):
    names = ["b.JPG", "a 2.png", "a 10.png", "ä.jpeg", "c.tiff", "Z.webp"]
    for name in (*names, ".hidden.jpg", "._b.JPG", "notes.txt", "photo.jpg.part"):
        (tmp_path / name).touch()
    (tmp_path / "folder.jpg").mkdir()
    (tmp_path / "folder.jpg" / "inner.jpg").touch()
    assert [p.name for p in list_images(tmp_path)] == sorted(names)
    with pytest.raises(UserError, match=r"cannot list the photos in .*nothing: No such file"):
        list_images(tmp_path / "nothing")
    with pytest.raises(UserError, match=r"cannot list the photos in .*notes\.txt: Not a directory"):
        list_images(tmp_path / "notes.txt")


def test_list_images_leaves_out_a_conversion_of_the_same_photo(tmp_path):
    """It would be held out and trained on at once."""
    kept = ["a.jpg", "b.avif", "c.png", "d.gif", "e.jpg", "e.png", "f.PNG", "g.heic"]
    for name in (*kept, "a.HEIC", "c.jp2", "f.hif", "g.MOV"):
        (tmp_path / name).touch()
    assert [p.name for p in list_images(tmp_path)] == kept


def test_files_that_are_no_photos_are_counted_by_their_suffix(tmp_path):
    (tmp_path / "below").mkdir()
    names = ("a.jpg", "a.heic", "b.dng", "c.mov", "d.MOV", "e.txt", "README", ".DS_Store", "Thumbs.db", "below/f.mov")
    for name in names:
        (tmp_path / name).touch()
    assert list_photos(tmp_path).skipped == "2 .mov, 1 .heic, 1 .txt, 1 without a suffix"
    assert list_photos(tmp_path, subfolders=True).skipped.startswith("3 .mov, ")
    with pytest.raises(UserError) as caught:
        find_photos(tmp_path / "below")
    assert caught.value.hint.startswith("there are only 1 .mov; expected photos, such as .jpg, .png, ")


@pytest.mark.parametrize("suffix", sorted(IMAGE_SUFFIXES))
def test_every_format_is_read_as_what_was_written(tmp_path, suffix):
    """Exactly where the format is lossless, and within the levels that its compression costs on a smooth picture."""
    y, x = np.mgrid[:48, :64]
    picture = np.stack([4 * x, 5 * y, 255 - 4 * x], axis=-1).astype(np.uint8)
    grey, black_and_white = Image.fromarray(picture[..., 0]), Image.fromarray(picture[..., 0] > 127)
    image = {".pgm": grey, ".pbm": black_and_white}.get(suffix, Image.fromarray(picture))
    path = tmp_path / f"a{suffix}"
    if suffix in HEIC_SUFFIXES:
        pillow_heif.from_pillow(image).save(path, quality=95)
    else:
        image.save(path)
    levels = {".gif": 40, ".jpg": 12, ".jpeg": 12, ".jpe": 12, ".jfif": 12, ".mpo": 12}
    allowed = levels.get(suffix, 12 if suffix in HEIC_SUFFIXES | {".avif", ".webp"} else 0)
    found = read_image(path)
    assert image_size(path) == (64, 48)
    assert np.abs(found[..., :3].astype(int) - np.asarray(image.convert("RGB"))).max() <= allowed


def test_the_first_picture_of_an_animation_and_of_a_stereo_pair_is_read(tmp_path):
    first, second = (Image.fromarray(np.full((8, 8, 3), level, np.uint8)) for level in (40, 200))
    for name, kind in (("a.gif", "GIF"), ("b.mpo", "MPO"), ("c.webp", "WEBP"), ("d.png", "PNG")):
        first.save(tmp_path / name, kind, save_all=True, append_images=[second])
        assert np.abs(read_image(tmp_path / name)[..., :3].astype(int) - 40).max() <= 2
        assert read_exif(tmp_path / name).pages == 1


@pytest.mark.parametrize("sizes", [((16, 12), (160, 120)), ((160, 120), (16, 12)), ((80, 60), (160, 120), (160, 120))])
def test_the_largest_page_of_a_tiff_is_read(tmp_path, sizes):
    """A scanner's preview may come first; of equal pages the first is taken."""
    pages = [Image.fromarray(np.full((h, w, 3), 50 + 50 * i, np.uint8)) for i, (w, h) in enumerate(sizes)]
    path = tmp_path / "scan.tif"
    pages[0].save(path, save_all=True, append_images=pages[1:])
    found = read_image(path)
    assert image_size(path) == (160, 120)
    np.testing.assert_array_equal(found, np.full((120, 160, 3), 50 + 50 * sizes.index((160, 120))))
    assert read_exif(path).pages == len(sizes)


def test_float_pixels_on_a_later_page_are_no_damage(tmp_path):
    pages = [np.zeros((4, 4, 3), np.uint8), np.full((8, 8, 3), 0.5, np.float32)]
    cv2.imwritemulti(str(tmp_path / "merge.tif"), pages)
    for read in (image_size, read_image):
        with pytest.raises(UserError, match=r"merge\.tif has float pixels, whose white level is unknown"):
            read(tmp_path / "merge.tif")


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_float_pixels_are_named_as_the_reason(tmp_path, channels, kind):
    cv2.imwrite(str(tmp_path / "merge.tif"), np.full((8, 8, channels), 0.5, kind))
    with pytest.raises(UserError, match=r"merge\.tif has (float pixels|32-bit float pixels), whose white level"):
        read_image(tmp_path / "merge.tif")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("a.insp", "two circles of a 360-degree camera: export it as one equirectangular picture"),
        ("a.CR3", "is a raw file: develop it"),
        ("a.jxl", "is a JPEG XL file: convert"),
        ("a.exr", "has float pixels, whose white level is unknown"),
        ("a.KDC", "is a raw file: develop it"),
        ("a.psd", "is a picture of several layers: export it"),
        ("a.jps", "holds the two pictures of a stereo camera"),
        ("a.pcx", "is a picture in a format that is not read"),
    ],
)
def test_photos_in_formats_that_are_not_read_say_what_to_do(tmp_path, name, reason):
    """Even if the file could be opened: an .insp is a JPEG of two circles."""
    Image.new("RGB", (8, 8)).save(tmp_path / name, "JPEG")
    with pytest.raises(UserError, match=rf"{name} .*{reason}"):
        read_image(tmp_path / name)
    assert list_images(tmp_path) == []
    assert [path.name for path in list_photos(tmp_path).unreadable] == [name]


def test_16_bit_tiffs_in_which_white_is_0_are_inverted(tmp_path):
    wide = np.array([[0, 256, 32768], [65279, 65280, 65535]], dtype=np.uint16)
    path = tmp_path / "a.tif"
    Image.fromarray(wide).save(path)
    data, (black, white) = path.read_bytes(), (struct.pack("<HHII", 262, 3, 1, is_0) for is_0 in (1, 0))
    assert data.count(black) == 1
    path.write_bytes(data.replace(black, white))
    np.testing.assert_array_equal(read_image(path)[..., 0], 255 - (wide >> 8))


def downscaled_by_loops(image: np.ndarray, factor: float) -> np.ndarray:
    """Downscale by definition, in float64: colours weighted by covered area and alpha, over the sum of weights."""
    height, width, channels = image.shape
    out_height, out_width = max(1, round(height / factor)), max(1, round(width / factor))
    result = np.zeros((out_height, out_width, channels))
    for row in range(out_height):
        for column in range(out_width):
            top, bottom = row * height / out_height, (row + 1) * height / out_height
            left, right = column * width / out_width, (column + 1) * width / out_width
            area, weight, colour = 0.0, 0.0, np.zeros(3)
            for y in range(math.floor(top), min(math.ceil(bottom), height)):
                for x in range(math.floor(left), min(math.ceil(right), width)):
                    covered = (min(bottom, y + 1) - max(top, y)) * (min(right, x + 1) - max(left, x))
                    alpha = image[y, x, 3] / 255 if channels == 4 else 1.0
                    area += covered
                    weight += covered * alpha
                    colour += covered * alpha * image[y, x, :3]
            result[row, column, :3] = colour / weight if weight > 0 else 0
            if channels == 4:
                result[row, column, 3] = 255 * weight / area
    return result


@pytest.mark.parametrize("factor", [1.5, 2, 3, 4, 2.7, 100])
@pytest.mark.parametrize("shape", [(12, 8, 3), (12, 8, 4), (13, 11, 3), (13, 11, 4), (1, 7, 4), (2, 2, 4)])
def test_downscale_is_the_mean_over_areas_by_double_loop(factor, shape):
    image = noise(*shape)
    if shape[2] == 4:
        image[: shape[0] // 2, : shape[1] // 2, 3] = 0  # a corner that is fully transparent
        image[-1, :, 3] = 1  # and a row that nearly is
    small, expected = downscale(image, factor), downscaled_by_loops(image, factor)
    assert small.shape == expected.shape
    assert small.dtype == np.uint8
    assert np.abs(small - expected).max() <= 0.5 + 1e-4  # rounding, and float32 sums


def test_downscale_of_grey_masks():
    mask = noise(6, 9)
    expected = downscaled_by_loops(np.repeat(mask[..., None], 3, axis=2), 3)[..., 0]
    assert np.abs(downscale(mask, 3) - expected).max() <= 0.5 + 1e-4


@pytest.mark.parametrize("channels", [3, 4])
def test_downscale_by_one_is_an_untouched_copy(channels):
    image = noise(5, 4, channels)
    same = downscale(image, 1)
    np.testing.assert_array_equal(same, image)
    assert not np.shares_memory(same, image)


def test_downscale_refuses_to_enlarge():
    for factor in (0.5, 0, -1, math.nan):
        with pytest.raises(ValueError, match="factor must be at least 1"):
            downscale(noise(6, 9), factor)


def test_exif_of_a_phone(tmp_path):
    path = tmp_path / "phone.jpg"
    tags, gps, ratio = ExifTags.Base, ExifTags.GPS, IFDRational
    lens = {tags.LensModel: "Lens 4 mm f/1.8", tags.FocalLength: ratio(399, 100), tags.FocalLengthIn35mmFilm: 28}
    camera = {**lens, tags.ExposureTime: ratio(1, 120), tags.ISOSpeedRatings: 40}
    south = {gps.GPSLatitudeRef: "S", gps.GPSLatitude: (ratio(33), ratio(30), ratio(36))}
    east = {gps.GPSLongitudeRef: "E", gps.GPSLongitude: (ratio(151), ratio(15), ratio(0))}
    place = {**south, **east, gps.GPSAltitudeRef: b"\x01", gps.GPSAltitude: ratio(25, 2)}
    entries = {tags.Make: "Maker\0", tags.Model: " Phone 7 ", tags.Orientation: 6}
    exif = exif_with(entries, {ExifTags.IFD.Exif: camera, ExifTags.IFD.GPSInfo: place})
    Image.fromarray(noise(6, 8, 3)).save(path, exif=exif)
    found = read_exif(path)
    assert (found.make, found.model, found.lens) == ("Maker", "Phone 7", "Lens 4 mm f/1.8")
    assert (found.focal_mm, found.focal_35mm, found.iso) == (3.99, 28, 40)
    assert (found.exposure_seconds, found.orientation) == (1 / 120, 6)
    assert (found.width, found.height) == (6, 8)
    assert found.gps == pytest.approx((-33.51, 151.25, -12.5), abs=1e-12)


def test_exif_that_is_absent_or_odd_reads_as_none(tmp_path):
    path = tmp_path / "photo.jpg"
    Image.fromarray(noise(6, 8, 3)).save(path)
    nothing = read_exif(path)
    assert (nothing.width, nothing.height, nothing.orientation) == (8, 6, 1)
    wanted = ("make", "model", "lens", "focal_mm", "focal_35mm", "exposure_seconds", "iso", "gps")
    assert [getattr(nothing, name) for name in wanted] == [None] * len(wanted)

    tags = ExifTags.Base
    camera = {tags.FocalLength: IFDRational(0, 0), tags.ExposureTime: IFDRational(1, 0), tags.FocalLengthIn35mmFilm: 0}
    nothing_over_nothing, too_far = (IFDRational(0, 0),) * 3, (IFDRational(200),) * 3
    without_fix = (IFDRational(0),) * 3
    for place in ((nothing_over_nothing, too_far), (without_fix, without_fix)):
        gps = dict(zip((ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLongitude), place, strict=True))
        exif = exif_with({ExifTags.Base.Make: "   "}, {ExifTags.IFD.Exif: camera, ExifTags.IFD.GPSInfo: gps})
        Image.fromarray(noise(6, 8, 3)).save(path, exif=exif)
        assert read_exif(path) == nothing
    Image.fromarray(noise(6, 8, 3)).save(path, exif=b"Exif\0\0II*\0\xff\xff\xff\xff")
    assert read_exif(path) == nothing
    np.testing.assert_array_equal(read_image(path).shape, (6, 8, 3))


def test_a_link_to_a_photo_counts_as_a_photo(tmp_path):
    write_png(tmp_path / "outside" / "a.png", noise(3, 4, 3))
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "link.png").symlink_to(Path("..") / "outside" / "a.png")
    (folder / "broken.png").symlink_to("nowhere.png")
    assert [p.name for p in list_images(folder)] == ["link.png"]
