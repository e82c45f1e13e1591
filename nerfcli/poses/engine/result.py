"""Write the model that becomes the scene, and describe it and the other models for the report."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from nerfcli.poses.engine.mapped import file_keys
from nerfcli.poses.input.job import Job
from nerfcli.poses.model.principal_points import camera_of_lens
from nerfcli.poses.model.reasons import FEW_MATCHES
from nerfcli.poses.model.two_views import count_matches


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


def with_colours(model: pycolmap.Reconstruction, job: Job) -> pycolmap.Reconstruction:
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
