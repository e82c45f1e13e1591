"""Write the model that becomes the scene, and describe it and the other models for the report."""

import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from nerfcli.poses.engine.database import evidence
from nerfcli.poses.engine.mapping import file_keys
from nerfcli.poses.engine.remap import ChosenModel
from nerfcli.poses.input.job import Job
from nerfcli.poses.model.principal_points import camera_of_lens
from nerfcli.poses.model.reasons import FEW_MATCHES
from nerfcli.poses.model.two_views import count_matches


def describe_result(chosen: ChosenModel, job: Job) -> dict[str, Any]:
    """Describe, for the report, how the chosen model came about, and what the checks say of it."""
    mapped, examined = chosen.mapped, chosen.examined
    placed = [] if examined.model is None else photo_numbers(examined.model, job)
    lacking = examined.details["not_computed"]  # of this model; ended attempts to map are skipped too
    return {
        "attempts": mapped.attempts,
        "cut_short": [
            *mapped.cut_short,
            *(f"{what}: {why}" for what, why in job.skipped_checks if what not in lacking),
        ],
        "evidence": evidence(mapped.job),
        "pairs": len(mapped.job.pairs),
        "versions": {"pycolmap": pycolmap.__version__, "ceres": pycolmap.__ceres_version__},
        "models": [placed, *(photo_numbers(other, job) for other in mapped.models[1:])] if mapped.models else [],
        "left_out": {str(number): reason for number, reason in examined.left_out.items()},
        "pose_blur_px": {str(number): px for number, px in examined.blur_px.items()},
        "verdict": examined.verdict.to_json(),
        "components": describe_components(mapped.models, mapped.job),
        **examined.details,
    }


def photo_numbers(model: pycolmap.Reconstruction, job: Job) -> list[int]:
    """Return the numbers of the photos that a model places, in ascending order."""
    return sorted(job.numbers[image_id] for image_id in model.reg_image_ids())


def describe_cameras(
    model: pycolmap.Reconstruction,
    job: Job,
    uncertainty: Mapping[int, dict[str, Any]],
    *,
    lens_of: Mapping[int, int],
) -> list[dict[str, Any]]:
    """Describe, for the report, the intrinsics of the lenses of the placed photos, and their uncertainty.

    `lens_of` has the lens of each photo, by image id. Photos may have principal points of their own; the lens has their
    median.
    """
    photos: dict[int, list[int]] = {}
    for image_id in model.reg_image_ids():
        photos.setdefault(lens_of[image_id], []).append(image_id)
    cameras = [(lens, camera_of_lens(model, taken), len(taken)) for lens, taken in sorted(photos.items())]
    return [
        {
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "params": [float(value) for value in camera.params],
            "focal_from_exif": camera.has_prior_focal_length and lens not in job.given_cameras,
            "images": count,
            "uncertainty": uncertainty.get(lens),
        }
        for lens, camera, count in cameras
    ]


def colour_points(model: pycolmap.Reconstruction, job: Job) -> pycolmap.Reconstruction:
    """Return the model with coloured points: a recoloured copy if most have no colour, as after merging sub-models.

    Raises:
        RuntimeError, ValueError: pycolmap cannot read a photo.
    """
    black = sum(not np.any(point.color) for point in model.points3D.values())
    if 2 * black <= model.num_points3D():
        return model
    copy = pycolmap.Reconstruction(model)
    copy.extract_colors_for_all_images(job.photos, num_threads=job.threads)
    return copy


def write_model(model: pycolmap.Reconstruction, job: Job) -> None:
    """Write sparse/0 into the job's folder, with the photos' own names."""
    names = dict(zip(job.files, job.names, strict=True))
    for image in model.images.values():
        image.name = names[image.name]
    folder = _model_folder(job)
    shutil.rmtree(folder, ignore_errors=True)  # left by a run that was killed before it was complete
    folder.mkdir(parents=True)
    model.write_binary(folder)


def model_keys(job: Job) -> dict[str, str]:
    """Return a hash of each file of the model in the job's folder, by the file's name; none if there is no model."""
    return file_keys(_model_folder(job))


def _model_folder(job: Job) -> Path:
    return Path(job.folder) / "sparse" / "0"


def describe_components(models: Sequence[pycolmap.Reconstruction], job: Job) -> list[dict[str, Any]]:
    """Describe each model of a job, the largest first, by the matches in the job's database.

    Per model {"size", "photos": numbers, "apart": why it is not part of the largest, None for that one}.
    """
    members = [photo_numbers(model, job) for model in models]
    pairs = [(count, job.numbers[one], job.numbers[other]) for one, other, count in count_matches(job.database)]
    return [
        {
            "size": len(photos),
            "photos": photos,
            "apart": _apart(set(photos), set(members[0]), pairs, job.names) if index else None,
        }
        for index, photos in enumerate(members)
    ]


def _apart(photos: set[int], largest: set[int], pairs: Sequence[tuple[int, int, int]], names: Sequence[str]) -> str:
    own = photos - largest
    between = [pair for pair in pairs if own.intersection(pair[1:]) and largest.intersection(pair[1:])]
    if not between:
        return "none of its photos matches a photo of the largest"
    count, one, other = max(between)
    best = f"{names[one]} and {names[other]}, {count} matches"
    strong = sum(pair[0] >= FEW_MATCHES for pair in between)
    if not strong:
        return f"no pair connects it well enough to the largest (best: {best})"
    pairs_connect = "1 pair connects" if strong == 1 else f"{strong} pairs connect"
    return f"{pairs_connect} it to the largest (strongest: {best}), but no consistent alignment was found"


def replace_non_finite(content: Any) -> tuple[Any, dict[str, str]]:
    """Copy plain content, with None in place of every non-finite number.

    Args:
        content: dictionaries, lists, tuples and plain values. Tuples come back as lists.

    Returns:
        The copy, and the replaced numbers by their path: `{"lenses.0.gain": "inf"}`.

    Example:
        >>> replace_non_finite({"gain": [1.0, float("inf")]})
        ({'gain': [1.0, None]}, {'gain.1': 'inf'})
    """
    replaced: dict[str, str] = {}

    def copy(value: Any, place: str) -> Any:
        if isinstance(value, dict):
            return {key: copy(item, f"{place}.{key}" if place else str(key)) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [copy(item, f"{place}.{index}" if place else str(index)) for index, item in enumerate(value)]
        if isinstance(value, float) and not math.isfinite(value):
            replaced[place] = str(float(value))
            return None
        return value

    return copy(content, ""), replaced
