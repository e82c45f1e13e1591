"""Short trainings that differ in one thing, judged on blocks of the training photos that none of them sees.

The held-out photos of the scene take no part in this: what is chosen by looking at them could not be measured on them.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nerfcli.train.components import Components
from nerfcli.train.error_map import ErrorMap
from nerfcli.train.extent import Extent
from nerfcli.train.fitting import Fitting
from nerfcli.train.photos import Photo, PixelPool
from nerfcli.train.settings import TrainSettings

# Photos are judged by squares of this side: single pixels between known neighbours would judge interpolation.
BLOCK_PX = 12
BLOCK_SHARE = 0.06
JUDGED_PIXELS = 8192
# The choice of blocks and pixels: the same for all candidates of a scene, and not that of any training.
SEED = 20_211


@dataclass(frozen=True)
class Trial:
    """What a short training achieved.

    Args:
        errors: (photos,) sums of squared differences of the judged pixels of each photo, sRGB.
        halfway: the same after half of the schedule.
        counts: (photos,) values that were summed.
        seconds: it took.
        steps: it went.
    """

    errors: np.ndarray
    halfway: np.ndarray
    counts: np.ndarray
    seconds: float
    steps: int

    @property
    def psnr(self) -> float:
        """In dB over all judged pixels."""
        return self._psnr(self.errors)

    @property
    def psnr_halfway(self) -> float:
        """The same after half of the schedule."""
        return self._psnr(self.halfway)

    def _psnr(self, errors: np.ndarray) -> float:
        return -10.0 * math.log10(max(float(errors.sum() / self.counts.sum()), 1e-12))


class Trials:
    """Trainings of one scene on the same pixels.

    Args:
        photos: those to train on.
        extent: of the field.
        settings: of the training that the trials are for; seed and components are given with each trial.
        log_gains: see `Fitting`.

    Raises:
        UserError: masks leave nothing to judge by.
    """

    def __init__(
        self,
        photos: Sequence[Photo],
        extent: Extent,
        *,
        settings: TrainSettings,
        log_gains: Tensor | None,
    ):
        device = torch.device(settings.device)
        generator = np.random.default_rng(SEED)
        judged = [_blocks(photo.pixels.shape[:2], generator) for photo in photos]
        seen = [_without(photo, blocks) for photo, blocks in zip(photos, judged, strict=True)]
        hidden = [_without(photo, ~blocks) for photo, blocks in zip(photos, judged, strict=True)]
        self._pool = PixelPool(seen, extent.training_from_scene, device)
        self._judged = PixelPool(hidden, extent.training_from_scene, device).draw(
            JUDGED_PIXELS, torch.Generator(device=device).manual_seed(SEED)
        )
        self._photos = self._pool.photo_of(self._judged.numbers).cpu().numpy()
        self._num_photos = len(photos)
        self._extent = extent
        # Small steps all along: they learn more from a sample, which is what a short training has few of.
        self._settings = replace(settings, samples_per_step=settings.first_samples_per_step)
        self._log_gains = log_gains

    def run(self, components: Components, *, seed: int, steps: int | None, seconds: float | None = None) -> Trial:
        """Train from the beginning to the end of a schedule, and judge.

        Args:
            components: what is in the model.
            seed: of everything random; candidates with the same one draw the same pixels.
            steps: to go.
            seconds: instead of steps; how many were gone then is in the answer.
        """
        settings = replace(self._settings, components=components, seed=seed)
        fitting = Fitting(
            self._pool,
            self._extent.marching,
            contraction=self._extent.contraction,
            settings=settings,
            log_gains=self._log_gains,
            error_map=ErrorMap(self._pool) if components.pixels == "error" else None,
        )
        took, halfway = 0.0, None
        while (share := fitting.step / steps if steps is not None else took / (seconds or math.inf)) < 1.0:
            if halfway is None and share >= 0.5:
                halfway = self._errors(fitting)
            began = time.perf_counter()
            fitting.advance(share)
            took += time.perf_counter() - began
        errors = self._errors(fitting)
        counts = np.bincount(self._photos, minlength=self._num_photos) * 3
        return Trial(errors, errors if halfway is None else halfway, counts, took, fitting.step)

    @torch.no_grad()
    def _errors(self, fitting: Fitting) -> np.ndarray:
        """(photos,) squared differences of the judged pixels, summed."""
        rendered, measured = fitting.compare(self._judged)
        errors = (rendered.clamp(0.0, 1.0) - measured).square().sum(-1).double().cpu().numpy()
        return np.bincount(self._photos, errors, self._num_photos)


def _blocks(shape: tuple[int, ...], generator: np.random.Generator) -> np.ndarray:
    """(H, W) bool: the blocks of a photo that are judged, at least one."""
    rows, columns = (-(-side // BLOCK_PX) for side in shape[:2])
    chosen = generator.random((rows, columns)) < BLOCK_SHARE
    chosen.flat[generator.integers(chosen.size)] = True
    return np.kron(chosen, np.ones((BLOCK_PX, BLOCK_PX), bool))[: shape[0], : shape[1]]


def _without(photo: Photo, hidden: np.ndarray) -> Photo:
    used = ~hidden if photo.used is None else photo.used & ~hidden
    return replace(photo, used=used)
