"""Examine a model after mapping: lens model, contradictions, acceptance, uncertainty."""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import pycolmap

from nerfcli.matching.graph import connected_groups
from nerfcli.poses.input.job import Job
from nerfcli.poses.judge.acceptance import Verdict, judge, nothing_placed
from nerfcli.poses.judge.checks import Checks
from nerfcli.poses.judge.contradictions import leave_out_contradicting, without_photos
from nerfcli.poses.judge.parallax import RotationFit, best_rotation_fit, panorama_rotation_fit
from nerfcli.poses.judge.uncertainty import pose_blur_px
from nerfcli.poses.model.intrinsics import ModelLenses, choose_lenses
from nerfcli.poses.model.lens_observability import focal_is_determined
from nerfcli.poses.model.localise import shared_pairs
from nerfcli.poses.model.reasons import FEW_MATCHES, MIN_MATCHES
from nerfcli.poses.model.two_views import VerifiedPair, read_verified_pairs


@dataclass(frozen=True)
class ExaminedModel:
    """A model after examination, with the results for the report.

    left_out: why photos were left out, by number. blur_px: of each photo's pose, by number. details: for the report.
    uncertainty: of the lenses, by camera id, see `lens_observability.uncertainty`.
    """

    model: pycolmap.Reconstruction | None
    verdict: Verdict
    left_out: dict[int, str]
    blur_px: dict[int, float]
    details: dict[str, Any]
    uncertainty: dict[int, dict[str, Any]] = field(default_factory=dict)


def examine(
    models: list[pycolmap.Reconstruction],
    job: Job,
    report: Callable[[str, int, int], None],
    *,
    localised: Sequence[int] = (),
    checks: Checks | None = None,
) -> ExaminedModel:
    """Leave out contradicting photos of the first model, choose lenses, adjust, judge, and measure the uncertainty.

    A check that cannot be computed is left out and listed in `details["not_computed"]`; the others go on.

    `report` is called with ("check", done, total); `localised` are ids of images that are supported by points of the
    model instead of a pair.
    """
    checks = Checks() if checks is None else checks
    pairs = read_verified_pairs(job.database, min_matches=MIN_MATCHES)
    strong = [pair for pair in pairs if pair.matches >= FEW_MATCHES]
    turn = checks.run("parallax", lambda: _rotation_fit(strong, job), otherwise=None)
    joined = connected_groups(job.image_ids, [(pair.one, pair.other) for pair in strong])
    details: dict[str, Any] = {"parts": [len(part) for part in joined if len(part) > 1]}
    if not models:
        return ExaminedModel(None, nothing_placed(turn), {}, {}, details | {"not_computed": checks.not_computed})
    names = dict(zip(job.files, job.names, strict=True))
    report("check", 0, 4)
    mapped = without_photos(models[0])
    held: list[VerifiedPair] = checks.run(
        "points of single photos", lambda: shared_pairs(mapped, localised, min_matches=MIN_MATCHES), otherwise=[]
    )
    model, left_out = checks.run(
        "contradicting photos", lambda: leave_out_contradicting(mapped, [*pairs, *held]), otherwise=(mapped, {})
    )
    report("check", 1, 4)
    lenses = checks.run("lens models", lambda: _with_lenses(model, job), otherwise=ModelLenses(model, [], {}))
    model = lenses.model
    details["lenses"] = [asdict(candidate) for candidate in lenses.candidates]
    report("check", 2, 4)
    verdict = judge(
        model,
        pairs,
        held=held,
        turn=turn,
        names=names,
        seed=job.seed,
        threads=job.threads,
        given=job.given_cameras,
        determined=[camera for camera, found in lenses.uncertainty.items() if focal_is_determined(found)],
        fixed=job.fixed_cameras,
        checks=checks,
    )
    report("check", 3, 4)
    blur: dict[int, float] = {}
    if verdict.accepted and model.num_reg_images() <= 500:  # with more photos, the joint covariance takes minutes
        blur = checks.run(
            "pose uncertainty",
            lambda: pose_blur_px(model, threads=job.threads, fixed=job.fixed_cameras),
            otherwise=blur,
        )
    report("check", 4, 4)
    # In one pass, since a photo's own name may contain the numbered name of another one.
    reasons = {
        job.numbers[image_id]: re.sub(r"\d+\.\w+", lambda file: names.get(file[0], file[0]), reason)
        for image_id, reason in left_out.items()
    }
    details["not_computed"] = checks.not_computed
    return ExaminedModel(
        model,
        verdict,
        reasons,
        {job.numbers[image_id]: px for image_id, px in blur.items()},
        details,
        lenses.uncertainty,
    )


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
    return choose_lenses(
        model,
        seed=job.seed,
        threads=job.threads,
        fixed=job.fixed_cameras,
        named=named,
        exif_focal_px=exif_focal_px,
    )
