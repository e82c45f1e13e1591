"""The child process: pycolmap from photos to a model on disk. Run as `python -m nerfcli.poses.engine.worker JOB.json`.

pycolmap is C++ code that may end the process without a Python exception, so it runs in a separate process. This reads
a job, extracts features, matches, maps, refines, accepts and writes, continuing from the completed stages in the job's
folder, and leaves `sparse/0` and `result.json` there. It reports its progress on stdout as JSON lines {"stage", "done",
"total"}, and messages for the user as {"note"}. Everything else, including glog's lines, goes to stderr. It ends by
itself when its stdin closes, as happens whenever the parent dies.

Photos have numbers as names here: pycolmap sees `00000.jpg`, `00001.png`..., so that a space or an umlaut in a name
cannot break the list of pairs.
"""

import math
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from nerfcli.child import take_stdout
from nerfcli.poses.engine.attempts import map_with_fallbacks
from nerfcli.poses.engine.database import discard_if_damaged, evidence, feature_counts, name_images, register_photos
from nerfcli.poses.engine.features import extract, match, start_matching
from nerfcli.poses.engine.held_out_photos import place_held_out, training_part
from nerfcli.poses.engine.mapping import MappedModels, file_keys, mapping_key, read_mapped, write_mapped
from nerfcli.poses.engine.remap import ChosenModel, choose_model
from nerfcli.poses.engine.retrieval import select_pairs
from nerfcli.poses.engine.turntable import describe_motions, mask_turning_object, recall_masks
from nerfcli.poses.input.job import Job, Report, Tell, read_job, read_stage, stage_key, write_stage
from nerfcli.poses.judge.checks import checks_of
from nerfcli.poses.model.lens_evidence import lenses_of
from nerfcli.poses.model.principal_points import StabilisedModel, camera_of_lens, choose_principal_points
from nerfcli.poses.model.reasons import FEW_MATCHES
from nerfcli.poses.model.two_views import count_matches


def describe_result(chosen: ChosenModel, job: Job) -> dict[str, Any]:
    """Describe, for the report, how the chosen model came about, and what the checks say of it."""
    mapped, examined = chosen.mapped, chosen.examined
    placed = [] if examined.model is None else placed_names(examined.model, job)
    lacking = examined.details["not_computed"]  # of this model; ended attempts to map are skipped too
    ended = [f"{what}: {why}" for what, why in job.skipped_checks if what not in lacking]
    return {
        "attempts": mapped.attempts,
        "cut_short": [*mapped.cut_short, *ended],
        "evidence": evidence(mapped.job),
        "pairs": len(mapped.job.pairs),
        "search": {"max_image_size": mapped.job.max_image_size, "max_features": mapped.job.max_features},
        "versions": {"pycolmap": pycolmap.__version__, "ceres": pycolmap.__ceres_version__},
        "models": [placed, *(placed_names(other, job) for other in mapped.models[1:])] if mapped.models else [],
        "left_out": examined.left_out,
        "pose_blur_px": examined.blur_px,
        "verdict": examined.verdict.to_json(),
        "components": describe_components(mapped.models, mapped.job),
        **examined.details,
    }


def placed_names(model: pycolmap.Reconstruction, job: Job) -> list[str]:
    """Return the sorted names of the photos that a model places."""
    return sorted(job.name_of[image_id] for image_id in model.reg_image_ids())


def describe_cameras(
    model: pycolmap.Reconstruction, job: Job, uncertainty: Mapping[int, dict[str, Any]], *, lens_of: Mapping[int, int]
) -> list[dict[str, Any]]:
    """Describe, for the report, the intrinsics of the lenses of the placed photos, and their uncertainty.

    `lens_of` has the lens of each photo, by image id. Photos may have principal points of their own; the lens has their
    median.
    """
    photos: dict[int, list[int]] = {}
    for image_id in model.reg_image_ids():
        photos.setdefault(lens_of[image_id], []).append(image_id)
    cameras = {lens: camera_of_lens(model, taken) for lens, taken in sorted(photos.items())}
    return [
        {
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "params": camera.params.tolist(),
            "focal_from_exif": camera.has_prior_focal_length and lens not in job.given_cameras,
            "images": len(photos[lens]),
            "uncertainty": uncertainty.get(lens),
        }
        for lens, camera in cameras.items()
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
    for image_id, image in model.images.items():
        image.name = job.name_of[image_id]
    shutil.rmtree(job.model_folder, ignore_errors=True)  # left by a run that was killed before it was complete
    job.model_folder.mkdir(parents=True)
    model.write_binary(job.model_folder)


def describe_components(models: Sequence[pycolmap.Reconstruction], job: Job) -> list[dict[str, Any]]:
    """Describe each model of a job, the largest first, by the matches in the job's database.

    Per model {"size", "photos": names, "apart": why it is not part of the largest, None for that one}.
    """
    members = [placed_names(model, job) for model in models]
    pairs = [(count, job.name_of[one], job.name_of[other]) for one, other, count in count_matches(job.database)]
    apart = [None, *(_apart(set(photos), set(members[0]), pairs) for photos in members[1:])]
    return [{"size": len(photos), "photos": photos, "apart": why} for photos, why in zip(members, apart, strict=False)]


def _apart(photos: set[str], largest: set[str], pairs: Sequence[tuple[int, str, str]]) -> str:
    own = photos - largest
    between = [pair for pair in pairs if own.intersection(pair[1:]) and largest.intersection(pair[1:])]
    if not between:
        return "none of its photos matches a photo of the largest"
    count, one, other = max(between)
    best = f"{one} and {other}, {count} matches"
    strong = sum(pair[0] >= FEW_MATCHES for pair in between)
    if not strong:
        return f"no pair connects it well enough to the largest (best: {best})"
    pairs_connect = "1 pair connects" if strong == 1 else f"{strong} pairs connect"
    return f"{pairs_connect} it to the largest (strongest: {best}), but no consistent alignment was found"


def replace_non_finite(content: Any) -> Any:
    """Copy plain content, with None in place of every number that is not finite, which JSON cannot hold."""
    if isinstance(content, dict):
        return {key: replace_non_finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [replace_non_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


# The last stage's file, with the data for the report. The model is beside it, in sparse/0.
RESULT = "result.json"
# Increased when the same models would give another result, so that scenes of earlier versions are checked again.
_RESULT_VERSION = 6


def main(job_path: str) -> None:
    """Do one job and write its result."""
    send = take_stdout()
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value
    job = read_job(Path(job_path))
    pycolmap.set_random_seed(job.seed)

    def report(stage: str, done: int, total: int) -> None:
        send({"stage": stage, "done": done, "total": total})

    solve(job, report, lambda text: send({"note": text}))


def solve(job: Job, report: Report, tell: Tell) -> None:
    """Do a job, from photos to a model on disk, continuing from what earlier calls have done; write the result."""
    stored = recall_masks(job)
    path, key = Path(job.folder) / RESULT, result_key(job if stored is None else stored[0])
    there = read_stage(path, key)
    if there is not None and there["model_files"].items() <= file_keys(job.model_folder).items():
        if job.database.exists():
            name_images(job)
        return
    path.unlink(missing_ok=True)
    seconds = {"extract": 0.0, "match": 0.0, "map": 0.0, "check": 0.0}
    job, moving = _mask_object(job, report, tell, seconds=seconds) if stored is None else stored
    if moving is not None and moving["found"]:
        tell(describe_motions(moving))
    result = _estimate(training_part(job) if job.held_out else job, report, tell, seconds=seconds)
    mapped: Job = result.pop("job")
    if job.held_out:
        with _timed(seconds, "place"):
            result = place_held_out(job, mapped, result, report)
        result["model_files"] = file_keys(job.model_folder)  # these now contain the held-out photos
    result |= {"moving_foreground": moving, "seconds": seconds}
    write_stage(path, result_key(job), replace_non_finite(result))
    name_images(job)


def result_key(job: Job) -> str:
    """Return a hash of all that the result depends on."""
    return stage_key(mapping_key(job), job.skipped_checks, _RESULT_VERSION)


def _estimate(job: Job, report: Report, tell: Tell, *, seconds: dict[str, float]) -> dict[str, Any]:
    """Map the photos, refine and accept a model, write it, and return the data for the report and "job", as mapped."""
    mapped = _map(job, report, tell, seconds=seconds)
    with _timed(seconds, "check"):
        chosen = choose_model(mapped, report, tell)
    result = describe_result(chosen, job) | {"model_files": {}, "job": chosen.mapped.job}
    model, uncertainty = chosen.examined.model, chosen.examined.uncertainty
    if model is None:
        return result
    lens_of, finishing = lenses_of(model), checks_of(job)
    if chosen.examined.verdict.accepted:
        choose = partial(choose_principal_points, model, job.solver, report=report)
        with _timed(seconds, "stabilisation"):
            found = finishing.run("principal points", choose, otherwise=StabilisedModel(model, None, {}))
        model, result["principal_points"] = found.model, found.evidence and asdict(found.evidence)
        uncertainty = uncertainty | found.uncertainty
    model = finishing.run("colours of points", partial(colour_points, model, job), otherwise=model)
    result["not_computed"] |= finishing.not_computed
    write_model(model, job)
    return result | {
        "cameras": describe_cameras(model, job, uncertainty, lens_of=lens_of),
        "mean_reprojection_error_px": model.compute_mean_reprojection_error(),
        "points": model.num_points3D(),
        "model_files": file_keys(job.model_folder),
    }


def _map(job: Job, report: Report, tell: Tell, *, seconds: dict[str, float]) -> MappedModels:
    """Extract, match and map, unless the models of an earlier call are intact; either way they are on disk."""
    discard_if_damaged(job.database)
    key = mapping_key(job)
    mapped = read_mapped(job, key)
    if mapped is not None:
        tell("the photos are already mapped: running the checks")
        register_photos(mapped.job)  # a completed call has renamed the images to the photos' own names
        return mapped
    with _timed(seconds, "extract"):
        extract(job, report)
    counts = feature_counts(job)
    report("features", round(sum(counts) / len(counts)), job.max_features)
    with _timed(seconds, "match"):
        matched = select_pairs(job, report)
        start_matching(matched, matched.pairs)
        unmatched = match(matched, matched.pairs, report)
        if unmatched is not None:
            tell(f"cut short: {unmatched}")
    matches = sum(count for _, _, count in count_matches(matched.database)) // len(job.files)
    report("matches", matches, matches)
    with _timed(seconds, "map"):
        start = time.perf_counter()
        mapped = map_with_fallbacks(matched, report, tell)
        cut_short = mapped.cut_short if unmatched is None else (unmatched, *mapped.cut_short)
        return write_mapped(replace(mapped, seconds=time.perf_counter() - start, cut_short=cut_short), key)


def _mask_object(
    job: Job, report: Report, tell: Tell, *, seconds: dict[str, float]
) -> tuple[Job, dict[str, Any] | None]:
    """Return the job with masks of an object that turns in front of a static background, and facts to report, if any.

    Panoramas are not checked: what stands still in them is the tripod, or the person holding the camera.
    """
    if any(group.is_panorama for group in job.groups):
        return job, None
    checks, name = checks_of(job), "moving foreground"
    with _timed(seconds, "motions"):
        found = checks.run(name, lambda: mask_turning_object(job, tell), otherwise=None)
    if found is None:
        tell(f"could not check for an object moving in front of a static background: {checks.not_computed[name]}")
        return job, None
    return found


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = round(time.perf_counter() - start, 3)


if __name__ == "__main__":
    main(sys.argv[1])
