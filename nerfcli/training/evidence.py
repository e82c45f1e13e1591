"""Evidence from the training photos before training: cameras, sky, known distances, exposures, what hides surfaces."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.rigid import apply, inverse
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.colmap import find_model, parse_colmap, parse_model
from nerfcli.errors import reason_of
from nerfcli.matching.camera_check import CameraCheck, check_cameras
from nerfcli.matching.correspondences import SharedFeatures
from nerfcli.matching.exposures import matched_log_gains
from nerfcli.matching.occluders import occluder_masks
from nerfcli.matching.sky import points_before, points_of_depths, points_of_tracks, sky_masks
from nerfcli.matching.stereo import LEAST_SIDE_PX, DenseDepth, affordable_side_px, dense_depths
from nerfcli.matching.tracks import Tracks, indices_by_value, triangulate, world_rays
from nerfcli.photos.exif import log_exposures
from nerfcli.photos.held_out_exposure import exif_slope
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training.pool import Album, PixelPool, PointDepths
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import Budget
from nerfcli.training.sensor_depths import sensor_depths

# Fewer photos with EXIF exposures cannot confirm the matched ones.
FEWEST_EXIF = 5
# If a larger fraction of pixels looks like a sky, there is one.
LEAST_SKY_FRACTION = 0.05
# Cameras with an epipolar error below this are as good as the features: structure from motion leaves 0.1 to 0.4.
LEAST_MISS_PX = 0.6
# Reprojection error at which a point has half the weight, in pixels of the training photo.
HALF_ERROR_PX = 1.0
# Expected relative error of a distance, by stereo or a sensor, at which its pixel has half the weight.
HALF_ERROR = 0.05
# Values of "cameras" with which focal lengths are learned.
LEARN_FOCAL = ("focal", "all")


@dataclass
class Evidence:
    """What the training photos tell; None, 0 or False where it is not needed or not known.

    Args:
        may_match: whether the budget allows matching the photos.
        cameras: the cameras against matched features.
        sky_fraction: fraction of the pixels that look like a sky, see `matching.sky`; 0 if that is enough for one, but
            3D points are in front.
        sky_confirmed: whether these are enough for a sky, and 3D points or depths by stereo are everywhere else.
        sky: (pixels,) bool, the pixels of the pool that look like a sky; None if they are too few to be one. A plain
            background counts as one.
        track_depths: of points from structure from motion, or of matched features.
        stereo_depths: from stereo matching.
        sensor_depths: from a sensor's maps.
        log_gains: (photos, 3) logarithms of exposures from pixels that several photos share; NaN where unknown.
        occluders: for each photo the mask (H, W) of pixels where something hides a surface that other photos see.
        seconds: how long each took, by name.
    """

    may_match: bool
    cameras: CameraCheck | None = None
    sky_fraction: float = 0.0
    sky_confirmed: bool = False
    sky: Tensor | None = None
    track_depths: PointDepths | None = None
    stereo_depths: PointDepths | None = None
    sensor_depths: PointDepths | None = None
    log_gains: np.ndarray | None = None
    occluders: list[np.ndarray] | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Note the seconds that something takes."""
        began = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - began

    @property
    def stereo_seconds(self) -> float:
        """Seconds that stereo matching and what is found with it took."""
        return sum(self.seconds.get(name, 0.0) for name in ("stereo", "exposures", "occluders"))

    @property
    def exposure_spread(self) -> float:
        """Standard deviation of the photos' log brightness in pixels that they share; 0 if nothing is known."""
        if self.log_gains is None:
            return 0.0
        measured = self.log_gains[np.isfinite(self.log_gains).all(1)]
        return float(measured.mean(1).std()) if len(measured) else 0.0

    @property
    def occluded_fraction(self) -> float:
        """Fraction of the pixels that `occluders` contain."""
        return 0.0 if self.occluders is None else _fraction(self.occluders)


@dataclass(frozen=True)
class TrainingPhotos:
    """The training photos of a scene.

    Args:
        album: their pixels.
        shared: the features that they share.
        plain: for each photo the mask (H, W) of a plain background, see `matching.plain_background`; None if there is
            none, or if it is not to be used.
    """

    scene: Capture
    album: Album
    shared: SharedFeatures
    plain: list[np.ndarray] | None = None

    @property
    def show_object(self) -> bool:
        """Whether they show nothing but an object, cut out by alpha or before a plain background."""
        return not self.album.fills_frame or self.plain is not None

    @property
    def lacks_points(self) -> bool:
        """Whether no 3D points tell about the cameras, and photos that fill the frame can."""
        return self.album.fills_frame and len(self.scene.points) == 0

    @cached_property
    def log_exposures(self) -> np.ndarray:
        """Logarithms (photos,) of their exposures by EXIF, see `photos.exif.log_exposures`."""
        return log_exposures(self.scene.train_frames)


def may_use_points(
    requested: Components, fixed: tuple[str, ...], *, has_alpha: bool, cameras: CameraCheck | None
) -> bool:
    """Return whether triangulated points may be used for depth supervision.

    The cameras must fit. With alpha, which tells where space is empty, points help only at first: on lego they cost
    half a decibel, through the time that their rays take.
    """
    if "points" in fixed:
        return bool(requested.points)
    fit = cameras is None or cameras.misses_px[0] < LEAST_MISS_PX
    return fit and requested.cameras == "fixed" and not has_alpha


def collect_evidence(
    photos: TrainingPhotos, pool: PixelPool, *, settings: TrainSettings, is_new: bool, notify: Callable[[str], None]
) -> Evidence:
    """Return what the components need, each step with what the steps before it have found.

    Args:
        settings: their components; with model="auto", what is open is not decided yet unless it is `fixed`.
        is_new: whether this training begins now, so that open components and focal lengths are decided.
    """
    album, shared, wanted, fixed = photos.album.photos, photos.shared, settings.components, settings.fixed
    budget, threads = Budget.of(settings), settings.threads
    selects = is_new and settings.model == "auto"
    found = Evidence(may_match=budget.allows_trials and budget.allows_matching(shared.matching_seconds))

    if found.may_match and photos.lacks_points and (selects or (is_new and wanted.cameras in LEARN_FOCAL)):
        with found.timed("cameras"):
            found.cameras = _camera_check(photos, notify)

    skies: list[np.ndarray] = []
    if wanted.background == "sphere" or (selects and "background" not in fixed and not pool.has_alpha):
        with found.timed("sky"):
            skies = photos.plain or sky_masks(album, threads=threads)
            find_sky(found, skies, photos, device=pool.colours.device)

    points_are_open = selects and may_use_points(wanted, fixed, has_alpha=pool.has_alpha, cameras=found.cameras)
    if wanted.points or (points_are_open and (shared.of_model.count or found.may_match)):
        with found.timed("points"):
            found.track_depths = point_depths(shared.tracks, pool)

    seconds, cores = budget.of_stereo(threads)
    side_px = affordable_side_px(album, seconds=seconds, threads=cores)
    has_points = found.track_depths is not None and len(found.track_depths.numbers) > 0
    stereo_is_open = points_are_open and has_points and (wanted.stereo if "stereo" in fixed else bool(side_px))
    with_exposures = wanted.exposure == "matched" or (wanted.exposure == "learned" and wanted.stereo) or stereo_is_open
    # Occluders that a selection has found come with stereo; without it, it has found something attached to the camera.
    wants_occluders = wanted.occluders and (settings.model != "auto" or "occluders" in fixed or wanted.stereo)
    with_occluders = wants_occluders or (stereo_is_open and "occluders" not in fixed)
    with_depths = stereo_is_open or (wanted.stereo and found.track_depths is not None)
    dense: Sequence[DenseDepth] = ()
    if with_exposures or with_occluders or with_depths:
        with found.timed("stereo"):
            dense = dense_depths(album, shared.tracks, longer_side_px=side_px or LEAST_SIDE_PX, threads=threads)
            confirm_sky(found, skies, photos, dense)
    if with_depths:
        found.stereo_depths = dense_points(dense, pool)
        count = len(found.stereo_depths.numbers)
        notify(f"stereo matching: the depth of {count} pixels of the training photos, {found.seconds['stereo']:.1f} s")

    if with_exposures or with_occluders:
        with found.timed("exposures"):
            log_gains = matched_log_gains(album, dense)
        if with_exposures:  # those that a user asks for need no confirmation
            found.log_gains = (
                log_gains if wanted.exposure == "matched" else confirmed_by_exif(log_gains, photos.log_exposures)
            )
        if with_occluders:
            with found.timed("occluders"):
                skies = skies or sky_masks(album, threads=threads)
                found.occluders = occluder_masks(album, dense, skies, log_gains, threads=threads)

    sensor_is_open = selects and "sensor" not in fixed and not pool.has_alpha
    can_match = shared.of_model.count or budget.allows_matching(shared.matching_seconds)
    if wanted.sensor or (sensor_is_open and can_match):
        _find_sensor_depths(found, photos, pool, notify=notify)
    return found


def _find_sensor_depths(
    found: Evidence, photos: TrainingPhotos, pool: PixelPool, *, notify: Callable[[str], None]
) -> None:
    """Fill in the depths of a sensor, checked with what is found already."""
    if not any(frame.depth is not None and not frame.camera.is_spherical for frame in pool.frames):
        return
    with found.timed("sensor"):
        tracks = found.track_depths or point_depths(photos.shared.tracks, pool)
        known = tracks if found.stereo_depths is None else tracks.joined(found.stereo_depths)
        found.sensor_depths = dense_points(sensor_depths(known, pool, notify=notify), pool)


def tracks_of_model(scene: Capture, photos: Sequence[LoadedPhoto]) -> Tracks:
    """Return the observations of these photos in the scene's COLMAP model; empty without such a model.

    Neither the observations in held-out photos are read nor the 3D positions of points, which depend on them.
    """
    folder = find_model(scene.root)
    # A COLMAP model may name photos by paths of another machine: `parse_model` names them as the scene does.
    parse = parse_model if scene.kind.startswith("colmap") else parse_colmap
    capture = parse(folder) if folder is not None else None
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))]
    if capture is not None and capture.observations is not None:
        seen = capture.observations
        index_of = {frame.name: index for index, frame in enumerate(capture.frames)}
        of_frame = indices_by_value(np.where(seen.point_index >= 0, seen.frame_index, -1), len(capture.frames))
        for number, photo in enumerate(photos):
            index = index_of.get(photo.frame.name)
            if index is None:
                continue
            frame, own = capture.frames[index], of_frame[index]
            # The loaded photo may be downscaled or rotated: observations are in pixels of the model's own camera.
            rays = world_rays(frame.camera.bearings(seen.pixels[own]), frame.world_from_cam)
            parts.append((np.full(len(own), number), seen.point_index[own], rays))
    return Tracks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def point_depths(tracks: Tracks, pool: PixelPool) -> PointDepths:
    """Return the usable pixels that see a triangulated point of tracks in the pool's photos; empty if there are none.

    trust = 1 / (1 + (reprojection error / 1 px)^2), in pixels of the training photos
    """
    surface = triangulate(pool.frames, tracks)
    kept = np.flatnonzero(np.isfinite(surface.misses_px))
    numbers = np.full(len(kept), -1)
    by_photo = indices_by_value(tracks.photos[kept], len(pool.frames))
    for photo, (frame, own) in enumerate(zip(pool.frames, by_photo, strict=True)):
        points = surface.points[tracks.points[kept[own]]]
        pixels, valid = frame.camera.project(apply(inverse(frame.world_from_cam), points))
        width, height = frame.camera.width, frame.camera.height
        shown = valid & (pixels >= 0).all(1) & (pixels < (width, height)).all(1)
        column, row = np.floor(pixels[shown]).astype(np.int64).T
        numbers[own[shown]] = int(pool.first_pixel[photo]) + row * width + column
    inside = numbers >= 0
    kept = kept[inside]
    centres = np.array([frame.centre for frame in pool.frames])[tracks.photos[kept]]
    distances = np.linalg.norm(surface.points[tracks.points[kept]] - centres, axis=1) * pool.training_from_scene.scale
    trust = 1.0 / (1.0 + (surface.misses_px[kept] / HALF_ERROR_PX) ** 2)
    return _usable(numbers[inside], distances, trust, pool=pool)


def dense_points(dense: Sequence[DenseDepth], pool: PixelPool) -> PointDepths:
    """Return the usable pixels of a pool whose depth in its photos is known from stereo matching or from a sensor.

    trust = 1 / (1 + (error / 5 %)^2)
    """
    widths = [frame.camera.width for frame in pool.frames]
    firsts = pool.first_pixel.tolist()
    numbers = [first + depth.pixels @ (1, width) for first, width, depth in zip(firsts, widths, dense, strict=True)]
    distances = np.concatenate([depth.distances for depth in dense]) * pool.training_from_scene.scale
    trust = 1.0 / (1.0 + np.square(np.concatenate([depth.errors for depth in dense]) / HALF_ERROR))
    return _usable(np.concatenate(numbers), distances, trust, pool=pool)


def _usable(numbers: np.ndarray, distances: np.ndarray, trust: np.ndarray, *, pool: PixelPool) -> PointDepths:
    device = pool.colours.device
    known = (torch.from_numpy(values).to(device, torch.float32) for values in (distances, trust))
    return PointDepths(torch.from_numpy(numbers).to(device), *known).among(pool)


def _camera_check(photos: TrainingPhotos, notify: Callable[[str], None]) -> CameraCheck | None:
    """Check the cameras against matched features; None, with a note, if the check cannot be computed."""
    try:
        return check_cameras(photos.album.photos, photos.shared.matched)
    except Exception as error:
        notify(f"could not check the cameras against matched features: {reason_of(error)}")
        return None


def find_sky(found: Evidence, skies: list[np.ndarray], photos: TrainingPhotos, *, device: torch.device) -> None:
    """Fill in what masks (H, W) of pixels that look like a sky tell."""
    found.sky_fraction = _fraction(skies)
    if found.sky_fraction <= LEAST_SKY_FRACTION:
        return
    if photos.plain is None:
        # Tracks from matches would have two photos each.
        points = points_of_tracks(photos.album.photos, photos.shared.of_model)
        before = points_before(skies, photos.album.photos, points)
        if before.refute:
            found.sky_fraction = 0.0
            return
        found.sky_confirmed = before.confirm
    found.sky = torch.from_numpy(np.concatenate([mask.ravel() for mask in skies])).to(device)


def confirm_sky(found: Evidence, skies: list[np.ndarray], photos: TrainingPhotos, dense: Sequence[DenseDepth]) -> None:
    """Confirm a sky by depths from stereo matching if structure from motion has left no points that could.

    They do not refute one: of poses that are a few pixels off, too many are in front of a sky.
    """
    if found.sky is not None and photos.plain is None and not photos.shared.of_model.count:
        points = points_of_depths(photos.album.photos, dense)
        found.sky_confirmed = points_before(skies, photos.album.photos, points).confirm


def confirmed_by_exif(log_gains: np.ndarray, exif: np.ndarray) -> np.ndarray:
    """Return exposures from shared pixels, (photos, 3); all NaN if EXIF does not confirm them.

    Surfaces that look brighter from one side differ between photos just as exposures do, and their differences add up
    along a ring of cameras.
    """
    measured = np.isfinite(log_gains).all(1) & np.isfinite(exif)
    places = np.flatnonzero(measured)
    if len(places) < FEWEST_EXIF or exif_slope(places, log_gains[measured], exif[measured]) == 0.0:
        return np.full_like(log_gains, np.nan)
    return log_gains


def _fraction(masks: list[np.ndarray]) -> float:
    """Return the fraction of the pixels that masks contain."""
    return sum(int(mask.sum()) for mask in masks) / sum(mask.size for mask in masks)
