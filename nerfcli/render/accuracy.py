"""Accuracy of a rendering relative to its field: bounds stored with every picture, and a measurement.

Two errors are kept apart. Truncation for speed (the early stop, colours of negligible samples) is bounded for every
pixel. The error of constant density and colour inside each interval is measured: some rays are rendered again with
every interval cut into 2 and into 4 parts, and the field evaluated in each part. Both errors concern the rendering of
the field. Only held-out photos and depths can show how far the field is from the scene.
"""

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.frame import Frame
from nerfcli.field.background import colours_behind
from nerfcli.kernels import RaysSeen
from nerfcli.render.depth import DepthRequest, fractions, requested
from nerfcli.render.pictures import RenderedPicture
from nerfcli.render.tracing import TOLERANCE, pixel_rays, render_rays, uniform_cuts
from nerfcli.render.trained_field import TrainedField

IN_WORDS = (
    "these numbers concern the rendering, not how close the field is to the scene: truncation_of_colour bounds what "
    "the early stop and negligible samples left out of a channel, truncation_of_depth and quadrature measure on "
    "random pixels what deeper stops and finer samples change"
)
# Tolerance of the renderings that are compared with each other: their truncation must be negligible.
TIGHT = 1e-6


def truncation_bounds(picture: RenderedPicture, tolerance: float) -> dict[str, float]:
    """Return the error bounds stored in a picture: the tolerance, the maximum and the mean bound of its pixels."""
    error = picture.truncation_error
    return {
        "tolerance": tolerance,
        "truncation_of_colour_max": float(error.max(initial=0.0)),
        "truncation_of_colour_mean": float(error.mean(dtype=np.float64)) if error.size else 0.0,
    }


@torch.no_grad()
def measure_error(model: TrainedField, frame: Frame, *, depth: DepthRequest | None) -> dict[str, float]:
    """Render the centres of 256 random pixels, always the same ones, with finer and finer intervals.

    Returns:
        The number of pixels, and median and 95th percentile (NAME_median, NAME_p95) of the absolute differences

        quadrature_of_colour: of the channel that differs most, sRGB in [0, 1], between whole intervals and intervals
            cut into 4; quadrature_of_colour_halved: between intervals cut into 2 and into 4: if it is much smaller, the
            steps converge.
        quadrature_of_depth, quadrature_of_depth_halved: the same for the requested depth, in the unit of the scene.
        truncation_of_depth: of depth due to the tolerance of pictures; it has no bound, because the light that was left
            out may end anywhere.
    """
    total = frame.camera.width * frame.camera.height
    pixels = np.sort(np.random.default_rng(0).choice(total, size=min(total, 256), replace=False))
    rgb, distances = (values.double().cpu().numpy() for values in _renderings(model, frame, pixels, depth=depth))
    differences = {
        "quadrature_of_colour": np.abs(rgb[1] - rgb[3]).max(-1),
        "quadrature_of_colour_halved": np.abs(rgb[2] - rgb[3]).max(-1),
    }
    if depth is not None:
        differences |= {
            "quadrature_of_depth": np.abs(distances[1] - distances[3]),
            "quadrature_of_depth_halved": np.abs(distances[2] - distances[3]),
            "truncation_of_depth": np.abs(distances[0] - distances[1]),
        }
    numbers: dict[str, float] = {"pixels_measured": len(rgb[0])}
    for name, values in differences.items():
        finite = values[np.isfinite(values)]
        median, high = np.percentile(finite, (50, 95)).tolist() if finite.size else (0.0, 0.0)
        numbers |= {f"{name}_median": median, f"{name}_p95": high}
    return numbers


def refine_cuts(cuts: Tensor, parts: int) -> Tensor:
    """Return the distances (S * parts + 1,) that cut each interval of `cuts` (S + 1,) into equal parts."""
    fraction = torch.arange(parts, dtype=cuts.dtype, device=cuts.device) / parts
    inner = cuts[:-1, None] + cuts.diff()[:, None] * fraction
    return torch.cat([inner.flatten(), cuts[-1:]])


def _renderings(
    model: TrainedField, frame: Frame, pixels: np.ndarray, *, depth: DepthRequest | None
) -> tuple[Tensor, Tensor]:
    """Return colours (4, P, 3), depths (4, P): as rendered; then at `TIGHT` with intervals whole and cut in 2 and 4."""
    rays = pixel_rays(frame, model.training_from_scene, pixels=pixels, device=model.device)
    directions, cosines = rays.directions[rays.valid], rays.cosines[rays.valid]
    background = colours_behind(model.background, directions)
    cuts = uniform_cuts(model.marching)
    seen = [
        render_rays(
            model,
            rays.origin.expand_as(directions),
            directions,
            cuts=refine_cuts(cuts, parts).to(directions),
            background=background,
            fractions=fractions(depth) if depth is not None else (),
            tolerance=wanted,
            cones=rays.cones[rays.valid],
            keep_intervals=False,
        )
        for parts, wanted in ((1, TOLERANCE), (1, TIGHT), (2, TIGHT), (4, TIGHT))
    ]
    scale = model.training_from_scene.scale

    def distance(one: RaysSeen) -> Tensor:
        if depth is None:
            return torch.full_like(cosines, torch.nan)
        far = torch.full_like(cosines, (depth.background_distance or 0.0) * scale)
        along_ray = requested(depth, one.ends, background_distance=far) / scale
        return along_ray if depth.axis == "ray" else torch.where(cosines > 0, along_ray * cosines, torch.nan)

    return torch.stack([one.rgb.clamp(0.0, 1.0) for one in seen]), torch.stack([distance(one) for one in seen])
