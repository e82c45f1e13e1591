"""The models of an ablation: the chosen one, and those that differ from it in one component."""

from dataclasses import dataclass, replace

from nerfcli.runs.components import CHOICES, Components, Value

CHOSEN, AUTO = "chosen", "auto"
# What these change is what a held-out photo is compared with: their numbers would say nothing beside the others.
NOT_COMPARABLE = ("masks",)


@dataclass(frozen=True)
class Variant:
    """A model that is compared with the chosen one.

    Args:
        name: of its row and of its folders.
        components: what is in it.
        adds: whether it has a component more than the chosen model, or one less; None for the chosen one itself.
    """

    name: str
    components: Components
    adds: bool | None = None


@dataclass(frozen=True)
class CaptureTraits:
    """Properties of a capture that components depend on.

    Args:
        has_alpha: whether its photos have alpha: then nothing is behind the object.
        has_points: whether it says where points of structure from motion were seen.
        has_exif: whether EXIF tells different exposures.
    """

    has_alpha: bool
    has_points: bool
    has_exif: bool


def variants(chosen: Components, capture: CaptureTraits, *, only: tuple[str, ...] = ()) -> list[Variant]:
    """Models with one component removed from the chosen one, or added to it, in the order of `CHOICES`.

    Args:
        chosen: what all are compared with.
        capture: decides what can be tried at all.
        only: names of components; all where there are none.
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
    """Return the value of a model without the component;
    what is behind the field is black where nothing else is said.
    """
    if name == "background" and chosen.background in ("auto", "random"):
        return chosen.background
    return CHOICES[name].off


def _offers(name: str, chosen: Components, capture: CaptureTraits) -> list[Value]:
    """Values with which the component may be added."""
    if (name == "background" and capture.has_alpha) or (name == "points" and not capture.has_points):
        return []
    if name == "stereo" and not chosen.points:
        return []
    if name == "exposure" and capture.has_exif:
        return ["exif", CHOICES[name].on]
    return [CHOICES[name].on]


def _variant(chosen: Components, name: str, value: Value, *, adds: bool) -> Variant:
    changed = {name: value}
    if name == "points" and not value:
        changed["stereo"] = False  # it has no effect without
    return Variant(f"{name}={str(value).lower()}", replace(chosen, **changed), adds)
