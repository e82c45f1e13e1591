"""Pixels drawn by the error of their block: the expected loss stays the same for any error map."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfcli.cameras.rigid import Similarity
from nerfcli.fit.error_map import BLOCK_PX, GUIDED_FRACTION, ErrorMap
from nerfcli.photos.loading import LoadedPhoto, load_photos
from nerfcli.photos.pool import PixelPool
from nerfcli.scene import Scene

SAME = Similarity(1.0, np.eye(3), np.zeros(3))


@pytest.fixture(scope="module")
def photos(spheres: Scene) -> list[LoadedPhoto]:
    """Two photos; their last blocks are not whole, and a mask hides a part of the second one."""
    first, second = load_photos(spheres.frames[:2], factor=1, threads=1)
    used = np.ones(second.pixels.shape[:2], bool)
    used[:30, 10:50] = False
    return [first, replace(second, used=used)]


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("masked", [False, True])
def test_weighted_means_are_those_of_all_pixels(masked, photos):
    """The weighted mean of a function of drawn pixels is its mean over all usable pixels, although one block of the map
    has 100 times the error of the others. The tolerance is from the standard error of the draws."""
    pool = PixelPool(photos if masked else photos[:1], SAME, torch.device("cpu"))
    usable = torch.arange(len(pool.colours)) if pool.usable is None else pool.usable
    guided = ErrorMap(pool)
    guided.errors.fill_(0.01)
    guided.errors[7] = 1.0
    values = torch.sin(0.01 * torch.arange(len(pool.colours)))
    drawn = guided.draw(200_000, generator())
    terms = values[drawn.numbers] * drawn.weights
    assert torch.isin(drawn.numbers, usable).all()
    for sample, expected in ((terms, values[usable].mean()), (drawn.weights, 1.0)):
        error = float(sample.std()) / len(sample) ** 0.5
        assert abs(float(sample.mean()) - float(expected)) < 4 * error + 1e-3 * masked


def test_pixels_are_drawn_where_the_error_is(photos):
    """Half are drawn anywhere, the others evenly within the one block that has an error."""
    pool = PixelPool(photos[:1], SAME, torch.device("cpu"))
    height, width = photos[0].pixels.shape[:2]
    guided = ErrorMap(pool)
    columns = -(-width // BLOCK_PX)
    guided.errors.fill_(0.0)
    guided.errors[columns + 2] = 1.0
    numbers = guided.draw(40_000, generator()).numbers
    row, column = numbers // width, numbers % width
    inside = (row // BLOCK_PX == 1) & (column // BLOCK_PX == 2)
    area = BLOCK_PX**2
    expected = GUIDED_FRACTION + (1 - GUIDED_FRACTION) * area / (height * width)
    assert inside.double().mean().item() == pytest.approx(expected, abs=0.01)
    counts = torch.bincount((row[inside] % BLOCK_PX) * BLOCK_PX + column[inside] % BLOCK_PX, minlength=area)
    assert counts.min() > 0.4 * counts.double().mean()


def test_a_block_remembers_its_error(photos):
    pool = PixelPool(photos[:1], SAME, torch.device("cpu"))
    guided = ErrorMap(pool)
    even = guided.draw(100, generator()).weights
    torch.testing.assert_close(even, torch.ones(100))  # no error is known: all are equally likely
    guided.learn(torch.tensor([0, 1, 500]), torch.tensor([1.0, 3.0, 2.0]))
    assert (guided.errors == 2.0).all()  # the mean of all pixels for unknown blocks, and that of block 0
    guided.learn(torch.tensor([0, 1]), torch.tensor([4.0, 8.0]))
    assert guided.errors[0].item() == pytest.approx(0.8 * 2 + 0.2 * 6)
    assert (guided.errors[1:] == 2.0).all()
