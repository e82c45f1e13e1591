"""The loss of a refinement: its gradient against differences of the loss as an independent library computes it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from nerfcli.splats.refine import SIMILARITY_WEIGHT, loss_gradient


def pair(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture and a target with texture, float32; a part of both is black, and a part white."""
    rng = np.random.default_rng(seed)
    target = gaussian_filter(rng.random((24, 31, 3)), (1.2, 1.2, 0.0))
    image = target + 0.1 * rng.normal(size=target.shape)
    image[:6, :9], target[:6, :9] = 0.0, 0.0
    image[-6:, -9:], target[-6:, -9:] = 1.0, 1.0
    return image.astype(np.float32), target.astype(np.float32)


def loss(image: np.ndarray, target: np.ndarray) -> float:
    """Return the loss in float64, with SciPy's windows; see `loss_gradient`."""

    def mean(picture: np.ndarray) -> np.ndarray:
        return gaussian_filter(picture, (1.5, 1.5, 0.0), mode="constant", radius=(5, 5, 0))

    image, target = image.astype(np.float64), target.astype(np.float64)
    x, y = mean(image), mean(target)
    light = (2 * x * y + 1e-4) / (x**2 + y**2 + 1e-4)
    variances = mean(image**2) - x**2 + mean(target**2) - y**2
    structure = (2 * (mean(image * target) - x * y) + 9e-4) / (variances + 9e-4)
    share = SIMILARITY_WEIGHT
    return float(((1 - share) * np.abs(image - target) + share * (1 - light * structure)).mean())


@pytest.mark.parametrize("seed", range(3))
def test_gradient_is_the_slope_of_the_loss(seed: int) -> None:
    image, target = pair(seed)
    found, rng = loss_gradient(image, target), np.random.default_rng(seed)
    for row, column, channel in zip(*(rng.integers(0, side, 40) for side in image.shape), strict=True):
        change = np.zeros(image.shape)
        change[row, column, channel] = 1e-5
        if abs(image[row, column, channel] - target[row, column, channel]) < 2e-5:
            continue  # the absolute error has no slope there
        slope = (loss(image + change, target) - loss(image - change, target)) / 2e-5
        assert found[row, column, channel] == pytest.approx(slope, rel=1e-3, abs=1e-7)


def test_equal_pictures_have_no_gradient() -> None:
    for level in (0.0, 1e-6, 1.0):
        flat = np.full((16, 16, 3), level, np.float32)
        assert np.abs(loss_gradient(flat, flat)).max() < 1e-6
    _, target = pair(1)
    assert np.abs(loss_gradient(target, target)).max() < 1e-6


def test_unused_pixels_have_no_gradient_and_no_influence() -> None:
    image, target = pair(2)
    used = np.ones(image.shape[:2], bool)
    used[:, 12:20] = False
    other = image.copy()
    other[~used] = 7.0
    found = loss_gradient(image, target, used)
    assert not found[~used].any()
    np.testing.assert_array_equal(found, loss_gradient(other, target, used))


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (11, 5)])
def test_pictures_smaller_than_the_window(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    image, target = rng.random((2, *shape, 3), dtype=np.float32)
    found = loss_gradient(image, target)
    assert found.shape == image.shape
    assert np.isfinite(found).all()
