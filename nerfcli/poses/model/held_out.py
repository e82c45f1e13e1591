"""Bundle adjustment without a tenth of the observations, and the errors of these held-out observations afterwards.

The mean reprojection error is measured on observations that were fitted. Observations that were not fitted measure how
well poses and intrinsics generalise; they are used to compare camera models and to accept results.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from nerfcli.poses.input.job import Solver
from nerfcli.poses.model.projection import Array, across_edge, offsets_px

# Beyond this, more observations cost time and change nothing; a part of the points is adjusted instead.
MOST_OBSERVATIONS = 30_000
# A robust adjustment downweights observations from this many times the usual error: 95 % efficient for normal noise.
_LOSS_FROM = 2.4
_LEAST_LOSS_PX = 0.3
# A point with fewer observations gives none away: at least two must remain to determine it.
_MIN_TRACK = 3
MAPPER = pycolmap.IncrementalMapperOptions()
# Observations with larger errors do not fit a model. Errors are clipped at this value: one wrong match must not decide.
MOST_ERROR_PX = MAPPER.filter_max_reproj_error
LEAST_ANGLE_DEG = MAPPER.filter_min_tri_angle


@dataclass(frozen=True)
class HeldOutObservations:
    """Observations that were taken out of a model: image ids (n,), point ids (n,), pixels (n, 2)."""

    images: NDArray[np.int64]
    points: NDArray[np.int64]
    pixels: Array


def split(model: pycolmap.Reconstruction, *, seed: int) -> tuple[pycolmap.Reconstruction, HeldOutObservations]:
    """Return a copy of a model without a random tenth of the observations, and these; at most one of each point.

    Points with fewer than three observations give none away. The copy of a large model has only some of the points.
    """
    rng = np.random.default_rng(seed)
    copy = pycolmap.Reconstruction(model)
    point_ids = np.array(sorted(copy.point3D_ids()), dtype=np.int64)
    kept_fraction = min(1.0, MOST_OBSERVATIONS / max(copy.compute_num_observations(), 1))
    dropped = rng.uniform(size=len(point_ids)) >= kept_fraction
    for point_id in point_ids[dropped]:
        copy.delete_point3D(int(point_id))
    lengths = np.array([copy.point3D(int(point_id)).track.length() for point_id in point_ids[~dropped]])
    # One observation of each of as many points as needed to take a tenth of all observations.
    taken = (lengths >= _MIN_TRACK) & (rng.uniform(size=len(lengths)) < 0.1 * lengths)
    images, points, pixels = [], [], []
    for point_id, length in zip(point_ids[~dropped][taken], lengths[taken], strict=True):
        element = copy.point3D(int(point_id)).track.elements[int(rng.integers(length))]
        image = copy.image(element.image_id)
        images.append(element.image_id)
        points.append(int(point_id))
        pixels.append(np.asarray(image.points2D[element.point2D_idx].xy))
        copy.delete_observation(element.image_id, element.point2D_idx)
    return copy, HeldOutObservations(
        np.array(images, dtype=np.int64), np.array(points, dtype=np.int64), np.array(pixels, dtype=float).reshape(-1, 2)
    )


def errors_px(model: pycolmap.Reconstruction, held: HeldOutObservations) -> Array:
    """Return the reprojection error of each held-out observation, (n,); inf if its point does not project."""
    errors = np.full(len(held.points), np.inf)
    for index, (image_id, point_id) in enumerate(zip(held.images, held.points, strict=True)):
        image = model.image(int(image_id))
        projected = image.project_point(model.point3D(int(point_id)).xyz)
        if projected is not None:
            offset = across_edge(model.camera(image.camera_id), (projected - held.pixels[index])[None])
            errors[index] = np.linalg.norm(offset)
    return errors


def gain(before: Array, after: Array) -> float:
    """Return by how many standard errors the mean of paired errors fell."""
    difference = before - after
    if len(difference) < 2 or difference.std() == 0:
        return 0.0
    return float(difference.mean() / (difference.std() / np.sqrt(len(difference))))


def drop_misfits(model: pycolmap.Reconstruction) -> None:
    """Drop the observations of a model that do not fit it, and the points with too small an angle, in place."""
    pycolmap.ObservationManager(model).filter_all_points3D(MOST_ERROR_PX, LEAST_ANGLE_DEG)
    model.update_point_3d_errors()


def adjust(
    model: pycolmap.Reconstruction,
    solver: Solver = Solver(),
    *,
    principal_points: bool = False,
    focal_lengths: bool = True,
    distortion: bool = True,
    robust_px: float | None = None,
    tolerance: float = 1e-9,
) -> pycolmap.CeresBundleAdjuster:
    """Run bundle adjustment of a whole model in place until it converges; return the adjuster, for the covariance.

    Args:
        robust_px: error from which observations are downweighted (Cauchy loss); None for squared errors.
        tolerance: the relative change of the cost per iteration at which it ends. The default is full convergence: of
            two models that are compared, neither must look better because it was adjusted longer.
    """
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False,
        refine_principal_point=principal_points,
        refine_focal_length=focal_lengths,
        refine_extra_params=distortion,
    )
    options.ceres.solver_options.num_threads = solver.threads
    options.ceres.solver_options.max_num_iterations = 200
    options.ceres.solver_options.function_tolerance = tolerance
    if robust_px is not None:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = robust_px
        # It converges slowly, over hundreds of iterations that change nothing significant.
        options.ceres.solver_options.max_num_iterations = 40
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for camera_id in solver.fixed:
        config.set_constant_cam_intrinsics(camera_id)
    # Points, not cameras, fix the gauge, so that every camera has a covariance.
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.THREE_POINTS)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    return adjuster


def loss_scale_px(errors: Array) -> float:
    """Return the error from which a robust adjustment downweights observations, given all errors in pixels."""
    finite = errors[np.isfinite(errors)]
    if len(finite) == 0:
        return _LEAST_LOSS_PX
    usual = float(np.median(finite)) / 1.1774  # of one coordinate, if the noise is normal
    return max(_LOSS_FROM * usual, _LEAST_LOSS_PX)


def observation_errors_px(model: pycolmap.Reconstruction) -> Array:
    """Return the reprojection errors of a model's observations, (n,), without points that do not project."""
    errors = []
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        seen = image.get_observation_points2D()
        if not seen:
            continue
        points = np.array([model.point3D(point.point3D_id).xyz for point in seen])
        pose = image.cam_from_world()
        local = points @ pose.rotation.matrix().T + pose.translation
        pixels = np.array([point.xy for point in seen])
        errors.append(np.linalg.norm(offsets_px(model.camera(image.camera_id), local, pixels), axis=1))
    joined = np.concatenate([np.zeros(0), *errors])
    return joined[np.isfinite(joined)]


def residual_deviation_px(model: pycolmap.Reconstruction) -> float:
    """Estimate the standard deviation of one coordinate of an observation from the residuals, without bias."""
    errors = observation_errors_px(model)
    unknowns = 6 * model.num_reg_images() + 3 * model.num_points3D() - 7
    return float(np.sqrt((errors**2).sum() / max(2 * len(errors) - unknowns, 1)))
