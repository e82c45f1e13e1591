"""What became of each photo: the content of poses_report.json."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import nerfcli
from nerfcli.errors import TOO_FEW_PHOTOS, UserError
from nerfcli.poses.photos import MIN_PHOTOS, Photos
from nerfcli.poses.reasons import Evidence, dominant, reason
from nerfcli.poses.settings import PoseSettings


@dataclass(frozen=True)
class ImageReport:
    """A photo, whether it was registered, and if not why."""

    name: str
    registered: bool
    reason: str | None


@dataclass(frozen=True)
class PosesReport:
    """What `poses_report.json` holds, under the same names.

    seconds: per stage, of the call that wrote the report; what an earlier one left is not in them. models: the sizes of
    all models found, the kept one first. attempts: what each run of the mapper gave. matching: the rule for pairs, and
    their number. points: how many the kept model has.
    """

    registered: int
    total: int
    seconds: dict[str, float]
    images: tuple[ImageReport, ...]
    mean_reprojection_error_px: float
    principal_point_refined: bool
    points: int
    cameras: tuple[dict[str, Any], ...]
    models: tuple[int, ...]
    attempts: tuple[dict[str, Any], ...]
    matching: dict[str, Any]
    settings: PoseSettings
    versions: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """Plain lists and dictionaries."""
        return asdict(self)


def make_report(
    photos: Photos, settings: PoseSettings, *, result: Mapping[str, Any], matching: dict[str, Any]
) -> PosesReport:
    """Put what the worker found into words."""
    models: list[list[int]] = result["models"]
    images = {name: ImageReport(name, False, f"unreadable: {why}") for name, why in photos.unreadable.items()}
    for number, name in enumerate(photos.names):
        if models and number in models[0]:
            images[name] = ImageReport(name, True, None)
        else:
            elsewhere = max((len(model) for model in models[1:] if number in model), default=0)
            known = Evidence(**result["evidence"][number], other_model_size=elsewhere)
            images[name] = ImageReport(name, False, reason(known))
    return PosesReport(
        registered=len(models[0]) if models else 0,
        total=len(images),
        seconds=result["seconds"],
        images=tuple(images[name] for name in sorted(images)),
        mean_reprojection_error_px=result.get("mean_reprojection_error_px", 0.0),
        principal_point_refined=result.get("principal_point_refined", False),
        points=result.get("points", 0),
        cameras=tuple(result.get("cameras", ())),
        models=tuple(len(model) for model in models),
        attempts=tuple(result["attempts"]),
        matching=matching,
        settings=settings,
        versions={"nerfcli": nerfcli.__version__, **result["versions"]},
    )


def require_enough(report: PosesReport, photos_dir: Path) -> None:
    """Refuse a result with too few photos.

    Raises:
        UserError: exit code 4, with the reason that most of the others share.
    """
    if report.registered >= max(MIN_PHOTOS, report.settings.min_registered * report.total):
        return
    reasons = [image.reason for image in report.images if image.reason]
    kind, advice = dominant(reasons)
    example = next(text for text in reasons if text.startswith(kind))
    placed = f"only {report.registered} of {report.total} photos could be placed ({photos_dir})"
    raise UserError(f"{placed}; most of the others: {example}", advice, TOO_FEW_PHOTOS)
