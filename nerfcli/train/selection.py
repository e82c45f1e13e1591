"""Which components a scene needs: each against the plainest model, in paired short trainings, with their noise.

A change is kept only if it is better by more than the noise. Gain and noise are measured, not assumed: every candidate
goes on from the same start with the same seeds and pixels as the model that it would change, and what the gains differ
by between seeds and between photos is their error. What is kept first is in the model that the next one has to better:
two components that mend the same fault are not both needed.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from torch import Tensor

from nerfcli.train.components import MOST_DEGREES, Components
from nerfcli.train.judgement import Decision, untried
from nerfcli.train.race import Change, Purse, Race
from nerfcli.train.signs import Signs
from nerfcli.train.trials import Trials

# Of the budget, for all trials together; and of those, for the training that they go on from.
SEARCH_SHARE, START_SHARE = 0.15, 0.2
# A search whose first training is shorter than this tells nothing, and is left out.
FEWEST_STEPS = 80
# Photos whose brightness differs by less than this, in logarithms of light, are as well without exposures.
LEAST_EXPOSURE_SPREAD = 0.03


@dataclass(frozen=True)
class Selection:
    """The components that were chosen, how, and what it took.

    Args:
        components: those of the model.
        decisions: one per candidate; none where there was too little to spend.
        seconds: of the search.
        log_gains: (photos, 3) of the exposures that the trials found; None where exposures are not learned.
    """

    components: Components
    decisions: tuple[Decision, ...]
    seconds: float
    log_gains: Tensor | None = None

    def to_json(self) -> dict[str, Any]:
        return {
            "components": self.components.to_json(),
            "decisions": [decision.to_json() for decision in self.decisions],
            "seconds": self.seconds,
        }


def decisions_in_words(config: Mapping[str, Any]) -> list[str]:
    """A line per decision of a run that has this RUN/config.json; none where nobody asked the scene."""
    known = {entry.name for entry in fields(Decision)}
    decisions = (config.get("selection") or {}).get("decisions", [])
    return [Decision(**{k: v for k, v in one.items() if k in known}).in_words() for one in decisions]


@dataclass(frozen=True)
class Facts:
    """What is known of a scene and asked for, before anything is learned.

    Args:
        field: the kind of field.
        has_alpha: whether the photos have alpha: then nothing is behind the object.
        has_exif: whether EXIF tells different exposures.
        fixed: components that the user has decided on.
    """

    field: str
    has_alpha: bool
    has_exif: bool
    fixed: tuple[str, ...] = ()


def plainest(asked: Components, facts: Facts) -> Components:
    """The model that has to be bettered: colours do not depend on the direction, unless the user wants them to.

    Only a hash grid can be given harmonics when it is half trained; other fields keep what they have.
    """
    return asked if "view" in facts.fixed or facts.field != "hash" else replace(asked, view=0)


def proposals(start: Components, signs: Signs, facts: Facts) -> tuple[list[Change], list[Decision]]:
    """Changes that may help a scene, and those that nothing speaks for.

    Args:
        start: what is in the model already.
        signs: of its first training.
        facts: of the scene.
    """
    candidates: list[Change] = []
    declined: list[Decision] = []
    if facts.has_exif:
        candidates.append(("exposure", "exif"))
    if signs.exposure_spread > LEAST_EXPOSURE_SPREAD:
        candidates.append(("exposure", "learned"))
    else:
        told = f"not tried, photos differ in brightness by {math.expm1(signs.exposure_spread):.1%} only"
        declined.append(untried("exposure", "learned", told))
    if facts.field == "hash":
        candidates.append(("view", MOST_DEGREES))
    if not facts.has_alpha:
        candidates.append(("background", "sphere"))
    open_ones = [(name, value) for name, value in candidates if getattr(start, name) != value]
    return (
        [change for change in open_ones if change[0] not in facts.fixed],
        [decision for decision in declined if decision.component not in facts.fixed],
    )


def select(
    trials: Trials,
    asked: Components,
    facts: Facts,
    *,
    seconds: float | None,
    steps: int | None,
) -> Selection:
    """Find the components that a scene needs.

    First all candidates with one seed; then the best of them with a second one, and if it is kept, the others that gain
    once more, beside it; and so on.

    Args:
        trials: of the scene.
        asked: what is in the model where nothing is found out.
        facts: of the scene.
        seconds: for all trials together; None to go by `steps`.
        steps: of all trials together, where there is no limit of time.

    Returns:
        `asked` and no decisions where there is too little to spend.
    """
    purse = Purse(seconds, steps)
    first_steps = None if seconds is not None else round(START_SHARE * (steps or 0))
    if first_steps is not None and first_steps < FEWEST_STEPS:
        return Selection(asked, (), 0.0)
    plain = plainest(asked, facts)
    start = trials.begin(plain, steps=first_steps, seconds=None if seconds is None else START_SHARE * seconds)
    purse.take(start.steps)
    if start.steps < FEWEST_STEPS:
        return Selection(asked, (), purse.spent)
    candidates, declined = proposals(plain, start.signs, facts)
    race = Race(trials, start, purse, plain)
    race.run(candidates)
    # What could not be decided stays as most scenes need it.
    chosen = replace(plain, **({name: getattr(asked, name) for name in race.undecided} | dict(race.kept)))
    gains = race.log_gains if chosen.exposure == "learned" else None
    return Selection(chosen, (*race.decisions.values(), *declined), purse.spent, gains)
