"""Moving things such as people, cars and leaves: leave out of the loss what one photo shows and others do not."""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from nerfcli.photos.pool import PixelPool

BLOCK_PX = 16
# Factor by which the sums of a block decay in each step.
KEPT = 0.997
# Fraction of the budget at which this begins, as the field explains no photo before, and steps between two refreshes.
BEGINS = 0.2
REFRESH_EVERY = 20
# A block moves if its mean residual is larger than this, in sRGB, and than this many times the median of all blocks.
LEAST, FACTOR = 0.07, 4.0
# A block is not judged while fewer pixels of it and its neighbours have been seen.
FEWEST_PIXELS = 4.0


class Movers:
    """The blocks of the training photos that show something that moves.

    Detail that a field has not learned yet is too bright in some pixels of a block and too dark in others. Something
    that other photos do not show is wrong in the same direction in all pixels. So a block moves if the mean residual of
    it and its eight neighbours, minus the median over the photo (its exposure), is large:

        mean over channels of |mean residual - median of the photo|  >  max(LEAST, FACTOR * median of all blocks)

    Means are also over time, with weights that decay. Pixels of such a block are still rendered, but do not count in
    the loss; if the field comes to agree with them, they count again.
    """

    def __init__(self, pool: PixelPool):
        self._pool = pool
        self._rows, self._columns = (-(-pool.sizes // BLOCK_PX)).amax(0).tolist()
        blocks = len(pool.sizes) * self._rows * self._columns
        device = pool.sizes.device
        self.sums = torch.zeros(blocks, 4, device=device)  # of the residuals of three channels, and of the pixels
        self.moving = torch.zeros(blocks, dtype=torch.bool, device=device)

    def learn(self, numbers: Tensor, residuals: Tensor, *, fraction: float, step: int) -> None:
        """Record the residuals (N, 3), rendered - measured in sRGB, of one step's pixels (N,); if it is time, decide
        which blocks move.
        """
        self.sums *= KEPT
        self.sums.index_add_(0, self._blocks_of(numbers), torch.cat([residuals, torch.ones_like(residuals[:, :1])], -1))
        if fraction >= BEGINS and step % REFRESH_EVERY == 0:
            self._refresh()

    def _refresh(self) -> None:
        photos = len(self._pool.sizes)
        maps = self.sums.view(photos, self._rows, self._columns, 4).permute(0, 3, 1, 2)
        around = 9.0 * avg_pool2d(maps, 3, stride=1, padding=1)
        seen = around[:, 3:] >= FEWEST_PIXELS
        means = torch.where(seen, around[:, :3] / around[:, 3:], torch.nan)
        medians = means.flatten(2).nanmedian(-1).values[..., None, None]
        off = (means - medians).abs().mean(1)
        limit = (FACTOR * off.nanmedian()).clamp_min(LEAST)
        self.moving = (off > limit).flatten()  # NaN is not larger

    def weights(self, numbers: Tensor) -> Tensor:
        """Return the weights of pixels (N,) in the loss: 0 where something moves, else 1."""
        return (~self.moving[self._blocks_of(numbers)]).float()

    def masks(self) -> dict[str, np.ndarray]:
        """Return the `mask` of each photo, by its name."""
        return {frame.name: self.mask(photo).cpu().numpy() for photo, frame in enumerate(self._pool.frames)}

    def mask(self, photo: int) -> Tensor:
        """Return the pixels of a photo that count: (height, width) bool, False where something moves."""
        height, width = self._pool.sizes[photo].tolist()
        blocks = ~self.moving.view(-1, self._rows, self._columns)[photo]
        return blocks.repeat_interleave(BLOCK_PX, 0).repeat_interleave(BLOCK_PX, 1)[:height, :width]

    def _blocks_of(self, numbers: Tensor) -> Tensor:
        photos = self._pool.photo_of(numbers)
        place, width = numbers - self._pool.first_pixel[photos], self._pool.sizes[photos, 1]
        row, column = place // width // BLOCK_PX, place % width // BLOCK_PX
        return (photos * self._rows + row) * self._columns + column
