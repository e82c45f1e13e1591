"""Novelty of held-out views: distance and angle to the nearest training view.

A metric measured between training views shows how well a field fills gaps; one beyond them, what the field knows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import focus_point

# A view is an extrapolation if its nearest training view is farther than this many typical distances between these...
MOST_SPACINGS = 2.0
# ...or differs in direction by more than this fraction of the field of view, so that less than half of it overlaps.
MOST_TURN = 0.5


@dataclass(frozen=True)
class Novelty:
    """Novelty of one held-out view.

    Args:
        nearest: name of the training view whose centre is nearest.
        distance: distance to it, scene units.
        distance_relative: the same over the scene's radius (median distance of training views from their focus point).
        spacings: the same over the median distance of a training view to the nearest other one; None if there is none.
        angle_deg: angle between the optical axes of the two.
        kind: "interpolation" or "extrapolation": see `MOST_SPACINGS` and `MOST_TURN`.
    """

    nearest: str
    distance: float
    distance_relative: float | None
    spacings: float | None
    angle_deg: float
    kind: str


def novelty(held_out: Sequence[Frame], training: Sequence[Frame]) -> list[Novelty]:
    """Compute the novelty of each held-out view; `training` has at least one view."""
    centres = np.array([frame.centre for frame in training])
    radius = float(np.median(np.linalg.norm(centres - focus_point(training), axis=1)))
    spacing = _spacing(centres)
    found = []
    for frame in held_out:
        distances = np.linalg.norm(centres - frame.centre, axis=1)
        # Of several views in one place, use the one with the most similar direction.
        near = np.flatnonzero(distances <= distances.min() * (1 + 1e-9)).tolist()
        angles = [_angle_deg(frame, training[index]) for index in near]
        index = near[int(np.argmin(angles))]
        distance, angle = float(distances[index]), min(angles)
        spacings = distance / spacing if spacing else None
        too_far = spacings is not None and spacings > MOST_SPACINGS
        turned = angle > MOST_TURN * min(frame.camera.fov_deg)
        found.append(
            Novelty(
                nearest=training[index].name,
                distance=distance,
                distance_relative=distance / radius if radius > 0 else None,
                spacings=spacings,
                angle_deg=angle,
                kind="extrapolation" if too_far or turned else "interpolation",
            )
        )
    return found


def _spacing(centres: np.ndarray) -> float | None:
    """Return the median distance from a centre to the nearest other one; None for fewer than two."""
    if len(centres) < 2:
        return None
    nearest = []
    for index, centre in enumerate(centres):
        distances = np.linalg.norm(centres - centre, axis=1)
        distances[index] = np.inf
        nearest.append(float(distances.min()))
    return float(np.median(nearest))


def _angle_deg(one: Frame, other: Frame) -> float:
    first, second = one.world_from_cam[:3, 2], other.world_from_cam[:3, 2]
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))
