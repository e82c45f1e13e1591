"""Errors of a field's depth by the number of photos that see the surface; intervals and confidence of depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

# Fraction of the errors in the interval of depth; largest relative error of a depth that confidence counts as right.
LEVEL, TOLERANCE = 0.9, 0.02
# Least coverage of each stratum. Where no photo sees the surface, no error can be measured.
STRATA = (1, 2, 4)
# Quantiles of the errors in a stratum that are kept: every half per cent.
_FRACTIONS = np.linspace(0.0, 1.0, 201)
# Measured pixels and photos that a stratum needs; several photos, because errors within one are correlated.
LEAST_PIXELS, LEAST_PHOTOS = 200, 2


@dataclass(frozen=True)
class DepthErrors:
    """Errors of the median depth, (measured - median) / median, in each of `STRATA`.

    Args:
        quantiles: (strata, 201) from the least to the largest; NaN where too little was measured.
        pixels: number of pixels measured in each stratum.
        photos: number of photos in which errors were measured.
        matched: fraction of the pixels of these photos that could be matched, and so measured.
    """

    quantiles: np.ndarray
    pixels: tuple[int, ...]
    photos: int
    matched: float

    @classmethod
    def of(cls, errors: np.ndarray, coverage: np.ndarray, photos: np.ndarray, *, matched: float) -> Self:
        """Summarise errors (N,) of pixels, given their coverage (N,) and the indices of their photos (N,)."""
        rows, counts = [], []
        for number in range(len(STRATA)):
            inside = _stratum(coverage) == number
            counts.append(int(inside.sum()))
            enough = counts[-1] >= LEAST_PIXELS and len(np.unique(photos[inside])) >= LEAST_PHOTOS
            rows.append(np.quantile(errors[inside], _FRACTIONS) if enough else np.full(len(_FRACTIONS), np.nan))
        return cls(np.stack(rows), tuple(counts), len(np.unique(photos)), matched)

    def bounds(self, median: np.ndarray, coverage: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the central interval of depth, (lower, upper) like `median`, with a fraction `LEVEL` of the errors.

        lower = median (1 + q), where q is the quantile of the errors in the pixel's stratum at (1 - LEVEL) / 2; upper
        uses the quantile at (1 + LEVEL) / 2. NaN where no photo sees the surface, or the stratum has too few errors.

        Source: split conformal prediction by groups: Angelopoulos and Bates 2021, arXiv:2107.07511, section 4.1.
        """
        number = _stratum(coverage)
        sides = []
        for fraction in ((1 - LEVEL) / 2, (1 + LEVEL) / 2):
            of_strata = np.array([np.interp(fraction, _FRACTIONS, row) for row in self.quantiles])
            factor = np.where(number >= 0, 1.0 + of_strata[number], np.nan)
            sides.append((median * factor).astype(np.float32))
        return sides[0], sides[1]

    def confidence(self, coverage: np.ndarray) -> np.ndarray:
        """Return the fraction of errors of at most `TOLERANCE` in each pixel's stratum, from 0 to 1, like `coverage`.

        F(TOLERANCE) - F(-TOLERANCE), with the distribution function F interpolated between the kept quantiles. NaN as
        in `bounds`.
        """
        number = _stratum(coverage)
        of_strata = np.array(
            [np.diff(np.interp((-TOLERANCE, TOLERANCE), row, _FRACTIONS))[0] for row in self.quantiles]
        )
        return np.where(number >= 0, of_strata[number], np.nan).astype(np.float32)

    def to_json(self) -> dict[str, Any]:
        """Return plain values; null for a stratum without quantiles."""
        rows = [None if np.isnan(row).any() else row.tolist() for row in self.quantiles]
        counts = {"pixels": list(self.pixels), "photos": self.photos, "matched": self.matched}
        return {"strata": list(STRATA), "quantiles": rows, **counts}

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Self:
        """Return the errors that `to_json` described."""
        rows: Sequence[Any] = content["quantiles"]
        empty = np.full(len(_FRACTIONS), np.nan)
        quantiles = np.stack([empty if row is None else np.array(row) for row in rows])
        return cls(quantiles, tuple(content["pixels"]), content["photos"], content["matched"])


def _stratum(coverage: np.ndarray) -> np.ndarray:
    """Return the index of the stratum; -1 where coverage is 0 or NaN."""
    return np.searchsorted(STRATA, np.nan_to_num(coverage), side="right") - 1
