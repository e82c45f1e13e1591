"""Place held-out photos after structure from motion, which has not seen them, with everything else fixed.

Cameras, points and poses come from the training photos alone. Then features of the held-out photos are matched with
the training photos, and each held-out photo gets the pose that best projects the matched points to its features.
Nothing else changes, not by a bit: results measured on these photos depend on them only through their own poses.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap

from nerfcli.poses.engine.database import evidence
from nerfcli.poses.engine.features import extract, match, start_matching
from nerfcli.poses.engine.retrieval import select_pairs
from nerfcli.poses.input.job import Job, Report
from nerfcli.poses.model.held_out import MAPPER
from nerfcli.poses.model.locate import place
from nerfcli.poses.model.principal_points import LEAST_OBSERVATIONS, camera_of_lens, refine_with_principal_point
from nerfcli.poses.model.reasons import FEW_MATCHES, NO_LENS, NO_MODEL, NO_TRAINING_PHOTO


def move_held_out_last(job: Job) -> Job:
    """Return the job with cameras of only held-out photos moved last, so that the others keep their numbers."""
    held_out = frozenset(job.held_out)
    return replace(job, groups=tuple(sorted(job.groups, key=lambda group: held_out.issuperset(group.photos))))


def training_part(job: Job) -> Job:
    """Return the job of the training photos alone; their numbered files, and so their image ids, stay the same."""
    held_out = frozenset(job.held_out)
    kept = [number for number in range(len(job.files)) if number not in held_out]
    place = {number: index for index, number in enumerate(kept)}
    groups = [
        replace(group, photos=tuple(place[number] for number in group.photos if number in place))
        for group in job.groups
    ]
    return replace(
        job,
        files=tuple(job.files[number] for number in kept),
        names=tuple(job.names[number] for number in kept),
        keys=tuple(job.keys[number] for number in kept),
        masks=tuple(job.masks[number] for number in kept) if job.masks else (),
        groups=tuple(group for group in groups if group.photos),
        pairs=tuple((place[i], place[j]) for i, j in job.pairs if i in place and j in place),
        held_out=(),
    )


def place_held_out(job: Job, mapped: Job, result: dict[str, Any], report: Report) -> dict[str, Any]:
    """Place the held-out photos of a job in the model of its training photos, and add them to the model on disk.

    Returns the worker's result for `mapped`, the `training_part` of the job with the features and lenses of the model,
    as one for all photos, with "strict": how each held-out photo was placed.
    """
    if not result["models"]:
        names = [job.names[number] for number in job.held_out]
        unseen = {name: {"features": 0, "best_matches": 0, "best_partner": None} for name in names}
        return result | {"left_out": dict.fromkeys(names, NO_MODEL), "evidence": result["evidence"] | unseen}
    job = _with_features_and_lenses(job, mapped)
    extract(job, report)
    job = select_pairs(job, report)
    held_out = frozenset(job.held_out)
    across = tuple((i, j) for i, j in job.pairs if (i in held_out) != (j in held_out))
    start_matching(job, [(i, j) for i, j in job.pairs if not {i, j} <= held_out])
    unmatched = match(job, across, report)
    model = pycolmap.Reconstruction(job.model_folder)
    placed: dict[str, dict[str, Any]] = {}
    reasons: dict[str, str] = {}
    own = (result.get("principal_points") or {"kept": False})["kept"]
    for done, number in enumerate(job.held_out):
        found = _place(model, job, number, across, own_principal_point=own)
        if isinstance(found, str):
            reasons[job.names[number]] = found
        else:
            placed[job.names[number]] = found
        report("map", done + 1, len(job.held_out))
    model.write_binary(job.model_folder)
    largest, *others = result["models"]
    return result | {
        "models": [sorted([*largest, *placed]), *others],
        "left_out": result["left_out"] | reasons,
        "evidence": evidence(job),
        "pairs": result["pairs"] + len(across),
        "cut_short": [*result["cut_short"], *([] if unmatched is None else [unmatched])],
        "strict": {"held_out": [job.names[number] for number in job.held_out], "placed": placed},
    }


def _place(
    model: pycolmap.Reconstruction,
    job: Job,
    number: int,
    pairs: tuple[tuple[int, int], ...],
    *,
    own_principal_point: bool,
) -> dict[str, Any] | str:
    """Add one photo with its pose to the model; return its inliers and their mean error, or why it has no pose."""
    group = next(group for group in job.groups if number in group.photos)
    training = [job.image_ids[photo] for photo in group.photos if photo not in job.held_out]
    placed = [image_id for image_id in training if model.exists_image(image_id)]
    if not placed:
        return NO_LENS if training else NO_TRAINING_PHOTO
    camera = camera_of_lens(model, placed)
    pixels, points = _seen_points(model, job, number, pairs)
    mapper = {"max_error": MAPPER.abs_pose_max_error, "min_inlier_ratio": MAPPER.abs_pose_min_inlier_ratio}
    options = pycolmap.AbsolutePoseEstimationOptions(ransac={**mapper, "random_seed": job.seed})
    refinement = pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=False, refine_extra_params=False)
    found = None
    if len(points) >= FEW_MATCHES:
        found = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, options, refinement)
    if found is None or found["num_inliers"] < FEW_MATCHES:
        count = 0 if found is None else found["num_inliers"]
        return f"matches too few points of the training photos ({count} inliers of {len(points)})"
    inside = np.asarray(found["inlier_mask"], dtype=bool)
    pose: pycolmap.Rigid3d = found["cam_from_world"]
    if own_principal_point:
        camera.camera_id = job.image_ids[number]  # a new one
        if found["num_inliers"] >= LEAST_OBSERVATIONS:
            refined, shift = refine_with_principal_point(camera, pose.matrix(), pixels[inside], points[inside])
            pose = pycolmap.Rigid3d(refined)
            camera.principal_point_x += shift[0]
            camera.principal_point_y += shift[1]
    image_id = job.image_ids[number]
    place(model, camera, pose, image_id=image_id, name=job.names[number], pixels=pixels[inside])
    there = model.image(image_id)
    projected = [there.project_point(point) for point in points[inside]]
    errors = [np.linalg.norm(p - xy) for p, xy in zip(projected, pixels[inside], strict=True) if p is not None]
    return {"inliers": int(inside.sum()), "error_px": float(np.mean(errors))}


def _seen_points(
    model: pycolmap.Reconstruction, job: Job, number: int, pairs: tuple[tuple[int, int], ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) of a photo and their points (N, 3), from its verified matches with placed photos."""
    image_id = job.image_ids[number]
    seen: set[tuple[int, int]] = set()  # feature of the photo, point
    with pycolmap.Database.open(job.database) as database:
        features = database.read_keypoints(image_id)[:, :2].astype(np.float64)
        for i, j in pairs:
            if number not in (i, j):
                continue
            other_id = job.image_ids[j if i == number else i]
            if not model.exists_image(other_id) or not model.image(other_id).has_pose:
                continue
            matches = database.read_two_view_geometry(image_id, other_id).inlier_matches
            observed = model.image(other_id).points2D
            seen |= {(int(a), observed[int(b)].point3D_id) for a, b in matches if observed[int(b)].has_point3D()}
    rows = sorted(seen)
    pixels = features[[feature for feature, _ in rows]] if rows else np.zeros((0, 2))
    points = np.array([model.point3D(point).xyz for _, point in rows]).reshape(-1, 3)
    return pixels, points


def _with_features_and_lenses(job: Job, mapped: Job) -> Job:
    """Return the job with the features and lenses of a job of its training photos."""
    lenses = [replace(used, photos=group.photos) for used, group in zip(mapped.groups, job.groups, strict=False)]
    return replace(
        job,
        variant=mapped.variant,
        max_image_size=mapped.max_image_size,
        max_features=mapped.max_features,
        groups=(*lenses, *job.groups[len(lenses) :]),  # cameras without a training photo are the last ones
    )
