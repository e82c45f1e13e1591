"""Trace rays: colour, distribution of depth, and the error of early stopping.

Two approximations save time. A ray ends where little light is left (the early stop), and the colours of samples with
negligible weights are taken as grey instead of evaluated. Together they change a colour by at most the tolerance;
`RaysSeen.truncation_error` bounds the change of each colour. The bound concerns the rendering of the field with its
steps, not the field.
"""

import math
from functools import lru_cache

import torch
from torch import Tensor

from nerfcli.kernels import March, Rays, RaysSeen
from nerfcli.kernels.interface import UNSEEN
from nerfcli.render.trained_field import Marching, TrainedField

# The default: a quarter of a grey level.
TOLERANCE = 1 / 1020
# Fraction of the tolerance for the early stop. Surfaces end rays at once, so a deep stop costs little.
STOP_FRACTION = 0.1


def deepest(tolerance: float) -> float:
    """Return the optical depth at which rays stop."""
    return -math.log(STOP_FRACTION * tolerance)


def render_rays(
    model: TrainedField,
    origins: Tensor,
    directions: Tensor,
    *,
    background: Tensor,
    cuts: Tensor | None = None,
    fractions: tuple[float, ...] = (),
    tolerance: float = TOLERANCE,
    cones: Tensor | None = None,
    keep_intervals: bool = True,
) -> RaysSeen:
    """March rays through the model. The result of a ray does not depend on the other rays.

    Args:
        origins, directions: (R, 3) in the training frame, unit directions.
        background: (3,) or (R, 3) sRGB.
        cuts: (S + 1,) distances at which all rays are cut; by default those of pictures, see `uniform_cuts`.
        fractions: of light for the quantiles to compute.
        tolerance: bound on the truncation error of a colour, > 0.
        cones: (R,) footprint of each ray per distance, see `kernels.Rays`; None for lines.
        keep_intervals: whether to return the samples.
    """
    field, cuts = model.field, uniform_cuts(model.marching).to(directions) if cuts is None else cuts
    edges = torch.cat([cuts, cuts[-1:]])  # the last edge is not used, because there is no jitter
    rays = Rays(origins, directions, torch.zeros_like(directions[:, 0]), cones)
    march = March(edges, model.occupied, model.contraction, deepest(tolerance))
    # All negligible samples of a ray together use at most the rest of the tolerance.
    negligible = (1.0 - STOP_FRACTION) * tolerance / UNSEEN
    return field.backend.trace_rays(
        rays,
        march,
        field.medium(),
        background=background,
        fractions=fractions,
        negligible=negligible,
        keep_intervals=keep_intervals,
    )


@lru_cache(maxsize=4)
def uniform_cuts(marching: Marching) -> Tensor:
    """Return the distances (S + 1,) float64 at which pictures cut all rays: the midpoints of the training's steps."""
    edges = marching.edges()
    return edges[:-1] + 0.5 * edges.diff()
