"""The numbers of a bench as table rows, as sentences, and as CSV for spreadsheets."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerfcli.atomic import atomic_path

RENDERING_COLUMNS = (
    "rendering",
    "s per picture",
    "quartiles",
    "peak MB",
    "field MB",
    "PSNR dB",
    "levels off",
    "Pareto set",
)
TRAINING_COLUMNS = (
    "training",
    "train s",
    "steps",
    "peak MB",
    "field MB",
    "PSNR dB",
    "levels off",
    "render s",
    "Pareto set",
)
_PARETO = "in it"


def rendering_rows(rendering: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row for each rendering setting, the fastest first."""
    return [
        (
            point["name"],
            f"{point['seconds']['median']:.3f}",
            f"{point['seconds']['low']:.3f} to {point['seconds']['high']:.3f}",
            _megabytes(point["peak_memory_bytes"]),
            _megabytes(point["field_bytes"]),
            f"{point['psnr']:.2f}",
            f"{point['quadrature_levels']:.2f}",
            _verdict(point),
        )
        for point in sorted(rendering["points"], key=lambda point: point["seconds"]["median"])
    ]


def training_rows(training: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row for each training, the shortest first, then by PSNR."""
    order = sorted(training["points"], key=lambda point: (round(point["seconds"]["median"]), -point["psnr"]))
    return [
        (
            point["name"] + (" (plain torch)" if point["compiled"] is False else ""),
            f"{point['seconds']['median']:.1f}",
            str(point["steps"]),
            _megabytes(point["peak_memory_bytes"]),
            _megabytes(point["field_bytes"]),
            f"{point['psnr']:.2f}",
            f"{point['quadrature_levels']:.2f}",
            f"{point['render_seconds']['median']:.2f}",
            _verdict(point),
        )
        for point in order
    ]


def sentences(content: Mapping[str, Any]) -> list[str]:
    """Return sentences with the recommendations and the smallest significant difference between trainings."""
    remarks = [_advice_in_words(advice) for advice in content["recommendations"]]
    training = content["training"]
    if training and training["noise_db"] is not None:
        remarks.append(
            f"Trainings that differ only in their seed: {', '.join(f'{psnr:.2f}' for psnr in training['seed_psnr'])}"
            f" dB; two trainings must differ by {training['noise_db']:.2f} dB to be significant (95 %)."
        )
    elif training:
        remarks.append("There was time for only one seed, so the spread between seeds is unknown.")
    return remarks


def write_csv(content: Mapping[str, Any], path: Path) -> None:
    """Write all points of both parts, one row each, without rounding.

    Raises:
        UserError: it cannot be written.
    """
    parts = ((part, content[part]["points"]) for part in ("rendering", "training") if content[part])
    rows = [_flat(part, point) for part, points in parts for point in points]
    names = list(dict.fromkeys(name for row in rows for name in row)) or ["part"]
    with atomic_path(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


def _flat(part: str, point: Mapping[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {"part": part}
    for name, value in point.items():
        if name == "pictures":
            continue
        if isinstance(value, Mapping):
            row |= {f"{name}_{inner}": number for inner, number in value.items()}
        elif isinstance(value, list):
            row[name] = "x".join(map(str, value))
        else:
            row[name] = value
    return row


def _verdict(point: Mapping[str, Any]) -> str:
    if point["pareto"] is None:
        return "repeat"
    return _PARETO if point["pareto"] else f"no: {point['dominated_by']}"


def command_of(advice: Mapping[str, Any]) -> str:
    """Return the command line for a recommendation."""
    if advice["part"] == "rendering":
        return f"nerfcli render RUN {advice['options']}".strip()
    return f"nerfcli train SCENE --budget {advice['seconds']:.0f}s {advice['options']}".strip()


def numbers_of(advice: Mapping[str, Any]) -> str:
    """Return time and PSNR of a recommendation, and those of the setting that it is compared with."""
    unit = "s per picture" if advice["part"] == "rendering" else "s of training"
    text = f"{advice['seconds']:.3g} {unit}, {advice['psnr']:.2f} dB"
    if advice["against"] == advice["point"]:
        return text
    return f"{text} ({advice['against']}: {advice['against_seconds']:.3g} s, {advice['against_psnr']:.2f} dB)"


def _advice_in_words(advice: Mapping[str, Any]) -> str:
    """Return a recommendation as one sentence with its command line."""
    head = f"{advice['part'].capitalize()}, {advice['question']}: "
    if advice["point"] is None:
        return f"{head}none of the measured settings is fast enough."
    return f"{head}{advice['point']}, {numbers_of(advice)}: {command_of(advice)}"


def _megabytes(count: int | None) -> str:
    return "" if count is None else f"{count / 1e6:.0f}" if count >= 1e7 else f"{count / 1e6:.1f}"
