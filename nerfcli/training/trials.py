"""Trials: short trainings that differ in one thing, judged on blocks of the training photos that none of them sees.

A training of the simplest model comes first. All trials continue from its state, each with a change or with none, so
that they differ only by the change and not by their start, and each is short.

The held-out photos of the scene are not used: a model chosen with them could not be measured on them.
"""

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfcli.errors import UserError
from nerfcli.field.background import SphereBackground
from nerfcli.field.exposure import linear_from_srgb
from nerfcli.field.hash_field import HashField
from nerfcli.photos.colours import psnr_of
from nerfcli.photos.exif import log_exposures, mean_log_exposure, relative_log_exposures
from nerfcli.training.appearance import LEAST_LEVEL
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.optimiser import Adam
from nerfcli.training.pool import PixelPool, PointRays
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.settings import FEWEST_LOG2_ROWS
from nerfcli.training.schedule import FORK_PROGRESS, Budget
from nerfcli.training.step import compare, light_from_beyond
from nerfcli.training.storage import PhotoStorage

# Fewer pixels tell nothing about a sky, nor about the exposure of a photo.
FEWEST_PIXELS = 12


def paint(background: SphereBackground, seen: Callable[[], tuple[Tensor, Tensor]]) -> None:
    """Fit a background so that each direction has about the median colour of the pixels that look along it.

    Args:
        seen: returns directions (N, 3) and the sRGB colours (N, 3) along them; called once per step.
    """
    adam = Adam(background.parameters())
    for _ in range(30):
        directions, colours = seen()
        adam.zero_grad()
        (background(directions) - colours).abs().sum().backward()
        adam.step(0.3)
    adam.zero_grad()


def explained_by_direction(directions: Tensor, colours: Tensor, photos: Tensor) -> tuple[float, float]:
    """Return how well half of the photos predict the other half by one colour, and by a colour for each direction.

    A sky is in the same direction for all photos; surfaces are in a different one for each. Photos with even indices
    predict those with odd ones, their neighbours, which see the same part of a sky.

    Args:
        directions, colours, photos: (N, 3) unit, (N, 3) sRGB, and (N,) the indices of their photos.

    Returns:
        PSNR in dB of one colour, and of a colour by direction; infinite if either half has too few pixels.
    """
    tells = photos % 2 == 0
    if min(int(tells.sum()), int((~tells).sum())) < FEWEST_PIXELS:
        return math.inf, math.inf
    one = colours[tells].median(0).values
    with torch.enable_grad():
        background = SphereBackground(8).to(colours.device)  # coarse, because of the noise of few pixels
        background.logits.data += torch.logit(one.clamp(LEAST_LEVEL, 1.0 - LEAST_LEVEL))[:, None, None, None]
        paint(background, lambda: (directions[tells], colours[tells]))
    with torch.no_grad():
        predictions = (one, background(directions[~tells]))
    one_psnr, painted = (psnr_of(float((c - colours[~tells]).square().mean())) for c in predictions)
    return one_psnr, painted


# Levels that are compared in brightness: lower ones are noise, higher ones saturated.
DARKEST, BRIGHTEST = 0.06, 0.95


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostics of a scene from a short training.

    Args:
        log_gains: (photos, 3) logarithm of the ratio of each photo to its rendering, in linear light; their mean is 0.
        exposure_spread: standard deviation of the photos' log brightness, without the noise of its estimates.
        far_fraction: fraction of the pixels whose light comes mostly from so far away that it shows no parallax.
        sky_psnr: PSNR of these pixels predicted by one colour, and by a colour for each direction; see
            `explained_by_direction`.
    """

    log_gains: Tensor
    exposure_spread: float
    far_fraction: float
    sky_psnr: tuple[float, float]


def diagnose(
    rendered: Tensor, measured: Tensor, photos: Tensor, *, directions: Tensor, from_beyond: Tensor, count: int
) -> Diagnostics:
    """Compute the diagnostics from some pixels.

    The gain of a photo is the median over its pixels of log(measured / rendered), channel by channel: highlights and
    edges that the model does not have yet do not affect it.

    Args:
        rendered, measured: (N, 3) sRGB.
        photos: (N,) the photo index of each pixel.
        directions: (N, 3) unit directions of their rays.
        from_beyond: (N,) fractions of their light from beyond the distance at which a background would begin.
        count: of the photos.
    """
    compared = ((measured > DARKEST) & (measured < BRIGHTEST) & (rendered > DARKEST)).cpu().numpy()
    ratios = (linear_from_srgb(measured).log() - linear_from_srgb(rendered.clamp_min(DARKEST)).log()).cpu().numpy()
    of_photo = photos.cpu().numpy()
    far = from_beyond > 0.5
    far_fraction = float(far.float().mean())
    sky_psnr = explained_by_direction(directions[far], measured[far], photos[far])
    gains, errors = np.zeros((count, 3)), np.full(count, np.nan)
    for photo in range(count):
        mine = of_photo == photo
        good = mine & compared.all(-1)
        if good.sum() >= FEWEST_PIXELS:
            gains[photo] = np.median(ratios[good], axis=0)
            common = ratios[good].mean(-1)
            # Of a normal distribution: its deviation from the median absolute one, and the error of its median.
            deviation = 1.4826 * np.median(np.abs(common - np.median(common)))
            errors[photo] = 1.2533 * deviation / np.sqrt(good.sum())
    finite = np.isfinite(errors)
    if finite.sum() < 2:
        return Diagnostics(torch.zeros(count, 3), 0.0, far_fraction, sky_psnr)
    gains[finite] -= gains[finite].mean(0)
    excess = gains[finite].mean(-1).var(ddof=1) - np.square(errors[finite]).mean()
    return Diagnostics(
        torch.tensor(gains, dtype=torch.float32), float(np.sqrt(max(0.0, excess))), far_fraction, sky_psnr
    )


JUDGED_PIXELS = 8192
# Seed of the choice of blocks and pixels: the same for all candidates of a scene, and not that of any training.
SEED = 20_211


@dataclass(frozen=True)
class Trial:
    """Result of a short training.

    Args:
        errors: (photos,) sums of squared differences of the judged pixels of each photo, sRGB.
        halfway: the same after half of its steps.
        counts: (photos,) numbers of values that were summed.
        seconds: how long it took.
        log_gains: (photos, 3) exposures of its model; None if it has none.
    """

    errors: np.ndarray
    halfway: np.ndarray
    counts: np.ndarray
    seconds: float
    steps: int
    log_gains: Tensor | None = None


@dataclass(frozen=True)
class TrialStart:
    """State of the first training when it stopped, the seconds that it took, its result, and what it shows."""

    tensors: dict[str, Tensor]
    description: dict[str, Any]
    seconds: float
    trial: Trial
    signs: Diagnostics


class Trials:
    """Trainings of one scene on the same pixels.

    Args:
        inputs: of the training that the trials are for; seed and components are given with each trial. Exposures are
            those from pixels that photos share; None if they are not used.

    Raises:
        UserError: masks leave no pixels to judge by.
    """

    def __init__(self, inputs: TrainingInputs):
        settings, pool = inputs.settings, inputs.pool
        masks, numbers = _judged(pool, inputs.storage)
        if len(numbers) == 0:
            raise UserError(
                "no training pixels are left to compare components on", "remove the masks, or use --model default"
            )
        self._pool = pool.without(masks, storage=inputs.storage)
        self._scored = pool.rays_of(torch.from_numpy(numbers).to(pool.colours.device))
        self._photos = pool.photo_of(self._scored.numbers).cpu().numpy()
        self._counts = np.bincount(self._photos, minlength=len(pool.frames)) * 3
        exif = log_exposures(pool.frames)
        exif = relative_log_exposures(exif, mean_log_exposure(exif))
        self._exif = torch.from_numpy(exif).to(torch.float32)[:, None].expand(-1, 3)
        depths = [] if inputs.points is None else [one.among(self._pool) for one in inputs.points.sets]
        points = PointRays(depths, self._pool)
        # Small steps throughout: they learn more per sample, and a short training has few samples. It has few rows,
        # however long the training after it.
        rows = min(settings.chosen_log2_rows, FEWEST_LOG2_ROWS)
        settings = replace(settings, samples_per_step=settings.samples[0], log2_rows=rows)
        self._inputs = replace(inputs, pool=self._pool, settings=settings, points=points if points.sets else None)

    def begin(self, components: Components, budget: Budget, *, fewest: int = 0) -> TrialStart | None:
        """Train from the beginning to `FORK_PROGRESS` of a schedule.

        Args:
            budget: steps, and seconds if time is limited; the result tells how many steps were taken.
            fewest: smallest number of steps, for which up to twice the time is used; end early if it is out of reach.

        Returns:
            The state; None if there were fewer than the fewest steps.
        """
        gains = self._inputs.log_gains if components.exposure in ("matched", "learned") else None
        settings = replace(self._inputs.settings, components=components)
        fitting = Fitting(replace(self._inputs, settings=settings, log_gains=gains))
        took: list[float] = []
        seconds = math.inf if budget.seconds is None else budget.seconds

        def fraction() -> float:
            enough = fitting.step / fewest if fewest else math.inf
            by_steps = fitting.step / budget.steps if budget.steps else 0.0
            return max(by_steps, sum(took) / (2.0 * seconds), min(sum(took) / seconds, enough))

        def is_in_vain() -> bool:
            # Ten steps tell within a factor of 1.25 how many the time allows, even on a machine slowed by other work.
            return len(took) == 10 and statistics.median(took) * fewest > 2.0 * 1.25 * seconds

        while fraction() < 1.0 and not is_in_vain():
            took.append(self._advance(fitting, FORK_PROGRESS * fraction()))
        if fitting.step < fewest:
            return None
        drawn = self._pool.draw(JUDGED_PIXELS, fitting.generator)
        with torch.no_grad():
            rendered, measured = compare(fitting, drawn, fitting.plan)
        reach = self._inputs.extent.reach
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
            components: of the model from here on. New parts begin so that they change nothing: new harmonics with no
                weight, exposures as in the residuals.
            seed: of everything random; candidates with the same seed draw the same pixels.
        """
        matched = self._inputs.log_gains
        learned = start.signs.log_gains if matched is None else matched
        gains = {"exif": self._exif, "matched": matched, "learned": learned}.get(components.exposure)
        settings = replace(self._inputs.settings, components=components, seed=seed)
        fitting = Fitting(replace(self._inputs, settings=settings, log_gains=gains), cameras_from=FORK_PROGRESS)
        self._take_up(fitting, start)
        if fitting.appearance.background is not None:
            paint(fitting.appearance.background, self._draws())
        seconds, halfway = [], None
        for done in range(steps):
            if halfway is None and 2 * done >= steps:
                halfway = self._errors(fitting)
            seconds.append(self._advance(fitting, FORK_PROGRESS + (1.0 - FORK_PROGRESS) * done / steps))
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
            sky = self._inputs.sky
            shown = slice(None) if sky is None else sky[drawn.numbers]
            return drawn.directions[shown], drawn.colours[shown, :3]

        return seen

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
        self._inputs.storage.release_pages()
        return time.perf_counter() - began

    @torch.no_grad()
    def _errors(self, fitting: Fitting) -> np.ndarray:
        """Return the sums of squared differences of the judged pixels, (photos,)."""
        fitting.settle()
        rendered, measured = compare(fitting, self._scored, fitting.plan)
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


def _judged(pool: PixelPool, storage: PhotoStorage) -> tuple[list[np.ndarray], np.ndarray]:
    """Return masks (H, W) bool of the judged blocks of all photos, and judged pixels of a pool in these blocks.

    Each photo has the same number of judged pixels, as far as its blocks have them.
    """
    generator = np.random.default_rng(SEED)
    sizes, firsts = pool.sizes.tolist(), pool.first_pixel.tolist()
    room = storage.array((sum(height * width for height, width in sizes),), bool)
    masks, numbers = [], []
    for (height, width), first in zip(sizes, firsts, strict=True):
        mask = room[first : first + height * width].reshape(height, width)
        mask[...] = _blocks((height, width), generator)
        inside = torch.from_numpy(first + np.flatnonzero(mask)).to(pool.colours.device)
        places = generator.permutation(inside[pool.is_usable(inside)].cpu().numpy())
        masks.append(mask)
        numbers.append(places[: max(1, JUDGED_PIXELS // len(sizes))])
        storage.release_pages()
    return masks, np.concatenate(numbers)
