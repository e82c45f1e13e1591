"""Pixels from rays: one ray per pixel, or the equally weighted mixture of several.

The end distances of a pixel with several rays are the mixture of those of the rays: the conditional mean is the mean of
the rays' means weighted by their opacity, the variance includes the variance between the rays, a quantile is taken over
all their light, and max-weight considers the intervals of all of them. Distances along z use each ray's own direction.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.kernels import Backend, Intervals, LightEnds, RaysSeen


class Pixels(NamedTuple):
    """Values of P pixels.

    Args:
        rgb: (P, 3) sRGB on the background.
        ends: where their light ends; distances are multiplied by `factor`.
        truncation_error: (P,) bound on the truncation error of each channel of rgb.
        to_background: (P,) `factor` for the distance of the background, the mean over the light that passes.
        valid: (P,) whether all rays of the pixel exist; other pixels show the background with opacity 0.
    """

    rgb: Tensor
    ends: LightEnds
    truncation_error: Tensor
    to_background: Tensor
    valid: Tensor


def pixels_of_rays(
    seen: RaysSeen,
    *,
    valid: Tensor,
    background: Tensor,
    factor: Tensor,
    fractions: tuple[float, ...],
    count: int,
    backend: Backend,
) -> Pixels:
    """Combine `count` adjacent rays into each pixel.

    Args:
        seen: rendered values of R rays, with the quantiles `fractions`.
        valid: (R,) whether the rays exist.
        background: (R, 3) sRGB; a pixel that is not valid has the background of its first ray.
        factor: (R,) > 0, by which distances along the ray are multiplied to get the requested ones.
        count: rays per pixel, a divisor of R.
    """
    rgb, error, ends, to_background = seen.rgb, seen.truncation_error, _scaled(seen.ends, factor), factor
    if count > 1:
        ends = _mixture(seen, ends, factor=factor, fractions=fractions, count=count, backend=backend)
        rgb, error, valid = rgb.view(-1, count, 3).mean(1), error.view(-1, count).mean(1), valid.view(-1, count).all(1)
        # The rays are weighted by the light that passes along them.
        passing = seen.ends.transmittance.view(-1, count) + torch.finfo(factor.dtype).tiny
        to_background = (passing * factor.view(-1, count)).sum(1) / passing.sum(1)
    return Pixels(
        rgb=torch.where(valid[:, None], rgb, background[::count]),
        ends=ends._replace(opacity=torch.where(valid, ends.opacity, 0.0)),
        truncation_error=torch.where(valid, error, 0.0),
        to_background=to_background,
        valid=valid,
    )


def _scaled(ends: LightEnds, factor: Tensor) -> LightEnds:
    return ends._replace(
        mean=ends.mean * factor,
        spread=ends.spread * factor,
        heaviest=ends.heaviest * factor,
        quantiles=ends.quantiles * factor[:, None],
    )


def _mixture(
    seen: RaysSeen, ends: LightEnds, *, factor: Tensor, fractions: tuple[float, ...], count: int, backend: Backend
) -> LightEnds:
    """Return where the light of pixels of `count` rays ends; `ends` are those of the rays, scaled by `factor`."""
    opacity = ends.opacity.view(-1, count)
    total = opacity.sum(1)
    defined = total > 0
    weights = opacity / torch.where(defined, total, 1.0)[:, None]
    # A ray with opacity 0 has no mean, and no weight.
    means = torch.where(opacity > 0, ends.mean.view(-1, count), 0.0)
    spreads = torch.where(opacity > 0, ends.spread.view(-1, count), 0.0)
    mean = (weights * means).sum(1)
    spread = (weights * (spreads.square() + (means - mean[:, None]).square())).sum(1).sqrt()
    largest, ray = ends.largest.view(-1, count).max(1)
    density, starts, stops, offsets = seen.intervals
    own = factor[kernels.ray_indices(offsets)]
    along = Intervals(density / own, starts * own, stops * own, offsets)
    quantiles = [backend.mixture_quantile(along, rays_per_pixel=count, fraction=fraction) for fraction in fractions]
    return LightEnds(
        opacity=opacity.mean(1),
        transmittance=ends.transmittance.view(-1, count).mean(1),
        mean=torch.where(defined, mean, torch.nan),
        spread=torch.where(defined, spread, torch.nan),
        heaviest=ends.heaviest.view(-1, count).gather(1, ray[:, None])[:, 0],
        largest=largest,
        quantiles=torch.stack(quantiles, dim=-1) if quantiles else mean.new_empty(len(mean), 0),
    )
