"""What can be rendered, exported and evaluated: a field, or splats."""

from collections.abc import Callable
from typing import Protocol

from nerfcli.cameras.frame import Frame
from nerfcli.field.background import Background
from nerfcli.render.depth import DepthRequest
from nerfcli.render.pictures import RenderedPicture


class Renderable(Protocol):
    """A model of a scene, in the scene's frame; `Model` and `splats.render.SplatScene` are such."""

    @property
    def background(self) -> Background:
        """SRGB behind everything, for pictures without alpha."""
        ...

    @property
    def unit(self) -> str:
        """Unit of length, "arbitrary" or "metre"."""
        ...

    @property
    def unit_source(self) -> str | None:
        """How the metre is known; None where unknown."""
        ...

    @property
    def thread_safe(self) -> bool:
        """Whether several threads may render it at the same time."""
        ...

    def render(
        self,
        frame: Frame,
        *,
        background: Background,
        depth: DepthRequest | None = None,
        on_tile: Callable[[int], None] | None = None,
    ) -> RenderedPicture:
        """Render a frame; see `render_picture`."""
        ...

    def measured_error(self, frame: Frame, *, depth: DepthRequest | None) -> dict[str, float]:
        """Return numbers on the accuracy of the rendering; see `accuracy`."""
        ...
