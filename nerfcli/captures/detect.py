"""Detect the convention of a capture by comparing hypotheses with its photos.

Four properties are tested: the camera axes and the direction of the transforms (together, for each picture size that
the intrinsics may refer to), then this size alone, then the half pixel. The answers to each question are compared with
the best answers to the others.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from nerfcli.captures.axes import Convention, all_axes, opencv_from_axes, poses_of, reinterpreted_poses
from nerfcli.captures.capture import Capture
from nerfcli.captures.evidence import FrustumEvidence, MatchEvidence, ObservationEvidence, match_neighbours
from nerfcli.errors import UserError

# Intrinsics for another size belong to photos before or after downscaling by a power of two.
SCALES = (1.0, 0.125, 0.25, 0.5, 2.0, 4.0, 8.0)

# A hypothesis holds if at least this fraction of the items agrees with it, and if it is better than the next by this
# factor and by more than the noise: the 99 % interval of the difference under resampling of photos.
LEAST_FRACTION = 0.5
LEAST_RATIO = 1.2

# The properties of a convention that each question is about.
_FIELDS = {
    "axes and direction": ("axes", "inverted"),
    "image size": ("intrinsics_scale",),
    "pixel centre": ("pixel_centre",),
}

Evidence = ObservationEvidence | MatchEvidence | FrustumEvidence


@dataclass(frozen=True)
class HypothesisScore:
    """One hypothesis and the evidence for it.

    Args:
        median_px: median error of the items; infinite if most are behind a camera.
        inlier_fraction: the fraction of items with a small error.
    """

    convention: Convention
    as_format_says: bool
    median_px: float
    inlier_fraction: float


@dataclass(frozen=True)
class Question:
    """One question with its answers, best first.

    Args:
        name: "axes and direction", "image size" or "pixel centre".
        answers: the hypotheses, best first, always including that of the format.
        verdict: "holds", "not decidable" or "none holds".
        ratio: how many times better the best is than the next: by medians, or by inlier ratios if medians cannot tell.
        reason: why no hypothesis holds; "" if one does.
    """

    name: str
    answers: tuple[HypothesisScore, ...]
    verdict: str
    ratio: float
    reason: str


@dataclass(frozen=True)
class Detection:
    """Result of detecting a convention.

    Args:
        evidence: the kind of evidence, with numbers of items.
        convention: the answers that hold; the format's own where no answer holds.
    """

    evidence: str
    questions: tuple[Question, ...]
    convention: Convention
    declared: Convention

    @property
    def as_format_says(self) -> bool:
        """True if nothing contradicts the format's own convention."""
        return self.convention == self.declared and not any(
            question.verdict == "none holds" for question in self.questions
        )


def detect(capture: Capture, *, axes: str, progress: Callable[[float, str], None]) -> Detection:
    """Score hypotheses about a capture's convention by the evidence of its photos.

    The evidence is the observations of its 3D points, if it has them; else SIFT matches between its photos; else
    the visibility of its points in its pictures.

    Args:
        axes: the camera axes that the format prescribes.
        progress: called with the fraction of the work that is done, and a short text.
    """
    evidence = _evidence(capture, progress)
    declared = Convention(axes)
    poses = poses_of(capture)
    conventions = [Convention(name, inverted) for inverted in (False, True) for name in _different_axes(axes)]
    best, question = _axes_and_scale(evidence, poses, conventions, declared)
    questions = [question]
    further = [
        ("image size", [replace(best, intrinsics_scale=scale) for scale in SCALES]),
        ("pixel centre", [replace(best, pixel_centre=centre) for centre in (0.5, 0.0)]),
    ]
    for name, variants in further if evidence.shows_intrinsics else ():
        tried = []
        for variant in variants:
            in_opencv = reinterpreted_poses(poses, variant, parsed_axes=axes)
            tried.append((variant, evidence.errors_px(evidence.directions(variant), in_opencv)))
        question = _question(name, tried, declared, evidence)
        questions.append(question)
        if question.verdict == "holds":
            best = question.answers[0].convention
        else:
            best = replace(best, **{field: getattr(declared, field) for field in _FIELDS[name]})
    if questions[0].verdict != "holds":
        best = declared
    return Detection(evidence.name, tuple(questions), best, declared)


def _evidence(capture: Capture, progress: Callable[[float, str], None]) -> Evidence:
    seen = capture.observations
    if seen is not None and (seen.point_index >= 0).sum() >= 20:
        return ObservationEvidence(capture)
    pairs, cameras = match_neighbours(capture.frames, progress=progress)
    if pairs:
        return MatchEvidence(pairs, cameras, len(capture.frames))
    if len(capture.points):
        return FrustumEvidence(capture)
    hint = "give the photo folder with --images"
    raise UserError("the convention cannot be detected: no photo matches another, and there are no 3D points", hint)


def _different_axes(declared: str) -> Iterable[str]:
    """Yield all camera axes, the declared ones first and as they were declared."""
    yield declared
    own = opencv_from_axes(declared)
    yield from (axes for axes in all_axes() if not np.array_equal(opencv_from_axes(axes), own))


def _axes_and_scale(
    evidence: Evidence, poses: np.ndarray, conventions: list[Convention], declared: Convention
) -> tuple[Convention, Question]:
    """Return the best convention, including its scale, and the question of axes and direction at that scale."""
    tried = []
    for scale in SCALES if evidence.shows_intrinsics else (1.0,):
        directions = evidence.directions(replace(declared, intrinsics_scale=scale))
        for convention in conventions:
            errors = evidence.errors_px(directions, reinterpreted_poses(poses, convention, parsed_axes=declared.axes))
            tried.append((replace(convention, intrinsics_scale=scale), errors))
    best, _ = min(tried, key=lambda pair: _rank(pair[1], evidence.threshold_px))
    at_its_scale = [pair for pair in tried if pair[0].intrinsics_scale == best.intrinsics_scale]
    return best, _question("axes and direction", at_its_scale, declared, evidence)


def _rank(errors: np.ndarray, threshold_px: float) -> tuple[float, float]:
    """Return a sort key, smaller is better: the median error; if most items are behind a camera, the inlier ratio."""
    return float(np.median(errors)), -float(np.mean(errors <= threshold_px))


def _question(
    name: str, tried: list[tuple[Convention, np.ndarray]], declared: Convention, evidence: Evidence
) -> Question:
    ranked = sorted(tried, key=lambda pair: _rank(pair[1], evidence.threshold_px))
    answers = tuple(
        HypothesisScore(
            convention,
            all(getattr(convention, field) == getattr(declared, field) for field in _FIELDS[name]),
            float(np.median(errors)),
            float(np.mean(errors <= evidence.threshold_px)),
        )
        for convention, errors in ranked
    )
    (_, best), (_, second) = ranked[:2]
    by_fraction = not 0 < answers[0].median_px < np.inf and not answers[0].median_px < answers[1].median_px
    if by_fraction:
        ratio = answers[0].inlier_fraction / max(answers[1].inlier_fraction, 1e-9)
        low, high = _interval(best, second, evidence.groups, partial(_minus_inliers, evidence.threshold_px))
        what = f"the inlier ratios differ by {100 * (answers[0].inlier_fraction - answers[1].inlier_fraction):.1f} %"
    else:
        ratio = answers[1].median_px / max(answers[0].median_px, 1e-9)
        low, high = _interval(best, second, evidence.groups, _median)
        what = f"the medians differ by {answers[1].median_px - answers[0].median_px:.2g} px"
    if answers[0].inlier_fraction < LEAST_FRACTION and evidence.shows_intrinsics:
        return Question(name, answers, "none holds", ratio, "most of the evidence contradicts each of them")
    if not (low > 0 and ratio >= LEAST_RATIO):
        noise = (high - low) / 2
        too_little = f"less than noise ({noise:.2g})" if low <= 0 else "which a small systematic error could cause"
        reason = f"{what}, {too_little}"
        return Question(name, answers, "not decidable", ratio, reason)
    return Question(name, answers, "holds", ratio, "")


def _interval(
    best: np.ndarray, second: np.ndarray, groups: np.ndarray, statistic: Callable[[np.ndarray, np.ndarray], float]
) -> tuple[float, float]:
    """Return the 99 % interval of the statistic of `second` minus that of `best`, under resampling of photos.

    With few photos, the items themselves are resampled. The statistic is of errors in ascending order, given how often
    each was drawn.
    """
    rng = np.random.default_rng(0)
    names, members = np.unique(groups, return_inverse=True)
    if len(names) < 5:
        members = np.arange(len(groups))
    count = int(members.max()) + 1
    # Infinite errors are limited, because differences of infinities are undefined.
    best, second = np.minimum(best, 1e6), np.minimum(second, 1e6)
    # Sorted once: the median of a sample is then found by counting, in a fifth of the time.
    ascending = [(errors[order], members[order]) for errors in (second, best) for order in [np.argsort(errors)]]
    differences = []
    for _ in range(400):
        times = np.bincount(rng.integers(0, count, count), minlength=count)
        of_second, of_best = (statistic(errors, times[owners]) for errors, owners in ascending)
        differences.append(of_second - of_best)
    low, high = np.quantile(differences, (0.005, 0.995))
    return float(low), float(high)


def _median(ascending: np.ndarray, times: np.ndarray) -> float:
    """Return the median of errors in ascending order, each of which was drawn so many times."""
    until = np.cumsum(times)
    lower, upper = until.searchsorted(((until[-1] - 1) // 2, until[-1] // 2), side="right")
    return float((ascending[lower] + ascending[upper]) / 2)


def _minus_inliers(threshold_px: float, ascending: np.ndarray, times: np.ndarray) -> float:
    """Return the negative fraction of the drawn errors within the threshold."""
    return -float(times[ascending <= threshold_px].sum() / times.sum())
