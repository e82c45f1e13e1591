"""Extent of the field: the covered part of space and its contraction, chosen before training."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerfcli.cameras.rigid import Similarity
from nerfcli.captures.capture import Capture
from nerfcli.render.trained_field import Marching
from nerfcli.training.normalisation import (
    NARROW_SPREAD,
    box_frame,
    contracted_frame,
    has_narrow_baseline,
    narrow_frame,
    object_frame,
)
from nerfcli.training.runs.components import LEARNED_BACKGROUNDS
from nerfcli.training.runs.settings import TrainSettings

# Radius, in unit balls, of the ball that a learned background surrounds: anything nearer shows parallax.
BALLS_BEFORE_BACKGROUND = 1.5

_IN_WORDS = {"none": "bounded scene", "l2": "unbounded scene"}


@dataclass(frozen=True)
class Extent:
    """Extent of a field.

    Args:
        contraction: one of `kernels.CONTRACTIONS`.
        training_from_scene: the similarity to the training frame.
        marching: the steps along rays there.
        reach: distance along rays at which the last ray has left the ball that a learned background surrounds; None if
            the field is bounded.
        parallax: shift of a point in the pictures of other cameras when it moves along a ray, relative to its motion:
            about 1 where cameras surround a scene, less where they are close together.
    """

    contraction: str
    training_from_scene: Similarity
    marching: Marching
    reach: float | None = None
    parallax: float = 1.0

    def __str__(self) -> str:
        return _IN_WORDS[self.contraction]

    def to_json(self) -> dict[str, Any]:
        """Return plain values; floats survive a round trip exactly."""
        return {
            "contraction": self.contraction,
            "training_from_scene": self.training_from_scene.to_json(),
            "marching": vars(self.marching),
            "reach": self.reach,
            "parallax": self.parallax,
        }

    @staticmethod
    def from_json(content: dict[str, Any]) -> "Extent":
        """Return the extent that `to_json` described."""
        similarity = Similarity.from_json(content["training_from_scene"])
        marching, parallax = Marching(**content["marching"]), content.get("parallax", 1.0)
        return Extent(content["contraction"], similarity, marching, content.get("reach"), parallax)

    def before(self, background: str, *, sky_known: bool) -> "Extent":
        """Return the extent for a kind of background, see `Components`: the field ends where a learned one begins.

        Otherwise the initial fog would hide the background for good, and the field would have to paint distant things.
        Pixels that are known to show the sky clear the fog before it: then the field keeps what is far away but not at
        infinity, such as the buildings around a square.
        """
        if background not in LEARNED_BACKGROUNDS or self.reach is None or sky_known:
            return self
        return replace(self, marching=replace(self.marching, far=min(self.marching.far, self.reach)))


def lacks_depth(scene: Capture, settings: TrainSettings, *, fills_frame: bool) -> bool:
    """Return whether the settings need a depth that the scene lacks, so that points must be triangulated first.

    Args:
        scene: cameras, and points or depth bounds if it has any.
        fills_frame: whether the photos show more than an object cut out by alpha.
    """
    contraction = _contraction(settings, fills_frame)
    is_object = contraction == "none" and not fills_frame
    return not is_object and len(scene.points) == 0 and (scene.depth_bounds is None or contraction == "none")


def choose_extent(scene: Capture, settings: TrainSettings, *, fills_frame: bool) -> Extent:
    """Choose the extent for the settings.

    Args:
        scene: cameras, and points or depth bounds; see `lacks_depth`.
        fills_frame: whether the photos show more than an object cut out by alpha.

    Raises:
        UserError: the requested contraction is "none", and there are too few points to tell where the scene ends.
    """
    contraction = _contraction(settings, fills_frame)
    if contraction == "none" and not fills_frame:
        return Extent(contraction, *object_frame(scene))
    if contraction == "none":
        return Extent(contraction, *box_frame(scene))
    if has_narrow_baseline(scene):
        return Extent(contraction, *narrow_frame(scene), parallax=NARROW_SPREAD)
    similarity, marching = contracted_frame(scene)
    farthest = max(float(np.linalg.norm(similarity.apply(frame.centre))) for frame in scene.frames)
    return Extent(contraction, similarity, marching, farthest + BALLS_BEFORE_BACKGROUND)


def _contraction(settings: TrainSettings, fills_frame: bool) -> str:
    return settings.contraction or ("l2" if fills_frame else "none")
