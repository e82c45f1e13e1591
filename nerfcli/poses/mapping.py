"""From matches to a model: incremental mapping with second chances, the principal point, COLMAP files."""

import shutil
from pathlib import Path
from typing import Any

import pycolmap

from nerfcli.poses.database import evidence
from nerfcli.poses.features import match
from nerfcli.poses.job import Job, Report
from nerfcli.poses.pairs import all_pairs
from nerfcli.poses.reasons import FEW_FEATURES, FEW_MATCHES

# Registered shares below which the mapper gets another chance; a photo or two missing is often the photo's own fault.
_GOOD_SHARE = 0.9
# A principal point farther than this from the centre, as a share of the size, is a fit to noise.
_PRINCIPAL_POINT_RANGE = 0.05
_PRINCIPAL_POINT_MIN_PHOTOS = 30
# Two more unknowns among thousands of observations lower the error by less than this if they fit nothing but noise.
_PRINCIPAL_POINT_GAIN = 0.001


def reconstruct(job: Job, report: Report) -> tuple[list[pycolmap.Reconstruction], list[dict[str, Any]]]:
    """The models of the best attempt, largest first, and what each attempt gave.

    The first attempt has pycolmap's own thresholds. If it leaves out many photos that match some other one well, the
    next one starts from a pair with a smaller baseline. If photos are still missing, and not all pairs were compared,
    the rest is compared before the last attempt.
    """
    attempts: list[dict[str, Any]] = []
    best: list[pycolmap.Reconstruction] = []

    def attempt(what: str, **start: float) -> None:
        nonlocal best
        models = _map(job, report, attempt=len(attempts), **start)
        attempts.append({"what": what, "models": [model.num_reg_images() for model in models]})
        if models and (not best or models[0].num_reg_images() > best[0].num_reg_images()):
            best = models

    def enough(photos: list[dict[str, Any]]) -> bool:
        return bool(best) and best[0].num_reg_images() >= _GOOD_SHARE * len(photos)

    attempt("default thresholds")
    found = evidence(job)
    if not enough([photo for photo in found if photo["best_matches"] >= FEW_MATCHES]):
        attempt("start from a smaller baseline", init_min_tri_angle=8.0, init_min_num_inliers=50)
    compared = set(job.pairs)
    rest = [pair for pair in all_pairs(len(job.files)) if pair not in compared]
    if rest and not enough([photo for photo in found if photo["features"] >= FEW_FEATURES]):
        match(job, rest, report)
        attempt("every pair compared")
    return best, attempts


def refine_principal_point(model: pycolmap.Reconstruction, threads: int) -> pycolmap.Reconstruction:
    """The model after a bundle adjustment with free principal points, or as it was where that does not pay.

    It pays if there are 30 photos or more, the mean reprojection error falls by a thousandth, and no principal point
    is farther than a twentieth of the size from the centre.
    """
    if model.num_reg_images() < _PRINCIPAL_POINT_MIN_PHOTOS:
        return model
    refined = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    pycolmap.bundle_adjustment(refined, options)
    refined.update_point_3d_errors()
    before, after = (m.compute_mean_reprojection_error() for m in (model, refined))
    centred = all(
        abs(camera.principal_point_x / camera.width - 0.5) < _PRINCIPAL_POINT_RANGE
        and abs(camera.principal_point_y / camera.height - 0.5) < _PRINCIPAL_POINT_RANGE
        for camera in refined.cameras.values()
    )
    return refined if centred and after < (1 - _PRINCIPAL_POINT_GAIN) * before else model


def photo_numbers(model: pycolmap.Reconstruction, job: Job) -> list[int]:
    """Numbers of the photos that a model places, rising."""
    return sorted(job.files.index(model.image(image_id).name) for image_id in model.reg_image_ids())


def describe_cameras(model: pycolmap.Reconstruction) -> list[dict[str, Any]]:
    """Intrinsics, for the report, of the cameras that took the placed photos."""
    counts: dict[int, int] = {}
    for image_id in model.reg_image_ids():
        camera_id = model.image(image_id).camera_id
        counts[camera_id] = counts.get(camera_id, 0) + 1
    return [
        {
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "params": [float(value) for value in camera.params],
            "focal_from_exif": camera.has_prior_focal_length,
            "images": counts[camera_id],
        }
        for camera_id, camera in sorted(model.cameras.items())
        if camera_id in counts
    ]


def write_model(model: pycolmap.Reconstruction, job: Job) -> None:
    """Write sparse/0 into the job's folder, with the photos' own names."""
    for image in model.images.values():
        image.name = job.names[job.files.index(image.name)]
    folder = Path(job.folder) / "sparse" / "0"
    shutil.rmtree(folder, ignore_errors=True)  # of a run that was killed before it said that it was complete
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def _map(
    job: Job, report: Report, *, attempt: int, init_min_tri_angle: float = 16.0, init_min_num_inliers: float = 100
) -> list[pycolmap.Reconstruction]:
    """One run of the incremental mapper; its models, largest first, errors filled in."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = job.threads
    seed = job.seed + attempt
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    # Small captures are no less whole; what is the largest is decided below.
    options.min_model_size = 3
    options.mapper.init_min_tri_angle = init_min_tri_angle
    options.mapper.init_min_num_inliers = int(init_min_num_inliers)
    options.mapper.abs_pose_min_num_inliers = FEW_MATCHES
    output = Path(job.folder) / f"models_{attempt}"
    output.mkdir(exist_ok=True)
    placed = 0

    def started() -> None:
        nonlocal placed
        placed = 2
        report("map", placed, len(job.files))

    def placed_one() -> None:
        nonlocal placed
        placed += 1
        report("map", min(placed, len(job.files)), len(job.files))

    models = pycolmap.incremental_mapping(
        str(job.database),
        str(job.photos),
        str(output),
        options=options,
        initial_image_pair_callback=started,
        next_image_callback=placed_one,
    )
    for model in models.values():
        model.update_point_3d_errors()
    return sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)
