"""Examine a model after mapping: lens model, contradictions, acceptance, uncertainty.

The uncertainty of a pose is given as blur in pixels, one standard deviation. The covariance of the adjustment depends
on which points or cameras fix the frame, an arbitrary choice. It is transformed to the frame in which the pictures of a
static scene move least over all photos together (an S-transformation, Baarda 1973); each photo's own uncertainty is
read off there.

Letters: R, t is a camera's pose from the world, C its centre. A pose's six unknowns are w, a rotation after R in the
camera's axes, and the change of t; J maps them to pixels; a similarity has theta, tau, s as its seven.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pycolmap

from nerfcli.matching.graph import connected_groups
from nerfcli.poses.input.job import Job, Report, Solver
from nerfcli.poses.judge.acceptance import Verdict, judge, nothing_placed
from nerfcli.poses.judge.checks import Checks, checks_of
from nerfcli.poses.judge.contradictions import leave_out_contradicting, without_photos
from nerfcli.poses.judge.parallax import RotationFit, best_rotation_fit, panorama_rotation_fit
from nerfcli.poses.model import held_out
from nerfcli.poses.model.intrinsics import ModelLenses, choose_lenses
from nerfcli.poses.model.lens_evidence import pose_jacobians, projection_jacobians
from nerfcli.poses.model.lens_observability import focal_is_determined
from nerfcli.poses.model.locate import shared_pairs
from nerfcli.poses.model.projection import Array
from nerfcli.poses.model.reasons import FEW_MATCHES, MIN_MATCHES
from nerfcli.poses.model.two_views import VerifiedPair, read_verified_pairs

# pycolmap's tangent space of a quaternion is half the angle.
_ANGLE_FROM_TANGENT = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class ExaminedModel:
    """A model after examination, with the results for the report.

    left_out: why photos were left out, by name. blur_px: of each photo's pose, by name. details: for the report.
    uncertainty: of the lenses, by camera id, see `lens_observability.uncertainty`.
    """

    model: pycolmap.Reconstruction | None
    verdict: Verdict
    left_out: dict[str, str]
    blur_px: dict[str, float]
    details: dict[str, Any]
    uncertainty: dict[int, dict[str, Any]] = field(default_factory=dict)


def examine(
    models: list[pycolmap.Reconstruction],
    job: Job,
    report: Report = lambda stage, done, total: None,
    *,
    located: Sequence[int] = (),
    checks: Checks | None = None,
) -> ExaminedModel:
    """Leave out contradicting photos of the first model, choose lenses, adjust, judge, and measure the uncertainty.

    A check that cannot be computed is left out and listed in `details["not_computed"]`; the others go on.

    `report` is called with ("check", done, total); `located` are ids of images that, where the model places them, are
    supported by its points instead of a pair.
    """
    checks = checks or checks_of(job)
    pairs = read_verified_pairs(job.database, min_matches=MIN_MATCHES)
    strong = [pair for pair in pairs if pair.matches >= FEW_MATCHES]
    turn = checks.run("parallax", lambda: _rotation_fit(strong, job), otherwise=None)
    joined = connected_groups(job.image_ids, [(pair.one, pair.other) for pair in strong])
    details: dict[str, Any] = {"parts": [len(part) for part in joined if len(part) > 1]}
    if not models:
        return ExaminedModel(None, nothing_placed(turn), {}, {}, details | {"not_computed": checks.not_computed})
    report("check", 0, 4)
    mapped = without_photos(models[0])
    single = [photo for photo in located if mapped.exists_image(photo)]
    held: list[VerifiedPair] = checks.run(
        "points of single photos", lambda: shared_pairs(mapped, single, min_matches=MIN_MATCHES), otherwise=[]
    )
    model, left_out = checks.run(
        "contradicting photos",
        lambda: leave_out_contradicting(mapped, [*pairs, *held], job.name_of),
        otherwise=(mapped, {}),
    )
    report("check", 1, 4)
    lenses = checks.run("lens models", lambda: _with_lenses(model, job), otherwise=ModelLenses(model, {}))
    model = lenses.model
    report("check", 2, 4)
    determined = [camera for camera, found in lenses.uncertainty.items() if focal_is_determined(found)]
    verdict = judge(model, pairs, job, turn=turn, held=held, determined=determined, checks=checks)
    report("check", 3, 4)
    blur: dict[int, float] = {}
    if verdict.accepted and model.num_reg_images() <= 500:  # with more photos, the joint covariance takes minutes
        blur = checks.run("pose uncertainty", lambda: pose_blur_px(model, job.solver), otherwise=blur)
    report("check", 4, 4)
    details["not_computed"] = checks.not_computed
    reasons = {job.name_of[image_id]: reason for image_id, reason in left_out.items()}
    blur_px = {job.name_of[image_id]: px for image_id, px in blur.items()}
    return ExaminedModel(model, verdict, reasons, blur_px, details, lenses.uncertainty)


def _rotation_fit(pairs: Sequence[VerifiedPair], job: Job) -> RotationFit | None:
    """Return how well rotations explain the matches: of panoramas if all photos are, else of the other photos."""
    panoramas = {job.image_ids[photo] for group in job.groups if group.is_panorama for photo in group.photos}
    if len(panoramas) == len(job.files):
        return panorama_rotation_fit(pairs, job.sizes)
    return best_rotation_fit([pair for pair in pairs if not {pair.one, pair.other} & panoramas], job.sizes)


def _with_lenses(model: pycolmap.Reconstruction, job: Job) -> ModelLenses:
    """Choose lens models by evidence, unless the user or a file has named them."""
    named = [number for number, group in enumerate(job.groups, start=1) if not group.choose]
    exif_focal_px = {
        number: group.focal_px
        for number, group in enumerate(job.groups, start=1)
        if group.focal_px is not None and group.focal_is_prior
    }
    return choose_lenses(model, job.solver, named=named, exif_focal_px=exif_focal_px)


def pose_blur_px(model: pycolmap.Reconstruction, solver: Solver = Solver()) -> dict[int, float]:
    """Compute the root mean square motion of a typical point in each photo by one standard deviation of its pose.

    The noise of an observation is estimated from the residuals of the adjustment. Points and intrinsics are treated as
    uncertain too; the lens model is taken as chosen. Errors common to all photos, and errors that no lens model
    describes, are not included. The model has converged and is not changed; fixed intrinsics are taken to be exact. The
    result is by image id; empty if there is no covariance, since the model is not constrained in all directions.
    """
    copy = pycolmap.Reconstruction(model)
    # The model has converged with robust errors, which differ little: the covariance needs no further convergence.
    adjuster = held_out.adjust(copy, solver, tolerance=1e-3)
    options = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.ALL)
    found = pycolmap.estimate_ba_covariance(options, copy, adjuster)
    photos = sorted(copy.reg_image_ids())
    if found is None:
        return {}
    covariance = _joint_covariance(found, photos)
    if covariance is None:
        return {}
    metrics = [_pixel_metric(copy, photo) for photo in photos]
    gauge = np.vstack([_gauge_directions(copy.image(photo)) for photo in photos])  # (6 photos, 7)
    weighted = np.vstack([metric @ gauge[6 * i : 6 * i + 6] for i, metric in enumerate(metrics)])
    onto_gauge = np.linalg.solve(gauge.T @ weighted, weighted.T)  # (7, 6 photos)
    moved = onto_gauge @ covariance
    noise = held_out.residual_deviation_px(copy)
    blur = {}
    for i, photo in enumerate(photos):
        rows = slice(6 * i, 6 * i + 6)
        shift = gauge[rows] @ moved[:, rows]
        own = covariance[rows, rows] - shift - shift.T + gauge[rows] @ moved @ onto_gauge.T @ gauge[rows].T
        blur[photo] = float(noise * np.sqrt(max(np.trace(metrics[i] @ own), 0.0)))
    return blur


def _joint_covariance(found: pycolmap.BACovariance, photos: list[int]) -> Array | None:
    """Return the covariance of all poses, (6 photos, 6 photos), for unit noise, with rotations as angles."""
    joint = np.zeros((6 * len(photos), 6 * len(photos)))
    for i, one in enumerate(photos):
        for j, other in enumerate(photos[: i + 1]):
            block = found.get_cam_cov_from_world(one) if i == j else found.get_cam_cross_cov_from_world(one, other)
            if block is None or block.shape != (6, 6):
                return None
            block = _ANGLE_FROM_TANGENT @ block @ _ANGLE_FROM_TANGENT
            joint[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = block
            joint[6 * j : 6 * j + 6, 6 * i : 6 * i + 6] = block.T
    return joint


def _pixel_metric(model: pycolmap.Reconstruction, photo: int) -> Array:
    """Return the mean of J^T J over points that a photo sees, (6, 6): the mean squared pixel motion per pose motion."""
    image = model.image(photo)
    camera = model.camera(image.camera_id)
    seen = image.get_observation_points2D()
    chosen = seen[:: max(1, len(seen) // 60)]  # enough to measure how the picture moves
    pose = image.cam_from_world()
    points = np.array([model.point3D(point.point3D_id).xyz for point in chosen]).reshape(-1, 3)
    rotated = points @ pose.rotation.matrix().T
    local = rotated + pose.translation
    jacobians = projection_jacobians(camera, local)
    usable = np.isfinite(jacobians).all(axis=(1, 2)) & (local[:, 2] > 0)
    metric = np.zeros((6, 6))
    for of_pose in pose_jacobians(jacobians[usable], rotated[usable]):
        metric += of_pose.T @ of_pose
    return metric / max(int(usable.sum()), 1)


def _gauge_directions(image: pycolmap.Image) -> Array:
    """Return the change of a camera's unknowns, (6, 7), for a world rotated by theta, moved by tau, scaled by 1 + s.

    X' = (1 + s) X + theta x X + tau and R' = R exp(-theta), so w = -R theta and dt = w x t - R (s C + theta x C + tau).
    """
    pose = image.cam_from_world()
    R, t, C = pose.rotation.matrix(), pose.translation, image.projection_center()
    directions = np.zeros((6, 7))
    for axis in range(3):
        theta = np.eye(3)[axis]
        w = -R @ theta
        directions[:3, axis] = w
        directions[3:, axis] = np.cross(w, t) - R @ np.cross(theta, C)
        directions[3:, 3 + axis] = -R @ theta
    directions[3:, 6] = -R @ C
    return directions
