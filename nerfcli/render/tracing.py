"""What rays see: their colour, where their light ends, and how much of it was not looked at.

Two things are left out for speed. A ray ends where little light is left (the stop), and samples whose weights are
negligible are not asked for their colour, which is taken as grey. Together they change a colour by at most the
tolerance, and `RaysSeen.truncation_error` bounds by how much they changed each one. The bound is one on the rendering
of the field with its steps, not on the field.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.kernels.depth import LightEnds
from nerfcli.render.model import Marching, Model

# The default: a quarter of a grey level.
TOLERANCE = 1 / 1020
# The share of the tolerance that the stop may take. Surfaces end rays at once, so that a deep stop costs little.
STOP_SHARE = 0.1
# The colour of samples that are not asked for theirs; what they may miss is half of their weight.
UNSEEN = 0.5


class Intervals(NamedTuple):
    """The samples of R rays, packed as in `kernels.reference`: distances along the ray in the training frame."""

    density: Tensor
    starts: Tensor
    ends: Tensor
    offsets: Tensor


class RaysSeen(NamedTuple):
    """What R rays saw.

    Args:
        rgb: (R, 3) sRGB on the background.
        ends: where their light ends, distances along the ray in the training frame.
        truncation_error: (R,) bound on what was left out of each channel of rgb.
        intervals: the samples.
    """

    rgb: Tensor
    ends: LightEnds
    truncation_error: Tensor
    intervals: Intervals


def deepest(tolerance: float) -> float:
    """The optical depth at which rays stop."""
    return -math.log(STOP_SHARE * tolerance)


def render_rays(
    model: Model,
    origins: Tensor,
    directions: Tensor,
    *,
    background: Tensor,
    shares: tuple[float, ...] = (),
    tolerance: float = TOLERANCE,
    cones: Tensor | None = None,
) -> RaysSeen:
    """March rays through the model. The answer of a ray does not depend on the others.

    Args:
        model: the trained model.
        origins, directions: (R, 3) in the training frame, unit directions.
        background: (3,) or (R, 3) sRGB.
        shares: quantiles to compute.
        tolerance: bound on what is left out of a colour, > 0.
        cones: (R,) width per distance of what each ray stands for, see `Rays`; None for lines.
    """
    cuts = uniform_cuts(model.marching).to(directions)
    return render_cut_rays(
        model, origins, directions, cuts=cuts, background=background, shares=shares, tolerance=tolerance, cones=cones
    )


def uniform_cuts(marching: Marching) -> Tensor:
    """(S + 1,) float64 distances at which pictures cut all rays: in the middle between those of a training."""
    edges = marching.edges()
    return edges[:-1] + 0.5 * edges.diff()


def render_cut_rays(
    model: Model,
    origins: Tensor,
    directions: Tensor,
    *,
    cuts: Tensor,
    background: Tensor,
    shares: tuple[float, ...],
    tolerance: float,
    cones: Tensor | None = None,
) -> RaysSeen:
    """`render_rays` with all rays cut at the same distances `cuts` (S + 1,)."""
    stop = deepest(tolerance)
    starts, ends, density, code, _, offsets, _ = model.field.visible_samples(
        origins,
        directions,
        torch.cat([cuts, cuts[-1:]]),  # the last is never used: there is no jitter
        jitter=torch.zeros_like(directions[:, 0]),
        occupied=model.occupied,
        deepest=stop,
        cones=cones,
    )
    lengths = ends - starts
    weights, _ = kernels.interval_weights(density, lengths, offsets)
    # All negligible samples of a ray together weigh no more than their share of the tolerance allows.
    negligible = (1.0 - STOP_SHARE) * tolerance / UNSEEN / offsets.diff().clamp_min(1).to(weights)
    rays = kernels.ray_indices(offsets)
    unseen = weights <= negligible[rays]
    seen = (~unseen).nonzero()[:, 0]
    rgb = torch.full((len(density), 3), UNSEEN, dtype=density.dtype, device=density.device)
    rgb[seen] = model.field.colour_of_code(code[seen], directions, rays[seen])
    colour, transmittance, _ = kernels.composite(
        density, rgb, lengths, offsets=offsets, background=background.expand(len(origins), 3)
    )
    light = kernels.light_ends(density, starts, ends, offsets=offsets, shares=shares)
    stopped = transmittance <= math.exp(-stop) * (1 + 1e-5)  # rounding must not hide a stop
    behind = torch.maximum(background, 1.0 - background).amax(-1)  # how far any colour is from the background's
    left_out = UNSEEN * kernels.sum_along_rays(torch.where(unseen, weights, 0.0), offsets)
    error = left_out + torch.where(stopped, transmittance * behind, 0.0)
    return RaysSeen(colour, light, error, Intervals(density, starts, ends, offsets))
