"""Content of poses_report.json: the result for each photo."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from statistics import median
from typing import Any

import nerfcli
from nerfcli.errors import TOO_FEW_PHOTOS, UserError, several
from nerfcli.poses.input.photos import MIN_PHOTOS, Photos
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.model.reasons import dominant, reason

# Fraction of all photos outside the largest part, above which the refusal blames the disconnected parts.
_MUCH_APART = 0.3


@dataclass(frozen=True)
class ImageReport:
    """A photo, whether it registered, and the reason if not.

    orientation: the EXIF orientation (1...8) that was applied before anything else; the camera is that of the upright
    picture. pose_blur_px: motion of a typical point in the photo by one standard deviation of its pose.
    """

    name: str
    registered: bool
    reason: str | None
    orientation: int | None = None
    pose_blur_px: float | None = None


@dataclass(frozen=True, kw_only=True)
class PosesReport:
    """Content of poses_report.json, with the same names.

    verdict: whether the result is accepted, why not, and all measurements (see `acceptance`). pose_blur_px: median,
    largest, and the photo that has the largest. parts: sizes of the groups of photos connected by matches.
    seconds: per stage, for the call that wrote the report; time spent in earlier calls is not included. models: the
    sizes of all models found, the kept one first. attempts: the result of each mapping attempt, and the "doubt" that is
    left about the last one, if any. matching: the rule for pairs, their number, and hashes of the photos, masks and
    files that were used. search: the search that the features are from, see `settings.Search`. points: number of points
    of the kept model. intrinsics: the given intrinsics, see `cameras.PhotoGroups`. strict: how held-out photos were
    placed afterwards, see `held_out_photos.place_held_out`. components: each model's photos and why it is not joined to
    the largest, ordered by size.
    not_computed: checks that could not be computed, and why.
    cut_short: what was stopped because it took far longer than planned.
    moving_foreground: facts about an object that turns in front of a static background, and its masks; see `turntable`.
    """

    registered: int
    total: int
    seconds: dict[str, float]
    images: tuple[ImageReport, ...]
    mean_reprojection_error_px: float = 0.0
    points: int = 0
    cameras: tuple[dict[str, Any], ...] = ()
    models: tuple[int, ...]
    attempts: tuple[dict[str, Any], ...]
    matching: dict[str, Any]
    search: dict[str, int]
    settings: PoseSettings
    versions: dict[str, str]
    verdict: dict[str, Any]
    pose_blur_px: dict[str, Any] | None
    parts: tuple[int, ...]
    intrinsics: dict[str, Any] | None = None
    strict: dict[str, Any] | None = None
    components: tuple[dict[str, Any], ...] = ()
    not_computed: dict[str, str] = field(default_factory=dict)
    moving_foreground: dict[str, Any] | None = None
    principal_points: dict[str, Any] | None = None
    cut_short: tuple[str, ...] = ()


def make_report(
    photos: Photos,
    settings: PoseSettings,
    *,
    result: Mapping[str, Any],
    matching: dict[str, Any],
    intrinsics: dict[str, Any] | None = None,
) -> PosesReport:
    """Make the report from the worker's result."""
    models = [set(names) for names in result["models"]]
    images = {name: ImageReport(name, False, f"unreadable: {why}") for name, why in photos.unreadable.items()}
    for photo in photos.photos:
        name, orientation = photo.name, photo.exif.orientation
        if models and name in models[0]:
            images[name] = ImageReport(name, True, None, orientation, result["pose_blur_px"].get(name))
        else:
            elsewhere = max((len(model) for model in models[1:] if name in model), default=0)
            known = {"other_model_size": elsewhere, "size_px": (photo.exif.width, photo.exif.height)}
            why = result["left_out"].get(name) or reason(**result["evidence"][name], **known)
            images[name] = ImageReport(name, False, why, orientation)
    blurs = sorted((image.pose_blur_px, image.name) for image in images.values() if image.pose_blur_px is not None)
    named_alike = {field.name: result[field.name] for field in fields(PosesReport) if field.name in result}
    content: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in named_alike.items()
    }
    content |= {
        "registered": len(models[0]) if models else 0,
        "total": len(images),
        "images": tuple(images[name] for name in sorted(images)),
        "models": tuple(len(model) for model in models),
        "matching": matching,
        "settings": settings,
        "versions": {"nerfcli": nerfcli.__version__, **result["versions"]},
        "pose_blur_px": {"median": median(px for px, _ in blurs), "largest": blurs[-1][0], "photo": blurs[-1][1]}
        if blurs
        else None,
        "intrinsics": intrinsics,
    }
    return PosesReport(**content)


def closing_notes(report: PosesReport) -> list[str]:
    """Return notes for the user on a result that is kept, one sentence each."""
    notes = []
    placed = {image.name for image in report.images if image.registered}
    if len(report.parts) > 1 and report.registered < report.total:
        sizes = " + ".join(str(size) for size in report.parts)
        notes.append(f"the photos form parts with few verified matches between them: {sizes} photos")
    for component in report.components[1:]:
        if placed.issuperset(component["photos"]):
            continue
        names = component["photos"]
        some = names[0] if len(names) == 1 else f"{names[0]} ... {names[-1]}"
        why = f": {component['apart']}" if component["apart"] else ""
        those = f"{component['size']} photos ({some})"
        notes.append(f"{those} form a model of their own{why}; estimate their poses separately")
    weak = [camera for camera in report.cameras if (camera.get("uncertainty") or {}).get("weak")]
    if weak:
        worst = max(weak, key=lambda camera: camera["uncertainty"]["focal_percent"])
        certain, images = worst["uncertainty"], worst["images"]
        which = f"{len(weak)} cameras; the worst, with" if len(weak) > 1 else "camera with"
        accuracy = f"focal length ± {certain['focal_percent']:.1f} %"
        if certain["distortion_border_px"] is not None:
            accuracy += f", distortion ± {certain['distortion_border_px']:.1f} px at the corners"
        weakest = f"{which} {several(images, 'photo')}: {accuracy}"
        notes.append(f"intrinsics are weakly determined ({weakest}): give --intrinsics")
    stabilised = report.principal_points
    if stabilised is not None and stabilised["kept"]:
        notes.append(
            "each photo has its own principal point, as with image stabilisation: error of held-out observations "
            f"{stabilised['shared_px']:.2f} -> {stabilised['own_px']:.2f} px"
        )
    notes += [attempt["doubt"] for attempt in report.attempts if "doubt" in attempt]
    notes += [f"cut short: {what}" for what in report.cut_short]
    for check, why in report.not_computed.items():
        notes.append(f"could not compute a check ({check}): {why}")
    return notes


def refusal(report: PosesReport, photos_dir: Path) -> UserError | None:
    """Return the error (exit code 4) of a refused result, or None: the evidence, or why most photos are missing."""
    failures = report.verdict["failures"]
    enough = report.registered >= max(MIN_PHOTOS, report.settings.min_registered * report.total)
    if failures and (enough or "baseline" in failures[0]["kind"]):
        first = failures[0]
        text = f"the poses of {photos_dir} cannot be trusted: {first['kind']}: {first['evidence']}"
        return UserError(text, first["advice"], TOO_FEW_PHOTOS)
    if enough:
        return None
    count = f"only {report.registered}" if report.registered else "none"
    placed = f"{count} of {report.total} photos registered ({photos_dir})"
    if sum(report.parts[1:]) > _MUCH_APART * report.total:
        sizes = " + ".join(str(size) for size in report.parts)
        text = f"{placed}: they form parts of {sizes} photos with few matches between them (disconnected)"
        advice = "take photos that connect the parts"
        if report.parts[1] >= MIN_PHOTOS:
            advice += ", or process each part separately"
        return UserError(text, advice, TOO_FEW_PHOTOS)
    reasons = [image.reason for image in report.images if image.reason]
    kind, advice = dominant(reasons)
    example = next(text for text in reasons if text.startswith(kind))
    others = "the other" if len(reasons) == 1 else "most of the others" if report.registered else "most of them"
    return UserError(f"{placed}; {others}: {example}", advice, TOO_FEW_PHOTOS)
