"""Measurements of a single photo, which is read once. They are small: those of a thousand photos fit into memory."""

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from nerfcli.doctor import brightness, sharpness
from nerfcli.errors import UserError
from nerfcli.matching.features import find_features
from nerfcli.photos.exif import Exif, read_exif
from nerfcli.photos.focal_evidence import with_digital_zoom
from nerfcli.photos.images import downscale, read_image
from nerfcli.photos.panoramas import MOST_OF_A_CAMERA, is_panorama

# Longer side of the pictures in which features are detected; all thresholds in pixels refer to this size.
LONGER_SIDE_PX = 800
MOST_FEATURES = 2000


@dataclass(frozen=True)
class PhotoFeatures:
    """Features of a photo at `LONGER_SIDE_PX`, strongest first.

    Args:
        size: (width, height) of the picture in which they were detected.
        pixels: (N, 2) float32, pixel centres at 0.5.
        scales: (N,) float32, sizes of the features in pixels.
        descriptors: (N, 128) uint8.
        detail: (N,) float32, see `sharpness.measure`; NaN without texture.
        light: (N, 2) float32, see `brightness.local_light`; NaN where unknown.
    """

    size: tuple[int, int]
    pixels: np.ndarray
    scales: np.ndarray
    descriptors: np.ndarray
    detail: np.ndarray
    light: np.ndarray


@dataclass(frozen=True)
class PhotoFacts:
    """Measurements of one photo.

    Args:
        name: its name in the capture.
        exif: with the upright size.
        digest: SHA-256 of the file.
        thumbnail: a small JPEG.
        tiny: (32, 32) float32 grey picture with mean 0 and norm 1; all 0 for a uniform one.
        is_panorama: whether it shows the whole sphere.
    """

    name: str
    exif: Exif
    digest: str
    thumbnail: bytes
    tiny: np.ndarray
    sharpness: sharpness.Sharpness
    exposure: brightness.Brightness
    features: PhotoFeatures
    is_panorama: bool = False


@dataclass(frozen=True)
class Source:
    """A photo to read: its name in the capture, its file, and the file of its mask."""

    name: str
    path: Path
    mask: Path | None = None


def read_all(
    sources: Sequence[Source], *, threads: int, progress: Callable[[int], None]
) -> tuple[list[PhotoFacts], dict[str, str]]:
    """Measure all photos, in order, each thread with one at full size in memory; also return why others are unreadable.

    The reasons are by name; `progress` receives the number of photos read.
    """
    facts: list[PhotoFacts] = []
    unreadable: dict[str, str] = {}
    # Fewer features of many photos, so that all fit into memory.
    most_features = MOST_FEATURES if len(sources) <= 200 else MOST_FEATURES // 2
    with ThreadPoolExecutor(threads) as readers:
        for index, found in enumerate(readers.map(lambda source: _examine(source, most_features), sources)):
            if isinstance(found, PhotoFacts):
                facts.append(found)
            else:
                unreadable[sources[index].name] = found
            progress(index + 1)
    exifs = with_digital_zoom([photo.exif for photo in facts])
    facts = [replace(photo, exif=exif) for photo, exif in zip(facts, exifs, strict=True)]
    if sum(photo.is_panorama for photo in facts) > MOST_OF_A_CAMERA * len(facts):
        facts = [replace(photo, is_panorama=photo.exif.width == 2 * photo.exif.height) for photo in facts]
    return facts, unreadable


def read_photo(source: Source, most_features: int) -> PhotoFacts:
    """Measure one photo, with at most `most_features` features.

    Raises:
        UserError: the photo or its mask cannot be read.
    """
    image = read_image(source.path)
    exif = read_exif(source.path)
    digest = hashlib.sha256(source.path.read_bytes()).hexdigest()
    panorama = is_panorama(source.path, image)
    large = _shrunk(image, sharpness.LONGER_SIDE_PX)
    del image
    rgb, used = _opaque(large)
    if source.mask is not None:
        mask = cv2.resize(read_image(source.mask)[..., :3].max(axis=2), used.shape[::-1], interpolation=cv2.INTER_AREA)
        used = used & (mask > 127)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    sharp, local_detail = sharpness.measure(np.where(used, grey, grey[used].mean() if used.any() else 0).astype("f4"))
    small = _shrunk(rgb, LONGER_SIDE_PX)
    small_grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    seen = cv2.resize(used.astype(np.uint8), small_grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return PhotoFacts(
        name=source.name,
        exif=exif,
        digest=digest,
        thumbnail=_jpeg(_shrunk(small, 160)),
        tiny=_tiny(small_grey),
        sharpness=sharp,
        exposure=brightness.measure(rgb, used),
        features=_features(small, seen, local_detail=local_detail, most_features=most_features),
        is_panorama=panorama,
    )


def _examine(source: Source, most_features: int) -> PhotoFacts | str:
    try:
        return read_photo(source, most_features)
    except UserError as error:
        return error.message.replace(str(source.path), "").removeprefix(" is ").strip(" :")


def _shrunk(image: np.ndarray, longer_side_px: int) -> np.ndarray:
    return downscale(image, max(1.0, max(image.shape[:2]) / longer_side_px))


def _opaque(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture (H, W, 3) on white, and a mask (H, W) of its opaque pixels."""
    if image.shape[2] == 3:
        return image, np.ones(image.shape[:2], dtype=bool)
    alpha = image[..., 3:].astype(np.float32) / 255
    on_white = np.rint(image[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
    return on_white, image[..., 3] > 127


def _features(rgb: np.ndarray, seen: np.ndarray, *, local_detail: np.ndarray, most_features: int) -> PhotoFeatures:
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    found = find_features(grey, longer_side_px=max(grey.shape), most=most_features, used=seen)
    # At equal response there may be a few more than were requested.
    clearest = np.argsort(-found.responses, kind="stable")[:most_features]
    height, width = grey.shape
    pixels = found.pixels[clearest].astype(np.float32)
    column, row = (np.clip(pixels[:, i].astype(int), 0, (width, height)[i] - 1) for i in (0, 1))
    rows, columns = local_detail.shape
    return PhotoFeatures(
        size=(width, height),
        pixels=pixels,
        scales=found.sizes[clearest],
        descriptors=found.descriptors[clearest].astype(np.uint8),
        detail=local_detail[row * rows // height, column * columns // width],
        light=brightness.local_light(rgb)[row, column],
    )


def _tiny(grey: np.ndarray) -> np.ndarray:
    side = 32
    tiny = cv2.resize(grey, (side, side), interpolation=cv2.INTER_AREA).astype(np.float32)
    tiny -= tiny.mean()
    norm = float(np.linalg.norm(tiny))
    return tiny / norm if norm > side else np.zeros_like(tiny)


def _jpeg(rgb: np.ndarray) -> bytes:
    encoded, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert encoded
    return data.tobytes()
