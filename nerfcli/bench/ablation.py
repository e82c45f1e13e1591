"""What each component of a model contributes: the variants compared, and their differences with intervals."""

import csv
import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from scipy.special import stdtrit

from nerfcli.atomic import atomic_path, read_json, write_json
from nerfcli.errors import UserError
from nerfcli.output import Output
from nerfcli.training.runs.components import CHOICES, Components, Value

CHOSEN, AUTO = "chosen", "auto"
# Components that change what is compared of a held-out photo, so that their numbers are not comparable with others.
NOT_COMPARABLE = ("masks",)


@dataclass(frozen=True)
class Variant:
    """A model that is compared with the chosen one.

    adds: True if it has one component more than the chosen model, False for one less; None for the chosen model.
    """

    name: str
    components: Components
    adds: bool | None = None


@dataclass(frozen=True)
class CaptureTraits:
    """Properties of a capture that components depend on.

    With alpha, nothing is behind the object. has_points: whether it states where structure-from-motion points were
    observed. has_exif: whether EXIF states different exposures.
    """

    has_alpha: bool
    has_points: bool
    has_exif: bool


def variants(chosen: Components, capture: CaptureTraits, *, only: tuple[str, ...] = ()) -> list[Variant]:
    """Return models with one component removed from the chosen one, or added to it, in the order of `CHOICES`.

    The capture decides which can be tried; `only` these components, all if empty.
    """
    found = []
    for name in CHOICES:
        if name in NOT_COMPARABLE or (only and name not in only):
            continue
        off, offers = _off(name, chosen), _offers(name, chosen, capture)
        now = getattr(chosen, name)
        if now != off:
            found.append(_variant(chosen, name, off, adds=False))
        found += [_variant(chosen, name, value, adds=True) for value in offers if now == off and value != off]
    return found


def _off(name: str, chosen: Components) -> Value:
    """Return the value of a component in a model without it; "auto" and "random" backgrounds stay as they are."""
    if name == "background" and chosen.background in ("auto", "random"):
        return chosen.background
    return CHOICES[name].off


def _offers(name: str, chosen: Components, capture: CaptureTraits) -> list[Value]:
    """Return the values with which the component may be added."""
    if (name == "background" and capture.has_alpha) or (name == "points" and not capture.has_points):
        return []
    if name == "sensor" or (name == "stereo" and not chosen.points):
        return []  # the selection has taken the depths of a sensor, if there are any
    if name == "exposure" and capture.has_exif:
        return ["exif", "matched", CHOICES[name].on]
    return [CHOICES[name].on]


def _variant(chosen: Components, name: str, value: Value, *, adds: bool) -> Variant:
    changed: dict[str, Any] = {name: value}
    if name == "points" and not value:
        changed["stereo"] = False  # stereo has no effect without points
    return Variant(f"{name}={str(value).lower()}", replace(chosen, **changed), adds)


RESULT, TABLE, RUNS = "ablation.json", "ablation.csv", "runs"
FORMAT = "nerfcli ablation 3"
# Settings that may change when an ablation is continued, see `Run.is_trained_from`.
_FREE = {"device", "threads"}
# Confidence level of the intervals.
CONFIDENCE = 0.95


@dataclass(frozen=True)
class MeasuredTraining:
    """One training: the mean PSNR over the held-out photos, measured as in `protocol`."""

    variant: str
    seed: int
    psnr: float
    seconds: float
    steps: int
    protocol: str


@dataclass(frozen=True)
class ResultRow:
    """A variant against the chosen model.

    Args:
        psnr: mean PSNR over its seeds, in dB.
        difference_db: mean PSNR difference of the variant from the chosen model, over the seeds that both have; None
            for the chosen model itself and if they have no seed in common.
        interval_db: half the width of the 95 % interval of that mean, by Student's t over seeds; None for one seed.
        seconds, steps: means per training.
        verdict: a short text such as "better"; empty where nothing can be compared.
    """

    name: str
    psnr: float
    difference_db: float | None
    interval_db: float | None
    seconds: float
    steps: float
    seeds: int
    verdict: str
    protocol: str


def rows_of(measured: Sequence[MeasuredTraining], variants: Sequence[Variant]) -> list[ResultRow]:
    """Return a row for each variant that was trained at least once, in the order of the variants."""
    reference = {entry.seed: entry.psnr for entry in measured if entry.variant == CHOSEN}
    rows = []
    for variant in variants:
        own = [entry for entry in measured if entry.variant == variant.name]
        if not own:
            continue
        differences = [entry.psnr - reference[entry.seed] for entry in own if entry.seed in reference]
        compared = bool(differences) and variant.name != CHOSEN
        mean = statistics.fmean(differences) if compared else None
        half = half_interval(differences) if compared else None
        rows.append(
            ResultRow(
                variant.name,
                statistics.fmean(entry.psnr for entry in own),
                mean,
                half,
                statistics.fmean(entry.seconds for entry in own),
                statistics.fmean(entry.steps for entry in own),
                len(own),
                _verdict(variant, mean, half),
                own[-1].protocol,
            )
        )
    return rows


def half_interval(differences: Sequence[float]) -> float | None:
    """Return half the width of the 95 % interval of the mean of normal differences; None for fewer than two.

    Formula: t(0.975, n - 1) s / sqrt(n), with Student's t.
    """
    if len(differences) < 2:
        return None
    quantile = float(stdtrit(len(differences) - 1, 0.5 + CONFIDENCE / 2))
    return quantile * statistics.stdev(differences) / math.sqrt(len(differences))


def _verdict(variant: Variant, difference: float | None, half: float | None) -> str:
    if difference is None:
        return ""
    if half is None:
        return "one seed: no verdict"
    if abs(difference) <= half:
        return "no difference shown"
    if variant.adds is None:
        return "better" if difference > 0 else "worse"
    if variant.adds:
        return "would help" if difference > 0 else "would hurt"
    return "not needed: better without it" if difference > 0 else "needed: worse without it"


def write_results(
    folder: Path, rows: Sequence[ResultRow], measured: Sequence[MeasuredTraining], about: dict[str, Any]
) -> None:
    """Write FOLDER/ablation.json and ablation.csv; `about` describes the ablation's subject, as plain values."""
    content = {
        "format": FORMAT,
        **about,
        "rows": [asdict(row) for row in rows],
        "trainings": [asdict(entry) for entry in measured],
    }
    write_json(folder / RESULT, content)
    with atomic_path(folder / TABLE) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(ResultRow.__dataclass_fields__))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def refuse_others(output: Output, folder: Path, about: dict[str, Any]) -> None:
    """Raise if the folder contains something other than an ablation, or one with results that this one would drop."""
    result = folder / RESULT
    others = folder.is_dir() and any(entry.name != RUNS for entry in folder.iterdir())
    if folder.is_file() or (others and not result.exists()):
        raise UserError(f"{folder} exists and is not an ablation folder", "choose another folder with -o")

    def is_included() -> bool:
        hint = "add --overwrite to replace it, or choose another folder with -o"
        earlier = read_json(result, needed=("settings", "seeds", "varied"), hint=hint)
        changed = {key for key, value in about["settings"].items() if earlier["settings"].get(key) != value}
        is_larger = earlier["seeds"] <= about["seeds"] and set(earlier["varied"]) <= set(about["varied"])
        return is_larger and changed <= _FREE

    output.keeps(result, is_included)


def table_of(rows: Sequence[ResultRow]) -> list[tuple[str, ...]]:
    """Return the cells of the printed table, in the order of `COLUMNS`."""

    def difference(row: ResultRow) -> str:
        if row.difference_db is None:
            return ""
        return f"{row.difference_db:+.2f}" + ("" if row.interval_db is None else f" ± {row.interval_db:.2f}")

    return [
        (
            row.name,
            f"{row.psnr:.2f}",
            difference(row),
            f"{row.seconds:.0f}",
            f"{row.steps:.0f}",
            str(row.seeds),
            row.verdict,
        )
        for row in rows
    ]


COLUMNS = ("model", "PSNR", "difference, dB", "seconds", "steps", "seeds", "verdict")
