"""The models of an ablation: the chosen one, and those that differ from it in one component."""

from dataclasses import dataclass, replace
from typing import Any

from nerfcli.training.runs.components import CHOICES, Components, Value

CHOSEN, AUTO = "chosen", "auto"
# Components that change what is compared of a held-out photo, so that their numbers are not comparable with others.
NOT_COMPARABLE = ("masks",)


@dataclass(frozen=True)
class Variant:
    """A model that is compared with the chosen one.

    Args:
        name: name of its row and its folders.
        adds: True if it has one component more than the chosen model, False for one less; None for the chosen model.
    """

    name: str
    components: Components
    adds: bool | None = None


@dataclass(frozen=True)
class CaptureTraits:
    """Properties of a capture that components depend on.

    Args:
        has_alpha: whether its photos have alpha: then nothing is behind the object.
        has_points: whether it states where structure-from-motion points were observed.
        has_exif: whether EXIF states different exposures.
    """

    has_alpha: bool
    has_points: bool
    has_exif: bool


def variants(chosen: Components, capture: CaptureTraits, *, only: tuple[str, ...] = ()) -> list[Variant]:
    """Return models with one component removed from the chosen one, or added to it, in the order of `CHOICES`.

    Args:
        chosen: the model that all are compared with.
        capture: decides which components can be tried.
        only: names of components; all if empty.
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
    if name == "stereo" and not chosen.points:
        return []
    if name == "exposure" and capture.has_exif:
        return ["exif", "matched", CHOICES[name].on]
    return [CHOICES[name].on]


def _variant(chosen: Components, name: str, value: Value, *, adds: bool) -> Variant:
    changed: dict[str, Any] = {name: value}
    if name == "points" and not value:
        changed["stereo"] = False  # stereo has no effect without points
    return Variant(f"{name}={str(value).lower()}", replace(chosen, **changed), adds)
