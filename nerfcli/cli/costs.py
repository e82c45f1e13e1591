"""What the field of a run costs, beside fields of the other kinds that would take the same storage."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerfcli.cameras.frame import Frame
    from nerfcli.render.model import Model

HEADINGS = ("field", "weights", "optimiser", "step keeps", "ops/sample", "B/sample", "ops/picture", "B/picture")
_UNITS = ("", "k", "M", "G", "T", "P")


def costs_of_run(
    model: "Model", frames: Sequence["Frame"], settings: dict[str, Any], log: Sequence[dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """By kind, the run's own first: size, bytes, operations and memory traffic; see `comparison.described_cost`.

    Args:
        model: of the run.
        frames: that it was trained on.
        settings: of its config.
        log: its log, whose last line tells how many samples a ray had.
    """
    from nerfcli.field.comparison import described_cost, others_of_equal_storage
    from nerfcli.runs.settings import TrainSettings
    from nerfcli.train.footprint import pixel_footprint

    factor = settings.get("downscale") or 1
    camera = frames[0].camera
    rays = log[-1].get("rays", 0) if log else 0
    samples_per_ray = log[-1]["samples"] / rays if rays else 1.0
    own = model.field.settings
    footprint = pixel_footprint(frames, model.training_from_scene) * factor
    return {
        size.kind: {
            "settings": size.to_json(),
            **described_cost(
                size,
                occupancy_side=len(model.occupied),
                batch=settings.get("samples_per_step", TrainSettings.samples_per_step),
                samples_per_ray=samples_per_ray,
                picture_px=(camera.width // factor) * (camera.height // factor),
            ),
        }
        for size in (own, *others_of_equal_storage(own, footprint).values())
    }


def cost_lines(costs: dict[str, dict[str, Any]]) -> list[str]:
    """A table: a line per kind. Operations are multiplications and additions, forward; bytes are those of rows and of
    layers' values."""
    rows: list[tuple[str, ...]] = [
        ("field", "weights", "optimiser", "step keeps", "ops/sample", "B/sample", "ops/picture", "B/picture")
    ]
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
    """Three digits and a letter: 8.4 M."""
    unit = 0
    while number >= 999.5 and unit < len(_UNITS) - 1:
        number, unit = number / 1000, unit + 1
    return f"{number:.3g}{_UNITS[unit]}"
