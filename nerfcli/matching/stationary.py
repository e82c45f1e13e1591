"""Detect two motions in a capture: a background fixed in the image, and a moving object.

A tripod and a turntable give two sets of matches. Matches on the background do not move in any pair of photos, or are
displaced together by a similarity that is nearly none; matches on the object follow their own epipolar geometry, which
the first set contradicts. No other capture has both. With a moving camera, hardly any match stays in place, and those
that do (far away, at the point that the camera keeps in the centre, at the point that it moves towards) agree with the
geometry of the rest. Copies of one photo have matches that do not move, but no others.

Letters: x and y are the pixels of a match in the first and in the second photo, F a fundamental matrix.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.matching.agreement import epipolar_px, fundamental_matrix

# A match is still if it moved by less than this fraction of the picture's diagonal: 2 px at 1600 x 1200.
_STILL = 0.001
# Lower bound of this tolerance, because features in small pictures are not located more precisely.
_LEAST_STILL_PX = 0.75
# Still matches must be at least `_LEAST_PEAK` times as many as the matches that moved by 1 to `_RING` tolerances. With
# motion that changes smoothly over the picture, eight times as many would have moved that far as stayed still.
_RING = 3.0
_LEAST_PEAK = 2.0
# A match that moved by more than this many tolerances moved for certain.
_MOVED = 4.0
# The whole background may be displaced by this fraction of the picture's diagonal, turned and scaled by this much: the
# tripod gives way, the camera is turned to keep the object in view, or the photos were cropped around it.
_MOST_SHIFTED = 0.15
_MOST_TURNED_DEG = 3.0
_MOST_SCALED = 0.01
# So many sets of matches that follow one displacement are tried as the background.
_CANDIDATES = 2
_LEAST_MATCHES = 15
# If one geometry explains this fraction of the still and of the moving matches to within 2 tolerances, they are one
# motion.
_MOST_AGREEING = 0.7
# Cells (columns, rows) of the picture in which still matches are counted.
_CELLS = (16, 12)

# Least `Stationary.fraction`, the fraction of the pairs with any motion that show two motions. All pairs of
# turntables do, none of captures with a moving camera.
LEAST_FRACTION = 0.5
_LEAST_PAIRS = 3
# Still matches that cover less of the picture are a time stamp or a watermark, not a background.
_LEAST_CELLS = 12
_LEAST_EXTENT = 0.25


@dataclass(frozen=True)
class Motions:
    """Motions found in the matches of two photos.

    Args:
        stays: (N,) bool, matches that stay in place; none if a smooth motion would leave as many in place.
        moves: (N,) bool, moving matches that are inliers of one epipolar geometry.
        agreeing: fraction of the still or of the moving matches, whichever is less, that one geometry explains; NaN
            without either.
        cells: numbers of the cells of the picture that contain still matches.
    """

    stays: np.ndarray
    moves: np.ndarray
    agreeing: float
    cells: frozenset[int]

    @property
    def still(self) -> int:
        """Number of matches that stayed in place."""
        return int(self.stays.sum())

    @property
    def moving(self) -> int:
        """Number of matches that moved, with one geometry."""
        return int(self.moves.sum())

    @property
    def two(self) -> bool:
        """Whether there are both static matches and matches of another motion."""
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
        two, still, moved: number of pairs with two motions, with static matches alone, and with one motion.
        cells: fraction of the picture's cells that have still matches in at least two pairs with two motions.
        extent: fraction of the picture that the box around these cells covers.
    """

    two: int
    still: int
    moved: int
    cells: float
    extent: float

    @property
    def fraction(self) -> float:
        """Fraction of the informative pairs with two motions; 0 without such pairs."""
        return self.two / max(self.two + self.moved, 1)

    @property
    def two_motions(self) -> bool:
        """Whether most pairs show two motions, however small the static part is."""
        return self.two >= _LEAST_PAIRS and self.fraction >= LEAST_FRACTION

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
    """Return which matches (N, 2) of pictures of (width, height) stay in place, (N,) bool, and their similarity (2, 3).

    The whole background may be displaced, as from a camera that was turned a little or photos that were cropped. No
    match is reported if a motion that changes smoothly over the picture would leave as many in place. Of two candidates
    the one that is spread over more of the picture is the background.
    """
    within = still_px(size)
    left = np.ones(len(x), dtype=bool)
    stays, displaced = np.zeros(len(x), dtype=bool), np.eye(2, 3)
    for _ in range(_CANDIDATES):
        if left.sum() < _LEAST_MATCHES:
            break
        found = cv2.estimateAffinePartial2D(x[left], y[left], ransacReprojThreshold=within, confidence=0.999)[0]
        if found is None:
            break
        distances = np.linalg.norm(y - _moved(x, found), axis=1)
        near = distances < within
        around = int(((distances >= within) & (distances < _RING * within)).sum())
        peak = near.sum() >= max(_LEAST_MATCHES, _LEAST_PEAK * around)
        if peak and _is_small(found, size) and len(_cells(x[near], size)) > len(_cells(x[stays], size)):
            stays, displaced = near, found
        left &= ~near
    return stays, displaced


def _is_small(similarity: np.ndarray, size: tuple[int, int]) -> bool:
    centre = np.array(size) / 2
    scale, turned = np.hypot(*similarity[:, 0]), np.arctan2(similarity[1, 0], similarity[0, 0])
    shift = np.linalg.norm(_moved(centre, similarity) - centre) / np.hypot(*size)
    return abs(scale - 1) < _MOST_SCALED and abs(np.degrees(turned)) < _MOST_TURNED_DEG and shift < _MOST_SHIFTED


def _moved(x: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    return x @ similarity[:, :2].T + similarity[:, 2]


def _cells(x: np.ndarray, size: tuple[int, int]) -> frozenset[int]:
    """Return the numbers of the cells of the picture that contain positions (N, 2)."""
    columns, rows = _CELLS
    places = np.floor(x / np.array(size) * np.array(_CELLS)).clip(0, (columns - 1, rows - 1))
    return frozenset(int(row) * columns + int(column) for column, row in places)


def motions(x: np.ndarray, y: np.ndarray, size: tuple[int, int]) -> Motions:
    """Find the motions in matches (N, 2) of two pictures of the same size (width, height). Deterministic."""
    within = still_px(size)
    stays, displaced = in_place(x, y, size)
    moves = np.linalg.norm(y - _moved(x, displaced), axis=1) > _MOVED * within
    fundamental, agree = fundamental_matrix(x[moves], y[moves], within_px=within, least=_LEAST_MATCHES)
    moves[moves] = agree
    agreeing = float("nan")
    if stays.any() and agree.any():
        common = _common(x, y, one=stays, other=moves, within=within)
        explained = [epipolar_px(x, y, matrix) < 2 * within for matrix in (fundamental, common)]
        agreeing = max(float(min(right[stays].mean(), right[moves].mean())) for right in explained)
    return Motions(stays, moves, agreeing, _cells(x[stays], size))


def together(pairs: Sequence[Motions]) -> Stationary:
    """Summarize the motions of pairs of photos."""
    two = [pair for pair in pairs if pair.two]
    counts = Counter(cell for pair in two for cell in pair.cells)
    cells = [cell for cell, count in counts.items() if count >= 2]
    columns, rows = _CELLS
    extent = 0.0
    if cells:
        down, across = np.divmod(np.array(cells), columns)
        extent = float((np.ptp(down) + 1) * (np.ptp(across) + 1) / (columns * rows))
    return Stationary(
        two=len(two),
        still=sum(pair.only_still for pair in pairs),
        moved=sum(pair.one for pair in pairs),
        cells=len(cells) / (columns * rows),
        extent=extent,
    )


def _common(x: np.ndarray, y: np.ndarray, *, one: np.ndarray, other: np.ndarray, within: float) -> np.ndarray:
    """Estimate the fundamental matrix of two sets of matches together, with equally many of each.

    If the moving matches are on a plane, many matrices fit them, and one may also fit the still ones.
    """
    count = min(one.sum(), other.sum())
    both = np.flatnonzero(one), np.flatnonzero(other)
    chosen = np.concatenate([which[np.linspace(0, len(which) - 1, count).astype(int)] for which in both])
    return fundamental_matrix(x[chosen], y[chosen], within_px=within, least=_LEAST_MATCHES)[0]
