"""Trials: short trainings that differ in one thing, judged on blocks of the training photos that none of them sees.

A training of the simplest model comes first. All trials continue from its state, each with a change or with none, so
that they differ only by the change and not by their start, and each is short.

The held-out photos of the scene are not used: a model chosen with them could not be measured on them.
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
from nerfcli.photos.colours import psnr_of
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training.extent import Extent
from nerfcli.training.fitting import Fitting
from nerfcli.training.point_depth import PointDepths, PointRays
from nerfcli.training.pool import PixelPool
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.settings import FEWEST_LOG2_ROWS, TrainSettings
from nerfcli.training.selection.diagnostics import Diagnostics, diagnose, paint
from nerfcli.training.step import compare, light_from_beyond
from nerfcli.training.storage import IN_MEMORY, PhotoStorage

JUDGED_PIXELS = 8192
# Fraction of the schedule at which the first training stops and the trials continue.
FORK_FRACTION = 0.6
# Seed of the choice of blocks and pixels: the same for all candidates of a scene, and not that of any training.
SEED = 20_211


@dataclass(frozen=True)
class Trial:
    """Result of a short training.

    Args:
        errors: (photos,) sums of squared differences of the judged pixels of each photo, sRGB.
        halfway: the same after half of its steps.
        counts: (photos,) numbers of values that were summed.
        seconds: that it took.
        log_gains: (photos, 3) exposures of its model; None if it has none.
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
        seconds: that it took.
        trial: its result.
        signs: diagnostics from its residuals.
    """

    tensors: dict[str, Tensor]
    description: dict[str, Any]
    seconds: float
    trial: Trial
    signs: Diagnostics

    @property
    def steps(self) -> int:
        """Number of its steps."""
        return self.trial.steps


class Trials:
    """Trainings of one scene on the same pixels.

    Args:
        settings: of the training that the trials are for; seed and components are given with each trial.
        exif: (photos,) logarithms of EXIF exposures, relative to their mean.
        log_focal: see `Fitting`.
        depths: sets of pixels whose distance is known.
        log_gains: (photos, 3) exposures from matched pixels, NaN where unknown; None if they are not used.
        sky: see `Fitting`.
        colours, storage: see `PixelPool`.

    Raises:
        UserError: masks leave no pixels to judge by.
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
        # Small steps throughout: they learn more per sample, and a short training has few samples.
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
        """Train from the beginning to `FORK_FRACTION` of a schedule.

        Args:
            steps: largest number of steps.
            seconds: time limit; the result tells how many steps were taken.
            fewest: smallest number of steps, for which up to twice the time is used; end early if it is out of reach.

        Returns:
            The state; None if there were fewer than the fewest steps.
        """
        gains = self._log_gains if components.exposure in ("matched", "learned") else None
        fitting = self._fitting(components, seed=self._settings.seed, log_gains=gains, cameras_from=0.0)
        took: list[float] = []

        def fraction() -> float:
            enough = fitting.step / fewest if fewest else math.inf
            return max(fitting.step / steps, sum(took) / (2.0 * seconds), min(sum(took) / seconds, enough))

        def is_in_vain() -> bool:
            # Ten steps tell within a factor of 1.25 how many the time allows, even on a machine slowed by other work.
            return len(took) == 10 and statistics.median(took) * fewest > 2.0 * 1.25 * seconds

        while fraction() < 1.0 and not is_in_vain():
            took.append(self._advance(fitting, FORK_FRACTION * fraction()))
        if fitting.step < fewest:
            return None
        drawn = self._pool.draw(JUDGED_PIXELS, fitting.generator)
        with torch.no_grad():
            rendered, measured = compare(fitting, drawn, fitting.plan)
        reach = self._extent.reach
        signs = diagnose(
            rendered,
            measured,
            self._pool.photo_of(drawn.numbers),
            directions=drawn.directions,
            from_beyond=light_from_beyond(fitting, drawn, fitting.plan, distance=math.inf if reach is None else reach),
            count=len(self._counts),
        )
        tensors, description = fitting.state()
        copies = {name: tensor.clone() for name, tensor in tensors.items()}
        errors = self._errors(fitting)
        trial = Trial(errors, errors, self._counts, statistics.median(took) * len(took), fitting.step)
        return TrialStart(copies, description, sum(took), trial, signs)

    def go_on(self, start: TrialStart, components: Components, *, seed: int, steps: int) -> Trial:
        """Continue from `start` to the end of the schedule with other components, and measure.

        Args:
            start: from `begin`.
            components: of the model from here on. New parts begin so that they change nothing: new harmonics with no
                weight, exposures as in the residuals.
            seed: of everything random; candidates with the same seed draw the same pixels.
        """
        learned = start.signs.log_gains if self._log_gains is None else self._log_gains
        gains = {"exif": self._exif, "matched": self._log_gains, "learned": learned}.get(components.exposure)
        fitting = self._fitting(components, seed=seed, log_gains=gains, cameras_from=FORK_FRACTION)
        self._take_up(fitting, start)
        if fitting.appearance.background is not None:
            paint(fitting.appearance.background, self._draws())
        seconds, halfway = [], None
        for done in range(steps):
            if halfway is None and 2 * done >= steps:
                halfway = self._errors(fitting)
            seconds.append(self._advance(fitting, FORK_FRACTION + (1.0 - FORK_FRACTION) * done / steps))
        errors = self._errors(fitting)
        # A median, so that other work on the machine does not look like the cost of a component.
        took = statistics.median(seconds) * steps if seconds else 0.0
        exposure = fitting.appearance.exposure
        found = exposure.log_gains().detach().clone() if exposure is not None else None
        return Trial(errors, errors if halfway is None else halfway, self._counts, took, steps, found)

    def _draws(self) -> Callable[[], tuple[Tensor, Tensor]]:
        """Return a source of directions and colours of pixels, of the sky alone if its pixels are known.

        Otherwise they are pixels of all kinds, as if nothing were in front of the background: what the field has put
        far away is cut off when it gets one.
        """
        generator = torch.Generator(device=self._pool.colours.device).manual_seed(SEED)

        def seen() -> tuple[Tensor, Tensor]:
            drawn = self._pool.draw(JUDGED_PIXELS, generator)
            shown = slice(None) if self._sky is None else self._sky[drawn.numbers]
            return drawn.directions[shown], drawn.colours[shown, :3]

        return seen

    def _fitting(self, components: Components, *, seed: int, log_gains: Tensor | None, cameras_from: float) -> Fitting:
        # A trial is a short training, however long the training after it.
        rows = min(self._settings.chosen_log2_rows, FEWEST_LOG2_ROWS)
        settings = replace(self._settings, components=components, seed=seed, log2_rows=rows)
        sky = self._sky if components.background == "sphere" else None
        return Fitting(
            self._pool,
            self._extent.before(components.background, sky_known=sky is not None).marching,
            contraction=self._extent.contraction,
            settings=settings,
            log_gains=log_gains,
            log_focal=self._log_focal,
            cameras_from=cameras_from,
            points=self._points if components.points else None,
            sky=sky,
        )

    def _take_up(self, fitting: Fitting, start: TrialStart) -> None:
        """Bring a fresh training to `start`, except for its random numbers and the parts besides the field."""
        own, _ = fitting.state()
        kept = {name: tensor for name, tensor in own.items() if name == "generator" or name.startswith("parts")}
        of_field = {name: tensor.clone() for name, tensor in start.tensors.items() if not name.startswith("parts")}
        fitting.restore({**of_field, **kept}, start.description)
        if isinstance(fitting.field, HashField):
            fitting.field.forget_directions(start.description["field"]["view_degree"])

    def _advance(self, fitting: Fitting, fraction: float) -> float:
        """Take a step, and return the seconds that it took."""
        began = time.perf_counter()
        fitting.advance(fraction)
        self._room.release_pages()
        return time.perf_counter() - began

    @torch.no_grad()
    def _errors(self, fitting: Fitting) -> np.ndarray:
        """Return the sums of squared differences of the judged pixels, (photos,)."""
        fitting.settle()
        rendered, measured = compare(fitting, self._judged, fitting.plan)
        errors = (rendered.clamp(0.0, 1.0) - measured).square().sum(-1).double().cpu().numpy()
        return np.bincount(self._photos, errors, len(self._counts))


def _blocks(shape: tuple[int, ...], generator: np.random.Generator) -> np.ndarray:
    """Return the pixels of a photo in judged blocks, (H, W) bool; there is at least one block."""
    # Single pixels between known neighbours would test interpolation only.
    block = max(1, min(12, min(shape[:2]) // 4))
    rows, columns = (-(-side // block) for side in shape[:2])
    chosen = generator.random((rows, columns)) < 0.06
    chosen.flat[generator.integers(chosen.size)] = True
    return np.kron(chosen, np.ones((block, block), bool))[: shape[0], : shape[1]]


def _split(photos: Sequence[LoadedPhoto], storage: PhotoStorage) -> tuple[list[LoadedPhoto], np.ndarray]:
    """Return the photos without the judged blocks, and judged pixels from these blocks, numbered through all photos.

    Each photo has the same number of judged pixels, as far as its blocks have them.
    """
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
