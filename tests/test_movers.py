"""Moving things are left out of the loss: exactly at their size and place where these are known, nowhere else."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfcli.cameras.rigid import Similarity
from nerfcli.field.checkpoint import load_tensors
from nerfcli.fit.extent import Extent
from nerfcli.fit.fitting import Fitting
from nerfcli.fit.movers import BEGINS, BLOCK_PX, LEAST, Movers
from nerfcli.media.images import read_image
from nerfcli.photos.loading import LoadedPhoto, load_photos
from nerfcli.photos.pool import PixelPool
from nerfcli.runs.components import Components
from nerfcli.runs.files import STATE
from nerfcli.runs.settings import TrainSettings
from nerfcli.scene import Scene
from nerfcli.train.left_out import write_left_out

CPU = torch.device("cpu")
SAME = Similarity(1.0, np.eye(3), np.zeros(3))
BLOCKS = slice(BLOCK_PX, 3 * BLOCK_PX)


@pytest.fixture(scope="module")
def photos(spheres: Scene) -> list[LoadedPhoto]:
    return load_photos(spheres.frames[:3], factor=1, threads=1)


def learned(pool: PixelPool, residual_of: Callable[[int, np.ndarray, np.ndarray], np.ndarray]) -> Movers:
    """Return movers that have seen every pixel once, with residuals (H, W, 3) by photo, row and column, plus noise."""
    movers, rng = Movers(pool), np.random.default_rng(0)
    residuals = []
    for photo, (height, width) in enumerate(pool.sizes.tolist()):
        rows, columns = np.mgrid[:height, :width]
        noise = rng.normal(0.0, 0.1, (height, width, 3))
        residuals.append((residual_of(photo, rows, columns) + noise).reshape(-1, 3))
    movers.learn(
        torch.arange(len(pool.colours)), torch.from_numpy(np.concatenate(residuals)).float(), fraction=BEGINS, step=0
    )
    return movers


def square(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return which pixels are in a square of two by two blocks, (H, W) bool."""
    return (rows >= BLOCKS.start) & (rows < BLOCKS.stop) & (columns >= BLOCKS.start) & (columns < BLOCKS.stop)


def test_a_square_of_one_photo_is_left_out(photos):
    """Two by two blocks of the second photo are left out, and no others.

    Of the nine blocks around each of them, four have the residual; around a neighbour, two or one: 0.11, 0.06, 0.03,
    with the limit at 0.07. A photo that is brighter by more than the limit is no mover: its median is subtracted."""
    pool = PixelPool(photos, SAME, CPU)

    def residual(photo: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        exposure = 3.0 * LEAST if photo == 2 else 0.0
        return exposure + (0.25 * square(rows, columns) if photo == 1 else 0.0 * rows)[..., None]

    movers = learned(pool, residual)
    rows, columns = np.mgrid[: photos[1].pixels.shape[0], : photos[1].pixels.shape[1]]
    for photo, moving in ((0, np.zeros_like(rows, bool)), (1, square(rows, columns)), (2, np.zeros_like(rows, bool))):
        np.testing.assert_array_equal(movers.mask(photo).numpy(), ~moving)
    everywhere = torch.cat([movers.mask(photo).flatten() for photo in range(3)]).float()
    torch.testing.assert_close(movers.weights(torch.arange(len(pool.colours))), everywhere)


def test_detail_that_is_not_learned_yet_counts(photos):
    """Stripes of 0.3 above and below the rendering: large residuals that cancel within a block."""
    pool = PixelPool(photos, SAME, CPU)
    movers = learned(pool, lambda photo, rows, columns: 0.3 * (-1.0) ** (columns // 2)[..., None])
    assert all(movers.mask(photo).all() for photo in range(3))


def test_pixels_count_again_when_the_field_agrees(photos):
    """A residual in one of eleven steps leaves about a tenth of it in the mean, less than the limit."""
    pool = PixelPool(photos, SAME, CPU)
    movers = learned(pool, lambda photo, rows, columns: 0.3 * (photo == 1) * square(rows, columns)[..., None])
    numbers = torch.arange(len(pool.colours))
    assert movers.weights(numbers).min() == 0.0
    for _ in range(10):
        movers.learn(numbers, torch.zeros(len(numbers), 3), fraction=BEGINS, step=0)
    assert movers.weights(numbers).min() == 1.0


def test_nothing_moves_at_the_beginning(photos):
    """Before `BEGINS` the field explains no photo; and nothing is known about blocks without a seen pixel."""
    movers = Movers(PixelPool(photos, SAME, CPU))
    movers.learn(torch.arange(500), torch.ones(500, 3), fraction=0.9 * BEGINS, step=0)
    assert not movers.moving.any()
    unseen = Movers(PixelPool(photos, SAME, CPU))
    unseen.learn(torch.arange(1), torch.ones(1, 3), fraction=BEGINS, step=0)
    assert not unseen.moving.any()


def test_a_training_leaves_out_what_one_photo_shows(spheres, spheres_run, tmp_path):
    """A trained field is held fixed, and the colours in a square of one photo are inverted. After 100 steps the square
    is black in the mask of that photo, which is the only one written, and does not count in the loss."""
    tensors, description = load_tensors(spheres_run / STATE, "cpu")
    extent = Extent.from_json(description["extent"])
    photos = load_photos(spheres.train_frames[:7], factor=1, threads=1)
    odd = photos[1].pixels.copy()
    place = np.s_[2 * BLOCK_PX : 4 * BLOCK_PX, 2 * BLOCK_PX : 4 * BLOCK_PX]
    odd[place] = np.where(odd[place] > 127, 0, 255)
    odd[..., 3:] = photos[1].pixels[..., 3:]
    pool = PixelPool([photos[0], replace(photos[1], pixels=odd), *photos[2:]], extent.training_from_scene, CPU)
    losses = []
    for movers, steps in ((None, 40), (Movers(pool), 100)):
        settings = TrainSettings(
            budget_seconds=None, steps=200, log2_rows=14, samples_per_step=2**12, threads=1, components=Components(),
            learning_rate=1e-30, final_learning_rate=1e-30,
        )  # fmt: skip
        fitting = Fitting(pool, extent.marching, contraction=extent.contraction, settings=settings, movers=movers)
        fitting.restore({**fitting.state()[0], **tensors}, description)
        losses.append(np.median([fitting.advance(0.5).loss for _ in range(steps)][-20:]))
    assert movers is not None
    notes: list[str] = []
    folder = tmp_path / "movers"
    write_left_out(folder, movers.masks(), notify=notes.append)
    written = [path.relative_to(folder) for path in sorted(folder.rglob("*.png"))]
    name = spheres.train_frames[1].name
    assert written == [Path(f"{name}.png")]
    mask = read_image(folder / written[0])
    assert (mask[place] == 0).all()
    assert f"in 1 of {len(photos)} photos, most in {name}" in notes[0]
    assert losses[1] < 0.8 * losses[0]
