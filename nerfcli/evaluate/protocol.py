"""Evaluation of a run on its held-out photos: metrics, the name of the protocol that produced them, and warnings.

A metric measured between training views shows how well a field fills gaps; one beyond them, what the field knows. So
each held-out view comes with its distance and angle to the nearest training view.
"""

import hashlib
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import centres_of, focus_point, gaps_between
from nerfcli.errors import UserError, listed, several
from nerfcli.evaluate.billboards import Billboards, GeometryComparison, GeometryEvidence
from nerfcli.evaluate.ledger import Entry
from nerfcli.evaluate.metrics import LPIPS_NAME, Metrics, Perceptual, compare_fully, whole_windows
from nerfcli.evaluate.photos import ComparedImages, HeldOutPhoto, background_of, paired, without_hidden
from nerfcli.render.pictures import Renderable
from nerfcli.training.runs.files import TrainingSummary

# A view is an extrapolation if its nearest training view is farther than this many typical distances between these...
MOST_SPACINGS = 2.0
# ...or differs in direction by more than this fraction of the field of view, so that less than half of it overlaps.
MOST_TURN = 0.5
# Up to this many typical distances and degrees, two poses are those of the same photo.
_SAME_SPACINGS, _SAME_DEG = 0.01, 0.05


@dataclass(frozen=True)
class Novelty:
    """Novelty of one held-out view.

    Args:
        nearest: name of the training view whose centre is nearest.
        distance: distance to it, scene units.
        distance_relative: the same over the scene's radius (median distance of training views from their focus point).
        spacings: the same over the median distance of a training view to the nearest other one; None if there is none.
        angle_deg: angle between the optical axes of the two.
        kind: "interpolation" or "extrapolation": see `MOST_SPACINGS` and `MOST_TURN`.
    """

    nearest: str
    distance: float
    distance_relative: float | None
    spacings: float | None
    angle_deg: float
    kind: str

    @property
    def is_training_view(self) -> bool:
        """True if a training photo has the same pose."""
        is_there = self.distance == 0 if self.spacings is None else self.spacings <= _SAME_SPACINGS
        return is_there and self.angle_deg <= _SAME_DEG


def novelty(held_out: Sequence[Frame], training: Sequence[Frame]) -> list[Novelty]:
    """Compute the novelty of each held-out view; `training` has at least one view."""
    centres = centres_of(training)
    radius = float(np.median(np.linalg.norm(centres - focus_point(training), axis=1)))
    spacing = float(np.median(gaps_between(centres))) if len(training) > 1 else None
    found = []
    for frame in held_out:
        distances = np.linalg.norm(centres - frame.centre, axis=1)
        # Of several views in one place, use the one with the most similar direction.
        near = np.flatnonzero(distances <= distances.min() * (1 + 1e-9)).tolist()
        angles = [_angle_deg(frame, training[index]) for index in near]
        index = near[int(np.argmin(angles))]
        distance, angle = float(distances[index]), min(angles)
        spacings = distance / spacing if spacing else None
        too_far = spacings is not None and spacings > MOST_SPACINGS
        turned = angle > MOST_TURN * min(frame.camera.fov_deg)
        found.append(
            Novelty(
                nearest=training[index].name,
                distance=distance,
                distance_relative=distance / radius if radius > 0 else None,
                spacings=spacings,
                angle_deg=angle,
                kind="extrapolation" if too_far or turned else "interpolation",
            )
        )
    return found


def _angle_deg(one: Frame, other: Frame) -> float:
    first, second = one.world_from_cam[:3, 2], other.world_from_cam[:3, 2]
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))


PROTOCOL = "nerfcli-2"


@dataclass(frozen=True)
class PhotoMetrics:
    """Metrics of a held-out photo.

    Args:
        pixels: number of pixels that count.
        masked_pixels, pixels_without_ray: numbers of those that do not.
        whole_windows: number of windows that SSIM is a mean of.
        exposure: the gains that were applied to the picture, and their source.
        view: its distance from the training views; None if these are not known.
    """

    name: str
    metrics: Metrics
    pixels: int = 0
    masked_pixels: int = 0
    pixels_without_ray: int = 0
    whole_windows: int = 0
    exposure: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    view: Novelty | None = None

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> "PhotoMetrics":
        """Return the metrics from plain values."""
        given = known(PhotoMetrics, content)
        if given.get("view") is not None:
            given["view"] = Novelty(**known(Novelty, given["view"]))
        return PhotoMetrics(metrics=Metrics(**known(Metrics, content)), **given)

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        content = asdict(self)
        metrics, view = content.pop("metrics"), content.pop("view")
        return {"name": content.pop("name"), **metrics, **content, **({} if view is None else {"view": view})}


@dataclass(frozen=True)
class RunMetrics:
    """All metrics of a run, or of splats, as in metrics.json.

    Args:
        shape: comparison with a model without geometry; None if it was not made.
        ledger: which stages used the held-out photos.
        splats: file, count and degree, of splats.
    """

    protocol: str
    mean: Metrics
    images: tuple[PhotoMetrics, ...]
    shape: GeometryEvidence | None = None
    warnings: tuple[str, ...] = ()
    training: TrainingSummary | None = None
    ledger: tuple[Entry, ...] = ()
    holdout: str | None = None
    split_sha256: str | None = None
    device: str = ""
    checkpoint_sha256: str | None = None
    splats: Mapping[str, Any] | None = None

    @property
    def seconds_per_image(self) -> float:
        """Median time of rendering a photo."""
        return statistics.median(image.seconds for image in self.images)

    @property
    def kinds(self) -> dict[str, tuple[int, Metrics]]:
        """Number of views of each kind, interpolation and extrapolation, and their means."""
        groups: dict[str, list[Metrics]] = {}
        for image in self.images:
            if image.view is not None:
                groups.setdefault(image.view.kind, []).append(image.metrics)
        return {kind: (len(group), Metrics.mean(group)) for kind, group in sorted(groups.items())}

    @staticmethod
    def from_json(content: Mapping[str, Any], path: Path) -> "RunMetrics":
        """Return the metrics from plain values.

        Raises:
            UserError: a number is missing, or not what it should be.
        """
        records = {"shape": GeometryEvidence, "training": TrainingSummary}
        try:
            given = known(RunMetrics, content)
            for name, record in records.items():
                if given.get(name) is not None:
                    given[name] = record(**known(record, given[name]))
            given["mean"] = Metrics(**known(Metrics, given["mean"]))
            given["images"] = tuple(map(PhotoMetrics.from_json, given["images"]))
            given["ledger"] = tuple(Entry(**entry) for entry in given.get("ledger") or ())
            given["warnings"] = tuple(given.get("warnings") or ())
            return RunMetrics(**given)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UserError(f"cannot read {path}: {error}", "add --overwrite to evaluate again") from error

    def to_json(self) -> dict[str, Any]:
        """Return plain values; splats have no training of their own."""
        seconds = [image.seconds for image in self.images]
        kinds = {kind: {"images": count, **asdict(mean)} for kind, (count, mean) in self.kinds.items()}
        times = {
            "seconds_per_image": self.seconds_per_image,
            "fastest_seconds": min(seconds),
            "slowest_seconds": max(seconds),
        }
        plain = {**asdict(self), "images": [image.to_json() for image in self.images], "kinds": kinds, "render": times}
        left_out = ("splats",) if self.splats is None else ("training", "ledger", "holdout", "split_sha256")
        return {name: value for name, value in plain.items() if name not in left_out}


def known(record: type, content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a record among plain values."""
    return {item.name: content[item.name] for item in fields(record) if item.name in content}


def evaluate_model(
    model: Renderable,
    held_out: Sequence[HeldOutPhoto],
    *,
    on_image: Callable[[int, int], None] = lambda done, total: None,
    training: Sequence[Frame] = (),
    perceptual: Perceptual | None = None,
    billboards: Billboards | None = None,
    keep: Callable[[ComparedImages], None] = lambda compared: None,
) -> RunMetrics:
    """Compare the model with every held-out photo; `on_image` receives (rays done, total rays), `keep` each pair.

    Measured only if given: the novelty among `training` views, `perceptual` differences, and the evidence of geometry
    against `billboards`.

    Raises:
        UserError: nothing was held out, or masks hide all photos.
    """
    if not held_out:
        hint = "train again with --holdout every:8 --overwrite"
        raise UserError("this run has no held-out photos to evaluate on", hint)
    hidden, held_out = [photo.frame.name for photo in held_out if photo.is_hidden], without_hidden(held_out)
    total = sum(photo.pixels.shape[0] * photo.pixels.shape[1] for photo in held_out)
    done = 0

    def on_tile(rays: int) -> None:
        nonlocal done
        done += rays
        on_image(done, total)

    views = novelty([photo.frame for photo in held_out], training) if training else None
    evidence = GeometryComparison(billboards) if billboards is not None else None
    images = []
    for index, photo in enumerate(held_out):
        background = background_of(model, photo)
        began = time.perf_counter()
        picture = model.render(photo.frame, background=background, on_tile=on_tile)
        seconds = time.perf_counter() - began
        pair = paired(photo, picture)
        keep(pair)
        if evidence is not None:
            evidence.add(pair.frame, pair.rendered, pair.photo, pair.used)
        images.append(
            PhotoMetrics(
                photo.frame.name,
                compare_fully(
                    pair.rendered, pair.photo, used=pair.used, perceptual=perceptual, align=not pair.on_white
                ),
                pixels=int(pair.used.sum()),
                masked_pixels=0 if photo.used is None else int((~photo.used).sum()),
                pixels_without_ray=int((~picture.valid).sum()),
                whole_windows=int(whole_windows(pair.used).sum()),
                exposure={"from": photo.gains_from, "log_gains": list(photo.log_gains)},
                seconds=seconds,
                view=None if views is None else views[index],
            )
        )
    shape = evidence.shape() if evidence is not None else None
    without = [f"{several(len(hidden), 'held-out photo')} hidden by masks and not compared: {listed(hidden)}"]
    return RunMetrics(
        _protocol_name(held_out, LPIPS_NAME + " (torchmetrics)" if perceptual is not None else "no LPIPS"),
        Metrics.mean([image.metrics for image in images]),
        tuple(images),
        shape,
        (
            *(without if hidden else ()),
            *_warnings(shape, evidence),
            *copy_warnings(views or ()),
            *outlier_warnings(images),
        ),
    )


def _warnings(shape: GeometryEvidence | None, evidence: GeometryComparison | None) -> list[str]:
    if evidence is not None and evidence.failure is not None:
        return [f"the comparison with a model without geometry failed: {evidence.failure}"]
    return [shape.in_words()] if shape is not None and not shape.shown else []


def copy_warnings(views: Sequence[Novelty]) -> list[str]:
    """Return a warning if most held-out views have the poses of training photos, as of test files that are copies."""
    same = sum(view.is_training_view for view in views)
    if same <= len(views) / 2:
        return []
    return [
        f"{same} of {len(views)} held-out views have the pose of a training photo: the metrics show how well the field "
        "remembers photos, not how good new views are. Remove the copies, or list photos of other poses in a file: "
        "nerfcli train SCENE --holdout FILE --overwrite"
    ]


# A photo is far below the others if it lacks this many standard deviations, estimated by the median absolute deviation,
# and this many dB. In sound runs the worst photo lacks up to 2 deviations and 2 dB; where views are uneven, 5 dB.
_DEVIATIONS, _LEAST_DB = 5.0, 6.0
# Standard deviation of a normal distribution over its median absolute deviation.
_NORMAL = 1.4826
# Fewer photos do not show what is usual, and more than this fraction of them are no exceptions.
_FEWEST, _MOST = 5, 0.25


def outliers(images: Sequence[PhotoMetrics]) -> list[PhotoMetrics]:
    """Return the photos whose PSNR is far below the median of all, the lowest first."""
    if len(images) < _FEWEST:
        return []
    median = statistics.median(image.metrics.psnr for image in images)
    deviation = _NORMAL * statistics.median(abs(image.metrics.psnr - median) for image in images)
    limit = median - max(_LEAST_DB, _DEVIATIONS * deviation)
    low = sorted((image for image in images if image.metrics.psnr < limit), key=lambda image: image.metrics.psnr)
    return low if len(low) <= _MOST * len(images) else []


def outlier_warnings(images: Sequence[PhotoMetrics]) -> list[str]:
    """Return a warning that names the images far below the others; none if there are none."""
    low = outliers(images)
    if not low:
        return []
    median = statistics.median(image.metrics.psnr for image in images)
    names = listed([f"{image.name} ({image.metrics.psnr:.1f} dB)" for image in low])
    return [
        f"far below the median of {median:.1f} dB: {names}. The pose may be wrong, or the photo shows what no "
        "training photo does: nerfcli doctor SCENE checks poses, nerfcli report RUN shows the pictures"
    ]


def _protocol_name(held_out: Sequence[HeldOutPhoto], lpips: str) -> str:
    sizes = sorted({f"{photo.pixels.shape[1]}x{photo.pixels.shape[0]}" for photo in held_out})
    names = hashlib.sha256("\n".join(photo.frame.name for photo in held_out).encode()).hexdigest()[:12]
    sources = {photo.gains_from for photo in held_out} - {"none"}
    exposures = f", exposures by {' or '.join(sorted(sources))}" if sources else ""
    alpha = ", RGBA on white" if any(photo.pixels.shape[-1] == 4 for photo in held_out) else ""
    return (
        f"{PROTOCOL}: {len(held_out)} held-out photos (names sha256 {names}) at {' '.join(sizes)}, area-averaged, "
        f"sRGB 8 bit{alpha}{exposures}, mean of per-image values; PSNR; SSIM with Gaussian window 1.5, 11 x 11, of "
        f"windows inside the picture that hold no masked pixel (scikit-image); {lpips}; float: before rounding; "
        f"colour_aligned: quadratic colour correction fitted to the held-out photo (multinerf)"
    )
