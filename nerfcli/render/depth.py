"""The meanings of "the depth of a ray". They differ wherever a ray meets more than one surface or none.

With end density p(t) = T(t) sigma(t), whose integral is the opacity:

    conditional   integral of t p(t) / opacity: the mean place where light ends, given that it ends
    moment        integral of t p(t): small where the ray is not opaque; a building block, not a distance
    background    moment + T * background distance: the mean with what passes counted at the background
    max-weight    the mean place inside the interval that stops most light; depends on where the ray is cut
    median        where half of all light has ended: T(t) = 1/2
    quantile:q    where the share q of all light has ended: T(t) = 1 - q

All are exact for density that is constant inside an interval; `reference.depth` defines them. Which rays have one:
moment and background every ray; conditional and max-weight those with at least `min_opacity`, which must not be zero
opacity; a quantile q those with at least max(q, min_opacity), as it counts all light and not only that which ends.
What is undefined is NaN, never a plausible number.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfcli.kernels import LightEnds

CONVENTIONS = ("conditional", "moment", "background", "max-weight", "median")
AXES = ("ray", "z")
QUANTILE = "quantile:"
# `LightEnds.quantiles` of a picture: the median for the disagreement, then the requested one.
MEDIAN = 0.5


@dataclass(frozen=True)
class DepthRequest:
    """Definition of the depth to render.

    Args:
        convention: one of `CONVENTIONS`, or "quantile:0.05" with a share between 0 and 1.
        axis: "ray" for the distance along the ray, "z" for that along the optical axis.
        min_opacity: rays that are less opaque have no depth, spread or disagreement; see `effective_floor`.
        background_distance: distance along the ray that the background convention counts for what passes, in the
            scene's unit; needed by that convention only.
        min_views, min_parallax_deg: coverage and parallax of the median point below which an export removes the depth;
            see `visibility`.
        level: of the interval between the outputs lower and upper, see `depth_errors`.
        depth_tolerance: relative error up to which the output confidence counts a depth as right.

    Raises:
        ValueError: no such convention or axis.
    """

    convention: str
    axis: str
    min_opacity: float = 0.5
    background_distance: float | None = None
    min_views: int = 0
    min_parallax_deg: float = 0.0
    level: float = 0.9
    depth_tolerance: float = 0.02

    def __post_init__(self) -> None:
        if not is_convention(self.convention):
            raise ValueError(f"unknown depth convention {self.convention!r}")
        if self.axis not in AXES:
            raise ValueError(f"unknown depth axis {self.axis!r}")

    @property
    def share(self) -> float | None:
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
    """Return the opacity below which a pixel has no depth: 0 for the conventions that every ray has."""
    if request.convention in ("moment", "background"):
        return 0.0
    return max(request.min_opacity, request.share or 0.0)


def shares(request: DepthRequest) -> tuple[float, ...]:
    """Return the quantiles that a picture needs: the median, and the requested one."""
    return (MEDIAN,) if request.share in (None, MEDIAN) else (MEDIAN, request.share)


def requested(request: DepthRequest, ends: LightEnds, *, background_distance: Tensor) -> Tensor:
    """Select the requested depth (R,).

    Args:
        request: which depth.
        ends: where light ends, with the quantiles of `shares(request)`, along the axis and in the unit wanted.
        background_distance: (R,) the request's, along that axis and in that unit.
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
            depth = ends.heaviest
        case _:
            depth = ends.quantiles[:, -1]
    # Quantiles are NaN by themselves where the opacity does not reach them.
    return torch.where(ends.opacity >= request.min_opacity, depth, torch.nan)


def spread(request: DepthRequest, ends: LightEnds) -> Tensor:
    """Standard deviation (R,) of where light ends, given that it ends; NaN below the request's `min_opacity`."""
    return torch.where(ends.opacity >= request.min_opacity, ends.spread, torch.nan)


def disagreement(request: DepthRequest, ends: LightEnds) -> Tensor:
    """|median - conditional| (R,); NaN where either is undefined: below 1/2 or below the request's `min_opacity`."""
    return (median(request, ends) - ends.mean).abs()


def median(request: DepthRequest, ends: LightEnds) -> Tensor:
    """Distance (R,) at which half of all light has ended; NaN below 1/2 or below the request's `min_opacity`."""
    return torch.where(ends.opacity >= request.min_opacity, ends.quantiles[:, 0], torch.nan)
