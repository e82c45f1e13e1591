"""Format the facts of scenes, runs, depth files, pictures and videos as lines of text."""

import json
import textwrap
from collections.abc import Iterator
from typing import Any

# Headings of the table of costs.
HEADINGS = ("field", "weights", "optimiser", "step keeps", "ops/sample", "B/sample", "ops/picture", "B/picture")
_UNITS = ("", "k", "M", "G", "T", "P")
# Units of maps that are not lengths.
_UNITS_OF_MAPS = {"coverage": " photos", "parallax": " degrees", "confidence": ""}
_LENGTHS = ("depth", "spread", "disagreement", "lower", "upper")
# Labels of facts whose names in JSON are not plain English.
_LABELS = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "psnr_float": "PSNR before rounding to 8 bits",
    "ssim_float": "SSIM before rounding to 8 bits",
    "psnr_colour_aligned": "PSNR after colour correction",
    "ssim_colour_aligned": "SSIM after colour correction",
    "lpips_colour_aligned": "LPIPS after colour correction",
    "budget_seconds": "budget",
    "fixed": "set by hand",
    "log2_rows": "rows per level",
    "features": "numbers per row",
    "coarsest": "cells per axis of the coarsest level",
    "finest": "of the finest",
    "first_samples_per_step": "samples of the first steps",
    "angles_deg": "angles in degrees",
    "pixel_at_object": "pixel at the object",
    "source_origin": "source to axis",
    "source_detector": "source to detector",
    "axis_column": "column of the axis",
    "held_out": "held out",
    "missing": "missing photos",
    "camera_count": "number of cameras",
    "step": "steps",
    "settled": "converged",
    "seconds": "time",
    "bytes": "size",
    "field_bytes": "size of the field",
    "occupied_share": "occupied cells",
}
# Maximum number of characters per line; longer lines are wrapped, and their continuations indented.
WIDTH = 110


def lines_of(facts: dict[str, Any]) -> list[str]:
    """Format facts by label, one line each or folded, lists below their label; unknown values are omitted.

    A table of costs comes last.
    """
    lines = []
    for key, value in facts.items():
        if value is None or value in ([], {}) or key == "cost":
            continue
        name = _name(key)
        if key == "corner":  # of a map: northings have seven digits before the point
            lines.append(f"{name}: {' '.join(f'{number:.10g}' for number in value)}")
        elif isinstance(value, list):
            lines += [
                f"{name}:",
                *(f"  {_plain(entry)}" for entry in value),
            ]
        elif key == "components":
            lines += _folded(f"{name}: {', '.join(f'{part}={_plain(choice)}' for part, choice in value.items())}")
        else:
            text = f"{name}: {_with_unit(key, value)}"
            lines += _folded(text) if isinstance(value, dict) else [text]
    if costs := facts.get("cost"):
        lines += [f"storage and cost of the {next(iter(costs))} field, and of other types of the same size:"]
        lines += [f"  {line}" for line in _cost_lines(costs)]
    return lines


def _name(key: str) -> str:
    return _LABELS.get(key, key.replace("_", " "))


def _listed(facts: dict[str, Any]) -> str:
    shown = {key: value for key, value in facts.items() if value not in (None, [])}
    return ", ".join(f"{_name(key)} {_with_unit(key, value)}" for key, value in shown.items())


def words_of(facts: dict[str, Any]) -> list[str]:
    """Format the facts of a file (`file_facts`) or of a folder of renders, one per line, without unknown values."""
    return [
        *_what(facts),
        *([facts["in_words"]] if facts["in_words"] else []),
        *([facts["note"]] if facts.get("note") else []),
        *_maps(facts),
        *_meaning(facts.get("meaning") or {}),
        *(f"{key}: {value}" for key, value in facts.get("texts", {}).items()),
    ]


def _what(facts: dict[str, Any]) -> Iterator[str]:
    kinds = {
        "depth": "depth file",
        "preview": "preview of a depth map (colours, not values)",
        "array": "depth of another program",
        "levels": "16-bit integers of another program",
    }
    size = f", {facts['width']}x{facts['height']}" if "width" in facts else ""
    frames = f", {facts['frames']} frames" if "frames" in facts else ""
    rate = f" at {facts['fps']:g} per second" if facts.get("fps") else ""
    files = f", {facts['files']} depth files with the same definition" if facts.get("files") else ""
    yield f"{kinds.get(facts['kind'], facts['kind'])} ({facts['format']}{size}{frames}{rate}{files})"


def _maps(facts: dict[str, Any]) -> Iterator[str]:
    """Yield the range of each map; lengths with their unit."""
    meaning = facts.get("meaning") or {}
    unit = {"metre": " m", "arbitrary": " units"}.get(meaning.get("unit", ""), "")
    for name, of_map in facts.get("maps", {}).items():
        suffix = unit if name in _LENGTHS else _UNITS_OF_MAPS.get(name, "")
        shape = "" if len(of_map["shape"]) == 2 else f" {'x'.join(map(str, of_map['shape']))}"
        line = f"{name}: {of_map['dtype']}{shape}"
        if "valid_share" in of_map:
            line += f", {100 * of_map['valid_share']:.1f} % valid"
        if "min" in of_map:
            line += f", {of_map['min']:.6g} to {of_map['max']:.6g}, median {of_map['median']:.6g}{suffix}"
        yield line


def _meaning(meaning: dict[str, Any]) -> Iterator[str]:
    from nerfcli.media.depth_pictures import limits_in_words

    if not meaning:
        return
    invalid = {"nan": "NaN", "0": "0"}.get(meaning.get("invalid", "nan"), "marked")
    if meaning["opacity_floor"] > 0:
        yield f"pixels with an opacity below {meaning['opacity_floor']:g} have no value ({invalid})"
    if meaning.get("background_distance") is not None:
        yield f"light that passes counts at the background distance, {meaning['background_distance']:.6g}"
    if meaning.get("units_per_level") is not None:
        yield f"value = level x {meaning['units_per_level']:g}"
    if limits := limits_in_words(meaning.get("min_views", 0), meaning.get("min_parallax_deg", 0.0)):
        yield f"pixels with {limits} have no value ({invalid})"
    if meaning.get("quantity") in _UNITS_OF_MAPS:
        pass  # not a length
    elif meaning["unit"] != "metre":
        yield "the scene has no metric scale: lengths are in scene units, not metres"
    elif not meaning.get("unit_source"):
        yield "the source of the metric scale is not recorded"
    for name, layer in meaning.get("layers", {}).items():
        yield f"also in the file: {name} ({layer.get('convention')})"
    bounds = dict(meaning.get("error_bounds", {}))
    if "rounding_max" in bounds:
        yield f"rounding to integers changed depth by at most {bounds.pop('rounding_max'):.3g}"
    if bounds:
        text = bounds.pop("meaning", "a bound on the rendering, not on the accuracy of the field")
        listed = ", ".join(f"{name} {_number(value)}" for name, value in bounds.items())
        yield from _folded(f"error of the rendering: {listed}")
        yield from _folded(text)
    yield from _camera(meaning.get("view", {}))
    made = {**meaning.get("provenance", {})}
    if made or meaning.get("nerfcli"):
        listed = ", ".join(f"{name} {str(value)[:16]}" for name, value in made.items())
        yield f"made by nerfcli {meaning.get('nerfcli', '?')}" + (f": {listed}" if listed else "")


def _camera(view: dict[str, Any]) -> Iterator[str]:
    if not view:
        return
    camera, pose = view.get("camera", {}), view.get("world_from_cam")
    parameters = " ".join(f"{value:.6g}" for value in camera.get("params", []))
    line = f"camera of {view.get('name')}: {camera.get('model')} {camera.get('width')}x{camera.get('height')}"
    yield f"{line}, parameters {parameters}"
    if pose:
        yield f"camera centre in the world: {' '.join(f'{row[3]:.6g}' for row in pose[:3])}"


def _folded(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _with_unit(key: str, value: Any) -> str:
    if key.endswith("seconds"):
        return f"{value:.4g} s"
    if key == "angles_deg":
        return f"{value['from']:g} to {value['to']:g}"
    if key == "log2_rows":
        return f"2^{value}"
    if key.startswith("psnr"):
        return f"{value:.2f} dB"
    if key.startswith(("ssim", "lpips")):
        return f"{value:.3f}"
    if isinstance(value, list):
        return " and ".join(map(str, value))
    if isinstance(value, dict):
        return _listed(value)
    if key == "samples_per_second":
        return f"{value:,}"
    if key.endswith("_share"):
        return f"{100 * value:.1f} %"
    if key.endswith("bytes"):
        return f"{value / 1e6:.2f} MB"
    return _plain(value)


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.2f}" if 1e5 <= abs(value) < 1e9 else f"{value:.6g}"  # northings to a centimetre
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _number(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _cost_lines(costs: dict[str, dict[str, Any]]) -> list[str]:
    """Return a table of costs, one line per kind of field.

    Operations are the multiplications and additions of the forward pass; bytes are those of rows and layers' values.
    """
    rows: list[tuple[str, ...]] = [HEADINGS]
    for kind, cost in costs.items():
        held, sample, picture = cost["bytes"], cost["per_sample"], cost["per_picture"]
        numbers = (
            held["weights"], held["optimiser"], held["activations"], sample["operations"], sample["bytes_moved"],
            picture["operations"], picture["bytes_moved"],
        )  # fmt: skip
        rows.append((kind, *map(_short, numbers)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]


def _short(number: float) -> str:
    """Format a number as three digits and a unit prefix: 8.4M."""
    unit = 0
    while number >= 999.5 and unit < len(_UNITS) - 1:
        number, unit = number / 1000, unit + 1
    return f"{number:.3g}{_UNITS[unit]}"
