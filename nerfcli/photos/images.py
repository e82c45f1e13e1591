"""Photos and rendered pictures: listing of folders, 8-bit sRGB pixels, exact downscaling, PNG.

The EXIF orientation is applied once, here, so that sizes, pixels and cameras all refer to the upright picture.
"""

import io
import os
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pi_heif
from PIL import ExifTags, Image, ImageCms, TiffImagePlugin, UnidentifiedImageError
from PIL.PngImagePlugin import PngInfo

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.photos.unread import UNREAD

HEIC_SUFFIXES = frozenset({".heic", ".heif", ".hif"})
# What every program reads; beside such a picture, one of the same name in another format is the same photo, converted.
_USUAL_SUFFIXES = frozenset({".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".tif", ".tiff", ".webp", ".bmp"})
# Which other programs often cannot read; JPEG 2000 and PNM have several each.
_OTHER_SUFFIXES = {".avif", ".gif", ".mpo", ".tga", ".jp2", ".j2k", ".jpx", ".jpf", ".jpc", ".j2c"}
UNUSUAL_SUFFIXES = HEIC_SUFFIXES | _OTHER_SUFFIXES | {".ppm", ".pgm", ".pbm", ".pnm"}
IMAGE_SUFFIXES = _USUAL_SUFFIXES | UNUSUAL_SUFFIXES

# Pillow now opens HEIC, too: upright, as the file itself says, and with an EXIF orientation of 1.
pi_heif.register_heif_opener()

# Pillow refuses twice this as an attack: by default 179 megapixels, but phones take photos of 200. Now it is 536.
_MOST_PIXELS = Image.MAX_IMAGE_PIXELS = 2**28
# Without libtiff, Pillow garbles some uncompressed TIFF files: with a 16-bit plane per colour, or turned by 90 degrees.
TiffImagePlugin.READ_LIBTIFF = True  # type: ignore[bad-assignment]

_UPRIGHT_FROM_STORED = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
# Exceptions of Pillow's decoders for damaged files; no common base class is documented.
_DAMAGED = (
    *(OSError, EOFError, SyntaxError, ValueError, TypeError, LookupError, RuntimeError),
    *(struct.error, zlib.error, Image.DecompressionBombError),
)
_OR_REMOVE = "or remove it from the folder"
_DAMAGED_HINT = f"copy the photo again, {_OR_REMOVE}"
_FORMATS = "JPEG, HEIC, AVIF, JPEG 2000, PNG, TIFF, WebP, BMP, GIF, TGA or PNM"
_SRGB = ImageCms.createProfile("sRGB")
# Two colour spaces that agree within this many of 255 levels on a grid of colours count as the same.
_SAME_COLOUR_LEVELS = 2
# zlib level, and PNG's filter "up": files are 9 % larger than with a filter chosen per line, but take half the time.
_PNG_LEVEL, _PNG_UP = 4, 2
_PNG_COLOURS = {1: 0, 3: 2, 4: 6}  # PNG's colour types by number of channels
_FLOAT = UNREAD[".exr"]
# Files that are not counted among skipped ones: our list of a video's frames, and what systems leave behind.
_OURS_OR_SYSTEM = frozenset({"frames.json", "Thumbs.db", "desktop.ini"})
_SAMPLE_FORMAT, _FLOAT_SAMPLES = 339, 3  # a tag of TIFF, and its value for float
_PHOTOMETRIC, _WHITE_IS_ZERO = 262, 0


def list_images(folder: Path) -> list[Path]:
    """Return the picture files directly in a folder, sorted by name; hidden files and subfolders are left out.

    A picture in an unusual format, such as HEIC, is left out if one of the same name in a usual format is beside it:
    the same photo, converted.

    Raises:
        UserError: the folder does not exist or cannot be listed.
    """
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    except OSError as error:
        what = f"cannot list the photos in {folder}: {error.strerror or error}"
        raise UserError(what, "give a folder of photos") from error
    pictures = [path for path in files if not path.name.startswith(".") and path.is_file()]
    usual = {path.stem for path in pictures if path.suffix.lower() in _USUAL_SUFFIXES}
    kept = (path for path in pictures if path.suffix.lower() in _USUAL_SUFFIXES or path.stem not in usual)
    return sorted(kept, key=lambda path: path.name)


def image_size(path: Path) -> tuple[int, int]:
    """Return the (width, height) of the upright picture, from the header alone; a UserError as for `read_image`."""
    with opened(path) as image:
        return upright_size(image)


def read_image(path: Path) -> np.ndarray:
    """Read a picture as upright 8-bit sRGB.

    Grey, palette, CMYK and 16-bit pixels (the high byte is kept) are converted to 8-bit RGB. Colours with an embedded
    profile other than sRGB are converted; a profile that cannot be used is ignored. Of a TIFF file with several pages
    the largest is read, of other files with several pictures the first.

    Returns:
        uint8, writable: (height, width, 3) RGB, or (height, width, 4) RGBA with straight alpha if the file
        has transparency.

    Raises:
        UserError: the file is missing, empty, truncated, damaged, not a picture, or has float or 32-bit pixels.
    """
    with opened(path) as image:
        image.load()
        # Read after loading: Pillow turns TIFF files upright while it loads them, and then reports orientation 1.
        orientation = orientation_of(image)
        srgb = _to_srgb(image, path)
        if orientation != 1:
            srgb = srgb.transpose(_UPRIGHT_FROM_STORED[orientation])
        return np.array(srgb)


def upright(stored: np.ndarray, orientation: int) -> np.ndarray:
    """Turn an array (H, W) of stored pixels, uint8 or float32, by an EXIF orientation from 2 to 8."""
    return np.array(Image.fromarray(stored).transpose(_UPRIGHT_FROM_STORED[orientation]))


def downscale(image: np.ndarray, factor: float) -> np.ndarray:
    """Return a smaller picture; each pixel is the mean of the area that it covers, including fractions of pixels.

    Colours are averaged with alpha as the weight, so that colours of transparent pixels do not bleed in;
    where alpha is 0 in the whole area, the colour is 0. A picture whose size stays the same is copied.

    Args:
        image: uint8 (height, width), (height, width, 3) or (height, width, 4) with straight alpha.
        factor: >= 1; width and height are divided by it and rounded, to at least 1 pixel.

    Raises:
        ValueError: factor < 1, or not an 8-bit picture.
    """
    if not factor >= 1:
        raise ValueError(f"factor must be at least 1, got {factor}")
    _check_pixels(image)
    height, width = image.shape[:2]
    size = (max(1, round(width / factor)), max(1, round(height / factor)))
    if size == (width, height):
        return image.copy()
    if image.ndim == 2 or image.shape[2] == 3:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    premultiplied = image.astype(np.float32)
    premultiplied[..., :3] *= premultiplied[..., 3:] / 255
    small = cv2.resize(premultiplied, size, interpolation=cv2.INTER_AREA)
    alpha = small[..., 3:]
    small[..., :3] *= np.divide(255, alpha, out=np.zeros_like(alpha), where=alpha > 0)
    return np.rint(small).clip(0, 255).astype(np.uint8)


def reduced(picture: np.ndarray, longest_px: int) -> np.ndarray:
    """Return a picture without alpha, (height, width, ...), whose longer side is at most this, averaged over areas."""
    height, width = picture.shape[:2]
    scale = min(1.0, longest_px / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)  # a copy if the size stays the same


def write_png(path: Path, image: np.ndarray, *, metadata: dict[str, str] | None = None) -> None:
    """Write a picture as PNG, atomically, with `metadata` as its text chunks (any Unicode; keys in Latin-1).

    Args:
        image: uint8 (height, width), (height, width, 3) or (height, width, 4) with straight alpha.

    Raises:
        UserError: the file cannot be written.
        ValueError: not an 8-bit picture.
    """
    _check_pixels(image)
    texts = PngInfo()
    for key, value in (metadata or {}).items():
        texts.add_text(key, value)
    height, width = image.shape[:2]
    lines = np.ascontiguousarray(image).reshape(height, -1)
    filtered = np.full((height, 1 + lines.shape[1]), _PNG_UP, np.uint8)
    filtered[:1, 1:] = lines[:1]
    np.subtract(lines[1:], lines[:-1], out=filtered[1:, 1:])
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, _PNG_COLOURS[lines.shape[1] // width], 0, 0, 0)),
        *((kind, content) for kind, content, *_ in texts.chunks),
        (b"IDAT", zlib.compress(filtered.data, _PNG_LEVEL)),
        (b"IEND", b""),
    ]
    with atomic_path(path) as partial, partial.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, content in chunks:
            file.write(struct.pack(">I", len(content)) + kind + content)
            file.write(struct.pack(">I", zlib.crc32(kind + content)))


def _check_pixels(image: np.ndarray) -> None:
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (3, 4))):
        raise ValueError(f"image must be uint8 (H, W[, 3|4]), got {image.dtype} {image.shape}")


@contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """Open a file as a lazy Pillow image; errors of the file inside the block become a UserError."""
    if path.suffix.lower() in UNREAD:
        raise UserError(f"{path} {UNREAD[path.suffix.lower()]}", _OR_REMOVE)
    try:
        if path.stat().st_size == 0:
            raise UserError(f"{path} is empty (0 bytes)", "copy the photo again, or remove the file")
        with warnings.catch_warnings():
            # Pillow warns about odd metadata and palettes; none of it changes the pixels.
            warnings.filterwarnings("ignore", module=r"PIL\.")
            with Image.open(path) as image:
                if number_of_pages(image) > 1:
                    image.seek(_largest_page(image))
                yield image
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        if path.is_symlink() and not path.exists():
            raise UserError(f"{path} is a link to a file that does not exist", "copy the photo again") from error
        raise UserError(f"cannot read {path}: {error.strerror}", f"expected a {_FORMATS} file") from error
    except _DAMAGED as error:
        raise _unusable(path, error) from error


def _unusable(path: Path, error: Exception) -> UserError:
    """Return the error for a file that Pillow cannot read."""
    if isinstance(error, Image.DecompressionBombError):
        return UserError(f"{path} has more than {2 * _MOST_PIXELS // 10**6} megapixels", f"reduce it, {_OR_REMOVE}")
    if _has_float_samples(path):
        return UserError(f"{path} {_FLOAT}", _OR_REMOVE)
    if not isinstance(error, UnidentifiedImageError):
        return UserError(f"{path} is damaged or truncated: {error}", _DAMAGED_HINT)
    if path.suffix.lower() in HEIC_SUFFIXES and pi_heif.is_supported(path):  # it begins like one
        return UserError(f"{path} is damaged or truncated", _DAMAGED_HINT)
    hint = f"supported are {_FORMATS}; convert it (raw files, too), {_OR_REMOVE}"
    return UserError(f"{path} is not a readable picture", hint)


def number_of_pages(image: Image.Image) -> int:
    """Return how many pages an opened TIFF has; 1 for other formats, where further pictures are not other photos."""
    return getattr(image, "n_frames", 1) if image.format == "TIFF" else 1


def _largest_page(image: Image.Image) -> int:
    """Return the number of the largest page of an opened TIFF, the first of equals: scanners store previews first."""
    pixels = []
    for page in range(number_of_pages(image)):
        image.seek(page)
        pixels.append(image.width * image.height)
    return pixels.index(max(pixels))


def _has_float_samples(path: Path) -> bool:
    """Return whether a file is a TIFF with a page of float pixels, which Pillow opens only if they are grey."""
    try:
        with warnings.catch_warnings(action="ignore"), path.open("rb") as file:
            tags, pages = TiffImagePlugin.ImageFileDirectory_v2(file.read(8)), set[int]()
            while tags.next and tags.next not in pages:
                pages.add(tags.next)
                file.seek(tags.next)
                tags.load(file)
                if _FLOAT_SAMPLES in tags.get(_SAMPLE_FORMAT, ()):
                    return True
    except _DAMAGED:
        pass
    return False


def _to_srgb(image: Image.Image, path: Path) -> Image.Image:
    """Return a loaded image in mode RGB or RGBA, in the sRGB colour space."""
    profile = image.info.get("icc_profile")
    mode = "RGBA" if image.has_transparency_data else "RGB"
    is_inverted = getattr(image, "tag_v2", {}).get(_PHOTOMETRIC) == _WHITE_IS_ZERO  # a TIFF
    # A 16-bit PNG is "I" in older releases of Pillow, and a 16-bit PGM in all.
    if image.mode.startswith("I;16") or (image.mode == "I" and image.format in ("PNG", "PPM")):
        # Keep the high byte, as Pillow does for 16-bit colour; this is exact for 8-bit pixels that were widened to 16.
        high = (np.asarray(image) >> 8).astype(np.uint8)
        # Of 8 bits, Pillow itself inverts levels whose white is 0.
        image = Image.fromarray(255 - high if is_inverted else high)
    if image.mode in ("I", "F"):
        what = f"{path} has 32-bit {'integer' if image.mode == 'I' else 'float'} pixels, whose white level is unknown"
        raise UserError(what, "save it with 8 or 16 bits per channel")
    if mode == "RGBA" or image.mode not in ("RGB", "L", "CMYK"):
        image = image.convert(mode)
    if profile:
        image = _from_profile(image, profile)
    return image.convert(mode)


def _from_profile(image: Image.Image, profile: bytes) -> Image.Image:
    """Convert an image (L, RGB, RGBA or CMYK) to sRGB, or return it as is if the profile is sRGB or cannot be used."""
    output_mode = image.mode if image.mode in ("RGB", "RGBA") else "RGB"
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        transform = ImageCms.buildTransform(source, _SRGB, image.mode, output_mode)
        # Names of profiles are unreliable ("c2" is sRGB, "sRGB-elle-V2-g10" is linear): compare colours instead.
        if image.mode == output_mode:
            levels = np.arange(0, 256, 17, dtype=np.uint8)
            grid = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(1, -1, 3)
            probe = Image.fromarray(grid).convert(image.mode)
            changed = np.asarray(ImageCms.applyTransform(probe, transform)).astype(int) - np.asarray(probe)
            if np.abs(changed).max() <= _SAME_COLOUR_LEVELS:
                return image
        converted = ImageCms.applyTransform(image, transform)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return image
    assert converted is not None  # Pillow returns None only for transforms in place
    return converted


def upright_size(image: Image.Image) -> tuple[int, int]:
    """Return the (width, height) of an opened picture, shown upright."""
    # Pillow swaps width and height of a TIFF on opening, although the tag still has the orientation as stored.
    width, height = image.size
    return (height, width) if image.format != "TIFF" and orientation_of(image) >= 5 else (width, height)


def orientation_of(image: Image.Image) -> int:
    """Return the EXIF orientation of an opened picture, 1...8; 1 if it has none or an invalid one."""
    value = exif_entries(image, None).get(ExifTags.Base.Orientation)
    return value if isinstance(value, int) and value in _UPRIGHT_FROM_STORED else 1


def exif_entries(image: Image.Image, which: int | None) -> dict[int, Any]:
    """Return one directory of EXIF entries, the main one for None; empty if it cannot be parsed."""
    try:
        exif = image.getexif()
        return dict(exif) if which is None else dict(exif.get_ifd(which))
    except _DAMAGED:
        return {}


@dataclass(frozen=True)
class Listing:
    """The files of a folder of photos, each list sorted by `name_in`.

    Args:
        pictures: as of `list_images`.
        unreadable: photos in formats that cannot be read (raw, JPEG XL...), and broken links; not those with a readable
            picture of the same name, apart from the suffix, beside them.
        skipped: the other files by suffix, such as "2 .mov, 1 .txt", and pictures that are there in a usual format too.
    """

    pictures: list[Path]
    unreadable: list[Path]
    skipped: str


def list_photos(folder: Path, *, subfolders: bool = False) -> Listing:
    """List the photos directly in a folder and, on request, in all of its subfolders."""
    pictures, unreadable, counts = list[Path](), list[Path](), Counter[str]()
    for each in _with_subfolders(folder) if subfolders else [folder]:
        read, unread = list_images(each), _unreadable(each)
        pictures += read
        unreadable += unread
        others = {*each.iterdir()} - {*read, *unread, *(each / name for name in _OURS_OR_SYSTEM)}
        shown = (path for path in others if path.is_file() and not path.name.startswith("."))
        counts.update(path.suffix.lower() or "without a suffix" for path in shown)
    most = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    skipped = ", ".join(f"{count} {suffix}" for suffix, count in most)
    for paths in (pictures, unreadable):
        paths.sort(key=lambda path: name_in(folder, path))
    return Listing(pictures, unreadable, skipped)


def name_in(folder: Path, path: Path) -> str:
    """Return the name of a photo: its path from the folder of photos, with forward slashes."""
    return path.relative_to(folder).as_posix()


def where_photos_may_be(folder: Path) -> str:
    """Return a hint for a folder without photos: which of its subfolders have some, or what is expected."""
    shown = (child for child in sorted(folder.iterdir()) if child.is_dir() and not child.name.startswith("."))
    with_photos = [child for child in shown if os.access(child, os.R_OK | os.X_OK) and list_images(child)]
    if len(with_photos) == 1:
        return f"there are photos in {with_photos[0]}; give that folder"
    if with_photos:
        more = f" and {len(with_photos) - 1} more folders" if len(with_photos) > 2 else f" and {with_photos[1]}"
        return f"there are photos in {with_photos[0]}{more}; give one of them, or use all with --subfolders"
    there = f"there are only {skipped}; " if (skipped := list_photos(folder).skipped) else ""
    return f"{there}expected photos, such as .jpg, .png, .heic, .tif or .webp"


def _with_subfolders(folder: Path) -> list[Path]:
    """Return a folder and all of its subfolders; not hidden ones, nor links to the others."""
    shown = [path for path in folder.rglob("*") if path.is_dir() and "/." not in f"/{name_in(folder, path)}"]
    folders = [folder, *sorted(shown, key=Path.is_symlink)]
    return list({path.resolve(): path for path in reversed(folders)}.values())


def _unreadable(folder: Path) -> list[Path]:
    read = {path.stem for path in list_images(folder)}
    files = [path for path in folder.iterdir() if not path.name.startswith(".") and path.stem not in read]
    broken = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES and not path.exists()]
    return [*(path for path in files if path.suffix.lower() in UNREAD), *broken]
