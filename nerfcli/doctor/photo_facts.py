"""Measurements of a single photo, which is read once. They are small: those of a thousand photos fit into memory."""

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from nerfcli.errors import UserError
from nerfcli.matching.features import find_features
from nerfcli.pages.page import jpeg_bytes
from nerfcli.photos.colours import linear_light, over_white
from nerfcli.photos.exif import Exif, read_exif
from nerfcli.photos.focal_evidence import with_digital_zoom
from nerfcli.photos.images import downscale, read_image, reduced
from nerfcli.photos.masks import read_mask
from nerfcli.photos.panoramas import MOST_OF_A_CAMERA, is_panorama

# Longer side of the pictures in which features are detected; all thresholds in pixels refer to this size.
LONGER_SIDE_PX = 800
MOST_FEATURES = 2000
# Longer side at which sharpness is measured.
SHARPNESS_SIDE_PX = 1600

# Tiles per side; the sharpest quarter of those with texture decides, since the background may be out of focus.
_TILES = 12
# A pixel has enough texture if the root mean square of the coarse octave around it exceeds this, in levels of 255.
_TEXTURE_LEVELS = 1.2
# Noise of the sensor and of JPEG, in levels, which must not count as fine detail.
_NOISE_LEVELS = 0.35

# A channel shows no detail from this level on, of 255, or as near to 0.
_WHITE_LEVEL = 253

# Linear light of each 8-bit sRGB level.
_LINEAR = linear_light(np.arange(256) / 255).astype(np.float32)
# Linear light below which noise and the black level dominate.
_DARKEST = 4e-3
# A colour is pale if its weakest channel is at least this fraction of its strongest.
_PALE = 0.3


@dataclass(frozen=True)
class Sharpness:
    """Sharpness of a photo, nearly independent of its content.

    Natural pictures have about the same energy in every octave of detail; blur removes it from the finest octaves and
    leaves the coarse ones. So `detail` compares two neighbouring octaves: it is near 0 in a sharp photo with texture,
    and decreases by one for every halving of the fine octave's amplitude relative to the coarse one's. Photos are
    measured at `SHARPNESS_SIDE_PX`: blur that vanishes at this size is not detected.

    Args:
        detail: log2 of fine over coarse amplitude, the 75th percentile over the tiles; NaN without texture.
        direction_ratio: ratio of fine over coarse amplitude between the directions where it is largest and smallest,
            >= 1; large if the photo is smeared in one direction.
        textured: fraction of the tiles with enough texture.
    """

    detail: float
    direction_ratio: float
    textured: float


@dataclass(frozen=True)
class Brightness:
    """Mean of all channels of a photo, sRGB in [0, 1], and the fractions of its pixels clipped at either end."""

    mean: float
    white: float
    black: float


@dataclass(frozen=True)
class PhotoFeatures:
    """Features of a photo at `LONGER_SIDE_PX`, strongest first.

    Args:
        size: (width, height) of the picture in which they were detected.
        pixels: (N, 2) float32, pixel centres at 0.5.
        scales: (N,) float32, sizes of the features in pixels.
        descriptors: (N, 128) uint8.
        detail: (N,) float32, see `measure_sharpness`; NaN without texture.
        light: (N, 2) float32, see `_local_light`; NaN where unknown.
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
        exif: with the upright size.
        digest: SHA-256 of the file.
        thumbnail: a small JPEG.
        tiny: (32, 32) float32 grey picture with mean 0 and norm 1; all 0 for a uniform one.
    """

    name: str
    exif: Exif
    digest: str
    thumbnail: bytes
    tiny: np.ndarray
    sharpness: Sharpness
    exposure: Brightness
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
    large = _shrunk(image, SHARPNESS_SIDE_PX)
    del image
    rgb, used = _opaque(large)
    if source.mask is not None:
        mask = cv2.resize(read_mask(source.mask, source.path), used.shape[::-1], interpolation=cv2.INTER_AREA)
        used = used & (mask > 127)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    sharp, local_detail = measure_sharpness(np.where(used, grey, grey[used].mean() if used.any() else 0).astype("f4"))
    small = _shrunk(rgb, LONGER_SIDE_PX)
    small_grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    seen = cv2.resize(used.astype(np.uint8), small_grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return PhotoFacts(
        name=source.name,
        exif=exif,
        digest=digest,
        thumbnail=jpeg_bytes(reduced(small, 160)),
        tiny=_tiny(small_grey),
        sharpness=sharp,
        exposure=measure_brightness(rgb, used),
        features=_features(small, seen, local_detail=local_detail, most_features=most_features),
        is_panorama=panorama,
    )


def measure_sharpness(grey: np.ndarray) -> tuple[Sharpness, np.ndarray]:
    """Measure the sharpness of a photo, and `detail` around each pixel, (H, W) float32, NaN where there is no texture.

    The photo is (H, W) float32 in levels of 255, at most `SHARPNESS_SIDE_PX` long.
    """
    # Fine and coarse octaves.
    blurred = [cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (0.8, 1.6, 3.2)]
    fine, coarse = blurred[0] - blurred[1], blurred[1] - blurred[2]
    fine_power, coarse_power = (cv2.GaussianBlur(band * band, (0, 0), 12.0) for band in (fine, coarse))
    textured = coarse_power > _TEXTURE_LEVELS**2
    local = 0.5 * np.log2(np.maximum(fine_power - _NOISE_LEVELS**2, 1e-3) / np.maximum(coarse_power, 1e-3))
    local[~textured] = np.nan
    tiles = [
        float(np.median(tile[~np.isnan(tile)]))
        for line in np.array_split(local, _TILES, axis=0)
        for tile in np.array_split(line, _TILES, axis=1)
        if tile.size and np.mean(~np.isnan(tile)) > 0.3
    ]
    fraction = len(tiles) / _TILES**2
    if len(tiles) < 6:
        return Sharpness(float("nan"), 1.0, fraction), local
    return Sharpness(float(np.percentile(tiles, 75)), _direction_ratio(fine, coarse, textured), fraction), local


def measure_brightness(rgb: np.ndarray, used: np.ndarray) -> Brightness:
    """Return the exposure of a photo (H, W, 3) uint8 where `used` (H, W) is True."""
    pixels = rgb[used]
    if not len(pixels):
        return Brightness(float("nan"), 0.0, 0.0)
    white, black = (pixels >= _WHITE_LEVEL).all(axis=1).mean(), (pixels <= 255 - _WHITE_LEVEL).all(axis=1).mean()
    return Brightness(float(pixels.mean() / 255), float(white), float(black))


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
    return over_white(image), image[..., 3] > 127


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
        light=_local_light(rgb)[row, column],
    )


def _tiny(grey: np.ndarray) -> np.ndarray:
    side = 32
    tiny = cv2.resize(grey, (side, side), interpolation=cv2.INTER_AREA).astype(np.float32)
    tiny -= tiny.mean()
    norm = float(np.linalg.norm(tiny))
    return tiny / norm if norm > side else np.zeros_like(tiny)


def _direction_ratio(fine: np.ndarray, coarse: np.ndarray, textured: np.ndarray) -> float:
    """Return the ratio of fine over coarse gradient amplitude between its best and its worst direction.

    The square root of the ratio of the generalised eigenvalues of the two octaves' mean structure tensors: directions
    in the photo's content appear in both octaves, smear only in the fine one.
    """
    tensors = []
    for band in (fine, coarse):
        x, y = cv2.Sobel(band, cv2.CV_32F, 1, 0)[textured], cv2.Sobel(band, cv2.CV_32F, 0, 1)[textured]
        tensors.append(np.array([[np.mean(x * x), np.mean(x * y)], [np.mean(x * y), np.mean(y * y)]], dtype=np.float64))
    ratios = np.linalg.eigvals(np.linalg.solve(tensors[1] + 1e-9 * np.eye(2), tensors[0])).real
    return float(np.sqrt(max(ratios.max(), 1e-9) / max(ratios.min(), 1e-9)))


def _local_light(rgb: np.ndarray) -> np.ndarray:
    """Return brightness and colour around each pixel, (H, W, 2) float32; NaN where unknown.

    First log2 of the linear luminance, to which a stop of exposure adds 1; NaN where it is clipped or too dark.
    Second log2 of red over blue, which white balance shifts; NaN also where the colour is saturated, since a small
    highlight on it shifts the ratio by more than the white balance does. The picture is (H, W, 3) uint8 sRGB.
    """
    light = np.maximum(cv2.GaussianBlur(cv2.LUT(rgb, _LINEAR), (0, 0), 4.0), 1e-6)
    clipped = 255 * np.any((rgb >= _WHITE_LEVEL) | (rgb <= 255 - _WHITE_LEVEL), axis=2).astype(np.uint8)
    unsure = (cv2.blur(clipped, (15, 15)) > 0.05 * 255) | (light.min(axis=2) < _DARKEST)
    luminance = np.log2(light @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32))
    redness = np.log2(light[..., 0] / light[..., 2])
    luminance[unsure] = np.nan
    redness[unsure | (light.min(axis=2) < _PALE * light.max(axis=2))] = np.nan
    return np.stack([luminance, redness], axis=-1)
