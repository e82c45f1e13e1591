"""Evidence from the training photos before training: known distances, exposures, the sky, what hides surfaces."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from nerfcli.matching.correspondences import SharedFeatures
from nerfcli.matching.exposures import matched_log_gains
from nerfcli.matching.occluders import occluder_masks
from nerfcli.matching.sky import PointsBefore, points_before, sky_masks
from nerfcli.matching.stereo import LEAST_SIDE_PX, DenseDepth, affordable_side_px, dense_depths
from nerfcli.photos.exif import log_exposures
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.render.held_out_exposure import exif_slope
from nerfcli.training.extent import Extent
from nerfcli.training.point_depth import PointDepths, point_depths, stereo_depths
from nerfcli.training.pool import Album, PixelPool
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.selection.selection import LEAST_SKY_FRACTION

# Fraction of the budget that stereo matching may take.
STEREO_FRACTION = 0.06
# Fewer photos with EXIF exposures cannot confirm the matched ones.
FEWEST_EXIF = 5


class Evidence:
    """Depth, exposures and sky, estimated from the training photos alone, each on first use.

    Args:
        shared: features and points of the photos.
        album, pool: the photos, and their pixels in the training frame.
        extent: of the field.
        settings: of the training; its budget determines the size of the pictures that are matched.
    """

    def __init__(
        self,
        shared: SharedFeatures,
        album: Album,
        pool: PixelPool,
        extent: Extent,
        settings: TrainSettings,
        notify: Callable[[str], None],
    ):
        self.shared, self.album, self.pool, self.settings = shared, album, pool, settings
        self.extent, self.notify = extent, notify
        self.stereo_seconds = 0.0
        budget = settings.budget_seconds
        # A training by steps must give the same result on all machines: without a time budget, ignore the threads.
        seconds, threads = (60.0, 1) if budget is None else (STEREO_FRACTION * budget, settings.threads)
        self.side_px = affordable_side_px(album.photos, seconds=seconds, threads=threads)

    @cached_property
    def track_depths(self) -> PointDepths:
        """Depths of points from structure from motion, or of matched features."""
        return point_depths(self.shared.tracks, self.pool, self.extent.training_from_scene)

    @cached_property
    def _dense(self) -> list[DenseDepth]:
        began = time.perf_counter()
        found = dense_depths(
            self.album.photos,
            self.shared.tracks,
            longer_side_px=self.side_px or LEAST_SIDE_PX,
            threads=self.settings.threads,
        )
        self.stereo_seconds += time.perf_counter() - began
        return found

    @cached_property
    def _matched_log_gains(self) -> np.ndarray:
        dense = self._dense
        began = time.perf_counter()
        found = matched_log_gains(self.album.photos, dense)
        self.stereo_seconds += time.perf_counter() - began
        return found

    @cached_property
    def log_gains(self) -> np.ndarray:
        """Logarithms of exposures from pixels that several photos share, (photos, 3); NaN where unknown.

        All are NaN if EXIF does not confirm them: surfaces that look brighter from one side differ between photos just
        as exposures do, and their differences add up along a ring of cameras. Only a user who asks for
        exposure=matched gets them without EXIF.
        """
        found = self._matched_log_gains
        if self.settings.components.exposure == "matched":
            return found
        exif = log_exposures([photo.frame for photo in self.album.photos])
        measured = np.isfinite(found).all(1) & np.isfinite(exif)
        if measured.sum() < FEWEST_EXIF or exif_slope(np.flatnonzero(measured), found[measured], exif[measured]) == 0.0:
            return np.full_like(found, np.nan)
        return found

    def matched_gains_or(self, others: Tensor) -> Tensor:
        """Return `log_gains` (photos, 3), with the values of `others` where unknown."""
        measured = torch.from_numpy(self.log_gains).to(others)
        return torch.where(measured.isfinite(), measured, others)

    @property
    def exposure_spread(self) -> float:
        """Standard deviation of the photos' log brightness in matched pixels; 0 if nothing is known."""
        measured = self.log_gains[np.isfinite(self.log_gains).all(1)]
        return float(measured.mean(1).std()) if len(measured) else 0.0

    @cached_property
    def _sky_masks(self) -> list[np.ndarray]:
        return sky_masks(self.album.photos, threads=self.settings.threads)

    @cached_property
    def _points_before_sky(self) -> PointsBefore:
        # Tracks from matches would have two photos each.
        return points_before(self._sky_masks, self.album.photos, self.shared.of_model)

    @cached_property
    def sky_fraction(self) -> float:
        """Fraction of the pixels that look like a sky; 0 if that is enough for one, but 3D points are in front."""
        found = sum(int(mask.sum()) for mask in self._sky_masks) / sum(mask.size for mask in self._sky_masks)
        return 0.0 if found > LEAST_SKY_FRACTION and self._points_before_sky.refute else found

    @property
    def sky_confirmed(self) -> bool:
        """Whether these pixels are enough for a sky, and 3D points are everywhere else."""
        return self.sky_fraction > LEAST_SKY_FRACTION and self._points_before_sky.confirm

    @cached_property
    def sky(self) -> Tensor | None:
        """Pixels of the pool that look like a sky, (pixels,) bool; None if they are too few to be one."""
        if self.sky_fraction <= LEAST_SKY_FRACTION:
            return None
        return torch.from_numpy(np.concatenate([mask.ravel() for mask in self._sky_masks])).to(self.pool.colours.device)

    @cached_property
    def occluders(self) -> list[np.ndarray]:
        """Masks (H, W) of the photos' pixels where something hides a surface that other photos see."""
        dense, gains, skies = self._dense, self._matched_log_gains, self._sky_masks
        began = time.perf_counter()
        found = occluder_masks(self.album.photos, dense, skies, gains, threads=self.settings.threads)
        self.stereo_seconds += time.perf_counter() - began
        return found

    @property
    def occluded_fraction(self) -> float:
        """Fraction of the pixels that `occluders` contain."""
        return sum(int(mask.sum()) for mask in self.occluders) / sum(mask.size for mask in self.occluders)

    @property
    def photos_without_occluders(self) -> list[LoadedPhoto]:
        """The photos, with `used` False where there are occluders."""
        return [
            replace(photo, used=~mask if photo.used is None else photo.used & ~mask)
            for photo, mask in zip(self.album.photos, self.occluders, strict=True)
        ]

    @cached_property
    def stereo_depths(self) -> PointDepths:
        """Depths from stereo matching."""
        found = stereo_depths(self._dense, self.pool, self.extent.training_from_scene)
        self.notify(
            f"stereo matching: the depth of {len(found.numbers)} pixels of the training photos, "
            f"{self.stereo_seconds:.1f} s"
        )
        return found

    def depths_for(self, components: Components) -> list[PointDepths]:
        """Return the sets of depths that a model with points uses."""
        found = [self.track_depths, self.stereo_depths] if components.stereo else [self.track_depths]
        return [depths.among(self.pool) for depths in found]
