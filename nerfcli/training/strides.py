"""The steps along the rays of a training, and of pictures of its field."""

import torch
from torch import Tensor

from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.kinds import cube_side
from nerfcli.render.trained_field import Marching
from nerfcli.training.extent import Extent
from nerfcli.training.normalisation import NEAR_PER_POINT
from nerfcli.training.schedule import SHORTEST

# Detailed fields end with shorter steps, halved until they are shorter than this many cells of the finest level as seen
# from other cameras: along a ray, a surface is at least as thick as a step, which blurs its edges in their pictures.
CELLS_PER_STEP = 2.0
# Each halving costs a quarter of a training's rays.
MOST_HALVINGS = 2


class RaySteps:
    """The steps along the rays of one training: long ones first, the shortest ones from half of the budget on.

    Gradients are scaled down nearer to a camera than `nearest`: where rays begin, divided by `NEAR_PER_POINT`, at most
    1. That is the distance of the nearest 3D point if the capture has points and no bounds.

    Args:
        extent: gives the steps of the capture, and its parallax.
    """

    def __init__(self, extent: Extent, settings: FieldSettings, device: torch.device):
        marching = extent.marching
        self._marching, self._detailed = marching, settings.detailed
        self.nearest = min(1.0, marching.near / NEAR_PER_POINT)
        self._halved = 2 ** halvings(marching, settings, extent.parallax)
        self._edges = marching.stretched(1 / self._halved).edges().to(device, torch.float32)

    @property
    def most(self) -> int:
        """Largest number of steps of a ray."""
        return len(self._edges) - 2

    def edges(self, stride: int) -> Tensor:
        """Return the edges of the steps, see `Marching.edges`, for `StepPlan.stride`."""
        return self._edges[:: stride * self._halved or 1].contiguous()

    def render_steps(self, stride: int) -> Marching:
        """Return the steps of pictures of the field: those of the training so far, at most those of the capture.

        Pictures of detailed fields have at most half of the capture's, with which the training had more rays.
        """
        shortest = self._halved if stride == SHORTEST else 1
        return self._marching.stretched(1 / max(2, shortest)) if self._detailed else self._marching


def halvings(marching: Marching, settings: FieldSettings, parallax: float) -> int:
    """Return how often the steps of a capture are halved by the end of a field's training."""
    if not (isinstance(settings, HashFieldSettings) and settings.detailed):
        return 0
    # In contracted space, steps grow with distance as cells do; `growth` is the step at distance 1.
    step = max(marching.shortest_step, marching.growth)
    cells = parallax * step / cube_side(settings.contraction) * settings.finest
    return next((n for n in range(MOST_HALVINGS) if cells / 2**n < CELLS_PER_STEP), MOST_HALVINGS)
