"""The parts of a model and of its training that a scene may need or not, each chosen by itself.

A component is a field of `Components`. Its value says what is done; `CHOICES` tells, for each, which value switches it
off, which one `--with NAME` stands for, and what `--with NAME=VALUE` may say.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from nerfcli.errors import UserError

Value = bool | int | float | str
Change = tuple[str, Value]

# What may be behind all that the field holds.
BACKGROUNDS = ("auto", "black", "constant", "random", "sphere")
LEARNED_BACKGROUNDS = ("constant", "sphere")
EXPOSURES = ("none", "exif", "learned")
CAMERAS = ("fixed", "poses", "focal", "all")
# What is behind the black of a mask: something unknown, or nothing.
MASKS = ("ignore", "empty")
PIXELS = ("anywhere", "error")
# Spherical harmonics up to this degree: 16 of them.
MOST_DEGREES = 3


@dataclass(frozen=True)
class Components:
    """Components of the model and of its loss. The defaults suit nearly every scene.

    Args:
        background: behind the field: "black"; a learned colour, "constant" or by direction ("sphere"); "random" colours
            in training, for photos with alpha; "auto" is random for photos with alpha and black for all others.
        view: how colours depend on the direction they are seen from: the highest degree of the spherical harmonics
            that the colour network takes, 0 to 3. 0: not at all.
        exposure: gains of the photos, see `field.exposure`: "none", those in "exif", or "learned" from there.
        cameras: which camera parameters of the training photos are trained with the field: "poses"; "focal", the focal
            length of each lens; "all", both and radial distortion; or nothing, "fixed". See `refinement`.
        masks: what their black means: "ignore", not to be looked at; or "empty", nothing is there, as with alpha.
        points: weight of `kernels.RaySums.off_target`.
        stereo: whether the points include pixels of training photos whose depth stereo matching tells, see
            `multiview.stereo`.
        overlap: whether space near a camera that no other photo looks into stays empty; see `fit.coverage`.
        entropy: weight of `losses.opacity_entropy`.
        near: whether gradients near a camera are scaled down; see `reference.scale_gradients`.
        distortion: weight of `kernels.RaySums.distortion`; 0.05 is best or as good as any on real and synthetic
            captures.
        antialias: whether details smaller than a pixel fade out of its view; see `reference.hash_encode`.
        pixels: which ones are drawn: from "anywhere", or half of them where the "error" is; see `error_map`.
        movers: whether pixels that show something that moves do not count in the loss; see `fit.movers`.
    """

    background: str = "auto"
    view: int = MOST_DEGREES
    exposure: str = "none"
    cameras: str = "fixed"
    masks: str = "ignore"
    points: float = 0.0
    stereo: bool = False
    overlap: bool = False
    entropy: float = 0.0
    near: bool = True
    distortion: float = 0.05
    antialias: bool = False
    pixels: str = "anywhere"
    movers: bool = False

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class Choice:
    """Allowed values of a component.

    Args:
        what: it does, in a few words.
        off, on: the values that `--without` and `--with` stand for.
        allowed: all values, or None for every number that is not negative.
    """

    what: str
    off: Value
    on: Value
    allowed: tuple[Value, ...] | None

    def value(self, name: str, text: str) -> Value:
        """Parse the value of a component.

        Raises:
            UserError: it stands for none.
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
    "background": Choice("colour behind the field", "black", "sphere", BACKGROUNDS),
    "view": Choice("degree of view-dependent colour", 0, MOST_DEGREES, tuple(range(MOST_DEGREES + 1))),
    "exposure": Choice("brightness and white balance per photo", "none", "learned", EXPOSURES),
    "cameras": Choice("camera parameters optimized with the field", "fixed", "poses", CAMERAS),
    "masks": Choice("whether black in masks is empty space", "ignore", "empty", MASKS),
    "points": Choice("surfaces at 3D points of matched features, weight", 0.0, 0.1, None),
    "stereo": Choice("points from stereo matching of photos", False, True, (False, True)),
    "overlap": Choice("empty space near a camera that no other photo sees", False, True, (False, True)),
    "entropy": Choice("opaque or transparent rays, weight", 0.0, 0.01, None),
    "near": Choice("smaller gradients near cameras", False, True, (False, True)),
    "distortion": Choice("concentrated density along rays, weight", 0.0, 0.05, None),
    "antialias": Choice("fade out details smaller than a pixel", False, True, (False, True)),
    "pixels": Choice("more pixels where the error is large", "anywhere", "error", PIXELS),
    "movers": Choice("leave out what moves between photos", False, True, (False, True)),
}
assert tuple(CHOICES) == tuple(field.name for field in fields(Components))


def choose(start: Components, *, included: Sequence[str], excluded: Sequence[str]) -> Components:
    """`start` with some components switched on and off.

    Args:
        start: what holds where nothing is said.
        included: NAME, for the value that switches it on, or NAME=VALUE.
        excluded: NAME, for the value that switches it off.

    Raises:
        UserError: an unknown name or value, or a component that is named twice.
    """
    values: dict[str, Value] = {}
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
    """Return the components that are not as they are by default, with their values."""
    default = Components()
    return {name: value for name in CHOICES if (value := getattr(components, name)) != getattr(default, name)}


def _wrong(name: str, text: str, expected: str) -> UserError:
    return UserError(f"--with {name}={text}: expected {expected}", f"for example --with {name}={CHOICES[name].on}", 2)
