"""What of space a field covers, and how: chosen for a scene before anything is learned."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from nerfcli.cameras.rigid import Similarity
from nerfcli.render.model import Marching
from nerfcli.scene import Scene
from nerfcli.train.normalisation import box_frame, contracted_frame, object_frame
from nerfcli.train.photos import Photo
from nerfcli.train.settings import TrainSettings
from nerfcli.train.triangulation import triangulate

_IN_WORDS = {"none": "bounded scene", "l2": "unbounded scene", "linf": "unbounded scene (linf)"}


@dataclass(frozen=True)
class Extent:
    """Where a field lives.

    Args:
        contraction: one of `kernels.CONTRACTIONS`.
        training_from_scene: the similarity to the training frame.
        marching: the steps along rays there.
    """

    contraction: str
    training_from_scene: Similarity
    marching: Marching

    def __str__(self) -> str:
        return _IN_WORDS[self.contraction]

    def to_json(self) -> dict[str, Any]:
        """Plain values; floats survive a round trip exactly."""
        return {
            "contraction": self.contraction,
            "training_from_scene": self.training_from_scene.to_json(),
            "marching": vars(self.marching),
        }

    @staticmethod
    def from_json(content: dict[str, Any]) -> "Extent":
        """The extent that `to_json` described."""
        similarity = Similarity.from_json(content["training_from_scene"])
        return Extent(content["contraction"], similarity, Marching(**content["marching"]))


def choose_extent(
    scene: Scene,
    photos: Sequence[Photo],
    settings: TrainSettings,
    *,
    fills_frame: bool,
    notify: Callable[[str], None],
) -> Extent:
    """The extent that the settings ask for.

    Args:
        scene: cameras, and points or depth bounds where it has them.
        photos: those of training; where the scene tells nothing of depth, points are found in them.
        settings: of the training.
        fills_frame: whether there is more in the photos than an object cut out by alpha.
        notify: takes a line for the user where points had to be found.

    Raises:
        UserError: no contraction is asked for, and there are too few points to see where the scene ends.
    """
    contraction = settings.contraction or ("l2" if fills_frame else "none")
    if contraction == "none" and not fills_frame:
        return Extent(contraction, *object_frame(scene))
    if len(scene.points) == 0 and (scene.depth_bounds is None or contraction == "none"):
        scene = replace(scene, points=triangulate(photos, threads=settings.threads))
        notify(f"the scene came without points; {len(scene.points)} found in its photos tell how far it reaches")
    return Extent(contraction, *(box_frame(scene) if contraction == "none" else contracted_frame(scene)))
