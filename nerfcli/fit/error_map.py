"""Error map: the training error of blocks of pixels, used to sample more pixels where it is large."""

import torch
from torch import Tensor

from nerfcli.photos.pool import PixelBatch, PixelPool

BLOCK_PX = 16
# This fraction of a step's pixels is drawn in proportion to the error of their block, the others uniformly.
GUIDED_FRACTION = 0.5
# Weight of a block's previous error when some of its pixels are seen again.
KEPT = 0.8
# The fraction of the budget at which this begins; before, photos are explained badly everywhere.
BEGINS = 0.2
UNKNOWN = -1.0


class ErrorMap:
    """The error of each block of the photos, as far as known, and pixels drawn in proportion to it.

    A pixel p is drawn with density q(p) = (1 - g) / N + g error(p) / sum of errors, instead of 1 / N. Its weight in the
    loss is 1 / (N q): the expected loss stays the same, only its noise differs.

    Args:
        pool: the photos. Drawn pixels that are not usable are replaced by random usable ones.
    """

    def __init__(self, pool: PixelPool):
        device = pool.sizes.device
        self._pool = pool
        self._rows, self._columns = (-(-pool.sizes // BLOCK_PX)).unbind(-1)
        counts = self._rows * self._columns
        self._first = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
        self.errors = torch.full((int(self._first[-1]),), UNKNOWN, device=device)
        blocks = torch.arange(len(self.errors), device=device)
        self._photo = torch.searchsorted(self._first, blocks, right=True) - 1
        place, columns = blocks - self._first[self._photo], self._columns[self._photo]
        self._corner = torch.stack([place // columns, place % columns], dim=-1) * BLOCK_PX  # (blocks, 2) row, column
        self._extent = (pool.sizes[self._photo] - self._corner).clamp_max(BLOCK_PX)

    def draw(self, count: int, generator: torch.Generator) -> PixelBatch:
        """Draw `count` pixels, with the weight of each in the loss."""
        pool, device = self._pool, self.errors.device
        guided = round(GUIDED_FRACTION * count)
        mass = self._known_errors() * self._extent.prod(-1)
        sums = mass.double().cumsum(0)
        uniform = torch.rand(guided, generator=generator, device=device, dtype=torch.float64)
        blocks = torch.searchsorted(sums, uniform * sums[-1], right=True).clamp_max(len(sums) - 1)
        inside = torch.rand(guided, 2, generator=generator, device=device)
        row, column = (self._corner[blocks] + (inside * self._extent[blocks]).long()).unbind(-1)
        photos = self._photo[blocks]
        numbers = pool.first_pixel[photos] + row * pool.sizes[photos, 1] + column
        anywhere = pool.numbers(count, generator)
        if pool.usable is None:
            replaced, numbers = 0.0, torch.cat([numbers, anywhere[guided:]])
        else:
            usable = _contains(pool.usable, numbers)
            replaced = (~usable).double().mean().float() if guided else 0.0
            numbers = torch.cat([torch.where(usable, numbers, anywhere[:guided]), anywhere[guided:]])
        relative = self._known_errors()[self._blocks_of(numbers)] / sums[-1].float() * pool.usable_count
        density = 1.0 - GUIDED_FRACTION + GUIDED_FRACTION * (relative + replaced)
        return pool.rays_of(numbers)._replace(weights=1.0 / density)

    def learn(self, numbers: Tensor, errors: Tensor) -> None:
        """Update the errors of blocks from the errors (N,) of pixels."""
        before = torch.where(self.errors[0] == UNKNOWN, errors.mean(), self.errors)
        blocks = self._blocks_of(numbers)
        sums, counts = (torch.zeros_like(self.errors) for _ in range(2))
        sums.index_add_(0, blocks, errors)
        counts.index_add_(0, blocks, torch.ones_like(errors))
        mixed = KEPT * before + (1.0 - KEPT) * sums / counts.clamp_min(1.0)
        self.errors.copy_(torch.where(counts > 0, mixed, before))

    def _known_errors(self) -> Tensor:
        """Return the errors of all blocks, 1 where unknown and never 0."""
        return torch.where(self.errors == UNKNOWN, 1.0, self.errors.clamp_min(1e-9))

    def _blocks_of(self, numbers: Tensor) -> Tensor:
        photos = self._pool.photo_of(numbers)
        place, width = numbers - self._pool.first_pixel[photos], self._pool.sizes[photos, 1]
        row, column = place // width // BLOCK_PX, place % width // BLOCK_PX
        return self._first[photos] + row * self._columns[photos] + column


def _contains(numbers: Tensor, wanted: Tensor) -> Tensor:
    """Return which of the `wanted` numbers are in `numbers`, which increase."""
    places = torch.searchsorted(numbers, wanted).clamp_max(len(numbers) - 1)
    return numbers[places] == wanted
