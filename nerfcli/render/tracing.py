"""Trace rays: colour, distribution of depth, and the error of early stopping.

Two things are left out for speed. A ray ends where little light is left (the stop), and samples whose weights are
negligible have their colour taken as grey, without evaluating it. Together they change a colour by at most the
tolerance, and `RaysSeen.truncation_error` bounds by how much they changed each one. The bound is one on the rendering
of the field with its steps, not on the field.
"""

import math
from functools import lru_cache

import torch
from torch import Tensor

from nerfcli.field.blocks_field import BlocksField
from nerfcli.kernels import March, Rays, RaysSeen
from nerfcli.kernels.interface import UNSEEN
from nerfcli.render.model import Marching, Model
from nerfcli.render.spans import trace_in_spans

# The default: a quarter of a grey level.
TOLERANCE = 1 / 1020
# The share of the tolerance that the stop may take. Surfaces end rays at once, so that a deep stop costs little.
STOP_SHARE = 0.1


def deepest(tolerance: float) -> float:
    """Return the optical depth at which rays stop."""
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
    keep_intervals: bool = True,
) -> RaysSeen:
    """March rays through the model. The answer of a ray does not depend on the others.

    Args:
        model: the trained model.
        origins, directions: (R, 3) in the training frame, unit directions.
        background: (3,) or (R, 3) sRGB.
        shares: quantiles to compute.
        tolerance: bound on what is left out of a colour, > 0.
        cones: (R,) width per distance of what each ray stands for, see `kernels.Rays`; None for lines.
        keep_intervals: whether the samples are wanted.
    """
    cuts = uniform_cuts(model.marching).to(directions)
    return render_cut_rays(
        model,
        origins,
        directions,
        cuts=cuts,
        background=background,
        shares=shares,
        tolerance=tolerance,
        cones=cones,
        keep_intervals=keep_intervals,
    )


@lru_cache(maxsize=4)
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
    keep_intervals: bool = True,
) -> RaysSeen:
    """`render_rays` with all rays cut at the same distances `cuts` (S + 1,)."""
    field = model.field
    edges = torch.cat([cuts, cuts[-1:]])  # the last is never used: there is no jitter
    rays = Rays(origins, directions, torch.zeros_like(directions[:, 0]), cones)
    march = March(edges, model.occupied, model.contraction, deepest(tolerance))
    # All negligible samples of a ray together weigh no more than their share of the tolerance allows.
    negligible = (1.0 - STOP_SHARE) * tolerance / UNSEEN
    if isinstance(field, BlocksField):
        return trace_in_spans(field, rays, march, background=background, shares=shares, negligible=negligible)
    return field.backend.trace_rays(
        rays,
        march,
        field.medium(),
        background=background,
        shares=shares,
        negligible=negligible,
        keep_intervals=keep_intervals,
    )
