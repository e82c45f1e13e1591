"""Nearest SIFT descriptors of two photos: exact, and faster than an approximate search.

Matrices of bytes are multiplied tile by tile, and maxima are found while a tile is in the cache. All sums are whole
numbers, so that results depend neither on threads nor on the library.
"""

import functools
from dataclasses import dataclass
from timeit import repeat

import numba
import numpy as np
import torch
from torch import Tensor

# Descriptors of each photo in a tile, whose products take 0.5 MB.
_ROWS, _COLUMNS = 128, 1024
# Likeness is this less the squared distance. Descriptors of length 512 without negative components are at most 2^19
# apart, squared: likeness has 20 bits with its sign, and the number of a row or column of a tile fits below it.
_LIKENESS = 1 << 18
_BITS = 12
_NUMBERS = (1 << _BITS) - 1
_LEAST = -(2**31)


@dataclass(frozen=True)
class Descriptors:
    """Descriptors of a photo, as `prepare` returns them.

    Args:
        signed: (N, 128) int8, components less 128.
        shares: (N,) int32, `_LIKENESS` / 2 less the squared length of `signed`.
    """

    signed: Tensor
    shares: np.ndarray


def prepare(descriptors: np.ndarray) -> Descriptors:
    """Prepare SIFT descriptors (N, 128) uint8, whose length is at most 512 and a few per cent, for `mutual_nearest`."""
    signed = (descriptors ^ 128).view(np.int8)
    squared = np.einsum("ij,ij->i", signed, signed, dtype=np.int32)
    return Descriptors(torch.from_numpy(signed), _LIKENESS // 2 - squared)


def mutual_nearest(one: Descriptors, other: Descriptors, *, ratio: float, furthest: float) -> np.ndarray:
    """Return the numbers (M, 2) of descriptors that are each other's nearest, clearly so and not far apart.

    Their distance is at most `furthest`, and less than `ratio` times that to the second nearest in either photo.
    Several threads may call this at once, each with the threads of its torch.

    Example:
        >>> corners = prepare(255 * np.eye(3, 128, dtype=np.uint8))
        >>> mutual_nearest(corners, corners, ratio=0.8, furthest=300.0).tolist()
        [[0, 0], [1, 1], [2, 2]]
    """
    rows, columns = len(one.shares), len(other.shares)
    # For each row and each column: the greatest likeness, who has it, and the second greatest.
    of_rows, of_columns = (np.full((3, count), _LEAST, np.int32) for count in (rows, columns))
    for right in range(0, columns, _COLUMNS):
        in_columns = slice(right, right + _COLUMNS)
        transposed = other.signed[in_columns].T.contiguous()
        for below in range(0, rows, _ROWS):
            in_rows = slice(below, below + _ROWS)
            products = _multiply(one.signed[in_rows], transposed).numpy()
            shares = one.shares[in_rows], other.shares[in_columns]
            _find_maxima(products, *shares, of_rows[:, in_rows], of_columns[:, in_columns], (below, right))
    if not rows or not columns:
        return np.zeros((0, 2), np.int32)
    likeness, nearest, second = of_rows
    second = np.maximum(second, of_columns[2][nearest])
    squared, clearly = (_LIKENESS - found.astype(np.float64) for found in (likeness, second))
    mutual = of_columns[1][nearest] == np.arange(rows)
    kept = mutual & (squared <= furthest**2) & (squared < ratio**2 * clearly)
    return np.column_stack([np.flatnonzero(kept), nearest[kept]])


def _multiply(left: Tensor, right: Tensor) -> Tensor:
    """Return the product of matrices of bytes, of int32 or float32, exactly."""
    return torch._int_mm(left, right) if _multiplies_bytes() else left.float() @ right.float()


@functools.cache
def _multiplies_bytes() -> bool:
    """Return whether torch multiplies bytes exactly, and faster than float32, as on processors with VNNI or AMX."""
    sides = torch.randint(-128, 128, (2, 512, 128), generator=torch.Generator().manual_seed(0), dtype=torch.int8)
    sides[:, :16] = -128  # the greatest sums
    left, right = sides[0], sides[1].T.contiguous()

    def bytewise() -> Tensor:
        return torch._int_mm(left, right)

    def in_floats() -> Tensor:
        return left.float() @ right.float()

    try:
        exact = torch.equal(bytewise().float(), in_floats())
    except (AttributeError, RuntimeError):  # not in this version of torch, or not for this processor
        return False
    return exact and min(repeat(bytewise, number=1)) < min(repeat(in_floats, number=1))


@numba.njit(nogil=True, cache=True)
def _find_maxima(
    products: np.ndarray,
    row_shares: np.ndarray,
    column_shares: np.ndarray,
    of_rows: np.ndarray,
    of_columns: np.ndarray,
    corner: tuple[int, int],
) -> None:
    """Take the tile of likenesses at `corner` into the maxima of its rows and columns; `products` are overwritten.

    likeness = 2 product + share of the row + share of the column. Shifted, with the number of the row or column below,
    taken from all ones so that the first of several maxima wins, it is one number, and maxima need no branch.
    """
    rows, columns = products.shape
    first, second = np.full(columns, _LEAST, np.int32), np.full(columns, _LEAST, np.int32)
    plain, numbered = np.empty(columns, np.int32), np.empty(columns, np.int32)
    for column in range(columns):
        plain[column] = column_shares[column] << _BITS
        numbered[column] = plain[column] | (_NUMBERS - column)
    for row in range(rows):
        share = np.int32(row_shares[row] << _BITS)
        own = np.int32(share | (_NUMBERS - row))
        best = np.int32(_LEAST)
        for column in range(columns):
            doubled = np.int32(np.int32(products[row, column]) << (_BITS + 1))
            of_column = np.int32(np.int32(doubled + plain[column]) + own)
            second[column] = max(second[column], min(first[column], of_column))
            first[column] = max(first[column], of_column)
            best = max(best, np.int32(np.int32(doubled + numbered[column]) + share))
        at = _NUMBERS - (best & _NUMBERS)
        # The second best of the row: the best becomes as far away as can be.
        products[row, at] = (1 - 2 * _LIKENESS - row_shares[row] - column_shares[at]) // 2
        next_best = np.int32(_LEAST)
        for column in range(columns):
            doubled = np.int32(np.int32(products[row, column]) << (_BITS + 1))
            next_best = max(next_best, np.int32(np.int32(doubled + numbered[column]) + share))
        _take(of_rows[:, row], best >> _BITS, corner[1] + at, next_best >> _BITS)
    for column in range(columns):
        at = _NUMBERS - (first[column] & _NUMBERS)
        _take(of_columns[:, column], first[column] >> _BITS, corner[0] + at, second[column] >> _BITS)


@numba.njit(nogil=True, cache=True)
def _take(found: np.ndarray, likeness: np.int32, number: np.int32, second: np.int32) -> None:
    """Take the two greatest likenesses of a tile into those found so far: the greatest, its number and the second."""
    if likeness > found[0]:
        found[2] = max(found[0], second)
        found[0], found[1] = likeness, number
    else:
        found[2] = max(found[2], likeness)
