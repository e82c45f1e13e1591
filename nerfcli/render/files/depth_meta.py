"""Definition of the values of a depth map, stored in every file and read back.

A depth map without its convention is ambiguous: it may be measured along the ray or along the optical axis, in any
unit, as a mean or a median, with any value where nothing was hit. Files whose definitions differ must not be mixed in
one folder, video or mesh.
"""

import json
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from nerfcli import __version__
from nerfcli.errors import UserError

FORMAT = "nerfcli depth 2"
# The key of a description in PNG text chunks and OpenEXR attributes.
KEY = "nerfcli"
AXES = {"ray": "along the ray", "z": "along the optical axis (z)"}
# The convention of quantities other than depth.
CONVENTION_OF = {
    "spread": "standard-deviation",
    "disagreement": "median-conditional",
    "coverage": "photos-that-see",
    "parallax": "largest-angle",
    "lower": "lower",
    "upper": "upper",
    "confidence": "confidence",
}
QUANTITIES = ("depth", *CONVENTION_OF)
# The unit of quantities that are not lengths.
UNIT_OF = {"coverage": "photos", "parallax": "degrees", "confidence": "fractions of 1"}

_IN_WORDS = {
    "conditional": "the mean distance at which light is absorbed, given that it is",
    "moment": "the mean distance multiplied by the opacity",
    "background": "the mean distance, with light that passes counted at the background distance",
    "max-weight": "the mean distance inside the interval that absorbs most light",
    "median": "the distance at which half of all light is absorbed",
    "standard-deviation": "the standard deviation of the distance at which light is absorbed",
    "median-conditional": "|median - conditional|, large where no single depth is right (edges, glass, fog)",
    "photos-that-see": "the number of training photos that see the surface, by the field's own depths",
    "lower": "measured on held-out photos by stereo matching; none where no training photo sees the surface",
    "upper": "measured on held-out photos by stereo matching; none where no training photo sees the surface",
    "confidence": "the proportion of depths with an error of at most {number} where as many photos see the surface, "
    "measured on held-out photos by stereo matching; none where no training photo sees the surface",
    "largest-angle": "the largest angle between the rays of two training photos that see the surface; 0 below two",
}
_WHAT_MUST_AGREE = (
    *("quantity", "convention", "axis", "unit", "opacity_floor", "background_distance"),
    *("invalid", "units_per_level", "min_views", "min_parallax_deg"),
)


@dataclass(frozen=True)
class DepthMeta:
    """Definition and provenance of the values of a map.

    Args:
        convention: which statistic of depth along the ray: "conditional", "median", "quantile:0.05", ...; for other
            quantities the entry of `CONVENTION_OF`.
        axis: "ray", distance from the camera's centre along the ray; or "z", along the optical axis.
        unit: "metre", or "arbitrary" if the scale of the scene is unknown; for quantities that are not lengths, see
            `UNIT_OF`.
        opacity_floor: pixels whose opacity is below it have no value.
        invalid: the value that marks pixels without one: "nan", or "0" in integer files.
        background_distance: the distance that counts for light that hits nothing, if the convention needs it.
        min_views, min_parallax_deg: coverage and parallax below which a pixel has no depth.
        quantity: one of `QUANTITIES`.
        unit_source: how the unit is known ("gps", "distances", ...); None if unknown.
        units_per_level: for integer files: value = level * units_per_level.
        error_bounds: bounds of the rendering error by name, as plain numbers and text. They apply to the rendering of
            the field, not to the field itself.
        view: the camera of the map: name, camera (model, width, height, params), world_from_cam; plain values.
        provenance: run, field_sha256 and other facts about the map's origin; plain values.
        layers: the other maps in the same file, by name, with their convention and opacity_floor.

    Raises:
        ValueError: unknown axis or quantity.
    """

    convention: str
    axis: str
    unit: str
    opacity_floor: float
    invalid: str = "nan"
    background_distance: float | None = None
    min_views: int = 0
    min_parallax_deg: float = 0.0
    quantity: str = "depth"
    unit_source: str | None = None
    units_per_level: float | None = None
    error_bounds: dict[str, Any] = field(default_factory=dict)
    view: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    layers: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if self.axis not in AXES:
            raise ValueError(f"axis must be one of {', '.join(AXES)}, got {self.axis}")
        if self.quantity not in QUANTITIES:
            raise ValueError(f"quantity must be one of {', '.join(QUANTITIES)}, got {self.quantity}")

    def of(self, quantity: str, *, opacity_floor: float | None = None, convention: str | None = None) -> Self:
        """Return the definition of another map of the same picture, along the same axis.

        opacity_floor defaults to that of this map, convention to the entry of `CONVENTION_OF`.
        """
        if quantity == self.quantity:
            return self
        floor = self.opacity_floor if opacity_floor is None else opacity_floor
        return replace(
            self,
            quantity=quantity,
            convention=convention or CONVENTION_OF[quantity],
            unit=UNIT_OF.get(quantity, self.unit),
            unit_source=None if quantity in UNIT_OF else self.unit_source,
            opacity_floor=floor,
            background_distance=None,
            min_views=0,
            min_parallax_deg=0.0,
        )

    @property
    def title(self) -> str:
        """A short title for legends, such as "conditional depth"."""
        named = {
            "spread": "spread of depth",
            "disagreement": "|median - conditional| depth",
            "coverage": "coverage: training photos that see the surface",
            "parallax": "parallax: largest angle between two of them",
            "lower": f"lower end of the {self._percentage} interval of depth",
            "upper": f"upper end of the {self._percentage} interval of depth",
            "confidence": f"confidence: proportion of depths with an error of at most {self._percentage}",
        }
        return named.get(self.quantity, f"{self.convention} depth")

    @property
    def _percentage(self) -> str:
        """The level of an interval, or the tolerance of a confidence, as a percentage: "90 %"."""
        return f"{100 * float(self.convention.partition(':')[2] or 'nan'):g} %"

    def to_json(self) -> dict[str, Any]:
        """Return plain values, with the format and the nerfcli version that wrote them."""
        return {"format": FORMAT, "nerfcli": __version__, **asdict(self)}

    def to_text(self) -> str:
        """Return `to_json` as one line of ASCII.

        Raises:
            ValueError: a number is not finite.
        """
        return json.dumps(self.to_json(), allow_nan=False)

    @classmethod
    def from_json(cls, entries: Any) -> Self:
        """Read the content that `to_json` returned; files of earlier versions have fewer entries.

        Raises:
            ValueError: the entries are not those of a depth map.
        """
        if not isinstance(entries, dict) or not {"convention", "axis", "unit", "opacity_floor"} <= entries.keys():
            raise ValueError("not a description of a depth map")
        return cls(**{f.name: entries[f.name] for f in fields(cls) if f.name in entries})

    def in_words(self) -> str:
        """Return one line for people: "conditional depth along the optical axis (z), in metres (gps): the mean ..."."""
        if self.quantity in UNIT_OF:
            meaning = _IN_WORDS[self.convention.partition(":")[0]].format(number=self._percentage)
            return f"{self.quantity.replace('_', ' ')}, in {self.unit}: {meaning}"
        unit = "metres" if self.unit == "metre" else f"{self.unit} units"
        source = f" (from: {self.unit_source})" if self.unit_source else ""
        convention, _, fraction = self.convention.partition(":")
        meaning = _IN_WORDS.get(convention, "")
        if convention == "quantile":
            meaning = f"the distance at which {fraction} of all light is absorbed"
        return f"{self.title} {AXES[self.axis]}, in {unit}{source}" + (f": {meaning}" if meaning else "")


def limits_in_words(min_views: int, min_parallax_deg: float) -> str:
    """Describe the limits below which a pixel loses its depth: "a coverage below 2 photos or ..."; "" without any."""
    views = [f"a coverage below {min_views} photos"] if min_views else []
    return " or ".join([*views, *([f"a parallax below {min_parallax_deg:g} degrees"] if min_parallax_deg else [])])


def difference_of(one: DepthMeta, other: DepthMeta) -> str | None:
    """Describe a difference that forbids mixing two maps: "convention median and conditional"; None if they agree."""
    for name in _WHAT_MUST_AGREE:
        a, b = getattr(one, name), getattr(other, name)
        if a != b:
            return f"{name.replace('_', ' ')} {a} and {b}"
    return None


def mixed(path: Path, other: Path, difference: str) -> UserError:
    """Return the two-line error for two maps with different definitions in one place."""
    return UserError(
        f"{path} and {other} have different definitions: {difference}",
        "keep depth with different definitions in separate folders: choose another one with -o",
    )


def entries_of_text(text: str | None) -> dict[str, Any] | None:
    """Return the JSON object in a text; None if it contains none."""
    try:
        entries = json.loads(text or "")
    except ValueError:
        return None
    return entries if isinstance(entries, dict) else None


def check_map(values: np.ndarray, *, channels: bool = False) -> None:
    """Check the dtype and the shape of a map.

    Raises:
        ValueError: not float32 (H, W), or with `channels` not float32 (H, W, 3 or 4).
    """
    fits = values.ndim == 3 and values.shape[2] in (3, 4) if channels else values.ndim == 2
    if values.dtype != np.float32 or not fits:
        shape = "(H, W, 3|4)" if channels else "(H, W)"
        raise ValueError(f"depth must be float32 {shape}, got {values.dtype} {values.shape}")
