"""Parts that are learned besides the field: the background, the exposures of the photos, and their cameras."""

import torch
from torch import Tensor, nn

from nerfcli.errors import UserError
from nerfcli.field.background import SphereBackground
from nerfcli.field.exposure import Exposure, changed_in_front
from nerfcli.training.pool import PixelBatch, PixelPool
from nerfcli.training.refinement import Refinement
from nerfcli.training.runs.components import LEARNED_BACKGROUNDS, Components

# Learning rates as multiples of the field's: at lower ones, short trainings come only a part of the way.
BACKGROUND_RATE, EXPOSURE_RATE = 5.0, 2.0
# At or above this level, a photo tells only that the light was at least that bright.
SATURATED = 254.5 / 255
# Initial background levels are kept this far from 0 and 1, which a sigmoid does not reach.
LEAST_LEVEL = 0.02


class Appearance(nn.Module):
    """The parts that the components require, and how they enter the colour of a ray.

    Args:
        log_gains: (photos, 3) logarithms of their initial exposures, NaN where unknown.
        log_focal: see `Refinement`.

    Raises:
        UserError: a background is to be learned behind photos with alpha.
    """

    def __init__(self, components: Components, pool: PixelPool, *, log_gains: Tensor, log_focal: float = 0.0):
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
            gains = log_gains.to(device, torch.float32)
            known = gains.isfinite().all(1)
            # Known exposures are fixed: with few photos, view dependence would take the place of learned ones.
            learned = ~known if components.exposure == "matched" else torch.ones_like(known)
            self.exposure = Exposure(torch.where(known[:, None], gains, 0.0), learned)
            self.exposure.requires_grad_(components.exposure != "exif")
        self.cameras = None if components.cameras == "fixed" else Refinement(components.cameras, pool, log_focal)
        self.is_random = kind == "random" or (kind == "auto" and pool.has_alpha)
        self._pool = pool
        self.sky: Tensor | None = None

    @torch.no_grad()
    def init_background_from_sky(self, sky: Tensor) -> None:
        """Initialise a learned background, for unseen directions, with the median colour of the pixels of the sky."""
        colours = self._pool.colours[sky]
        if self.background is None or len(colours) == 0:
            return
        median = (colours[:, :3].float().median(0).values / 255.0).clamp(LEAST_LEVEL, 1.0 - LEAST_LEVEL)
        self.background.logits.add_(torch.logit(median)[:, None, None, None])
        self.sky = sky

    def groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """Return the parameters to optimise, with their learning rates as multiples of the field's."""
        rates = ((self.background, BACKGROUND_RATE), (self.exposure, EXPOSURE_RATE))
        learned = [(list(part.parameters()), rate) for part, rate in rates if part is not None]
        return [(tensors, rate) for tensors, rate in learned if tensors[0].requires_grad]

    def gradients(self) -> dict[str, Tensor]:
        """Return by name the gradients of the parameters that have one."""
        return {name: tensor.grad for name, tensor in self.named_parameters() if tensor.grad is not None}

    def refine_cameras(self, drawn: PixelBatch) -> PixelBatch:
        """Return the same pixels, with the rays of the current cameras."""
        return drawn if self.cameras is None else self.cameras.refine_cameras(drawn)

    def with_learning_rays(self, drawn: PixelBatch, rate: float) -> PixelBatch:
        """Return the same as `refine_cameras`, with rays that collect gradients where the rate of cameras is not 0."""
        refined = self.refine_cameras(drawn)
        if self.cameras is None or rate == 0.0:
            return refined
        return refined._replace(
            origins=refined.origins.clone().requires_grad_(), directions=refined.directions.clone().requires_grad_()
        )

    def behind(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the colours (count, 3) that rays are composited on: black or random.

        Photos with alpha are composited on random colours, so that only opacity explains them. Other photos fill the
        frame and are put on black: random colours shining through the initial fog would drown everything else.
        """
        device = self._pool.colours.device
        if self.is_random:
            return torch.rand(count, 3, generator=generator, device=device)
        return torch.zeros(count, 3, device=device)

    def compared(
        self, rendered: Tensor, transmittance: Tensor, drawn: PixelBatch, *, behind: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the predicted and the measured colours of pixels, both (R, 3) sRGB.

        Args:
            rendered: (R, 3) composited on `behind`.
            transmittance: (R,) the fraction of light that passes through the field.
            behind: (R, 3) colours behind the field.
        """
        if self.background is not None:
            rendered = rendered + transmittance[:, None] * self.background(drawn.directions)
        measured = over_background(drawn.colours, behind)
        if self.exposure is None:
            return rendered, measured
        exposure, photos = self.exposure, self._pool.photo_of(drawn.numbers)

        def shown(colours: Tensor) -> Tensor:
            found = exposure(colours, photos)
            return torch.where(drawn.colours[:, :3] < SATURATED, found, found.clamp_max(1.0))

        if not self._pool.has_alpha:
            return shown(rendered), measured
        return changed_in_front(rendered, shown, transmittance=transmittance[:, None], behind=behind), measured


def over_background(colours: Tensor, background: Tensor) -> Tensor:
    """Return colours (R, 3), or (R, 4) of straight alpha, over a background: alpha rgb + (1 - alpha) background."""
    if colours.shape[-1] == 3:
        return colours
    alpha = colours[:, 3:]
    return alpha * colours[:, :3] + (1.0 - alpha) * background
