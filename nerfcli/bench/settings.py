"""The settings that a bench compares, the most informative first; how many of them are measured depends on the time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate

from nerfcli.render.tracing import TOLERANCE
from nerfcli.training.runs.settings import TrainSettings

# A training shorter than this learns too little to tell settings apart.
SHORTEST_TRAINING_SECONDS = 8.0


@dataclass(frozen=True)
class RenderSetting:
    """One way to render a trained field.

    Args:
        step: length of the steps along rays, relative to those of the training.
        tolerance: see `render.pictures.render_picture`.
    """

    threads: int
    step: float = 1.0
    tolerance: float = TOLERANCE

    def name(self, default: "RenderSetting") -> str:
        """Return what differs from the default."""
        differences = []
        if self.step != default.step:
            differences.append(f"step {self.step:g}")
        if self.tolerance != default.tolerance:
            differences.append(f"tolerance {as_text(self.tolerance)}")
        if self.threads != default.threads:
            differences.append(f"{self.threads} {'thread' if self.threads == 1 else 'threads'}")
        return ", ".join(differences) or "default"


@dataclass(frozen=True)
class TrainSetting:
    """One training.

    Args:
        fraction: training time relative to the planned time of one training.
        changed: values that differ from the defaults of `TrainSettings`, by name.
    """

    name: str
    fraction: float = 1.0
    changed: tuple[tuple[str, int], ...] = ()

    def settings(self, base: TrainSettings, seconds: float) -> TrainSettings:
        """Return the settings of the training, if one of fraction 1 takes these seconds."""
        values = dict(self.changed)
        if "samples_per_step" in values:
            values["first_samples_per_step"] = min(base.first_samples_per_step, values["samples_per_step"])
        return replace(base, budget_seconds=self.fraction * seconds, steps=None, **values)  # type: ignore[arg-type]


def render_settings(threads: int) -> list[RenderSetting]:
    """List rendering settings: the default, far steps and tolerances on both sides, fewer threads, and both at once."""
    default = RenderSetting(threads)
    fewer = [2**power for power in range(threads.bit_length()) if 2**power < threads][::-1]
    return [
        default,
        *(replace(default, step=step) for step in (2.0, 4.0, 0.5)),
        *(replace(default, tolerance=tolerance) for tolerance in (1 / 255, 1 / 64, 1 / 16, 1 / 4080)),
        *(replace(default, threads=count) for count in fewer),
        *(replace(default, step=step, tolerance=t) for step in (2.0, 4.0) for t in (1 / 255, 1 / 64)),
        *(replace(default, step=step) for step in (8.0, 0.25)),
        replace(default, step=0.5, tolerance=1 / 4080),
    ]


def train_settings() -> list[TrainSetting]:
    """List trainings: other seeds of the default show the noise of all differences."""
    return [
        TrainSetting("default"),
        TrainSetting("seed 1", changed=(("seed", 1),)),
        TrainSetting("2 x time", 2.0),
        TrainSetting("2^15 rows", changed=(("log2_rows", 15),)),
        TrainSetting("2^17 rows", changed=(("log2_rows", 17),)),
        TrainSetting("seed 2", changed=(("seed", 2),)),
        TrainSetting("0.5 x time", 0.5),
        TrainSetting(f"batch {2**15}", changed=(("samples_per_step", 2**15),)),
        TrainSetting(f"batch {2**17}", changed=(("samples_per_step", 2**17),)),
        TrainSetting("2^18 rows", changed=(("log2_rows", 18),)),
        TrainSetting("4 x time", 4.0),
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
