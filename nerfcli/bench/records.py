"""Records of measurements: an append-only file of JSON lines, so that an interruption costs at most one measurement."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfcli.atomic import cannot_write, write_json
from nerfcli.errors import UserError

PLAN, MEASURED = "plan.json", "measured.jsonl"
FORMAT = "nerfcli bench 1"


@dataclass(frozen=True)
class Records:
    """Measurements in a folder, each a flat dict whose "kind" names its type."""

    folder: Path

    def append(self, kind: str, **content: Any) -> None:
        """Append one measurement.

        Raises:
            UserError: it cannot be written.
        """
        line = json.dumps({"kind": kind, **content}, allow_nan=False)
        try:
            with (self.folder / MEASURED).open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        except OSError as error:
            raise cannot_write(self.folder / MEASURED, error) from error

    def of_kind(self, kind: str) -> Iterator[dict[str, Any]]:
        """Return the measurements of one kind, in order."""
        return (entry for entry in self.all() if entry["kind"] == kind)

    def last(self, kind: str) -> dict[str, Any] | None:
        """Return the latest measurement of a kind; None if there is none."""
        return next(reversed(list(self.of_kind(kind))), None)

    def all(self) -> list[dict[str, Any]]:
        """Return all measurements; a line that a kill truncated is left out."""
        path = self.folder / MEASURED
        entries = []
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
            try:
                entries.append(json.loads(line))
            except ValueError:
                continue
        return entries


def opened(folder: Path, plan: dict[str, Any]) -> Records:
    """Open the records of a bench in a folder, new or existing.

    Args:
        folder: created if it does not exist.
        plan: subject and options of the bench, as plain values.

    Raises:
        UserError: the folder holds another bench or something else, or cannot be written.
    """
    path = folder / PLAN
    wanted = {"format": FORMAT, **plan}
    if path.exists():
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise UserError(f"{path} is damaged", "add --overwrite to measure again") from error
        different = [name for name in found if found[name] != wanted.get(name)]
        if different:
            name = different[0]
            raise UserError(
                f"{folder} contains a bench with a different {name} ({found[name]}, now {wanted.get(name)})",
                "add --overwrite to measure again, or choose another folder with -o",
            )
        if found != wanted:  # it was `emptied`
            write_json(path, wanted)
        _end_with_whole_line(folder / MEASURED)
        return Records(folder)
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise UserError(f"{folder} exists and is not a bench folder", "choose another folder with -o")
    write_json(path, wanted)
    return Records(folder)


def emptied(folder: Path) -> None:
    """Delete the measurements, and write an empty plan, which any bench may take over."""
    write_json(folder / PLAN, {"format": FORMAT})
    (folder / MEASURED).unlink(missing_ok=True)


def _end_with_whole_line(path: Path) -> None:
    """Terminate a line that a kill truncated, so that the next record begins a new line."""
    if path.exists() and (data := path.read_bytes()) and not data.endswith(b"\n"):
        with path.open("ab") as file:
            file.write(b"\n")
