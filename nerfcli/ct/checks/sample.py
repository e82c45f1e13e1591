"""Input of the checks: line integrals of some rows of all views, noise and air."""

from dataclasses import dataclass

import numpy as np

from nerfcli.ct.quick import filled
from nerfcli.ct.scan import Scan

# Largest numbers of rows and views that are examined, as a sample of all.
MOST_ROWS, MOST_VIEWS = 32, 400
# Columns at each side that should see past the object, as a fraction of the width.
BORDER = 0.02
# Median of |x| of a normal distribution as a fraction of its standard deviation; variance of a second difference.
_MAD, _SECOND = 0.6745, 6.0


@dataclass(frozen=True)
class Sample:
    """Line integrals of some rows.

    Args:
        integrals: (V, rows, columns) float32, unusable pixels interpolated.
        noise: standard deviation of a line integral where there is little object.
        object_level: line integral that only 0.5 % of the pixels exceed.
    """

    scan: Scan
    rows: np.ndarray
    integrals: np.ndarray
    noise: float
    object_level: float

    @property
    def border(self) -> np.ndarray:
        """(V, rows, 2) means over the outermost columns, left and right."""
        width = max(1, round(BORDER * self.integrals.shape[2]))
        return np.stack([self.integrals[..., :width].mean(-1), self.integrals[..., -width:].mean(-1)], axis=-1)

    @property
    def air_level(self) -> float:
        """The line integral above which a pixel shows the object."""
        return max(0.05 * self.object_level, 4 * self.noise)


def sample_of(scan: Scan) -> Sample:
    """Prepare a scan for its checks."""
    rows = np.unique(np.linspace(0, scan.geometry.rows - 1, min(MOST_ROWS, scan.geometry.rows)).round().astype(int))
    count = scan.geometry.views
    views = np.unique(np.linspace(0, count - 1, min(MOST_VIEWS, count)).round().astype(int))
    integrals = np.stack([filled(scan, views, int(row))[:, 0] for row in rows], axis=1)
    second = np.abs(np.diff(integrals, 2, axis=2)) if integrals.shape[2] > 4 else np.zeros((1, 1, 1))
    inner = integrals[..., 1:-1] if integrals.shape[2] > 4 else integrals[..., :1]
    thin = inner <= np.quantile(inner, 0.25)
    noise = float(np.median(second[thin])) / _MAD / np.sqrt(_SECOND) if thin.any() else 0.0
    return Sample(scan, rows, integrals, noise, float(np.quantile(integrals, 0.995)))
