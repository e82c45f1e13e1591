"""Prepare a training: load photos, compute evidence from them, select components, and collect all in its inputs.

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
from nerfcli.errors import UserError, several
from nerfcli.machine import default_memory_limit
from nerfcli.matching.attached import attached_masks, masks_of
from nerfcli.matching.correspondences import SharedFeatures
from nerfcli.matching.plain_background import plain_background
from nerfcli.matching.tracks import triangulate
from nerfcli.photos.exif import mean_log_exposure, relative_log_exposures
from nerfcli.photos.loading import downscaled_camera
from nerfcli.training.evidence import LEARN_FOCAL, Evidence, TrainingPhotos, collect_evidence, tracks_of_model
from nerfcli.training.extent import Extent, choose_extent, fits_object_frame, lacks_depth
from nerfcli.training.fitting import TrainingInputs
from nerfcli.training.pool import Album, PixelPool, PointRays, load_album
from nerfcli.training.runs.components import LEARNED_BACKGROUNDS, Components, Selection
from nerfcli.training.runs.run import RunConfig
from nerfcli.training.runs.settings import TrainSettings, automatic_downscale
from nerfcli.training.schedule import SEARCH_FRACTION, Budget
from nerfcli.training.selection import Facts, select, with_evidence, with_known_cameras
from nerfcli.training.step import NonFiniteError
from nerfcli.training.storage import MASK_BYTES, check_device_memory, needs_of, storage_for
from nerfcli.training.trials import Trials

# Even a circular fisheye leaves a smaller fraction of a picture of 16:9 without rays.
MOST_WITHOUT_RAY = 0.6


@dataclass(frozen=True)
class EarlierDecisions:
    """Decisions of an interrupted training: the extent of its field, and its configuration."""

    extent: Extent
    config: RunConfig


def prepare(
    scene: Capture,
    settings: TrainSettings,
    *,
    run: Path,
    memory_bytes: int | None = None,
    begun: EarlierDecisions | None = None,
    notify: Callable[[str], None],
) -> TrainingInputs:
    """Return what a training begins from: photos and rays, evidence, and the decisions that rest on it.

    Of several processes that train together, each loads the photos, and the first one chooses.

    Args:
        run: folder for temporary files that hold what does not fit into memory.
        memory_bytes: limit of resident memory, or of GPU memory.
        begun: decisions of a training that is resumed; None for a new one.

    Raises:
        UserError: too little memory, no training photo, unreadable photos.
    """
    refuse_without_training_photos(scene)
    device, masks, threads = torch.device(settings.device), settings.components.masks, settings.threads
    factor = settings.downscale or automatic_downscale([frame.camera for frame in scene.train_frames])
    needs = needs_of((*scene.train_frames, *scene.test_frames), factor, settings=settings)
    if device.type == "cuda":
        notify(check_device_memory(needs, device, memory_bytes))
        memory_bytes = default_memory_limit()
    storage, text = storage_for(needs, memory_bytes, folder=run)
    notify(text)
    album = load_album(scene.train_frames, factor=factor, threads=threads, storage=storage, masks=masks)
    photos = _photos(scene, album, threads)
    photos = replace(photos, plain=_plain_background(photos, settings, None if begun is None else begun.extent))
    attached = distributed.from_first(lambda: _attached(photos, settings, factor, notify=notify))
    if attached:
        seen = tuple(photo.without(attached.get(photo.frame.name)) for photo in album.photos)
        photos = _photos(scene, replace(album, photos=seen), threads)
        if all(frame.mask is None for frame in scene.frames):  # else masks are counted already
            needs = replace(needs, photos=needs.photos + MASK_BYTES * sum(mask.size for mask in attached.values()))
            storage, _ = storage_for(needs, memory_bytes, folder=run)

    if begun is not None:
        settings = replace(settings, components=begun.config.components)
    extent = distributed.from_first(lambda: _extent(photos, settings, notify=notify) if begun is None else begun.extent)
    pool = PixelPool(photos.album, extent.training_from_scene, device, storage=storage)
    camera = pool.cameras[0]
    notify(
        f"{len(pool.frames)} training photos, {len(scene.test_frames)} held out, {camera.width}x{camera.height} "
        f"(1/{factor}), {extent}, {settings.device}, {several(threads, 'thread')}"
    )
    if pool.without_ray:
        notify(_without_ray(pool))
    inputs = TrainingInputs(settings, extent, pool, factor=factor, storage=storage, attached=attached)

    is_new = begun is None
    evidence, selection = distributed.from_first(lambda: _decide(photos, inputs, is_new=is_new, notify=notify))
    seconds = dict(evidence.seconds)
    log_focal = 0.0
    if selection is not None:
        seconds["trials"] = selection.seconds - sum(seconds.values())
        settings, log_focal = replace(settings, components=selection.components), selection.log_focal
    elif is_new and settings.model != "auto" and settings.components.cameras in LEARN_FOCAL:
        _, log_focal, decisions = with_known_cameras(settings.components, _facts(photos, inputs, evidence))
        for decision in decisions:
            notify(decision.in_words())

    inputs = _with_evidence(inputs, settings.components, evidence)
    _check_depths(scene, inputs, evidence, notify=notify)
    log_exposure, log_gains = _exposures(photos, settings.components, evidence, selection, notify=notify)
    return replace(
        inputs,
        selection=selection if begun is None else begun.config.selection,
        log_exposure=log_exposure,
        log_gains=log_gains,
        log_focal=log_focal,
        seconds=seconds,
    )


def _photos(scene: Capture, album: Album, threads: int) -> TrainingPhotos:
    shared = SharedFeatures(album.photos, lambda: tracks_of_model(scene, album.photos), threads=threads)
    return TrainingPhotos(scene, album, shared)


def _attached(
    photos: TrainingPhotos, settings: TrainSettings, factor: int, *, notify: Callable[[str], None]
) -> dict[str, np.ndarray]:
    """Return the masks of what is attached to the cameras, by the names of photos; report how much that is.

    Before a plain background, nothing else tells what moves with the camera.
    """
    if not settings.may_have_occluders or photos.plain is not None:
        return {}
    masks = attached_masks(photos.album.photos, threads=settings.threads)
    frames = [
        replace(frame, camera=downscaled_camera(frame.camera, factor))
        for frame in (*photos.scene.train_frames, *photos.scene.test_frames)
    ]
    found = masks_of(frames, masks, seen=[photo.frame for photo in photos.album.photos])
    if not found:
        return found
    fraction = np.mean([mask.mean() for mask in found.values()])
    notify(
        f"attached to the camera: {100.0 * fraction:.1f} % of the pixels of {several(len(found), 'photo')} stay in "
        "place while it moves, and are left out"
    )
    return found


def _extent(photos: TrainingPhotos, settings: TrainSettings, *, notify: Callable[[str], None]) -> Extent:
    """Return the extent of the field; without 3D points, from triangulated ones if it needs any."""
    scene, is_object = photos.scene, photos.show_object
    if lacks_depth(scene, settings, is_object=is_object):
        scene = _with_points(photos)
        notify(f"the scene has no 3D points; estimating its extent from {len(scene.points)} triangulated ones")
    return choose_extent(scene, settings, is_object=is_object)


def _with_points(photos: TrainingPhotos) -> Capture:
    """Return the scene with 3D points triangulated from matched features."""
    frames = [photo.frame for photo in photos.album.photos]
    return replace(photos.scene, points=triangulate(frames, photos.shared.of_matches).found)


def _plain_background(photos: TrainingPhotos, settings: TrainSettings, begun: Extent | None) -> list[np.ndarray] | None:
    """Return the masks of a plain background around an object; None if there is none that the model can show."""
    found, kind = plain_background(photos.album.photos), settings.components.background
    is_open = settings.model == "auto" and "background" not in settings.fixed
    if found is None or not (is_open or kind in LEARNED_BACKGROUNDS or (kind != "random" and found.is_black)):
        return None
    if begun is not None:
        return found.masks if begun.contraction == "none" else None
    scene = photos.scene if len(photos.scene.points) else _with_points(photos)
    return found.masks if fits_object_frame(scene) else None


def _decide(
    photos: TrainingPhotos, inputs: TrainingInputs, *, is_new: bool, notify: Callable[[str], None]
) -> tuple[Evidence, Selection | None]:
    """Compute the evidence that the components need, and select those that are open; report each decision."""
    began, settings = time.perf_counter(), inputs.settings
    evidence = collect_evidence(photos, inputs.pool, settings=settings, is_new=is_new, notify=notify)
    if not is_new or settings.model != "auto":
        return evidence, None
    selection = _select(inputs, evidence, _facts(photos, inputs, evidence), began=began, notify=notify)
    for decision in selection.decisions:
        notify(decision.in_words())
    return evidence, replace(selection, seconds=time.perf_counter() - began)


def _select(
    inputs: TrainingInputs, evidence: Evidence, facts: Facts, *, began: float, notify: Callable[[str], None]
) -> Selection:
    """Select components for the scene."""
    budget, requested = Budget.of(inputs.settings), inputs.settings.components
    if not budget.allows_trials:
        return _without_trials(requested, facts, "the budget is too short for trials", notify=notify)
    requested, log_focal, measured = with_known_cameras(requested, facts)
    model, _ = with_evidence(requested, facts)
    uses_matched = facts.exposure_spread > 0.0 or requested.exposure == "matched"
    log_gains = evidence.log_gains if uses_matched else None
    trials = Trials(
        replace(
            _with_evidence(inputs, model, evidence),
            log_gains=None if log_gains is None else torch.from_numpy(log_gains),
            log_focal=log_focal,
        )
    )
    notify(f"selecting components, for up to {100 * SEARCH_FRACTION:.0f} % of the budget")
    used = time.perf_counter() - began - evidence.stereo_seconds
    try:
        selection = select(trials, requested, facts, budget.of_search(used))
        if not selection.decisions:
            notify("the budget is too short for trials; using the default components")
    except NonFiniteError:  # the training itself recovers from that
        selection = _without_trials(requested, facts, "numbers became non-finite in a trial", notify=notify)
    return replace(selection, decisions=(*measured, *selection.decisions), log_focal=log_focal)


def _without_trials(requested: Components, facts: Facts, why: str, *, notify: Callable[[str], None]) -> Selection:
    notify(f"{why}; only components that need no trial are selected")
    components, decisions = with_evidence(requested, facts)
    return Selection(components, tuple(decisions))


def _facts(photos: TrainingPhotos, inputs: TrainingInputs, evidence: Evidence) -> Facts:
    """Return what the selection needs to know about the scene."""
    settings = inputs.settings
    exif, depths = photos.log_exposures, (evidence.track_depths, evidence.stereo_depths, evidence.sensor_depths)
    points, stereo, sensor = (0 if one is None else len(one.numbers) for one in depths)
    return Facts(
        settings.field,
        has_alpha=photos.album.colours.shape[-1] == 4,
        has_exif=bool(np.ptp(relative_log_exposures(exif, mean_log_exposure(exif))) > 0.0),
        cameras_known=_known(photos.scene)
        or (None if evidence.may_match else "the budget is too short to match photos"),
        cameras=evidence.cameras,
        points=points,
        stereo=stereo,
        sensor=sensor,
        sky_fraction=evidence.sky_fraction,
        sky_confirmed=evidence.sky_confirmed,
        is_plain=photos.plain is not None,
        occluded_fraction=evidence.occluded_fraction,
        has_attached=bool(inputs.attached),
        photos=len(exif),
        exposure_spread=evidence.exposure_spread,
        fixed=settings.fixed,
    )


def _without_ray(pool: PixelPool) -> str:
    """Say that pixels have no ray, and what that means if they are most of them."""
    fraction = pool.without_ray / len(pool.colours)
    note = f"{pool.without_ray} pixels are skipped: they lie outside the lens model's field of view"
    if fraction <= MOST_WITHOUT_RAY:
        return note
    return (
        f"{note}. These are {100.0 * fraction:.0f} % of all: the distortion of the lens must be wrong; nerfcli poses "
        "PHOTOS estimates it"
    )


def _known(scene: Capture) -> str | None:
    """Return the reason to trust the cameras, shown to the user; None if they may be wrong."""
    if scene.kind == "blender" and all(frame.camera.model == "PINHOLE" for frame in scene.frames):
        return "these cameras are exact: the pictures were rendered with them"
    return "structure from motion has already optimized the cameras" if len(scene.points) else None


def _with_evidence(inputs: TrainingInputs, components: Components, evidence: Evidence) -> TrainingInputs:
    """Return the inputs with the evidence that components use."""
    pool, occluders = inputs.pool, evidence.occluders if components.occluders else None
    if occluders is not None:
        pool = pool.without(occluders, storage=inputs.storage)
    used = (
        evidence.track_depths if components.points else None,
        evidence.stereo_depths if components.points and components.stereo else None,
        evidence.sensor_depths if components.sensor else None,
    )
    depths = [one.among(pool) for one in used if one is not None]
    return replace(
        inputs,
        settings=replace(inputs.settings, components=components),
        pool=pool,
        points=PointRays(depths, pool) if any(len(one.numbers) for one in depths) else None,
        sky=evidence.sky,
        occluders=occluders,
    )


def _check_depths(scene: Capture, inputs: TrainingInputs, evidence: Evidence, *, notify: Callable[[str], None]) -> None:
    """Refuse a training whose components need depths that are not known; report how many points there are."""
    settings, components = inputs.settings, inputs.settings.components
    if components.points:
        if inputs.points is None or evidence.track_depths is None:
            raise UserError(
                f"--with points: no 3D point could be triangulated from the photos of {scene.root}",
                "use a scene written by nerfcli poses or a COLMAP model, or remove --with points",
            )
        if settings.model != "auto" or "points" in settings.fixed:  # else the decision on points reports it
            notify(f"points: {len(evidence.track_depths.numbers):,} pixels see a 3D point at a known distance")
    if components.sensor and (evidence.sensor_depths is None or not len(evidence.sensor_depths.numbers)):
        raise UserError(
            f"--with sensor: {scene.root} has no depth maps of a sensor that its photos confirm", "remove --with sensor"
        )


def _exposures(
    photos: TrainingPhotos,
    components: Components,
    evidence: Evidence,
    selection: Selection | None,
    *,
    notify: Callable[[str], None],
) -> tuple[float | None, Tensor]:
    """Return the mean log exposure of the training photos by EXIF, and their initial ones relative to it, (photos, 3).

    The latter are those that trials have found, else from pixels that photos share, else from EXIF.
    """
    none = np.full(len(photos.scene.train_frames), np.nan)
    exif = none if components.exposure == "none" else photos.log_exposures
    reference = mean_log_exposure(exif)
    if reference is not None:
        notify(f"EXIF gives the exposure of {np.isfinite(exif).sum()} of {len(exif)} photos")
    by_exif = torch.from_numpy(relative_log_exposures(exif, reference))[:, None].expand(-1, 3)
    if selection is not None and selection.log_gains is not None:
        return reference, selection.log_gains
    matched = None if evidence.log_gains is None else torch.from_numpy(evidence.log_gains)
    if matched is not None and components.exposure == "matched":
        known = int(matched.isfinite().all(1).sum())
        others = "" if known == len(matched) else "; the others are learned"
        notify(f"matched pixels give the exposure of {known} of {len(matched)} photos{others}")
        return reference, matched
    if matched is not None and components.exposure == "learned" and components.stereo:
        matched = matched.to(by_exif)
        return reference, torch.where(matched.isfinite(), matched, by_exif)
    return reference, by_exif
