"""Sharpness of a photo, nearly independent of its content.

Natural pictures have about the same energy in every octave of detail; blur removes it from the finest octaves and
leaves the coarse ones. So `detail` compares two neighbouring octaves: it is near 0 in a sharp photo with texture, and
decreases by one for every halving of the fine octave's amplitude relative to the coarse one's. Photos are measured at
`LONGER_SIDE_PX`: blur that vanishes at this size is not detected.
"""

from dataclasses import dataclass

import cv2
import numpy as np

LONGER_SIDE_PX = 1600

# Tiles per side; the sharpest quarter of those with texture decides, since the background may be out of focus.
_TILES = 12
# A pixel has enough texture if the root mean square of the coarse octave around it exceeds this, in levels of 255.
_TEXTURE_LEVELS = 1.2
# Noise of the sensor and of JPEG, in levels, which must not count as fine detail.
_NOISE_LEVELS = 0.35


@dataclass(frozen=True)
class Sharpness:
    """Sharpness measures of a photo.

    Args:
        detail: log2 of fine over coarse amplitude, the 75th percentile over the tiles; NaN without texture.
        direction_ratio: ratio of fine over coarse amplitude between the directions where it is largest and smallest,
            >= 1; large if the photo is smeared in one direction.
        textured: fraction of the tiles with enough texture.
    """

    detail: float
    direction_ratio: float
    textured: float


def octaves(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fine and coarse octaves of a grey picture (H, W) in levels of 255, float32."""
    fine, middle, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (0.8, 1.6, 3.2))
    return fine - middle, middle - coarse


def measure(grey: np.ndarray) -> tuple[Sharpness, np.ndarray]:
    """Measure the sharpness of a photo, and `detail` around each pixel, (H, W) float32, NaN where there is no texture.

    The photo is (H, W) float32 in levels of 255, at most `LONGER_SIDE_PX` long.
    """
    fine, coarse = octaves(grey)
    fine_power, coarse_power = (cv2.GaussianBlur(band * band, (0, 0), 12.0) for band in (fine, coarse))
    textured = coarse_power > _TEXTURE_LEVELS**2
    local = 0.5 * np.log2(np.maximum(fine_power - _NOISE_LEVELS**2, 1e-3) / np.maximum(coarse_power, 1e-3))
    local[~textured] = np.nan
    tiles = [
        (float(np.median(tile[~np.isnan(tile)])), row, column)
        for row, line in enumerate(np.array_split(local, _TILES, axis=0))
        for column, tile in enumerate(np.array_split(line, _TILES, axis=1))
        if tile.size and np.mean(~np.isnan(tile)) > 0.3
    ]
    fraction = len(tiles) / _TILES**2
    if len(tiles) < 6:
        return Sharpness(float("nan"), 1.0, fraction), local
    detail = float(np.percentile([tile[0] for tile in tiles], 75))
    return Sharpness(detail, _direction_ratio(fine, coarse, textured), fraction), local


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
