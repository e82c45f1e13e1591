"""Definitions of the depth of a ray. They differ wherever a ray meets more than one surface or none.

With end density p(t) = T(t) sigma(t), whose integral is the opacity:

    conditional   integral of t p(t) / opacity: the mean distance at which light ends, given that it ends
    moment        integral of t p(t): small where the ray is not opaque; a building block, not a distance
    background    moment + T * background distance: the mean if light that passes ends at the background
    max-weight    the mean distance inside the interval that stops most light; depends on where the ray is cut
    median        where half of all light has ended: T(t) = 1/2
    quantile:q    where the fraction q of all light has ended: T(t) = 1 - q

All are exact for density that is constant inside an interval; `reference.depth` defines them. Moment and background are
defined for every ray; conditional and max-weight for rays whose opacity is at least `min_opacity` and not zero; a
quantile q for rays whose opacity is at least max(q, min_opacity), because it counts all light and not only the light
that ends. Undefined values are NaN, never a plausible number.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfcli.kernels import RayTermination

CONVENTIONS = ("conditional", "moment", "background", "max-weight", "median")
AXES = ("ray", "z")
QUANTILE = "quantile:"
# `RayTermination.quantiles` of a picture: the median for the disagreement, then the requested one.
MEDIAN = 0.5


@dataclass(frozen=True)
class DepthRequest:
    """Definition of the depth to render.

    Args:
        convention: one of `CONVENTIONS`, or for example "quantile:0.05", with a fraction between 0 and 1.
        axis: "ray" for the distance along the ray, "z" for the distance along the optical axis.
        min_opacity: rays that are less opaque have no depth, spread or disagreement; see `effective_floor`.
        background_distance: distance along the ray at which the background convention counts the light that passes, in
            the scene's unit; only needed by that convention.
        min_views, min_parallax_deg: coverage and parallax of the median point below which an export removes the depth;
            see `render.coverage`.

    Raises:
        ValueError: unknown convention or axis.
    """

    convention: str
    axis: str
    min_opacity: float = 0.5
    background_distance: float | None = None
    min_views: int = 0
    min_parallax_deg: float = 0.0

    def __post_init__(self) -> None:
        if not is_convention(self.convention):
            raise ValueError(f"unknown depth convention {self.convention!r}")
        if self.axis not in AXES:
            raise ValueError(f"unknown depth axis {self.axis!r}")

    @property
    def fraction(self) -> float | None:
        """Fraction of light of a quantile or the median; None for other definitions."""
        if self.convention == "median":
            return MEDIAN
        return float(self.convention.removeprefix(QUANTILE)) if self.convention.startswith(QUANTILE) else None


def is_convention(name: str) -> bool:
    """Return whether a definition of depth has this name."""
    if not name.startswith(QUANTILE):
        return name in CONVENTIONS
    try:
        return 0.0 < float(name.removeprefix(QUANTILE)) < 1.0
    except ValueError:
        return False


def effective_floor(request: DepthRequest) -> float:
    """Return the opacity below which a pixel has no depth: 0 for conventions that are defined for every ray."""
    if request.convention in ("moment", "background"):
        return 0.0
    return max(request.min_opacity, request.fraction or 0.0)


def fractions(request: DepthRequest) -> tuple[float, ...]:
    """Return the quantiles that a picture needs: the median, and the requested one."""
    return (MEDIAN,) if request.fraction is None or request.fraction == MEDIAN else (MEDIAN, request.fraction)


def requested(request: DepthRequest, ends: RayTermination, *, background_distance: Tensor) -> Tensor:
    """Select the requested depth (R,).

    Args:
        ends: where light ends, with the quantiles of `fractions(request)`, along the requested axis and in its unit.
    """
    moment = torch.where(ends.mean.isnan(), 0.0, ends.mean * ends.opacity)
    match request.convention:
        case "moment":
            return moment
        case "background":
            return moment + ends.transmittance * background_distance
        case "conditional":
            depth = ends.mean
        case "max-weight":
            depth = ends.peak
        case _:
            depth = ends.quantiles[:, -1]
    # Quantiles are NaN by themselves where the opacity does not reach them.
    return torch.where(ends.opacity >= request.min_opacity, depth, torch.nan)


def spread(request: DepthRequest, ends: RayTermination) -> Tensor:
    """Return the standard deviation (R,) of where light ends, given that it ends; NaN below `min_opacity`."""
    return torch.where(ends.opacity >= request.min_opacity, ends.spread, torch.nan)


def disagreement(request: DepthRequest, ends: RayTermination) -> Tensor:
    """Return |median - conditional| (R,); NaN where the opacity is below 1/2 or below the request's `min_opacity`."""
    return (median(request, ends) - ends.mean).abs()


def median(request: DepthRequest, ends: RayTermination) -> Tensor:
    """Return the distance (R,) at which half of all light has ended; NaN below an opacity of 1/2 or `min_opacity`."""
    return torch.where(ends.opacity >= request.min_opacity, ends.quantiles[:, 0], torch.nan)
