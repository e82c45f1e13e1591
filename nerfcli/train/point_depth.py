"""Depth that is known before training: points of structure from motion, in the photos that saw them."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerfcli import kernels
from nerfcli.cameras.formats.colmap import parse_colmap
from nerfcli.cameras.rigid import Similarity, apply, inverse
from nerfcli.errors import UserError
from nerfcli.scene import Scene, model_folder
from nerfcli.train.photos import Drawn, PixelPool

# Until this share of the budget the points count less and less; photos tell more than points once there are surfaces.
LAST_SHARE = 0.5
# One keypoint is drawn for so many other pixels.
PIXELS_PER_POINT = 8
# Relative distance from the point from which on light counts as simply elsewhere.
MOST_DEVIATION = 0.25
# Reprojection error at which a point counts half, in pixels of the photo.
HALF_ERROR_PX = 1.0


@dataclass(frozen=True)
class PointDepths:
    """Pixels whose surface is known: M of them.

    Args:
        numbers: (M,) int64, pixels of the pool.
        distances: (M,) along their rays, training frame.
        trust: (M,) in (0, 1].
    """

    numbers: Tensor
    distances: Tensor
    trust: Tensor

    def draw(self, count: int, generator: torch.Generator) -> "PointDepths":
        """`count` of them at random, with replacement."""
        chosen = torch.randint(len(self.numbers), (count,), generator=generator, device=self.numbers.device)
        return PointDepths(self.numbers[chosen], self.distances[chosen], self.trust[chosen])


class PointRays:
    """Known pixels among those that a step draws.

    Args:
        known: the pixels.
        pool: what they are pixels of.
    """

    def __init__(self, known: PointDepths, pool: PixelPool):
        self.known = known
        self._pool = pool

    def added_to(self, drawn: Drawn, generator: torch.Generator) -> Drawn:
        """The pixels drawn, and known ones behind them. Their colours count like all others."""
        chosen = self.known.draw(max(1, len(drawn.numbers) // PIXELS_PER_POINT), generator)
        both = self._pool.rays_of(torch.cat([drawn.numbers, chosen.numbers]))
        weights = drawn.weights
        if len(weights):
            weights = torch.cat([weights, torch.ones_like(chosen.distances)])
        return both._replace(distances=chosen.distances, trust=chosen.trust, weights=weights)


def point_depths(scene: Scene, pool: PixelPool, training_from_scene: Similarity) -> PointDepths:
    """The points of the scene's COLMAP model, at the training photos' pixels that they were seen in.

    trust = 1 / (1 + (reprojection error / 1 px)^2)

    Raises:
        UserError: the scene has no model, or none of its points was seen in a training photo.
    """
    folder = model_folder(scene.root)
    capture = parse_colmap(folder) if folder is not None else None
    seen = capture.observations if capture is not None else None
    numbers, distances, trust = [], [], []
    if capture is not None and seen is not None:
        index_of = {frame.name: index for index, frame in enumerate(capture.frames)}
        for photo, frame in enumerate(pool.frames):
            of_frame = (seen.frame_index == index_of.get(frame.name, -1)) & (seen.point_index >= 0)
            points = capture.points[seen.point_index[of_frame]]
            calibrated = capture.frames[index_of[frame.name]] if frame.name in index_of else frame
            expected, valid = calibrated.camera.project(apply(inverse(calibrated.world_from_cam), points))
            error = np.linalg.norm(expected - seen.pixels[of_frame], axis=-1)
            # The photo may be smaller or turned: the point is looked up with the photo's own camera.
            pixels, inside = frame.camera.project(apply(inverse(frame.world_from_cam), points))
            column, row = np.floor(pixels.T)
            kept = valid & inside & (column >= 0) & (row >= 0)
            kept &= (column < frame.camera.width) & (row < frame.camera.height)
            first = int(pool.first_pixel[photo])
            numbers.append(first + (row * frame.camera.width + column)[kept].astype(np.int64))
            distances.append(np.linalg.norm(points[kept] - frame.centre, axis=-1) * training_from_scene.scale)
            trust.append(1.0 / (1.0 + (error[kept] / HALF_ERROR_PX) ** 2))
    if not sum(map(len, numbers)):
        raise UserError(
            f"--with points: {scene.root} does not tell which photos saw which points",
            "use a scene of nerfcli poses or a COLMAP model, or leave it out",
        )
    device = pool.colours.device
    return PointDepths(
        torch.from_numpy(np.concatenate(numbers)).to(device),
        torch.from_numpy(np.concatenate(distances)).to(device, torch.float32),
        torch.from_numpy(np.concatenate(trust)).to(device, torch.float32),
    )


def fading(share: float) -> float:
    """How much the points count at a share of the budget: 1 at the start, 0 from `LAST_SHARE` on, a line between."""
    return max(0.0, 1.0 - share / LAST_SHARE)


def point_depth_loss(
    weights: Tensor, transmittance: Tensor, middles: Tensor, *, offsets: Tensor, known: PointDepths
) -> Tensor:
    """How far from the known points light ends, on average over its rays.

    mean_r trust_r (sum_i weight_i min(1, |middle_i - distance_r| / (c distance_r)) + transmittance_r),  c = 0.25

    Light that ends c of the distance away or more, or not at all, counts 1, so that a wrong point pulls no harder than
    a right one that has been reached pulls back.

    Args:
        weights, middles: (N,) packed samples; middles are distances along the ray, training frame.
        transmittance: (R,).
        offsets: (R + 1,).
        known: the points of the last M rays, M <= R.

    Returns:
        Scalar in [0, 1]; 0 where all light ends at the points. Differentiable in weights and transmittance.
    """
    count = len(known.numbers)
    first = len(transmittance) - count
    of_points = offsets[first:] - offsets[first]
    part = slice(int(offsets[first]), None)
    distance = known.distances[kernels.ray_indices(of_points)]
    deviation = ((middles[part] - distance).abs() / (MOST_DEVIATION * distance)).clamp_max(1.0)
    elsewhere = kernels.sum_along_rays(weights[part] * deviation, of_points) + transmittance[first:]
    return (known.trust * elsewhere).mean()
