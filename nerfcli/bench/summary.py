"""Summarize measurements: points with their spread, Pareto sets, recommendations."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from nerfcli import __version__
from nerfcli.bench.measurement import COMPLETE
from nerfcli.bench.pareto import SettingResult, TimeSpread, at_most, dominators, least_difference, near_best
from nerfcli.bench.records import Records
from nerfcli.bench.sample_pictures import slug

LEVELS = 255.0
# Renderings whose distances to the converged one differ by less than this fraction count as equally good.
SAME_QUADRATURE = 0.02


def summarised(records: Records, plan: dict[str, Any]) -> dict[str, Any]:
    """Return all numbers of a complete or interrupted bench as plain values.

    Args:
        plan: subject and options of the bench; the content of plan.json.
    """
    begun = list(records.of_kind("begun"))
    rendering, training = _rendering(records), _training(records)
    return {
        "nerfcli": __version__,
        **{name: plan[name] for name in ("source", "measured", "machine", "budget_seconds", "sweep", "seed")},
        "complete": records.last(COMPLETE) is not None,
        "spent_seconds": round(sum(entry.get("took", 0.0) for entry in records.all()), 1),
        "load_average": [entry["load_average"] for entry in begun],
        "busy": any(entry["busy"] for entry in begun),
        "rendering": rendering,
        "training": training,
        "recommendations": [
            *(_rendering_advice(rendering["points"]) if rendering else []),
            *(_training_advice(training) if training else []),
        ],
    }


def _by_psnr(point: dict[str, Any]) -> SettingResult:
    return SettingResult(point["name"], TimeSpread(**point["seconds"]), -point["psnr"])


def _by_quadrature(point: dict[str, Any]) -> SettingResult:
    """Return time and quadrature error of a point, as a logarithm so that differences are relative."""
    return SettingResult(point["name"], TimeSpread(**point["seconds"]), math.log(max(point["quadrature_levels"], 1e-6)))


def _rendering(records: Records) -> dict[str, Any] | None:
    times: dict[str, list[dict[str, Any]]] = {}
    for entry in records.of_kind("time"):
        times.setdefault(entry["point"], []).append(entry)
    pictures = {entry["point"]: entry for entry in records.of_kind("picture") if entry["point"] in times}
    plan, float64 = records.last("rendering plan"), records.last("float64")
    if plan is None or not pictures:
        return None
    points = [_rendering_point(entry, times[name]) for name, entry in pictures.items()]
    found = dominators([_by_quadrature(point) for point in points], noise=math.log(1.0 + SAME_QUADRATURE))
    for point in points:
        point |= {"pareto": found[point["name"]] is None, "dominated_by": found[point["name"]]}
    converged = list(records.of_kind("converged"))
    return {
        "photos": plan["photos"],
        "factor": plan["factor"],
        "truth": f"{slug(converged[0]['photo'])}-truth.jpg",
        "rounds": min(len(entries) for entries in times.values()),
        "converged_psnr": statistics.fmean(entry["psnr"] for entry in converged),
        "float64_levels": None if float64 is None else LEVELS * float64["error"],
        "points": points,
    }


def _rendering_point(entry: dict[str, Any], times: Sequence[dict[str, Any]]) -> dict[str, Any]:
    memory = [time["peak_memory_bytes"] for time in times if time["peak_memory_bytes"] is not None]
    return {
        "name": entry["point"],
        "options": entry["options"],
        "settings": entry["settings"],
        "seconds": asdict(TimeSpread.of([time["seconds"] for time in times])),
        "peak_memory_bytes": max(memory, default=None),
        "field_bytes": entry["field_bytes"],
        "psnr": entry["psnr"],
        "quadrature_levels": LEVELS * entry["quadrature"],
        "truncation_bound_levels": LEVELS * entry["truncation_bound"],
        "pictures": {name: f"{slug(entry['point'])}-{name}.jpg" for name in ("render", "error", "quadrature")},
    }


def _training(records: Records) -> dict[str, Any] | None:
    entries = {entry["point"]: entry for entry in records.of_kind("training")}
    plan = records.last("training plan")
    if not entries or plan is None:
        return None
    points = [_training_point(entry) for entry in entries.values()]
    repeats = [point["psnr"] for point in points if point["group"] in ("default", "seed")]
    noise = least_difference(repeats)
    found = dominators([_by_psnr(point) for point in points if point["group"] != "seed"], noise=noise or 0.0)
    found |= dict.fromkeys(longer_and_better(points))
    for point in points:
        seed = point["group"] == "seed"
        point["pareto"] = None if seed else found[point["name"]] is None
        point["dominated_by"] = None if seed else found[point["name"]]
    return {
        "unit_seconds": plan["unit_seconds"],
        "noise_db": noise,
        "seeds": len(repeats),
        "seed_psnr": repeats,
        "points": points,
        "failed": [{"name": entry["point"], "reason": entry["reason"]} for entry in records.of_kind("failed")],
    }


def longer_and_better(points: Sequence[dict[str, Any]]) -> list[str]:
    """Return the trainings that differ from shorter ones only in their length, and are better than all of those.

    That more steps help is known beforehand, so the difference need not be significant.
    """
    same = [point for point in points if point["group"] in ("default", "time", "run")]
    same.sort(key=lambda point: point["seconds"]["median"])
    best, longer = -math.inf, []
    for point in same:
        if point["psnr"] > best:
            best = point["psnr"]
            longer.append(point["name"])
    return longer[1:]


def _training_point(entry: dict[str, Any]) -> dict[str, Any]:
    prefix = slug(f"training {entry['point']}")
    return {
        "name": entry["point"],
        **{name: entry[name] for name in ("group", "options", "settings")},
        "seconds": asdict(TimeSpread.of([entry["seconds"]])),
        **{name: entry[name] for name in ("steps", "samples_per_second", "peak_memory_bytes", "field_bytes", "psnr")},
        "quadrature_levels": LEVELS * entry["quadrature"],
        "render_seconds": asdict(TimeSpread.of(entry["render_seconds"])),
        "render_size": entry["render_size"],
        "compiled": entry.get("compiled"),
        "shown_psnr": entry["shown_psnr"],
        "pictures": {name: f"{prefix}-{name}.jpg" for name in ("render", "error", "truth")},
    }


def _rendering_advice(points: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    selectable = [_by_psnr(point) for point in points if point["options"] is not None]
    by_name = {point["name"]: point for point in points}
    default = next((point for point in selectable if point.name == "default"), None)
    if default is None:
        return []
    near = near_best(selectable)
    half = at_most(selectable, default.seconds.median / 2)
    return [
        _advice("rendering", "within 0.1 dB of the best", near, by_name, default),
        _advice("rendering", "half the time", half, by_name, default),
    ]


def _training_advice(training: dict[str, Any]) -> list[dict[str, Any]]:
    points = [point for point in training["points"] if point["group"] not in ("seed", "run")]
    by_name = {point["name"]: point for point in points}
    measured = [_by_psnr(point) for point in points]
    default = next((point for point in measured if point.name == "default"), None)
    if default is None:
        return []
    best, noise = min(measured, key=lambda point: point.error), training["noise_db"] or 0.0
    near = _default_unless_better(near_best(measured), default, noise)
    half = at_most(measured, best.seconds.median / 2)
    if half is not None:
        half = _default_unless_better(half, default, noise)
    return [
        _advice("training", "within 0.1 dB of the best", near, by_name, best),
        _advice("training", "half the time", half, by_name, best),
    ]


def _default_unless_better(chosen: SettingResult, default: SettingResult, noise: float) -> SettingResult:
    """Return the default if the chosen setting takes as long and is not better by more than the noise."""
    same_time = not chosen.seconds.clearly_below(default.seconds) and not default.seconds.clearly_below(chosen.seconds)
    return default if same_time and default.error - chosen.error <= noise else chosen


def _advice(
    part: str, question: str, chosen: SettingResult | None, by_name: dict[str, dict[str, Any]], against: SettingResult
) -> dict[str, Any]:
    """Return one recommendation; its "point" is None where no setting is fast enough."""
    if chosen is None:
        return {"part": part, "question": question, "point": None}
    point = by_name[chosen.name]
    return {
        "part": part,
        "question": question,
        "point": chosen.name,
        "options": point["options"],
        "seconds": chosen.seconds.median,
        "psnr": point["psnr"],
        "against": against.name,
        "against_seconds": against.seconds.median,
        "against_psnr": by_name[against.name]["psnr"],
    }
