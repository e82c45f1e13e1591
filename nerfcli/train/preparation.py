"""What a training starts from: photos and their rays, the extent of the field, and the components the scene needs.

Of held-out photos nothing is read here but the sizes that their cameras have.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfcli.errors import UserError, reason_of
from nerfcli.fit.error_map import ErrorMap
from nerfcli.fit.extent import Extent, choose_extent, lacks_depth
from nerfcli.fit.fitting import Fitting
from nerfcli.fit.point_depth import PointDepths, PointRays, point_depths
from nerfcli.multiview.camera_check import CameraCheck, check_cameras
from nerfcli.multiview.correspondences import Shared
from nerfcli.multiview.triangulation import triangulate
from nerfcli.photos.exif_exposure import log_exposures, mean_log_exposure, relative_log_exposures
from nerfcli.photos.pool import Album, PixelPool, load_album
from nerfcli.photos.storage import Room, needs_of, room_for
from nerfcli.runs.components import Components
from nerfcli.runs.decisions import Selection
from nerfcli.runs.settings import TrainSettings, automatic_downscale
from nerfcli.scene import Scene
from nerfcli.search.selection import (
    LEARN_FOCAL,
    SEARCH_SHARE,
    Facts,
    is_worth_a_search,
    select,
    tells_points,
    with_known_cameras,
    with_points,
)
from nerfcli.search.trials import Trials

# A search that has no time left has this.
LEAST_SECONDS = 1e-3
# Of a search, what the comparison of photos may take.
MATCHING_SHARE = 0.5


@dataclass(frozen=True)
class Begun:
    """What an interrupted training had decided on."""

    extent: Extent
    components: Components


@dataclass(frozen=True)
class Prepared:
    """What a training goes over, and what was decided for it.

    Args:
        settings: with the components that are taken.
        factor: photos are averaged over squares of this many pixels.
        room: where arrays of the size of the photos go.
        extent: of the field.
        pool: the training photos.
        selection: how the scene decided on the components; None where it was not asked.
        log_exposure: the mean of the training photos by EXIF; None where exposures are not asked for, or not known.
        log_gains: (photos, 3) logarithms of their exposures relative to it, as the trials found them or as far as EXIF
            tells; else 0.
        log_focal: logarithm of the factor of focal lengths to start from.
        points: pixels whose distance is known, where the components ask for them.
    """

    settings: TrainSettings
    factor: int
    room: Room
    extent: Extent
    pool: PixelPool
    selection: Selection | None
    log_exposure: float | None
    log_gains: Tensor
    log_focal: float
    points: PointRays | None

    def fitting(self) -> Fitting:
        """A training at its first step."""
        return Fitting(
            self.pool,
            self.extent.marching,
            contraction=self.extent.contraction,
            settings=self.settings,
            log_gains=self.log_gains,
            log_focal=self.log_focal,
            points=self.points,
            error_map=ErrorMap(self.pool) if self.settings.components.pixels == "error" else None,
        )


def prepare(
    scene: Scene,
    settings: TrainSettings,
    *,
    run: Path,
    memory_bytes: int | None,
    begun: Begun | None,
    notify: Callable[[str], None],
) -> Prepared:
    """Read the training photos and decide what is to be decided.

    Args:
        scene: photos, cameras and split.
        settings: as asked for.
        run: where files may stand that hold what does not fit into memory.
        memory_bytes: that may be resident.
        begun: decisions of a training that goes on; None for a new one.
        notify: takes lines for the user.

    Raises:
        UserError: too little memory, no training photo, unreadable photos.
    """
    if not scene.train_frames:
        raise UserError(f"{scene.root} has no training photo", "every 8th photo is held out; at least 2 are needed")
    first = scene.train_frames[0].camera
    factor = settings.downscale or automatic_downscale(first.width, first.height)
    needs = needs_of((*scene.train_frames, *scene.test_frames), factor, settings=settings)
    room, told = room_for(needs, memory_bytes, folder=run)
    notify(told)
    masks = settings.components.masks
    album = load_album(scene.train_frames, factor=factor, threads=settings.threads, room=room, masks=masks)
    shared = Shared(scene, album.photos, threads=settings.threads)
    if begun is not None:
        extent = begun.extent
    else:
        located = scene
        if lacks_depth(scene, settings, fills_frame=album.fills_frame):
            frames = [photo.frame for photo in album.photos]
            located = replace(scene, points=triangulate(frames, shared.of_matches).known)
            notify(f"the scene came without points; {len(located.points)} found in its photos tell how far it reaches")
        extent = choose_extent(located, settings, fills_frame=album.fills_frame)
    device = torch.device(settings.device)
    pool = PixelPool(album.photos, extent.training_from_scene, device, colours=album.colours, room=room)
    camera = album.photos[0].frame.camera
    notify(
        f"{len(album.photos)} photos to train on, {len(scene.test_frames)} held out, "
        f"{camera.width}x{camera.height} (1/{factor}), {extent}, {settings.device}, {settings.threads} threads"
    )
    if pool.without_ray:
        notify(f"{pool.without_ray} pixels are left out: their lens model has no direction for them")
    selection, known, log_focal = None, None, 0.0
    if begun is not None:
        settings = replace(settings, components=begun.components)
    elif settings.model == "auto":
        began = time.perf_counter()
        facts, known = _facts(scene, album, extent, settings, pool=pool, shared=shared, notify=notify)
        selection = _search(
            scene, album, extent, settings, facts=facts, known=known, room=room, began=began, notify=notify
        )
        settings, log_focal = replace(settings, components=selection.components), selection.log_focal
    elif settings.components.cameras in LEARN_FOCAL:
        facts, _ = _facts(scene, album, extent, settings, pool=pool, shared=shared, notify=notify)
        _, log_focal, decisions = with_known_cameras(settings.components, facts)
        for decision in decisions:
            notify(decision.in_words())
    extent = extent.before(settings.components.background)
    reference, gains = _exposures(scene, settings.components, notify=notify)
    if selection is not None and selection.log_gains is not None:
        gains = selection.log_gains
    points = None
    if settings.components.points:
        known = known or point_depths(shared.tracks, pool, extent.training_from_scene)
        if len(known.numbers) == 0:
            raise UserError(
                f"--with points: no photos of {scene.root} agree on where a point is",
                "use a scene of nerfcli poses or a COLMAP model, or leave it out",
            )
        notify(f"{len(known.numbers)} pixels see a point whose distance is known")
        points = PointRays(known, pool)
    return Prepared(settings, factor, room, extent, pool, selection, reference, gains, log_focal, points)


def _facts(
    scene: Scene,
    album: Album,
    extent: Extent,
    settings: TrainSettings,
    *,
    pool: PixelPool,
    shared: Shared,
    notify: Callable[[str], None],
) -> tuple[Facts, PointDepths | None]:
    """What is known before anything is learned, and the pixels whose distance is known, where these may be asked."""
    lacks_points = album.fills_frame and len(scene.points) == 0
    budget = settings.budget_seconds
    has_time = is_worth_a_search(budget, settings.steps) and (
        budget is None or shared.matching_seconds <= MATCHING_SHARE * SEARCH_SHARE * budget
    )
    facts = Facts(
        settings.field,
        has_alpha=album.colours.shape[-1] == 4,
        has_exif=bool(np.ptp(_exif(scene)) > 0.0),
        cameras_known=_known(scene) or (None if has_time else "there is no time to compare photos"),
        cameras=_camera_check(album, shared, notify=notify) if lacks_points and has_time else None,
        fixed=settings.fixed,
    )
    if not tells_points(settings.components, facts):
        return facts, None
    if shared.of_model.count:
        known = point_depths(shared.of_model, pool, extent.training_from_scene)
    elif has_time or settings.components.points:
        known = point_depths(shared.of_matches, pool, extent.training_from_scene)
    else:
        return facts, None
    return replace(facts, points=len(known.numbers)), known


def _camera_check(album: Album, shared: Shared, *, notify: Callable[[str], None]) -> CameraCheck | None:
    """Check the cameras against matched features; a check that cannot be computed says nothing and ends no training."""
    try:
        return check_cameras(album.photos, shared.matched)
    except Exception as error:
        notify(f"the cameras could not be checked against matched features: {reason_of(error)}")
        return None


def _search(
    scene: Scene,
    album: Album,
    extent: Extent,
    settings: TrainSettings,
    *,
    facts: Facts,
    known: PointDepths | None,
    room: Room,
    began: float,
    notify: Callable[[str], None],
) -> Selection:
    """Let the scene decide on the components, and tell how it did."""
    budget, steps = settings.budget_seconds, settings.steps
    if not is_worth_a_search(budget, steps):
        notify("the training is too short to try components; those are taken that need no trial")
        components, decisions = with_points(settings.components, facts)
        for decision in decisions:
            notify(decision.in_words())
        return Selection(components, tuple(decisions), time.perf_counter() - began)
    asked, log_focal, measured = with_known_cameras(settings.components, facts)
    trials = Trials(
        album.photos,
        extent,
        settings=settings,
        exif=_exif(scene),
        log_focal=log_focal,
        known=known,
        colours=album.colours,
        room=room,
    )
    took = time.perf_counter() - began
    notify(f"asks the scene which components it needs, for up to {SEARCH_SHARE:.0%} of the budget")
    selection = select(
        trials,
        asked,
        facts,
        seconds=None if budget is None else max(LEAST_SECONDS, SEARCH_SHARE * budget - took),
        steps=None if steps is None else round(SEARCH_SHARE * steps),
    )
    if not selection.decisions:
        notify("the budget is too small to try components; the default ones are taken")
    selection = replace(
        selection,
        decisions=(*measured, *selection.decisions),
        seconds=selection.seconds + took,
        log_focal=log_focal,
    )
    for decision in selection.decisions:
        notify(decision.in_words())
    return selection


def _exif(scene: Scene) -> np.ndarray:
    """(photos,) logarithms of the exposures that EXIF tells, relative to their mean."""
    return relative_log_exposures(scene.train_frames, mean_log_exposure(scene.train_frames))


def _known(scene: Scene) -> str | None:
    """Why nobody has to doubt the cameras; None where one may."""
    if scene.kind == "blender":
        return "the pictures were rendered with these cameras"
    return "structure from motion has fitted cameras to points" if len(scene.points) else None


def _exposures(scene: Scene, components: Components, *, notify: Callable[[str], None]) -> tuple[float | None, Tensor]:
    """The mean exposure of the training photos, and the (photos, 3) logarithms of theirs relative to it."""
    frames = scene.train_frames
    reference = None if components.exposure == "none" else mean_log_exposure(frames)
    if reference is not None:
        notify(f"EXIF tells the exposure of {np.isfinite(log_exposures(frames)).sum()} of {len(frames)} photos")
    gains = torch.from_numpy(relative_log_exposures(frames, reference))
    return reference, gains[:, None].expand(-1, 3)
