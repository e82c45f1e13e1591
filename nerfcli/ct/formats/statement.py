"""Descriptions of scans: the user's options, units, and fields of text files, as "key = value" lines or JSON."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nerfcli.atomic import read_json
from nerfcli.errors import UserError

Word = TypeVar("Word", bound=str)

# Millimetres per unit of length, keyed by the names of units in files.
MILLIMETRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1e3),
    **dict.fromkeys(("cm", "centimetre", "centimeter"), 10.0),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), 1.0),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns", "micrometre", "micrometer", "micrometers"), 1e-3),
    **dict.fromkeys(("nm", "nanometre", "nanometer"), 1e-6),
}
_DEGREES = ("deg", "degree", "degrees", "°", "degs")
_RADIANS = ("rad", "radian", "radians")
# Angles said to be in degrees that span less than this over many views are in radians.
_NARROW_DEG, _MANY_VIEWS = 6.5, 30


@dataclass(frozen=True)
class ScanOptions:
    """The user's options.

    Args:
        photons: number of photons per pixel of the open beam in a view.
        unit: unit of lengths in the file, a key of `MILLIMETRES`; overrides the unit that the file states.
        centre_column: the column that the axis of rotation is projected to, 0 for the middle of the first pixel.
        holdout: a rule of `holdout.check_holdout` for views, which are named 00000, 00001, ...
        mirrored: whether columns are numbered from the side opposite to the one that the file states.
    """

    photons: float | None = None
    unit: str | None = None
    centre_column: float | None = None
    holdout: str | None = None
    mirrored: bool = False


def millimetres(unit: str, *, where: str) -> float:
    """Return the length of a unit in millimetres.

    Raises:
        UserError: it is not a unit of length.
    """
    found = MILLIMETRES.get(unit.strip().lower())
    if found is None:
        raise UserError(f"{where}: {unit!r} is not a unit of length", "set it with --unit: m, cm, mm, um or nm")
    return found


def angles_in_radians(angles: np.ndarray, *, views: int, unit: str | None, where: str) -> np.ndarray:
    """Convert angles of views to radians.

    Args:
        angles: (V,).
        views: expected number of angles.
        unit: unit as written in the file; None, for no unit, means degrees.
        where: the place in the file, for error messages.

    Raises:
        UserError: there are too few or too many, some are not finite, all are the same, or the unit cannot be right.
    """
    values = np.asarray(angles, dtype=np.float64).reshape(-1)
    if len(values) != views:
        raise UserError(
            f"{where} has {len(values)} angles for {views} projections",
            "each projection needs one angle: remove the frames or angles without a counterpart",
        )
    if not np.isfinite(values).all():
        bad = int(np.argmin(np.isfinite(values)))
        raise UserError(f"{where}: angle {bad} is {values[bad]}", "correct the angles in the file")
    span = float(np.ptp(values))
    if span == 0 and views > 1:
        raise UserError(f"{where}: all {views} angles are {values[0]:g}", "give the angle of each projection")
    name = "degrees" if unit is None else unit.strip().lower()
    if name in _RADIANS:
        if span > 8 * np.pi:
            raise UserError(f"{where}: angles span {span:.4g} radians", "these look like degrees: correct their unit")
        return values
    if name not in _DEGREES:
        raise UserError(f"{where}: {unit!r} is not a unit of angle", "write degrees or radians")
    if span < _NARROW_DEG and views >= _MANY_VIEWS:
        raise UserError(
            f"{where}: {views} angles span {span:.4g} degrees",
            "these look like radians: correct their unit in the file",
        )
    return np.radians(values)


class Statement:
    """Fields of a description; their names are case-insensitive."""

    def __init__(self, path: Path, fields: Mapping[str, Any], *, hint: str):
        self.path, self.hint = path, hint
        self._fields = {name.strip().lower(): value for name, value in fields.items()}

    def __contains__(self, name: str) -> bool:
        return name.lower() in self._fields

    @property
    def names(self) -> list[str]:
        """Names of all fields, in lower case."""
        return list(self._fields)

    def text(self, name: str, default: str | None = None) -> str:
        """Return a field as text, without spaces around it."""
        value = self._fields.get(name.lower(), default)
        if value is None:
            raise UserError(f"{self.path} has no {name}", self.hint)
        return str(value).strip()

    def number(self, name: str, default: float | None = None) -> float:
        """Return the number that a field begins with."""
        if default is not None and name not in self:
            return default
        text = self.text(name)
        found = re.match(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", text.replace(",", "."))
        if not found:
            raise UserError(f"{self.path}: {name} is {text!r}", "expected a number")
        return float(found[0])

    def positive(self, name: str) -> float:
        """Return a number above 0 that is a normal one in float32."""
        value = self.number(name)
        if not float(np.finfo(np.float32).tiny) <= value <= float(np.finfo(np.float32).max):
            raise UserError(f"{self.path}: {name} is {value:g}", "expected a number above 0")
        return value

    def whole(self, name: str) -> int:
        """Return a whole number above 0."""
        value = self.positive(name)
        if value != round(value):
            raise UserError(f"{self.path}: {name} is {value:g}", "expected a whole number")
        return round(value)

    def one_of(self, name: str, choices: Sequence[Word]) -> Word:
        """Return a field that is one of several words."""
        text = self.text(name)
        for choice in choices:
            if choice == text:
                return choice
        raise UserError(f"{self.path}: {name} is {text!r}", f"choose one of {', '.join(choices)}")

    def nested(self, name: str, *, hint: str | None = None) -> "Statement":
        """Return the fields of a field that is an object; `hint` is for errors in them."""
        value, hint = self._fields.get(name.lower()), hint or self.hint
        if value is None:
            raise UserError(f"{self.path} has no {name}", hint)
        if not isinstance(value, dict):
            raise UserError(f"{self.path}: {name} is {value!r}", hint)
        return Statement(self.path, value, hint=hint)

    def value(self, name: str, default: Any = None) -> Any:
        """Return a field without conversion."""
        return self._fields.get(name.lower(), default)


def read_lines(path: Path, *, hint: str) -> Statement:
    """Read the "key = value" lines of a file in any 8-bit encoding; the first of equal keys counts.

    Raises:
        UserError: it cannot be read.
    """
    try:
        text = path.read_bytes().decode("latin-1")
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}", hint) from error
    fields: dict[str, str] = {}
    for line in text.splitlines():
        name, equals, value = line.partition("=")
        if equals and name.strip() and not name.lstrip().startswith((";", "#")):
            fields.setdefault(name.strip().lower(), value.strip())
    return Statement(path, fields, hint=hint)


def read_object(path: Path, *, hint: str) -> Statement:
    """Read a JSON object; raise a UserError if the file has none."""
    return Statement(path, read_json(path, needed=(), hint=hint), hint=hint)
