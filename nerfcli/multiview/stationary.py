"""Detect two motions in a capture: a background fixed in the image, and a moving object.

A tripod and a turntable give two sets of matches. Those of the background do not move at all, whatever the two photos
are; those of the object follow an epipolar geometry of their own, which the first set contradicts. No other capture
does both. A camera that moves leaves hardly any match in its place, and what there is (the far distance, the point that
it keeps in the middle, the point that it moves towards) agrees with the geometry of the rest. Photos that were copied
have matches that do not move, but no others.

Letters: x and y are the pixels of a match in the first and in the second photo, F a fundamental matrix.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.multiview.epipolar import epipolar_px, fundamental_matrix

# A match is still if it moved by less than this share of the picture's diagonal; that is 2 px at 1600 x 1200.
_STILL = 0.001
# In small pictures features are found no better than this.
_LEAST_STILL_PX = 0.75
# Of matches that change smoothly over the picture, eight times as many moved by one to three such lengths as by less.
_RING = 3.0
_LEAST_PEAK = 2.0
# A tripod that gives way shifts the whole background by so many lengths at most.
_SHAKEN = 4.0
# From so many such lengths on a match moved for certain.
_MOVED = 4.0
_LEAST_MATCHES = 15
_LEAST_FOR_GEOMETRY = 12
# A geometry that explains so much of what stays and of what moves, to twice a length, makes them one motion.
_MOST_AGREEING = 0.7
# Cells of the picture in which still matches are counted.
_CELLS = (16, 12)

# Of the pairs that tell anything, the share that must show two motions or nothing but the still one. Measured: all of
# them on turntables, none on captures with a camera that moves.
LEAST_SHARE = 0.5
_LEAST_PAIRS = 3
# Less of the picture than this is a time stamp or a mark, not a background.
_LEAST_CELLS = 12
_LEAST_EXTENT = 0.25


@dataclass(frozen=True)
class Motions:
    """Motions found in the matches of two photos.

    Args:
        stays: (N,) bool, matches in their place; none if they are no more than what a smooth motion leaves there.
        moves: (N,) bool, the others that agree on one geometry of two views.
        agreeing: share of both that one geometry explains, of that part of which it explains less; NaN without both.
        cells: those of the picture in which still matches are, by number.
    """

    stays: np.ndarray
    moves: np.ndarray
    agreeing: float
    cells: frozenset[int]

    @property
    def still(self) -> int:
        """Matches that stayed in their place."""
        return int(self.stays.sum())

    @property
    def moving(self) -> int:
        """Matches that moved, by one geometry."""
        return int(self.moves.sum())

    @property
    def two(self) -> bool:
        """Whether there are two motions, one of which is none."""
        return self.still >= _LEAST_MATCHES and self.moving >= _LEAST_MATCHES and self.agreeing < _MOST_AGREEING

    @property
    def only_still(self) -> bool:
        """Whether there are only static matches."""
        return self.still >= _LEAST_MATCHES and self.moving < _LEAST_MATCHES

    @property
    def one(self) -> bool:
        """Whether all moving matches follow one motion, and are consistent with the static ones."""
        return self.moving >= _LEAST_MATCHES and not self.two


@dataclass(frozen=True)
class Stationary:
    """Summary over many pairs.

    Args:
        two, still, moved: pairs with two motions, with the still one alone, and with one that moves.
        photos: that are in a pair with two motions.
        cells: share of the picture in which matches stay in their place in two pairs or more.
        extent: share of the picture that a box around these takes.
    """

    two: int
    still: int
    moved: int
    photos: int
    cells: float
    extent: float

    @property
    def share(self) -> float:
        """Fraction of the informative pairs with two motions; 0 without such pairs."""
        return self.two / max(self.two + self.moved, 1)

    @property
    def two_motions(self) -> bool:
        """Whether most pairs show two motions, however small the static part is."""
        return self.two >= _LEAST_PAIRS and self.share >= LEAST_SHARE

    @property
    def wide(self) -> bool:
        """Whether the static part is wide enough for a background."""
        return self.cells * _CELLS[0] * _CELLS[1] >= _LEAST_CELLS and self.extent >= _LEAST_EXTENT

    @property
    def found(self) -> bool:
        """Whether an object moves in front of a static background."""
        return self.two_motions and self.wide


def still_px(size: tuple[int, int]) -> float:
    """Return the tolerance for a static feature, pixels, in a picture of (width, height)."""
    return max(_LEAST_STILL_PX, _STILL * float(np.hypot(*size)))


def in_place(x: np.ndarray, y: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return which matches (N, 2) of pictures of (width, height) stay in their place, (N,) bool, and its shift (2,).

    The whole place may be shifted by a few pixels, as by a tripod that gives way. None stay if so few do that they are
    no more than what a motion that changes smoothly over the picture leaves there.
    """
    within = still_px(size)
    motion = y - x
    small = motion[np.linalg.norm(motion, axis=1) < _SHAKEN * within]
    shift = np.zeros(2)
    if len(small) >= _LEAST_MATCHES:
        starts = np.zeros(2), np.median(small, axis=0)
        shift = max(
            (_densest(small, start, within) for start in starts),
            key=lambda at: int((np.linalg.norm(small - at, axis=1) < within).sum()),
        )
    distances = np.linalg.norm(motion - shift, axis=1)
    stays = distances < within
    around = int(((distances >= within) & (distances < _RING * within)).sum())
    if stays.sum() < max(_LEAST_MATCHES, _LEAST_PEAK * around):
        stays = np.zeros(len(x), dtype=bool)
    return stays, shift


def _densest(motion: np.ndarray, start: np.ndarray, within: float) -> np.ndarray:
    """Return the centre of the most motions (N, 2) near a start: the mean of those nearby, again and again."""
    at = start
    for _ in range(10):
        near = np.linalg.norm(motion - at, axis=1) < within
        if not near.any():
            break
        at = motion[near].mean(axis=0)
    return at


def motions(x: np.ndarray, y: np.ndarray, size: tuple[int, int]) -> Motions:
    """Find the motions in matches (N, 2) of two pictures of the same size (width, height). Deterministic."""
    within = still_px(size)
    stays, shift = in_place(x, y, size)
    moves = np.linalg.norm(y - x - shift, axis=1) > _MOVED * within
    fundamental, agree = _geometry(x[moves], y[moves], within)
    moves[moves] = agree
    agreeing = float("nan")
    if stays.any() and agree.any():
        common = _common(x, y, one=stays, other=moves, within=within)
        explained = [epipolar_px(x, y, matrix) < 2 * within for matrix in (fundamental, common)]
        agreeing = max(float(min(right[stays].mean(), right[moves].mean())) for right in explained)
    columns, rows = _CELLS
    cells = frozenset(
        int(row) * columns + int(column)
        for column, row in np.floor(x[stays] / np.array(size) * np.array(_CELLS)).clip(0, (columns - 1, rows - 1))
    )
    return Motions(stays, moves, agreeing, cells)


def together(pairs: Sequence[tuple[int, int, Motions]]) -> Stationary:
    """Summarize pairs (photo, photo, motions)."""
    two = [pair for pair in pairs if pair[2].two]
    often = [cell for _, _, pair in two for cell in pair.cells]
    cells = [cell for cell in set(often) if often.count(cell) >= 2]
    columns, rows = _CELLS
    extent = 0.0
    if cells:
        down, across = np.divmod(np.array(cells), columns)
        extent = float((np.ptp(down) + 1) * (np.ptp(across) + 1) / (columns * rows))
    return Stationary(
        two=len(two),
        still=sum(pair.only_still for _, _, pair in pairs),
        moved=sum(pair.one for _, _, pair in pairs),
        photos=len({photo for pair in two for photo in pair[:2]}),
        cells=len(cells) / (columns * rows),
        extent=extent,
    )


def _common(x: np.ndarray, y: np.ndarray, *, one: np.ndarray, other: np.ndarray, within: float) -> np.ndarray:
    """Return the fundamental matrix that most of two sets of matches agree on, as many of the one as of the other.

    What moved may be flat, and then has many such matrices, of which one may hold for what stayed, too.
    """
    count = min(one.sum(), other.sum())
    chosen = np.concatenate(
        [np.flatnonzero(which)[np.linspace(0, which.sum() - 1, count).astype(int)] for which in (one, other)]
    )
    return _geometry(x[chosen], y[chosen], within)[0]


def _geometry(x: np.ndarray, y: np.ndarray, within: float) -> tuple[np.ndarray, np.ndarray]:
    return fundamental_matrix(x, y, within_px=within, least=_LEAST_FOR_GEOMETRY)
