"""Give each photo its own principal point where the observations show that these differ.

Optical image stabilisation shifts the lens or the sensor during each exposure. To first order, a shift s looks like a
rotation of the camera by s / f, and the pose absorbs it. What remains, s x^2 / f^2 and s x y / f^2 at pixels (x, y)
from the centre, no pose can describe: for a shift of one degree in a picture of 1000 pixels and a common focal length,
these are 5 pixels at the border.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pycolmap
from scipy.optimize import least_squares

from nerfcli.cameras.rigid import transform_from_twist
from nerfcli.poses.input.job import Report, Solver
from nerfcli.poses.model import held_out
from nerfcli.poses.model.intrinsics import DEVIATIONS, LEAST_PHOTOS, MOST_CAMERAS
from nerfcli.poses.model.lens_evidence import OwnCameras, lenses_of
from nerfcli.poses.model.lens_observability import PRINCIPAL_POINT_RANGE, refine_lens, uncertainty
from nerfcli.poses.model.locate import pixels_of, place
from nerfcli.poses.model.projection import Array, projected

# The principal points stay shared unless their own ones clearly reduce the error of held-out observations, and by this
# fraction.
_GAIN_FRACTION = 0.1
# Errors are clipped at this multiple of their median: wrong matches must not decide.
_CLIP = 4.0
# Photos with fewer observations keep the shared principal point, as do those whose own would be farther from it than
# this fraction of the picture's size, many times what stabilisers shift: it fits something else, or is undetermined.
LEAST_OBSERVATIONS = 60
# Robust adjustments of the whole model, each to this relative change of the cost. The first ones reduce the errors by
# so much that what counts as an outlier changes.
_ROUNDS, _TOLERANCE = 3, 1e-5


@dataclass(frozen=True)
class PrincipalPoints:
    """Whether photos have their own principal points, and why.

    shared_px, own_px: mean error of the held-out observations with shared and with own principal points, each clipped
    to four times the median. gain: the difference in standard errors. photos: how many may have their own. kept:
    whether they do.
    """

    shared_px: float
    own_px: float
    gain: float
    photos: int
    kept: bool


@dataclass(frozen=True)
class StabilisedModel:
    """A model in which each photo has its own principal point, or the model as it was, and the evidence.

    evidence: None if too few photos have enough observations, or none can be held out. uncertainty: of the lenses with
    own principal points, by camera id, see `lens_observability.uncertainty`; empty if they are shared.
    """

    model: pycolmap.Reconstruction
    evidence: PrincipalPoints | None
    uncertainty: dict[int, dict[str, Any]]


def choose_principal_points(
    model: pycolmap.Reconstruction, solver: Solver = Solver(), *, report: Report = lambda stage, done, total: None
) -> StabilisedModel:
    """Return the model with a camera for each photo if their principal points differ, else the model as it is.

    Photos of one lens keep a common focal length and distortion, which are adjusted too. The model has converged and is
    not changed. `report` is called with ("stabilise", done, total), then with ("settle", done, total) if principal
    points differ.
    """
    report("stabilise", 0, 2)
    shared, held = held_out.split(model, seed=solver.seed)
    free = _free_photos(shared, solver)
    if len(free) < LEAST_PHOTOS or len(held.points) == 0:
        report("stabilise", 2, 2)
        return StabilisedModel(model, None, {})
    scale_px = held_out.loss_scale_px(held_out.observation_errors_px(shared))
    _adjust(shared, set(), solver, robust_px=scale_px)
    report("stabilise", 1, 2)
    own = give_own_cameras(shared)
    _adjust(own, free, solver, robust_px=scale_px)
    before, after = held_out.errors_px(shared, held), held_out.errors_px(own, held)
    most = _CLIP * float(np.median(before))
    before, after = np.minimum(before, most), np.minimum(after, most)
    gain = held_out.gain(before, after)
    kept = gain > DEVIATIONS and after.mean() < (1 - _GAIN_FRACTION) * before.mean()
    evidence = PrincipalPoints(float(before.mean()), float(after.mean()), gain, len(free), bool(kept))
    if not kept:
        report("stabilise", 2, 2)
        return StabilisedModel(model, evidence, {})
    return _settled(model, evidence, solver, report)


def give_own_cameras(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy of a model in which each photo has a camera of its own, with the id of the image."""
    own = pycolmap.Reconstruction()
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        camera = pycolmap.Camera(model.camera(image.camera_id).todict())
        camera.camera_id = image_id
        place(own, camera, image.cam_from_world(), image_id=image_id, name=image.name, pixels=pixels_of(image))
    for point_id in sorted(model.point3D_ids()):
        own.add_point3D_with_id(point_id, model.point3D(point_id))
    return own


def camera_of_lens(model: pycolmap.Reconstruction, photos: Sequence[int]) -> pycolmap.Camera:
    """Return the camera of a lens by the ids of images taken with it, at least one: their median principal point."""
    cameras = [model.camera(model.image(photo).camera_id) for photo in photos]
    middle = pycolmap.Camera(cameras[0].todict())
    if not middle.principal_point_idxs():  # panoramas have none
        return middle
    middle.principal_point_x = float(np.median([camera.principal_point_x for camera in cameras]))
    middle.principal_point_y = float(np.median([camera.principal_point_y for camera in cameras]))
    return middle


def refine_with_principal_point(
    camera: pycolmap.Camera, cam_from_world: Array, pixels: Array, points: Array
) -> tuple[Array, Array]:
    """Refine the pose and the principal point of one photo on fixed points; errors beyond the usual ones count less.

    The photo shows the points (N, 3) at the pixels (N, 2); N >= 4, for 8 unknowns. The camera's principal point and the
    pose (3, 4) are near the best ones. Returns the pose (3, 4), and the shift (2,) of the principal point in pixels.
    """

    def moved(values: Array) -> Array:
        return (np.vstack([cam_from_world, [0, 0, 0, 1]]) @ transform_from_twist(values[:6]))[:3]

    def misses(values: Array) -> Array:
        pose = moved(values)
        seen = projected(camera, points @ pose[:, :3].T + pose[:, 3])
        return np.nan_to_num(seen + values[6:] - pixels, nan=1e3).ravel()

    found = np.zeros(8)
    for _ in range(_ROUNDS):
        usual = held_out.loss_scale_px(np.linalg.norm(misses(found).reshape(-1, 2), axis=1))
        found = least_squares(misses, found, x_scale="jac", loss="cauchy", f_scale=usual).x
    return moved(found), found[6:]


def _settled(
    model: pycolmap.Reconstruction, evidence: PrincipalPoints, solver: Solver, report: Report
) -> StabilisedModel:
    """Adjust the model with own principal points, and drop the observations that no longer fit."""
    report("settle", 0, 1 + _ROUNDS)
    own, lens_of = give_own_cameras(model), lenses_of(model)
    free, held = _free_photos(model, solver), set[int]()
    scale_px = held_out.loss_scale_px(held_out.observation_errors_px(own))
    _adjust(own, free, solver, robust_px=scale_px, tolerance=_TOLERANCE)
    for number in range(_ROUNDS):
        report("settle", 1 + number, 1 + _ROUNDS)
        # Before cameras move: poses and points have not followed yet.
        scale_px = held_out.loss_scale_px(held_out.observation_errors_px(own))
        held = _anchored(own, model, free)
        if number > 0:
            _move_lenses(own, OwnCameras(lens_of, free - held), solver)
        _adjust(own, free - held, solver, robust_px=scale_px, tolerance=_TOLERANCE)
    report("settle", 1 + _ROUNDS, 1 + _ROUNDS)
    held_out.drop_misfits(own)
    of_photos = OwnCameras(lens_of, free - held)
    certain = {
        lens: uncertainty(own, lens, solver, principal_point=False, own=of_photos)
        for lens, _ in Counter(lens_of.values()).most_common(MOST_CAMERAS)
    }
    return StabilisedModel(own, evidence, certain)


def _anchored(own: pycolmap.Reconstruction, model: pycolmap.Reconstruction, free: set[int]) -> set[int]:
    """Put back the principal points that are too far from the shared one, in place; return the photos to hold there.

    The mean of a lens's principal points is hardly determined and drifts. So the photo nearest to their median gets the
    shared principal point, and the others move with it.
    """
    held: set[int] = set()
    lens_of = lenses_of(model)
    for lens in {lens_of[photo] for photo in free}:
        photos = sorted(photo for photo in free if lens_of[photo] == lens)
        camera = model.cameras[lens]
        shared = np.array([camera.principal_point_x, camera.principal_point_y])
        points = np.array([(own.cameras[p].principal_point_x, own.cameras[p].principal_point_y) for p in photos])
        anchor = int(np.linalg.norm(points - np.median(points, axis=0), axis=1).argmin())
        shifts = points - points[anchor]
        far = np.linalg.norm(shifts / [camera.width, camera.height], axis=1) > PRINCIPAL_POINT_RANGE
        shifts[far] = 0.0
        for photo, (x, y) in zip(photos, shared + shifts, strict=True):
            own.cameras[photo].principal_point_x, own.cameras[photo].principal_point_y = float(x), float(y)
        held |= {photos[anchor], *np.array(photos)[far].tolist()}
    return held


def _move_lenses(own: pycolmap.Reconstruction, of_photos: OwnCameras, solver: Solver) -> None:
    """Take a step of focal lengths and distortions, which shared principal points have biased, in place."""
    for lens in sorted(set(of_photos.lens_of.values())):
        found = refine_lens(own, lens, of_photos, solver)
        if found is None:
            continue
        kept = [*found.focal_length_idxs(), *found.extra_params_idxs()]
        for photo in (image_id for image_id, number in of_photos.lens_of.items() if number == lens):
            params = np.array(own.cameras[photo].params)
            params[kept] = np.array(found.params)[kept]
            own.cameras[photo].params = params.tolist()


def _adjust(
    model: pycolmap.Reconstruction, free: set[int], solver: Solver, *, robust_px: float, tolerance: float = 1e-9
) -> None:
    """Adjust poses, points and the principal points of the photos in `free`, which have cameras of their own."""
    held_out.adjust(
        model,
        replace(solver, fixed=tuple(sorted(set(model.cameras) - free))),
        principal_points=bool(free),
        focal_lengths=False,
        distortion=False,
        robust_px=robust_px,
        tolerance=tolerance,
    )


def _free_photos(model: pycolmap.Reconstruction, solver: Solver) -> set[int]:
    """Return the ids of images with enough observations for a principal point, without those of fixed cameras."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    return {
        image.image_id
        for image in images
        if image.camera_id not in solver.fixed and image.num_points3D >= LEAST_OBSERVATIONS
    }
