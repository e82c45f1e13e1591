"""Result of a check: a number, its threshold, a verdict, and advice."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass

GOOD, LOOK, BAD = "good", "look", "bad"
VERDICTS = (GOOD, LOOK, BAD)


@dataclass(frozen=True)
class Finding:
    """The result of a check, in one line.

    Args:
        verdict: good; look: usable, but expect lower quality; bad: fix it before any long computation.
        number: the measured value; None if it is not a number.
        threshold: description of the limits on the number.
        advice: what to do; empty if there is nothing to do.
        photos: (name, remark) of each photo concerned, worst first.
    """

    check: str
    verdict: str
    summary: str
    number: float | None
    threshold: str
    advice: str = ""
    photos: tuple[tuple[str, str], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the photos concerned."""
        return tuple(name for name, _ in self.photos)


def finding(
    check: str,
    verdict: str,
    summary: str,
    number: float | None,
    threshold: str,
    *,
    advice: str,
    photos: Iterable[tuple[str, str]] = (),
) -> Finding:
    """Return the finding of a check, which has advice and names photos only where its verdict is not good."""
    if verdict == GOOD:
        advice, photos = "", ()
    return Finding(check, verdict, summary, number, threshold, advice, tuple(photos))


def verdict_above(number: float, *, look: float, bad: float) -> str:
    """Return the verdict on a number that should be small: look from `look` on, bad from `bad` on."""
    return BAD if number >= bad else LOOK if number >= look else GOOD


def verdict_below(number: float, *, look: float, bad: float) -> str:
    """Return the verdict on a number that should be large: look below `look`, bad below `bad`."""
    return BAD if number < bad else LOOK if number < look else GOOD


def worst(verdicts: Iterable[str]) -> str:
    """Return the worst of the verdicts; good if there are none."""
    return max(verdicts, key=VERDICTS.index, default=GOOD)


def as_json(finding: Finding) -> dict[str, object]:
    """Return the finding as plain values; a number that is not finite is left out."""
    number = None if finding.number is None or not math.isfinite(finding.number) else round(finding.number, 4)
    photos = [{"name": name, "what": what} for name, what in finding.photos]
    return {**asdict(finding), "number": number, "photos": photos}
