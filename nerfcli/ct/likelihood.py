"""Likelihoods of measurements given line integrals: Poisson for counts, least squares for line integrals.

The likelihood of counts takes no logarithm of the data: it is biased for few photons and undefined for none. Both
likelihoods are negative logarithms, view by view; tensors are (views, pixels), with pixels row by row:

    slope        derivative by each line integral; 0 for unusable pixels
    curvature    second derivative, >= 0, at the line integrals that the data themselves suggest
    deviance     squared misfit over the noise variance, 1 on average for a correct model; NaN if unusable
    suggested    line integrals estimated directly from the data, to start a fit; NaN for unusable pixels
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import root_scalar
from torch import Tensor

from nerfcli.ct.scan import Scan

# Median of |x - median| of a normal distribution, as a fraction of its standard deviation.
MEDIAN_DEVIATION = 0.6745


@dataclass(frozen=True)
class Poisson:
    """Photon counts: N ~ Poisson(O exp(-p) + B), for a model whose line integrals p have small errors of their own.

    Voxels cannot represent sharp edges, and no scanner matches its description exactly. An error of a line integral of
    about `model_error` k changes the expected signal S by k S, so that counts of expectation E have the variance
    E + k^2 S^2: bright rays get no more weight than the model's accuracy justifies. Slopes, curvatures and deviances
    are those of the Poisson likelihood over 1 + k^2 S^2 / E (a quasi-likelihood).

    Args:
        counts, open_beam, background: (views, pixels) photons N, O and B; O is 0 for pixels that are not usable.
        model_error: k >= 0, a standard deviation of line integrals.

    Source: Wedderburn 1974, Quasi-likelihood functions, Biometrika 61(3).
    """

    counts: Tensor
    open_beam: Tensor
    background: Tensor
    model_error: float = 0.0

    def slope(self, integrals: Tensor, views: Tensor) -> Tensor:
        """-O exp(-p) (1 - N / (O exp(-p) + B)). Source: Erdogan and Fessler 1999, equation 5, with its sign changed."""
        signal = self.open_beam[views] * torch.exp(-integrals)
        expected = signal + self.background[views]
        inflation = 1 + self.model_error**2 * signal * signal / expected
        return torch.where(signal > 0, signal * (self.counts[views] / expected - 1) / inflation, 0)

    def curvature(self, views: Tensor) -> Tensor:
        """Return (N - B)^2 / N with N - B >= 1. Source: as for `slope`, equation 17, precomputed curvatures."""
        signal = (self.counts[views] - self.background[views]).clamp_min(1)
        curvature = torch.minimum(signal.square() / self.counts[views].clamp_min(1), signal)
        return torch.where(self.open_beam[views] > 0, curvature / (1 + self.model_error**2 * curvature), 0)

    def deviance(self, integrals: Tensor, views: Tensor) -> Tensor:
        """Return Pearson's (N - E)^2 over the variance E + k^2 S^2, which has mean 1 for any count."""
        signal = self.open_beam[views] * torch.exp(-integrals)
        expected = signal + self.background[views]
        variance = expected + self.model_error**2 * signal * signal
        return torch.where(signal > 0, (self.counts[views] - expected).square() / variance, torch.nan)

    def suggested(self, views: Tensor) -> Tensor:
        signal = (self.counts[views] - self.background[views]).clamp_min(0.5)
        return torch.where(self.open_beam[views] > 0, torch.log(self.open_beam[views] / signal), torch.nan)

    def found_model_error(self, integrals: Tensor, views: Tensor) -> float:
        """Estimate the model error, at most 1, that makes the mean deviance 1; 0 if no error is needed."""
        low, high = 0.0, 1.0

        def excess(error: float) -> float:
            return float(torch.nanmean(replace(self, model_error=error).deviance(integrals, views))) - 1

        if excess(low) <= 0:
            return 0.0
        return high if excess(high) > 0 else float(root_scalar(excess, bracket=(low, high), xtol=1e-5).root)


@dataclass(frozen=True)
class Gaussian:
    """Line integrals with normal noise: y ~ Normal(p, 1 / weight).

    Args:
        measured: (views, pixels) y.
        weight: (views, pixels) 1 / variance; 0 for pixels that are not usable.
    """

    measured: Tensor
    weight: Tensor

    def slope(self, integrals: Tensor, views: Tensor) -> Tensor:
        return self.weight[views] * (integrals - self.measured[views])

    def curvature(self, views: Tensor) -> Tensor:
        return self.weight[views]

    def deviance(self, integrals: Tensor, views: Tensor) -> Tensor:
        weight = self.weight[views]
        return torch.where(weight > 0, weight * (integrals - self.measured[views]).square(), torch.nan)

    def suggested(self, views: Tensor) -> Tensor:
        return torch.where(self.weight[views] > 0, self.measured[views], torch.nan)


Likelihood = Poisson | Gaussian


def likelihood_of(
    scan: Scan,
    views: np.ndarray,
    *,
    binning: int = 1,
    air: Sequence[float] | np.ndarray | None = None,
    model_error: float = 0.0,
) -> Likelihood:
    """Build the likelihood of some views of a scan.

    Transmissions are treated as counts with an open beam of 1, scaled to photons. If the number of photons per value
    is unknown, it is estimated from the noise between neighbouring pixels, see `photons_per_value`.

    Args:
        binning: number of rows and columns to combine, as in `ScanGeometry.binned`: photons are added, line
            integrals averaged.
        air: (views,) factors on the open beam of counts; 1 if not given.
        model_error: of counts, see `Poisson`.

    Returns:
        A likelihood with float32 tensors.
    """
    values, good = _values(scan, views)
    if scan.kind == "line_integral":
        weight = good.astype(np.float32) / np.float32(assumed_noise(scan, views) ** 2)
        total = _binned(weight, binning)
        mean = _binned(np.where(good, values, 0) * weight, binning) / np.maximum(total, np.float32(1e-30))
        return Gaussian(_flat(mean), _flat(total))
    dark, open_beam = scan.of_views("dark", views), scan.of_views("open_beam", views)
    background = np.zeros_like(values) if dark is None else np.broadcast_to(dark, values.shape)
    beam = np.ones_like(values) if open_beam is None else np.broadcast_to(open_beam, values.shape)
    photons = assumed_noise(scan, views)
    good = good & (beam > 0)
    # Negative detector values are noise of the electronics; a Poisson likelihood has no negative counts.
    parts = (np.maximum(values, 0), beam, np.maximum(background, 0))
    counts, beam, background = (
        _flat(_binned(np.where(good, part, 0) * np.float32(photons), binning)) for part in parts
    )
    if air is not None:
        beam = beam * torch.as_tensor(air, dtype=torch.float32)[:, None]
    return Poisson(counts, beam, background, model_error)


def assumed_noise(scan: Scan, views: np.ndarray) -> float:
    """Return the photons per value, or the standard deviation of line integrals; where unknown, those of some views."""
    known = scan.deviation if scan.kind == "line_integral" else scan.photons_per_value
    if known is not None:
        return known
    values, good = _values(scan, views)
    if scan.kind == "line_integral":
        return noise(np.where(good, values, np.nan))
    dark = scan.of_views("dark", views)
    return photons_per_value(np.where(good, values if dark is None else values - dark, np.nan))


def with_noise(scan: Scan, *, lower: float = 1.0) -> Scan:
    """Return a scan whose noise is known: if it was not, as its training views suggest; lower by a factor."""
    level = assumed_noise(scan, scan.training_views)
    if scan.kind == "line_integral":
        return replace(scan, deviation=level / lower)
    return replace(scan, photons_per_value=level * lower**2)


def photons_per_value(values: np.ndarray) -> float:
    """Estimate the photons per detector value from the noise: mean / variance.

    Args:
        values: (views, rows, columns) detector values minus the dark ones; NaN where not usable.
    """
    spread = noise(values)
    mean = float(np.nanmean(values))
    return mean / spread**2 if spread > 0 and mean > 0 else 1.0


def noise(values: np.ndarray) -> float:
    """Estimate the standard deviation of the noise from fourth differences along rows, which vanish in smooth pictures.

    Args:
        values: (views, rows, columns); NaN where not usable.

    Returns:
        > 0; 1 where there are too few pixels to tell, or no noise at all.
    """
    if values.shape[-1] < 5:
        return 1.0
    fourth = np.diff(values.astype(np.float64), n=4, axis=-1)
    found = np.abs(fourth[np.isfinite(fourth)])
    deviation = float(np.median(found)) if len(found) else 0.0
    # The squares of 1, -4, 6, -4, 1 sum up to 70.
    return deviation / MEDIAN_DEVIATION / np.sqrt(70) or 1.0


def _values(scan: Scan, views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of views, and the mask of those that are usable."""
    values = np.asarray(scan.values[views], dtype=np.float32)
    usable = scan.of_views("usable", views)
    return values, np.isfinite(values) if usable is None else np.isfinite(values) & usable


def _binned(values: np.ndarray, factor: int) -> np.ndarray:
    """Sum over factor x factor pixels; leftover rows and columns at the end are dropped."""
    views, rows, columns = values.shape
    row_factor = factor if rows >= factor else 1
    rows, columns = rows // row_factor, max(columns // factor, 1)
    cut = values[:, : rows * row_factor, : columns * factor]
    return cut.reshape(views, rows, row_factor, columns, -1).sum((2, 4))


def _flat(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values.reshape(len(values), -1), dtype=np.float32))
