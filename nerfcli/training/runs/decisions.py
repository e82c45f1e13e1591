"""Decisions of the automatic selection: for each candidate, its gain with standard error, and whether it is kept."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from torch import Tensor

from nerfcli.training.runs.components import Components, Value


@dataclass(frozen=True)
class Decision:
    """Result for one candidate component.

    Args:
        component, value: the change.
        gain_db: gain in PSNR of pixels that were not trained on, at equal steps, mean over photos; negative is a loss.
            None if the candidate was not tried, as for the numbers below.
        error_db: standard error of the gain.
        trend_db: gain minus the gain halfway through the steps.
        cost: time per step relative to a step without the change, minus 1.
        gain_at_equal_time_db: gain minus what spending the extra time on more steps would bring.
        kept: whether the change is in the model.
        why: reason for the decision, shown to the user.
    """

    component: str
    value: Value
    gain_db: float | None
    error_db: float | None
    trend_db: float | None
    cost: float | None
    gain_at_equal_time_db: float | None
    kept: bool
    why: str

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Decision":
        """Read the entries of a decision; numbers that earlier versions did not write are None."""
        entries: dict[str, Any] = {entry.name: content.get(entry.name) for entry in fields(cls)}
        return cls(**entries)

    def in_words(self) -> str:
        """Return a line for people: "exposure=learned: +1.20 dB (± 0.08), 3 % more time: kept, gains ..."."""
        named = f"{self.component}={str(self.value).lower()}"
        if self.gain_db is None or self.error_db is None or self.cost is None:
            return f"{named}: {'kept, ' if self.kept else ''}{self.why}"
        measured = f"{self.gain_db:+.2f} dB (± {self.error_db:.2f}), {_time_in_words(self.cost)}"
        return f"{named}: {measured}: {'kept' if self.kept else 'not kept'}, {self.why}"


def _time_in_words(cost: float) -> str:
    per_cent = round(100.0 * abs(cost))
    if per_cent == 0:
        return "same time"
    return f"{per_cent} % {'more' if cost > 0 else 'less'} time"


def untried(component: str, value: Value, why: str, *, kept: bool = False) -> Decision:
    """Return the decision about a candidate that was not tried, or that is kept without a trial."""
    return Decision(component, value, None, None, None, None, None, kept, why)


@dataclass(frozen=True)
class Selection:
    """The selected components, the decisions behind them, and the seconds spent.

    Args:
        components: those of the model.
        decisions: one per candidate; empty if the budget was too small.
        seconds: seconds spent on the search.
        log_gains: (photos, 3) log gains of exposure that the trials found; None where exposures are not learned.
        log_focal: see `Fitting`.
    """

    components: Components
    decisions: tuple[Decision, ...]
    seconds: float
    log_gains: Tensor | None = None
    log_focal: float = 0.0

    def to_json(self) -> dict[str, Any]:
        return {
            "components": asdict(self.components),
            "decisions": [asdict(decision) for decision in self.decisions],
            "seconds": self.seconds,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any], *, wanted: Components) -> "Selection":
        """Read the content that `to_json` returned, without exposures; `wanted` are the components if it has none."""
        chosen = content.get("components")
        return cls(
            components=Components.from_json(chosen) if chosen else wanted,
            decisions=tuple(Decision.from_json(one) for one in content.get("decisions", ())),
            seconds=content.get("seconds", 0.0),
        )
