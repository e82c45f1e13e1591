"""The leak ledger: which stages have seen the held-out photos before they were measured on.

A held-out photo that helped to find the cameras, the points or the scene's extent is not quite unseen. Nearly every
published number has such leaks; here each one is written down.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from nerfcli.runs.config import RunConfig

_TEXTS = {True: "yes", False: "no", None: "not known"}


@dataclass(frozen=True)
class Entry:
    """A stage, whether it saw the held-out photos (None where nobody can tell), and how that is known."""

    stage: str
    saw_held_out: bool | None
    how: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def leak_ledger(config: RunConfig) -> list[Entry]:
    """The ledger of a run.

    `config.history` is the provenance of the scene: {"command": "poses", ...} where `nerfcli poses` found the
    cameras.
    """
    return [
        *_cameras(config.history, str(config.scene_kind)),
        Entry("normalisation", True, "the poses of all photos, held-out ones included, say where the scene is"),
        _exposure(config),
        Entry("training", False, "no pixel of a held-out photo was trained on"),
        Entry(
            "checks while training", False, "pixels of held-out photos were measured, and nothing was chosen by them"
        ),
    ]


def told(ledger: list[Entry]) -> str:
    """One line: which stages have seen the held-out photos, and of which nobody knows."""
    parts = []
    for answer, words in ((True, "seen by"), (None, "perhaps seen by"), (False, "not seen by")):
        stages = [entry.stage for entry in ledger if entry.saw_held_out is answer]
        parts += [f"{words} {', '.join(stages)}"] if stages else []
    return "held-out photos were " + "; ".join(parts)


def _exposure(config: RunConfig) -> Entry:
    """No exposure is ever fitted to a held-out photo; what its EXIF says of it may be used."""
    chosen = config.settings.components.exposure
    how = {
        "none": "none is fitted",
        "exif": "by EXIF, that of the held-out photos included",
        "learned": "fitted to training photos; of held-out ones by EXIF",
    }
    return Entry("exposure", False, how.get(chosen, str(chosen)))


def _cameras(history: Mapping[str, Any] | None, kind: str) -> list[Entry]:
    stages = ("poses", "intrinsics", "points")
    if history is None:
        return [Entry(stage, None, "this run was trained before that was written down") for stage in stages]
    if history.get("command") != "poses":
        source = history.get("from", kind)
        return [Entry(stage, None, f"the capture came with its cameras ({source})") for stage in stages]
    settings = history.get("settings") or {}
    if settings.get("strict"):
        how = "found from the training photos alone; held-out ones were placed afterwards, with all else fixed"
        return [Entry(stage, False, how) for stage in stages]
    how = "found from all photos together (nerfcli poses without --strict)"
    given = history.get("intrinsics") or {}
    known = given.get("use") == "fixed"
    return [
        Entry("poses", True, how),
        Entry("intrinsics", False, "they were given and kept") if known else Entry("intrinsics", True, how),
        Entry("points", True, how),
    ]
