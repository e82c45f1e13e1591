"""Files of a run folder: their names, and RUN/log.jsonl, with a line at least every second."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NotRequired, TypedDict, cast

from nerfcli.atomic import atomic_path, cannot_write
from nerfcli.errors import UserError

CONFIG = "config.json"
FIELD = "field.safetensors"
STATE = "state.safetensors"
SPLATS = "splats.safetensors"
LOG = "log.jsonl"
METRICS = "metrics.json"
DEPTH_ERRORS = "depth_errors.json"
PHOTO_DEPTHS = "photo_depths.npz"
REPORT = "report.html"
OCCLUDERS = "occluders"  # a folder of masks
LOCK = ".train.lock"


def left_out_mask(run: Path, photo: str) -> Path:
    """Return the file of the pixels that a training left out of a photo, by its name; ".." in it is "up"."""
    parts = ["up" if part == ".." else part for part in PurePosixPath(photo).parts]
    return run.joinpath(OCCLUDERS, *parts[:-1], f"{parts[-1]}.png")


class LogEntry(TypedDict):
    """A line of the log: totals since the start, and speeds since the previous line.

    `losses` are the weighted terms of `loss` by name, see `training.losses`. Lines of earlier versions may lack what
    is not in `_REQUIRED`; only the lines of waypoints have `heldout_psnr`.
    """

    step: int
    seconds: float
    loss: float
    losses: NotRequired[dict[str, float]]
    samples: int
    rays: int
    peak_memory_bytes: int
    samples_per_second: float
    rays_per_second: float
    rollbacks: int
    heldout_psnr: NotRequired[float]


_REQUIRED = ("step", "seconds", "loss", "samples", "rays", "peak_memory_bytes")


@dataclass(frozen=True)
class TrainingSummary:
    """Summary of a training: seconds, optimizer steps, mean speeds and peak resident memory."""

    seconds: float
    steps: int
    samples_per_second: float
    rays_per_second: float
    peak_memory_bytes: int

    @classmethod
    def of(cls, log: Sequence[LogEntry]) -> "TrainingSummary":
        """Summarise a log of at least one line."""
        last = log[-1]
        return cls(
            seconds=last["seconds"],
            steps=last["step"],
            samples_per_second=last["samples"] / last["seconds"],
            rays_per_second=last["rays"] / last["seconds"],
            peak_memory_bytes=max(entry["peak_memory_bytes"] for entry in log),
        )


def append_log(run: Path, entry: LogEntry) -> None:
    """Append a line to RUN/log.jsonl."""
    try:
        with (run / LOG).open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry, allow_nan=False) + "\n")
    except OSError as error:
        raise cannot_write(run / LOG, error) from error


def read_log(run: Path) -> list[LogEntry]:
    """Return the entries of RUN/log.jsonl up to the first incomplete line: a kill may have cut the last one.

    Raises:
        UserError: the file exists and cannot be read.
    """
    try:
        lines = (run / LOG).read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UserError(f"{run / LOG} cannot be read: {error.strerror}", "train again with --overwrite") from error
    entries: list[LogEntry] = []
    for line in lines:
        try:
            entry = json.loads(line)
        except ValueError:
            break
        if not isinstance(entry, dict) or not all(_is_number(entry.get(name)) for name in _REQUIRED):
            break
        entries.append(cast(LogEntry, entry))
    return entries


def cut_log(run: Path, step: int) -> None:
    """Remove the entries after `step`: a killed training has logged steps after its last checkpoint."""
    _write_log(run, [entry for entry in read_log(run) if entry["step"] <= step])


def add_to_log(run: Path, measured: Mapping[int, dict[str, Any]]) -> None:
    """Add values that were measured after the training, by step, to the entries of these steps."""
    _write_log(run, [{**entry, **measured.get(entry["step"], {})} for entry in read_log(run)])


def _write_log(run: Path, entries: Iterable[Mapping[str, Any]]) -> None:
    with atomic_path(run / LOG) as partial:
        partial.write_text("".join(f"{json.dumps(entry)}\n" for entry in entries), encoding="utf-8")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
