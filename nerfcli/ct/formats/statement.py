"""Descriptions in text files: "key = value" lines of scanners, and JSON; errors name the missing or invalid field."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.errors import UserError


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
    """Read a JSON object.

    Raises:
        UserError: it cannot be read, or is not a JSON object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}", hint) from error
    except ValueError as error:
        raise UserError(f"{path} is not JSON: {error}", hint) from error
    if not isinstance(content, dict):
        raise UserError(f"{path} holds a {type(content).__name__}", hint)
    return Statement(path, content, hint=hint)
