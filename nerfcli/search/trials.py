"""Short trainings that differ in one thing, judged on blocks of the training photos that none of them sees.

One training of the plainest model goes first. All others go on from where it stood, each with a change or with none:
what they differ by is the change, not what a different start would have led to, and each takes a moment only.

The held-out photos of the scene take no part in this: what is chosen by looking at them could not be measured on them.
"""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfcli.errors import UserError
from nerfcli.field.hash_field import HashField
from nerfcli.fit.error_map import ErrorMap
from nerfcli.fit.extent import Extent
from nerfcli.fit.fitting import Fitting
from nerfcli.fit.movers import Movers
from nerfcli.fit.point_depth import PointDepths, PointRays
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.photos.pool import PixelPool
from nerfcli.photos.psnr import psnr_of
from nerfcli.photos.storage import IN_MEMORY, PhotoStorage
from nerfcli.runs.components import Components
from nerfcli.runs.settings import FEWEST_LOG2_ROWS, TrainSettings
from nerfcli.search.diagnostics import Diagnostics, diagnose
from nerfcli.search.sky import paint

# Photos are judged by squares of this side, or of a quarter of a small photo's: single pixels between known neighbours
# would judge interpolation.
BLOCK_PX = 12
BLOCK_SHARE = 0.06
JUDGED_PIXELS = 8192
# Of the whole schedule, what is over when the first training stops and the others go on.
FORK_SHARE = 0.6
# After so many steps it is known how many there will be, within this factor: of a machine that something else slowed
# down, too. Where they are too few, the rest would be in vain.
PROBE_STEPS, PROBE_FACTOR = 10, 1.25
# The choice of blocks and pixels: the same for all candidates of a scene, and not that of any training.
SEED = 20_211


@dataclass(frozen=True)
class Trial:
    """Result of a short training.

    Args:
        errors: (photos,) sums of squared differences of the judged pixels of each photo, sRGB.
        halfway: the same after half of its steps.
        counts: (photos,) values that were summed.
        seconds: it took.
        steps: it went.
        log_gains: (photos, 3) that it found, where it looked for any.
    """

    errors: np.ndarray
    halfway: np.ndarray
    counts: np.ndarray
    seconds: float
    steps: int
    log_gains: Tensor | None = None

    @property
    def psnr(self) -> float:
        """PSNR in dB over all judged pixels."""
        return psnr_of(float(self.errors.sum() / self.counts.sum()))


@dataclass(frozen=True)
class TrialStart:
    """State of the first training when it stopped.

    Args:
        tensors, description: its state.
        seconds: it took.
        trial: what it achieved.
        signs: what its residuals tell.
    """

    tensors: dict[str, Tensor]
    description: dict[str, Any]
    seconds: float
    trial: Trial
    signs: Diagnostics

    @property
    def steps(self) -> int:
        """It went."""
        return self.trial.steps


class Trials:
    """Trainings of one scene on the same pixels.

    Args:
        photos: those to train on.
        extent: of the field.
        settings: of the training that the trials are for; seed and components are given with each trial.
        exif: (photos,) logarithms of the exposures that EXIF tells, relative to their mean.
        log_focal: see `Fitting`.
        depths: sets of pixels whose distance is known.
        log_gains: (photos, 3) of exposures that learn, where matched pixels tell them.
        sky: see `Fitting`.
        colours, storage: see `PixelPool`.

    Raises:
        UserError: masks leave nothing to judge by.
    """

    def __init__(
        self,
        photos: Sequence[LoadedPhoto],
        extent: Extent,
        *,
        settings: TrainSettings,
        exif: np.ndarray,
        log_focal: float = 0.0,
        depths: Sequence[PointDepths] = (),
        log_gains: Tensor | None = None,
        sky: Tensor | None = None,
        colours: np.ndarray | None = None,
        storage: PhotoStorage = IN_MEMORY,
    ):
        device = torch.device(settings.device)
        seen, numbers = _split(photos, storage)
        self._pool = PixelPool(seen, extent.training_from_scene, device, colours=colours, storage=storage)
        if len(numbers) == 0:
            raise UserError(
                "no training pixels are left to compare components on", "remove the masks, or use --model default"
            )
        self._judged = self._pool.rays_of(torch.from_numpy(numbers).to(device))
        self._photos = self._pool.photo_of(self._judged.numbers).cpu().numpy()
        self._counts = np.bincount(self._photos, minlength=len(photos)) * 3
        self._extent = extent
        # Small steps all along: they learn more from a sample, which is what a short training has few of.
        self._settings = replace(settings, samples_per_step=settings.first_samples_per_step)
        self._exif = torch.from_numpy(exif).to(torch.float32)[:, None].expand(-1, 3)
        self._log_focal = log_focal
        points = PointRays([one.among(self._pool) for one in depths], self._pool)
        self._points = points if points.sets else None
        self._room = storage
        self._log_gains, self._sky = log_gains, sky

    def begin(
        self, components: Components, *, steps: int, seconds: float = math.inf, fewest: int = 0
    ) -> TrialStart | None:
        """Train from the beginning to `FORK_SHARE` of a schedule.

        Args:
            components: what is in the model.
            steps: to go at most.
            seconds: to take; how many steps were gone then is in the answer.
            fewest: steps, for which it takes up to twice as long; it ends at once where these are surely out of reach.

        Returns:
            None where it did not come to the fewest steps.
        """
        gains = self._log_gains if components.exposure == "learned" else None
        fitting = self._fitting(components, seed=self._settings.seed, log_gains=gains, cameras_from=0.0)
        took: list[float] = []

        def share() -> float:
            enough = fitting.step / fewest if fewest else math.inf
            return max(fitting.step / steps, sum(took) / (2.0 * seconds), min(sum(took) / seconds, enough))

        def is_in_vain() -> bool:
            return len(took) == PROBE_STEPS and statistics.median(took) * fewest > 2.0 * PROBE_FACTOR * seconds

        while share() < 1.0 and not is_in_vain():
            took.append(self._advance(fitting, FORK_SHARE * share()))
        if fitting.step < fewest:
            return None
        drawn = self._pool.draw(JUDGED_PIXELS, fitting.generator)
        with torch.no_grad():
            rendered, measured = fitting.compare(drawn)
        reach = self._extent.reach
        signs = diagnose(
            rendered,
            measured,
            self._pool.photo_of(drawn.numbers),
            directions=drawn.directions,
            from_beyond=fitting.light_from_beyond(drawn, distance=math.inf if reach is None else reach),
            count=len(self._counts),
        )
        tensors, description = fitting.state()
        copies = {name: tensor.clone() for name, tensor in tensors.items()}
        errors = self._errors(fitting)
        trial = Trial(errors, errors, self._counts, statistics.median(took) * len(took), fitting.step)
        return TrialStart(copies, description, sum(took), trial, signs)

    def go_on(self, start: TrialStart, components: Components, *, seed: int, steps: int) -> Trial:
        """Continue to the end of the schedule with these components, and measure.

        Args:
            start: what `begin` gave.
            components: what is in the model from here on. What is new begins so that it changes nothing: new
                harmonics without weight, exposures as the residuals have them.
            seed: of everything random; candidates with the same one draw the same pixels.
            steps: to go.
        """
        learned = start.signs.log_gains if self._log_gains is None else self._log_gains
        gains = {"exif": self._exif, "learned": learned}.get(components.exposure)
        fitting = self._fitting(components, seed=seed, log_gains=gains, cameras_from=FORK_SHARE)
        self._take_up(fitting, start)
        if fitting.parts.background is not None:
            paint(fitting.parts.background, self._draws())
        seconds, halfway = [], None
        for done in range(steps):
            if halfway is None and 2 * done >= steps:
                halfway = self._errors(fitting)
            seconds.append(self._advance(fitting, FORK_SHARE + (1.0 - FORK_SHARE) * done / steps))
        errors = self._errors(fitting)
        # A median: other work on the machine must not look like the price of a component.
        took = statistics.median(seconds) * steps if seconds else 0.0
        exposure = fitting.parts.exposure
        found = exposure.log_gains().detach().clone() if exposure is not None else None
        return Trial(errors, errors if halfway is None else halfway, self._counts, took, steps, found)

    def _draws(self) -> Callable[[], tuple[Tensor, Tensor]]:
        """Directions and colours of pixels of all photos, as if nothing stood before what is far away: what a field
        without a background put there is cut away when it gets one."""
        generator = torch.Generator(device=self._pool.colours.device).manual_seed(SEED)

        def seen() -> tuple[Tensor, Tensor]:
            drawn = self._pool.draw(JUDGED_PIXELS, generator)
            shown = slice(None) if self._sky is None else self._sky[drawn.numbers]
            return drawn.directions[shown], drawn.colours[shown, :3]

        return seen

    def _fitting(self, components: Components, *, seed: int, log_gains: Tensor | None, cameras_from: float) -> Fitting:
        # A trial is a short training, whatever comes after it.
        rows = min(self._settings.chosen_log2_rows, FEWEST_LOG2_ROWS)
        settings = replace(self._settings, components=components, seed=seed, log2_rows=rows)
        return Fitting(
            self._pool,
            self._extent.before(components.background).marching,
            contraction=self._extent.contraction,
            settings=settings,
            log_gains=log_gains,
            log_focal=self._log_focal,
            cameras_from=cameras_from,
            points=self._points if components.points else None,
            sky=self._sky if components.background == "sphere" else None,
            error_map=ErrorMap(self._pool) if components.pixels == "error" else None,
            movers=Movers(self._pool) if components.movers else None,
        )

    def _take_up(self, fitting: Fitting, start: TrialStart) -> None:
        """Bring a fresh training to `start`, but for its random numbers and for what only its own model has."""
        own, _ = fitting.state()
        kept = {name: tensor for name, tensor in own.items() if name == "generator" or name.startswith("parts")}
        of_field = {name: tensor.clone() for name, tensor in start.tensors.items() if not name.startswith("parts")}
        fitting.restore({**of_field, **kept}, start.description)
        if isinstance(fitting.field, HashField):
            fitting.field.forget_directions(start.description["field"]["view_degree"])

    def _advance(self, fitting: Fitting, fraction: float) -> float:
        """Take a step; return it and the seconds it took."""
        began = time.perf_counter()
        fitting.advance(fraction)
        self._room.release_pages()
        return time.perf_counter() - began

    @torch.no_grad()
    def _errors(self, fitting: Fitting) -> np.ndarray:
        """(photos,) squared differences of the judged pixels, summed."""
        fitting.settle()
        rendered, measured = fitting.compare(self._judged)
        errors = (rendered.clamp(0.0, 1.0) - measured).square().sum(-1).double().cpu().numpy()
        return np.bincount(self._photos, errors, len(self._counts))


def _blocks(shape: tuple[int, ...], generator: np.random.Generator) -> np.ndarray:
    """(H, W) bool: the blocks of a photo that are judged, at least one."""
    block = max(1, min(BLOCK_PX, min(shape[:2]) // 4))
    rows, columns = (-(-side // block) for side in shape[:2])
    chosen = generator.random((rows, columns)) < BLOCK_SHARE
    chosen.flat[generator.integers(chosen.size)] = True
    return np.kron(chosen, np.ones((block, block), bool))[: shape[0], : shape[1]]


def _split(photos: Sequence[LoadedPhoto], storage: PhotoStorage) -> tuple[list[LoadedPhoto], np.ndarray]:
    """Return the photos without the blocks that are judged, and numbers of pixels of those blocks, counted through all
    photos: as many of each photo, as far as it has them."""
    generator = np.random.default_rng(SEED)
    sizes = [photo.pixels.shape[0] * photo.pixels.shape[1] for photo in photos]
    masks = storage.array((sum(sizes),), bool)
    seen, numbers = [], []
    for photo, size, end in zip(photos, sizes, np.cumsum(sizes).tolist(), strict=True):
        judged = _blocks(photo.pixels.shape[:2], generator)
        used = masks[end - size : end].reshape(judged.shape)
        np.logical_not(judged, out=used)
        if photo.used is not None:
            used &= photo.used
            judged &= photo.used
        seen.append(replace(photo, used=used))
        places = generator.permutation(np.flatnonzero(judged))[: max(1, JUDGED_PIXELS // len(photos))]
        rows, columns = np.divmod(places, judged.shape[1])
        valid = photo.frame.camera.bearings(np.stack([columns, rows], axis=-1) + 0.5)[1]
        numbers.append(end - size + places[valid])
        storage.release_pages()
    return seen, np.concatenate(numbers)
