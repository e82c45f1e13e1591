"""Optional parts of a model and of its training, each chosen independently, and the decisions about them.

A component is a field of `Components`. `CHOICES` gives for each component the value that switches it off, the value
that `--with NAME` stands for, and the values that `--with NAME=VALUE` allows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from torch import Tensor

from nerfcli.errors import UserError

Value = bool | int | float | str
Change = tuple[str, Value]

# Colours behind the field.
BACKGROUNDS = ("auto", "black", "constant", "random", "sphere")
LEARNED_BACKGROUNDS = ("constant", "sphere")
EXPOSURES = ("none", "exif", "matched", "learned")
CAMERAS = ("fixed", "poses", "focal", "all")
# Weight of known distances where they are used.
POINT_WEIGHT = 0.1
# Meaning of black in a mask: unknown, or empty space.
MASKS = ("ignore", "empty")
# Spherical harmonics up to this degree: 16 of them.
MOST_DEGREES = 3


@dataclass(frozen=True)
class Components:
    """Components of the model and of its loss. The defaults suit nearly every scene.

    Args:
        background: colour behind the field: "black"; learned, "constant" or by direction ("sphere"); "random" in
            training, for photos with alpha; "auto" is random for photos with alpha and black for all others.
        view: dependence of colours on the viewing direction: highest degree of the spherical harmonics that the colour
            network takes, 0 (no dependence) to 3.
        exposure: gains of the photos, see `field.exposure`: "none"; from "exif"; from "matched" pixels, see
            `matching.exposures`, and learned for photos without such pixels; or all "learned", starting from EXIF.
        cameras: camera parameters of the training photos that are trained with the field: "poses"; "focal", the focal
            length of each lens; "all", both and radial distortion; or "fixed", none. See `refinement`.
        masks: meaning of black in masks: "ignore", not used; or "empty", empty space, as with alpha.
        points: weight of known distances, see `training.losses.emerging_losses`.
        stereo: whether the points include pixels of training photos with a depth from stereo matching, see
            `matching.stereo`.
        sensor: whether the depths of a sensor are known distances, see `training.sensor_depths`.
        near: whether gradients near a camera are scaled down; see `reference.scale_gradients`.
        distortion: weight of `kernels.RaySums.distortion`; 0.05 is best or as good as any on real and synthetic
            captures.
        antialias: whether details smaller than a pixel fade out of its view; see `reference.hash_encode`.
        occluders: whether pixels are left out where something hides a surface that other photos see, or is attached to
            the camera; see `matching.occluders` and `matching.attached`.
    """

    background: str = "auto"
    view: int = MOST_DEGREES
    exposure: str = "none"
    cameras: str = "fixed"
    masks: str = "ignore"
    points: float = 0.0
    stereo: bool = False
    sensor: bool = False
    near: bool = True
    distortion: float = 0.05
    antialias: bool = False
    occluders: bool = False

    @property
    def distance_weight(self) -> float:
        """Weight of known distances: those of a sensor count as much without points as with them by default."""
        return self.points or (POINT_WEIGHT if self.sensor else 0.0)


@dataclass(frozen=True)
class Choice:
    """Allowed values of a component.

    Args:
        off, on: values that `--without` and `--with` stand for.
        allowed: all values; None for any number that is not negative.
    """

    off: Value
    on: Value
    allowed: tuple[Value, ...] | None

    def value(self, name: str, text: str) -> Value:
        """Parse the value of a component.

        Raises:
            UserError: the value is not allowed.
        """
        if self.allowed is not None:
            for value in self.allowed:
                if text == str(value).lower():
                    return value
            listed = ", ".join(str(value).lower() for value in self.allowed)
            raise _wrong(name, text, f"one of {listed}")
        try:
            number = float(text)
        except ValueError as error:
            raise _wrong(name, text, "a number") from error
        if not 0.0 <= number < float("inf"):
            raise _wrong(name, text, "a number of at least 0")
        return number


CHOICES = {
    "background": Choice("black", "sphere", BACKGROUNDS),
    "view": Choice(0, MOST_DEGREES, tuple(range(MOST_DEGREES + 1))),
    "exposure": Choice("none", "learned", EXPOSURES),
    "cameras": Choice("fixed", "poses", CAMERAS),
    "masks": Choice("ignore", "empty", MASKS),
    "points": Choice(0.0, POINT_WEIGHT, None),
    "stereo": Choice(False, True, (False, True)),
    "sensor": Choice(False, True, (False, True)),
    "near": Choice(False, True, (False, True)),
    "distortion": Choice(0.0, 0.05, None),
    "antialias": Choice(False, True, (False, True)),
    "occluders": Choice(False, True, (False, True)),
}
assert tuple(CHOICES) == tuple(field.name for field in fields(Components))


def choose(start: Components, *, included: Sequence[str], excluded: Sequence[str]) -> Components:
    """Return `start` with some components switched on and off.

    Args:
        start: values of the components that are not named.
        included: components to switch on, each as NAME or NAME=VALUE.
        excluded: names of components to switch off.

    Raises:
        UserError: an unknown name or value, or a component that is named twice.
    """
    values: dict[str, Any] = {}
    for text, on in [*((text, True) for text in included), *((text, False) for text in excluded)]:
        name, given, value = text.partition("=")
        if name not in CHOICES or (given and not on):
            option = "--with" if on else "--without"
            raise UserError(f"{option} {text}: unknown component", f"choose from {', '.join(CHOICES)}", 2)
        if name in values:
            raise UserError(f"component {name} is given twice", "give it once, with --with or --without", 2)
        choice = CHOICES[name]
        values[name] = choice.value(name, value) if given else choice.on if on else choice.off
    return replace(start, **values)


def differences(components: Components) -> dict[str, Value]:
    """Return the components that differ from the defaults, with their values."""
    default = Components()
    return {name: value for name in CHOICES if (value := getattr(components, name)) != getattr(default, name)}


def _wrong(name: str, text: str, expected: str) -> UserError:
    return UserError(f"--with {name}={text}: expected {expected}", f"for example --with {name}={CHOICES[name].on}", 2)


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
        why: what else decided; "" if nothing did.
        seen: what was seen in the photos before any trial; "" if that is nothing.
    """

    component: str
    value: Value
    gain_db: float | None
    error_db: float | None
    trend_db: float | None
    cost: float | None
    gain_at_equal_time_db: float | None
    kept: bool
    why: str = ""
    seen: str = ""

    @property
    def reason(self) -> str:
        """What was seen, and what else decided."""
        return "; ".join(part for part in (self.seen, self.why) if part)

    def in_words(self) -> str:
        """Return a line: "exposure=learned: kept, photos differ by 0.8 stops; +1.20 ± 0.08 dB, 3 % more time"."""
        named = self.component if self.component == "points" or self.value is True else f"{self.component}={self.value}"
        if self.gain_db is None or self.error_db is None or self.cost is None:
            return f"{named}: {'kept' if self.kept else 'not tried'}, {self.reason}"
        measured = f"{self.gain_db:+.2f} ± {self.error_db:.2f} dB, {_time_in_words(self.cost)}"
        parts = "; ".join(part for part in (self.seen, measured, self.why) if part)
        return f"{named}: {'kept' if self.kept else 'not kept'}, {parts}"


def _time_in_words(cost: float) -> str:
    per_cent = round(100.0 * abs(cost))
    if per_cent == 0:
        return "same time"
    return f"{per_cent} % {'more' if cost > 0 else 'less'} time"


def untried(change: Change, seen: str, *, why: str = "", kept: bool = False) -> Decision:
    """Return the decision about a candidate that was not tried, or that is kept without a trial."""
    return Decision(*change, None, None, None, None, None, kept, why, seen)


@dataclass(frozen=True)
class Selection:
    """The selected components, the decisions behind them, and the seconds spent.

    Args:
        components: those of the model.
        decisions: one per candidate; empty if the budget was too small.
        seconds: seconds spent on the search.
        log_gains: (photos, 3) log gains of exposure that the trials found; None where exposures are not learned.
        log_focal: see `TrainingInputs`.
    """

    components: Components
    decisions: tuple[Decision, ...]
    seconds: float = 0.0
    log_gains: Tensor | None = None
    log_focal: float = 0.0

    def to_json(self) -> dict[str, Any]:
        return {
            "components": asdict(self.components),
            "decisions": [asdict(decision) for decision in self.decisions],
            "seconds": self.seconds,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Selection":
        """Read the content that `to_json` returned, without exposures."""
        decisions = tuple(Decision(**one) for one in content["decisions"])
        return cls(Components(**content["components"]), decisions, content["seconds"])
