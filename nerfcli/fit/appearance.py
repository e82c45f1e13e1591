"""What is learned besides the field: what is infinitely far, the exposures of the photos, and their cameras."""

from typing import Any

import torch
from torch import Tensor, nn

from nerfcli.errors import UserError
from nerfcli.field.background import SphereBackground
from nerfcli.field.exposure import Exposure
from nerfcli.fit.losses import over_background
from nerfcli.fit.ranks import Alone
from nerfcli.fit.refinement import Refinement, rate_at
from nerfcli.photos.pool import Drawn, Pool
from nerfcli.runs.components import LEARNED_BACKGROUNDS, Components

# Learning rates as multiples of the field's. After 300 steps at 0.3, gains of photos are a tenth of the way to the true
# ones, at 2 half of it, at 5 no further.
BACKGROUND_RATE, EXPOSURE_RATE = 5.0, 2.0
# Detail comes later to a field whose cameras learn: see `Appearance.share_of_detail`. Balls, photos turned by 0.5
# degree, 800 steps: 31.1 dB with the usual shares, 31.2 with 0.7 of them, 31.9 and 32.0 with these.
DETAIL_DELAY, DETAIL_SLOPE = 0.125, 0.875
# From here on a photo's level says only that the light was at least that bright.
SATURATED = 254.5 / 255
# A ray that meets less than this has no colour of its own to speak of.
LEAST_OPACITY = 1e-3
# Levels of a background that a sigmoid reaches.
LEAST_LEVEL = 0.02


class Appearance(nn.Module):
    """The parts that the components ask for, and how they enter the colour of a ray.

    Args:
        components: what is in the model.
        pool: the training photos.
        log_gains: (photos, 3) logarithms of their exposures to start from.
        log_focal: see `Refinement`.

    Raises:
        UserError: a background is to be learned behind photos with alpha.
    """

    def __init__(self, components: Components, pool: Pool, *, log_gains: Tensor, log_focal: float = 0.0):
        super().__init__()
        device = pool.colours.device
        kind = components.background
        if kind in LEARNED_BACKGROUNDS and pool.has_alpha:
            raise UserError(
                f"--with background={kind} does not work with these photos: their alpha channel says that the "
                "background is empty",
                "remove the option, or use photos without alpha",
            )
        self.background: SphereBackground | None = None
        if kind in LEARNED_BACKGROUNDS:
            self.background = (SphereBackground(1) if kind == "constant" else SphereBackground()).to(device)
        self.exposure: Exposure | None = None
        if components.exposure != "none":
            self.exposure = Exposure(log_gains.to(device, torch.float32))
            self.exposure.requires_grad_(components.exposure == "learned")
        self.cameras = None if components.cameras == "fixed" else Refinement(components.cameras, pool, log_focal)
        self.is_random = kind == "random" or (kind == "auto" and pool.has_alpha)
        self._pool = pool
        self.sky: Tensor | None = None

    @torch.no_grad()
    def show_sky(self, sky: Tensor) -> None:
        """Begin a learned background with the median colour of the sky: where no photo looks, it stays.

        Args:
            sky: (pixels,) bool, those of the pool that show it.
        """
        colours = self._pool.colours[sky]
        if self.background is None or len(colours) == 0:
            return
        median = (colours[:, :3].float().median(0).values / 255.0).clamp(LEAST_LEVEL, 1.0 - LEAST_LEVEL)
        self.background.logits.add_(torch.logit(median)[:, None, None, None])
        self.sky = sky

    def groups(self) -> list[dict[str, Any]]:
        """Return what is to be optimised, with its learning rate as a multiple of the field's."""
        rates = ((self.background, BACKGROUND_RATE), (self.exposure, EXPOSURE_RATE))
        learned = [(list(part.parameters()), rate) for part, rate in rates if part is not None]
        return [{"params": tensors, "multiple": rate} for tensors, rate in learned if tensors[0].requires_grad]

    def share_of_detail(self, fraction: float) -> float:
        """Return the share of the budget whose detail the field may have: cameras find their places in a coarse field,
        while a fine one learns to show each photo as it is, in its wrong place."""
        return fraction if self.cameras is None else DETAIL_SLOPE * fraction - DETAIL_DELAY

    def gradients(self) -> dict[str, Tensor]:
        """Return the gradients that there are, by name."""
        return {name: tensor.grad for name, tensor in self.named_parameters() if tensor.grad is not None}

    def refined(self, drawn: Drawn) -> Drawn:
        """Return the same pixels, with the rays of the cameras as they are now."""
        return drawn if self.cameras is None else self.cameras.refined(drawn)

    def with_learning_rays(self, drawn: Drawn, fraction: float) -> Drawn:
        """`refined`, with rays that collect gradients while cameras learn."""
        refined = self.refined(drawn)
        if self.cameras is None or rate_at(fraction) == 0.0:
            return refined
        return refined._replace(
            origins=refined.origins.clone().requires_grad_(), directions=refined.directions.clone().requires_grad_()
        )

    def step_cameras(self, drawn: Drawn, losses: Tensor, fraction: float, *, factor: float, ranks: Alone) -> None:
        """Take one step of the cameras against the gradients of rays of `with_learning_rays`.

        Args:
            drawn: those rays.
            losses: (R,) of each of them.
            fraction: of the budget.
            factor: of the rate.
            ranks: each has rays of its own.
        """
        if self.cameras is not None:
            self.cameras.step(drawn, losses, fraction, factor=factor, ranks=ranks)

    def forget_gradients(self) -> None:
        """Drop those that a GPU has sent for the next step of the cameras."""
        if self.cameras is not None:
            self.cameras.sent.forget()

    def behind(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, 3) what rays are composited on: black or random colours.

        Photos with alpha are shown on random colours, so that only opacity explains them. Others fill the frame: behind
        them is black, as random colours shining through the fog of the start would drown all else.
        """
        device = self._pool.colours.device
        if self.is_random:
            return torch.rand(count, 3, generator=generator, device=device)
        return torch.zeros(count, 3, device=device)

    def compared(
        self, rendered: Tensor, transmittance: Tensor, drawn: Drawn, *, behind: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return what the field and these parts say of pixels, and what the photos say, both (R, 3) sRGB.

        Args:
            rendered: (R, 3) composited on `behind`.
            transmittance: (R,) the share of light that passes the field.
            drawn: the pixels.
            behind: (R, 3).
        """
        if self.background is not None:
            rendered = rendered + transmittance[:, None] * self.background(drawn.directions)
        measured = over_background(drawn.colours, behind)
        if self.exposure is None:
            return rendered, measured
        photos = self._pool.photo_of(drawn.numbers)
        if not self._pool.has_alpha:
            return _up_to_white(self.exposure(rendered, photos), drawn.colours), measured
        # What is behind an object was put there by us: no photo exposed it.
        opacity = 1.0 - transmittance[:, None]
        own = (rendered - transmittance[:, None] * behind).clamp_min(0.0) / opacity.clamp_min(LEAST_OPACITY)
        own = _up_to_white(self.exposure(own, photos), drawn.colours)
        return opacity * own + transmittance[:, None] * behind, measured


def _up_to_white(rendered: Tensor, colours: Tensor) -> Tensor:
    """Return what a photo shows of colours (R, 3): no more than white where its own (R, 3 or 4) are white."""
    return torch.where(colours[:, :3] < SATURATED, rendered, rendered.clamp_max(1.0))
