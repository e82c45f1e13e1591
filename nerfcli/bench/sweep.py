"""The settings to try, the most informative first; how many are tried depends on the time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate
from typing import Any

from nerfcli.render.pictures import RAYS_PER_TILE
from nerfcli.render.tracing import TOLERANCE
from nerfcli.runs.settings import TrainSettings

# Steps and tolerances far from the defaults, on both sides: only with both ends does a curve show where it bends.
_STEPS = (2.0, 4.0, 0.5, 8.0, 0.25)
_TOLERANCES = (1 / 255, 1 / 64, 1 / 16, 1 / 4080, 1 / 4)
_TILES = (1024, 65536)
# Precisions in which the field is stored; it is always rendered in float32.
STORED_IN = ("float32", "float16", "bfloat16")
# A training shorter than this learns too little to tell settings apart.
SHORTEST_TRAINING_SECONDS = 8.0


@dataclass(frozen=True)
class RenderSetting:
    """One way to render a trained field.

    Args:
        step: length of the steps along rays, relative to those of the training.
        tolerance: see `render.pictures.render_picture`.
        rays_per_tile: number of rays rendered at a time; the default suits the device.
        stored_in: one of `STORED_IN`.
    """

    threads: int
    step: float = 1.0
    tolerance: float = TOLERANCE
    rays_per_tile: int = RAYS_PER_TILE
    stored_in: str = "float32"

    @property
    def name(self) -> str:
        """Name of the setting: its differences from the defaults, except threads if all are used."""
        return ", ".join(self._changes()) or "default"

    @property
    def options(self) -> str | None:
        """Options of `nerfcli render` that select this setting; None if options cannot select it."""
        given = list(self._changes().values())
        return " ".join(given) if all(given) else None

    def _changes(self) -> dict[str, str]:
        """Return the differences from the defaults, each with the option that selects it, "" if there is none."""
        changes = {}
        if self.step != 1.0:
            changes[f"step {self.step:g}"] = ""
        if self.tolerance != TOLERANCE:
            changes[f"tolerance {as_text(self.tolerance)}"] = f"--tolerance {as_text(self.tolerance)}"
        if self.rays_per_tile != RAYS_PER_TILE:
            changes[f"{self.rays_per_tile} rays a tile"] = ""
        if self.stored_in != "float32":
            changes[f"stored in {self.stored_in}"] = ""
        return changes


@dataclass(frozen=True)
class ThreadSetting(RenderSetting):
    """A setting with fewer threads than are available."""

    def _changes(self) -> dict[str, str]:
        words = f"{self.threads} {'thread' if self.threads == 1 else 'threads'}"
        return {**super()._changes(), words: f"--threads {self.threads}"}


@dataclass(frozen=True)
class TrainSetting:
    """One training.

    Args:
        group: the parameter that is varied: "default", "seed", "time", "rows" or "batch".
        fraction: training time relative to the planned time of one point.
        changed: values that differ from the defaults of `TrainSettings`, by name.
    """

    group: str
    fraction: float = 1.0
    seed: int = 0
    changed: tuple[tuple[str, int], ...] = ()

    @property
    def name(self) -> str:
        """Name of the setting: the parameter that is varied."""
        values = dict(self.changed)
        match self.group:
            case "seed":
                return f"default, seed {self.seed}"
            case "time":
                return f"{self.fraction:g} x time"
            case "rows":
                return f"2^{values['log2_rows']} rows"
            case "batch":
                return f"batch {values['samples_per_step']}"
        return "default"

    def settings(self, base: TrainSettings, unit_seconds: float) -> TrainSettings:
        """Return the settings of the training."""
        values = dict(self.changed)
        if "samples_per_step" in values:
            values["first_samples_per_step"] = min(base.first_samples_per_step, values["samples_per_step"])
        seconds = self.fraction * unit_seconds
        return replace(base, budget_seconds=seconds, steps=None, seed=base.seed + self.seed, **values)  # type: ignore[arg-type]

    def to_json(self) -> dict[str, Any]:
        """Return the differences from the defaults of `TrainSettings`."""
        return {**dict(self.changed), "seed": self.seed}

    @property
    def options(self) -> str:
        """Options of `nerfcli train` that select this setting, besides the budget."""
        names = {"log2_rows": "--log2-rows", "samples_per_step": "--batch"}
        seed = [f"--seed {self.seed}"] if self.seed else []
        return " ".join([*(f"{names[name]} {value}" for name, value in self.changed), *seed])


def render_settings(threads: int) -> list[RenderSetting]:
    """List rendering settings, the most informative first: the default, then with one or two changes."""
    default = RenderSetting(threads)
    return [
        default,
        *(replace(default, step=step) for step in _STEPS[:3]),
        *(replace(default, tolerance=tolerance) for tolerance in _TOLERANCES[:3]),
        *(ThreadSetting(count) for count in _fewer(threads)),
        *(replace(default, step=step, tolerance=t) for step in (2.0, 4.0) for t in _TOLERANCES[:2]),
        *(replace(default, rays_per_tile=rays) for rays in _TILES),
        *(replace(default, stored_in=precision) for precision in STORED_IN[1:]),
        *(replace(default, step=step) for step in _STEPS[3:]),
        *(replace(default, tolerance=tolerance) for tolerance in _TOLERANCES[3:]),
        *(replace(default, step=step, tolerance=1 / 16) for step in (2.0, 4.0)),
        replace(default, step=0.5, tolerance=1 / 4080),
        replace(default, step=0.5, tolerance=1 / 64),
    ]


def train_settings() -> list[TrainSetting]:
    """List trainings, the most informative first. Two more seeds of the default give the noise of all differences."""
    return [
        TrainSetting("default"),
        TrainSetting("seed", seed=1),
        TrainSetting("time", 2.0),
        TrainSetting("rows", changed=(("log2_rows", 15),)),
        TrainSetting("rows", changed=(("log2_rows", 17),)),
        TrainSetting("seed", seed=2),
        TrainSetting("batch", changed=(("samples_per_step", 2**15),)),
        TrainSetting("batch", changed=(("samples_per_step", 2**17),)),
        TrainSetting("time", 0.5),
        TrainSetting("rows", changed=(("log2_rows", 14),)),
        TrainSetting("rows", changed=(("log2_rows", 18),)),
        TrainSetting("time", 4.0),
        TrainSetting("batch", changed=(("samples_per_step", 2**14),)),
    ]


def affordable(
    settings: Sequence[TrainSetting], seconds: float, *, overhead: float
) -> tuple[list[TrainSetting], float]:
    """Return as many of the first settings as time allows, and the time for one unit of training.

    Args:
        settings: the most informative first; at least one.
        seconds: time limit for all.
        overhead: seconds that each takes besides its training.

    Returns:
        The settings, and seconds for a fraction of 1: at least `SHORTEST_TRAINING_SECONDS` if there are two or more.
    """
    fractions = accumulate(setting.fraction for setting in settings)
    units = [(seconds - overhead * count) / total for count, total in enumerate(fractions, start=1)]
    count = max((n for n, unit in enumerate(units, start=1) if unit >= SHORTEST_TRAINING_SECONDS), default=1)
    return list(settings[:count]), max(units[count - 1], 1.0)


def as_text(value: float) -> str:
    """Format a number, as a fraction such as 1/255 if it is the reciprocal of a whole number."""
    ratio = Fraction(value).limit_denominator(10**6)
    return str(ratio) if ratio.numerator == 1 and value < 1 else f"{value:g}"


def _fewer(threads: int) -> list[int]:
    """Return the powers of two below a number of threads, the largest first."""
    return [2**power for power in range(threads.bit_length()) if 2**power < threads][::-1]
