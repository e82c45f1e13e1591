"""The leak ledger: which stages have seen the held-out photos before they were measured on.

A held-out photo that helped to find the cameras, the points or the scene's extent is not quite unseen. Nearly every
published number has such leaks; here each one is written down.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nerfcli.training.runs.run import RunConfig


@dataclass(frozen=True)
class Entry:
    """A stage, whether it used the held-out photos (None if unknown), and the source of that information."""

    stage: str
    saw_held_out: bool | None
    how: str


def leak_ledger(config: RunConfig) -> list[Entry]:
    """Return the ledger of a run, by the provenance of its scene, `config.history`, which `nerfcli poses` writes."""
    return [
        *_cameras(config.history, str(config.scene_kind), config.holdout),
        Entry(
            "normalisation",
            True,
            "the extent of the scene is computed from the poses of all photos, including held-out ones",
        ),
        _exposure(config),
        Entry("training", False, "held-out photos were not used for training"),
        Entry(
            "checks while training",
            False,
            "PSNR on held-out pixels was measured after training; nothing was selected by it",
        ),
    ]


def summary_line(ledger: Sequence[Entry]) -> str:
    """Summarize in one line which stages used the held-out photos, and for which it is unknown."""
    parts = []
    for answer, words in ((True, "used by"), (None, "perhaps used by"), (False, "not used by")):
        stages = [entry.stage for entry in ledger if entry.saw_held_out is answer]
        parts += [f"{words} {', '.join(stages)}"] if stages else []
    return "held-out photos were " + "; ".join(parts)


def _exposure(config: RunConfig) -> Entry:
    """Return the entry of the exposure, which is never fitted to a held-out photo; its EXIF may be used."""
    chosen = config.components.exposure
    how = {
        "none": "no exposure is fitted",
        "exif": "from EXIF, including that of held-out photos",
        "matched": "from pixels that training photos share; held-out photos use EXIF and the photos around",
        "learned": "fitted to training photos; held-out photos use EXIF and the photos around",
    }
    return Entry("exposure", False, how.get(chosen, str(chosen)))


def _cameras(history: Mapping[str, Any], kind: str, holdout: str | None) -> list[Entry]:
    stages = ("poses", "intrinsics", "points")
    if history.get("command") != "poses":
        source = history.get("from", kind)
        return [Entry(stage, None, f"the cameras came with the capture ({source})") for stage in stages]
    saw, how = True, "estimated from all photos (nerfcli poses without --strict)"
    if (history.get("settings") or {}).get("strict"):
        saw = False
        how = "estimated from training photos only; held-out photos were located afterwards with everything else fixed"
        if holdout is not None:  # instead of the scene's split: perhaps others
            saw, how = None, f"estimated without the photos that nerfcli poses held out, perhaps not those of {holdout}"
    given = "intrinsics" in history
    return [
        Entry("poses", saw, how),
        Entry("intrinsics", False, "given and kept fixed") if given else Entry("intrinsics", saw, how),
        Entry("points", saw, how),
    ]
