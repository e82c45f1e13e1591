"""Prepare a training: load photos and rays, choose the extent of the field, and select components.

Of held-out photos, only the image sizes of their cameras are read here.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfcli import distributed
from nerfcli.captures.capture import Capture
from nerfcli.captures.loading import refuse_without_training_photos
from nerfcli.captures.model_tracks import tracks_of_model
from nerfcli.errors import UserError, reason_of
from nerfcli.matching.camera_check import CameraCheck, check_cameras
from nerfcli.matching.correspondences import SharedFeatures
from nerfcli.matching.tracks import triangulate
from nerfcli.memory import default_memory_limit
from nerfcli.photos.exif import log_exposures, mean_log_exposure, relative_log_exposures
from nerfcli.training.evidence import Evidence
from nerfcli.training.extent import Extent, choose_extent, lacks_depth
from nerfcli.training.fitting import Fitting
from nerfcli.training.point_depth import PointDepths, PointRays
from nerfcli.training.pool import Album, PixelPool, load_album
from nerfcli.training.runs.components import Components, Selection
from nerfcli.training.runs.settings import TrainSettings, automatic_downscale
from nerfcli.training.selection.selection import (
    LEARN_FOCAL,
    SEARCH_FRACTION,
    Facts,
    is_worth_a_search,
    may_use_points,
    may_use_stereo,
    select,
    with_evidence,
    with_known_cameras,
)
from nerfcli.training.selection.trials import Trials
from nerfcli.training.storage import PhotoStorage, check_device_memory, needs_of, storage_for

# Fraction of a search that matching photos may take.
MATCHING_FRACTION = 0.5


@dataclass(frozen=True)
class EarlierDecisions:
    """Decisions of an interrupted training."""

    extent: Extent
    components: Components
    selection: Selection | None


@dataclass(frozen=True)
class Prepared:
    """The data of a training, and the decisions made for it.

    Args:
        settings: with the components that were chosen.
        factor: photos are averaged over squares of this side in pixels.
        storage: where arrays of the size of the photos are kept.
        selection: result of the automatic selection of components; None if there was none.
        log_exposure: mean log exposure of the training photos by EXIF; None if unknown or not used.
        log_gains: (photos, 3) logarithms of their exposures relative to it: from matched pixels, NaN where unknown, for
            exposure=matched; else from the trials, from matched pixels or from EXIF, 0 where unknown.
        log_focal: logarithm of the initial factor of focal lengths.
        points: pixels whose distance is known, if the components use them.
        seconds: of the budget, spent on all this.
        sky: (pixels,) bool, the pixels of the pool that look like a sky; None if no sky is learned or known.
        occluders: for each photo of the pool the mask (height, width) bool of the pixels that are left out because
            something hides a surface there; None if the components keep them.
    """

    settings: TrainSettings
    factor: int
    storage: PhotoStorage
    extent: Extent
    pool: PixelPool
    selection: Selection | None
    log_exposure: float | None
    log_gains: Tensor
    log_focal: float
    points: PointRays | None
    seconds: float
    sky: Tensor | None
    occluders: list[np.ndarray] | None

    def fitting(self) -> Fitting:
        """Return the training before its first step."""
        return Fitting(
            self.pool,
            self.extent.marching,
            contraction=self.extent.contraction,
            parallax=self.extent.parallax,
            settings=self.settings,
            log_gains=self.log_gains,
            log_focal=self.log_focal,
            points=self.points,
            sky=self.sky,
        )


def load_training_photos(
    scene: Capture,
    settings: TrainSettings,
    *,
    run: Path,
    memory_bytes: int | None,
    notify: Callable[[str], None],
) -> tuple[int, PhotoStorage, Album]:
    """Load the training photos; return the factor of reduction, the storage for further arrays, and the photos.

    Args and raises: see `prepare`.
    """
    refuse_without_training_photos(scene)
    first = scene.train_frames[0].camera
    factor = settings.downscale or automatic_downscale(first)
    needs = needs_of((*scene.train_frames, *scene.test_frames), factor, settings=settings)
    device = torch.device(settings.device)
    if device.type == "cuda":
        notify(check_device_memory(needs, device, memory_bytes))
        memory_bytes = default_memory_limit()
    storage, text = storage_for(needs, memory_bytes, folder=run)
    notify(text)
    masks = settings.components.masks
    album = load_album(scene.train_frames, factor=factor, threads=settings.threads, storage=storage, masks=masks)
    return factor, storage, album


def prepare(
    scene: Capture,
    settings: TrainSettings,
    *,
    run: Path,
    memory_bytes: int | None,
    begun: EarlierDecisions | None,
    notify: Callable[[str], None],
) -> Prepared:
    """Load the training photos and choose extent, components and initial exposures.

    Of several processes that train together, each loads the photos, and the first one chooses.

    Args:
        scene: photos, cameras and split.
        run: folder for temporary files that hold what does not fit into memory.
        memory_bytes: limit of resident memory, or of GPU memory.
        begun: decisions of a training that is resumed; None for a new one.

    Raises:
        UserError: too little memory, no training photo, unreadable photos.
    """
    factor, storage, album = load_training_photos(scene, settings, run=run, memory_bytes=memory_bytes, notify=notify)
    device = torch.device(settings.device)
    shared = SharedFeatures(album.photos, lambda: tracks_of_model(scene, album.photos), threads=settings.threads)
    if begun is not None:
        extent, settings = begun.extent, replace(settings, components=begun.components)
    else:
        extent = distributed.from_first(lambda: _extent(scene, settings, album, shared, notify=notify))
    pool = PixelPool(album.photos, extent.training_from_scene, device, colours=album.colours, storage=storage)
    camera = album.photos[0].frame.camera
    notify(
        f"{len(album.photos)} training photos, {len(scene.test_frames)} held out, "
        f"{camera.width}x{camera.height} (1/{factor}), {extent}, {settings.device}, {_threads(settings.threads)}"
    )
    if pool.without_ray:
        notify(f"{pool.without_ray} pixels are skipped: they lie outside the lens model's field of view")
    evidence = Evidence(shared, album, pool, extent, settings, notify)
    selection, log_focal = None, 0.0
    if begun is None and settings.model == "auto":
        began = time.perf_counter()
        selection = distributed.from_first(lambda: _search(scene, evidence, storage=storage, began=began))
        settings, log_focal = replace(settings, components=selection.components), selection.log_focal
    elif begun is None and settings.components.cameras in LEARN_FOCAL:
        log_focal = distributed.from_first(lambda: _log_focal(scene, evidence))
    sky = distributed.from_first(lambda: evidence.sky) if settings.components.background == "sphere" else None
    extent = extent.before(settings.components.background, sky_known=sky is not None)
    reference, gains = _exposures(scene, settings.components, notify=notify)
    if selection is not None and selection.log_gains is not None:
        gains = selection.log_gains
    elif settings.components.exposure == "matched":
        gains = torch.from_numpy(distributed.from_first(lambda: evidence.log_gains))
        known = int(gains.isfinite().all(1).sum())
        others = "" if known == len(gains) else "; the others are learned"
        notify(f"matched pixels give the exposure of {known} of {len(gains)} photos{others}")
    elif settings.components.exposure == "learned" and settings.components.stereo:
        gains = distributed.from_first(lambda: evidence.matched_gains_or(gains))
    occluders, points = None, None
    if settings.components.occluders:
        occluders = distributed.from_first(lambda: evidence.occluders)
        pool.leave_out(occluders, storage=storage)
    if settings.components.points:
        points = PointRays(distributed.from_first(lambda: _depths(scene, settings, evidence)), pool)
    seconds = distributed.from_first(lambda: evidence.stereo_seconds if selection is None else selection.seconds)
    return Prepared(
        settings,
        factor,
        storage,
        extent,
        pool,
        selection,
        reference,
        gains,
        log_focal,
        points,
        seconds,
        sky,
        occluders,
    )


def _extent(
    scene: Capture, settings: TrainSettings, album: Album, shared: SharedFeatures, *, notify: Callable[[str], None]
) -> Extent:
    """Return the extent of the field; without 3D points, from triangulated ones if it needs any."""
    if lacks_depth(scene, settings, fills_frame=album.fills_frame):
        frames = [photo.frame for photo in album.photos]
        scene = replace(scene, points=triangulate(frames, shared.of_matches).found)
        notify(f"the scene has no 3D points; estimating its extent from {len(scene.points)} triangulated ones")
    return choose_extent(scene, settings, fills_frame=album.fills_frame)


def _log_focal(scene: Capture, evidence: Evidence) -> float:
    """Return the logarithm of the initial factor of focal lengths, and report how it was found."""
    _, log_focal, decisions = with_known_cameras(evidence.settings.components, _facts(scene, evidence))
    for decision in decisions:
        evidence.notify(decision.in_words())
    return log_focal


def _depths(scene: Capture, settings: TrainSettings, evidence: Evidence) -> list[PointDepths]:
    """Return the sets of pixels at known distances that are drawn from in each step."""
    sets = evidence.depths_for(settings.components)
    if not any(len(depths.numbers) for depths in sets):
        raise UserError(
            f"--with points: no 3D point could be triangulated from the photos of {scene.root}",
            "use a scene written by nerfcli poses or a COLMAP model, or remove --with points",
        )
    if settings.model != "auto" or "points" in settings.fixed:  # else the decision on points reports it
        evidence.notify(f"points: {len(evidence.track_depths.numbers):,} pixels see a 3D point at a known distance")
    return sets


def _threads(count: int) -> str:
    return f"{count} {'thread' if count == 1 else 'threads'}"


def _facts(scene: Capture, evidence: Evidence) -> Facts:
    """Collect facts about the scene before training."""
    album, shared, settings = evidence.album, evidence.shared, evidence.settings
    lacks_points = album.fills_frame and len(scene.points) == 0
    budget = settings.budget_seconds
    has_time = is_worth_a_search(budget, settings.steps) and (
        budget is None or shared.matching_seconds <= MATCHING_FRACTION * SEARCH_FRACTION * budget
    )
    facts = Facts(
        settings.field,
        has_alpha=album.colours.shape[-1] == 4,
        has_exif=bool(np.ptp(_exif(scene)) > 0.0),
        cameras_known=_known(scene) or (None if has_time else "the budget is too short to match photos"),
        cameras=_camera_check(evidence) if lacks_points and has_time else None,
        photos=len(album.photos),
        fixed=settings.fixed,
    )
    if not facts.has_alpha and "background" not in facts.fixed:
        facts = replace(facts, sky_fraction=evidence.sky_fraction, sky_confirmed=evidence.sky_confirmed)
    if may_use_points(settings.components, facts) and (shared.of_model.count or has_time or settings.components.points):
        facts = replace(facts, points=len(evidence.track_depths.numbers))
        if may_use_stereo(settings.components, facts, has_time=bool(evidence.side_px)):
            stereo = len(evidence.stereo_depths.numbers)
            facts = replace(
                facts,
                stereo=stereo,
                exposure_spread=evidence.exposure_spread,
                occluded_fraction=evidence.occluded_fraction if "occluders" not in facts.fixed else 0.0,
            )
    return facts


def _camera_check(evidence: Evidence) -> CameraCheck | None:
    """Check the cameras against matched features; None, with a note, if the check cannot be computed."""
    try:
        return check_cameras(evidence.album.photos, evidence.shared.matched)
    except Exception as error:
        evidence.notify(f"could not check the cameras against matched features: {reason_of(error)}")
        return None


def _search(scene: Capture, evidence: Evidence, *, storage: PhotoStorage, began: float) -> Selection:
    """Select components for the scene and report each decision."""
    facts = _facts(scene, evidence)
    album, settings, notify = evidence.album, evidence.settings, evidence.notify
    budget, steps = settings.budget_seconds, settings.steps
    if not is_worth_a_search(budget, steps):
        notify("the budget is too short for trials; only components that need no trial are selected")
        components, decisions = with_evidence(settings.components, facts)
        for decision in decisions:
            notify(decision.in_words())
        return Selection(components, tuple(decisions), time.perf_counter() - began)
    requested, log_focal, measured = with_known_cameras(settings.components, facts)
    model, _ = with_evidence(requested, facts)
    uses_matched = facts.exposure_spread > 0.0 or requested.exposure == "matched"
    trials = Trials(
        evidence.photos_without_occluders if model.occluders else album.photos,
        evidence.extent,
        settings=settings,
        exif=_exif(scene),
        log_focal=log_focal,
        depths=evidence.depths_for(model) if facts.points else [],
        log_gains=torch.from_numpy(evidence.log_gains) if uses_matched else None,
        sky=None if facts.has_alpha else evidence.sky,
        colours=album.colours,
        storage=storage,
    )
    took = time.perf_counter() - began
    seconds = None
    if budget is not None:
        seconds = max(1e-3, SEARCH_FRACTION * budget - took + evidence.stereo_seconds)
    notify(f"selecting components, for up to {100 * SEARCH_FRACTION:.0f} % of the budget")
    selection = select(
        trials,
        requested,
        facts,
        seconds=seconds,
        steps=None if steps is None else round(SEARCH_FRACTION * steps),
    )
    if not selection.decisions:
        notify("the budget is too short for trials; using the default components")
    decisions = (*measured, *selection.decisions)
    for decision in decisions:
        notify(decision.in_words())
    return replace(selection, decisions=decisions, seconds=selection.seconds + took, log_focal=log_focal)


def _exif(scene: Capture) -> np.ndarray:
    """Return the (photos,) logarithms of EXIF exposures relative to their mean."""
    return relative_log_exposures(scene.train_frames, mean_log_exposure(scene.train_frames))


def _known(scene: Capture) -> str | None:
    """Return the reason to trust the cameras, shown to the user; None if they may be wrong."""
    if scene.kind == "blender":
        return "these cameras are exact: the pictures were rendered with them"
    return "structure from motion has already optimized the cameras" if len(scene.points) else None


def _exposures(scene: Capture, components: Components, *, notify: Callable[[str], None]) -> tuple[float | None, Tensor]:
    """Return the mean log exposure of the training photos by EXIF, and theirs relative to it, (photos, 3)."""
    frames = scene.train_frames
    reference = None if components.exposure == "none" else mean_log_exposure(frames)
    if reference is not None:
        notify(f"EXIF gives the exposure of {np.isfinite(log_exposures(frames)).sum()} of {len(frames)} photos")
    gains = torch.from_numpy(relative_log_exposures(frames, reference))
    return reference, gains[:, None].expand(-1, 3)
