"""Facts read from the folders of a run and its scene: settings, log, metrics, poses, warnings."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfcli.atomic import read_json
from nerfcli.captures.formats.run_cameras import RunCameras
from nerfcli.errors import listed, several
from nerfcli.evaluate.protocol import RunMetrics
from nerfcli.training.runs.files import LogEntry
from nerfcli.training.runs.run import Run, RunConfig

POSES_REPORT = "poses_report.json"


@dataclass(frozen=True)
class RunFacts:
    """Facts of one run: its label on the page, configuration, log, training and held-out frames.

    Args:
        metrics: RUN/metrics.json; None if the run was not evaluated, or another checkpoint was.
        poses: the scene's poses_report.json; None if the poses came from elsewhere or the scene was moved.
        field_bytes: size of the checkpoint.
    """

    path: Path
    label: str
    config: RunConfig
    log: list[LogEntry]
    metrics: RunMetrics | None
    poses: dict[str, Any] | None
    frames: RunCameras
    field_bytes: int


def read_facts(run: Run, label: str, *, checkpoint_sha256: str) -> RunFacts:
    """Read all facts of a run; metrics of another checkpoint than that with this digest are left out.

    Raises:
        UserError: it is not a run, or one of its files cannot be read.
    """
    content = _json(run.metrics_path)
    metrics = None if content is None else RunMetrics.from_json(content, run.metrics_path)
    if metrics is not None and metrics.checkpoint_sha256 != checkpoint_sha256:
        metrics = None
    return RunFacts(
        path=run.path,
        label=label,
        config=run.config,
        log=run.log,
        metrics=metrics,
        poses=_json(run.config.scene / POSES_REPORT),
        frames=run.cameras,
        field_bytes=run.field_path.stat().st_size,
    )


def labels_of(runs: Sequence[Path]) -> list[str]:
    """Return the shortest trailing parts of the paths that are unique; numbered paths if two are equal."""
    parts = [run.resolve().parts for run in runs]
    for depth in range(1, max(map(len, parts)) + 1):
        labels = ["/".join(part[-depth:]) for part in parts]
        if len(set(labels)) == len(labels):
            return labels
    return [f"{run} ({index + 1})" for index, run in enumerate(runs)]


def warnings_of(facts: RunFacts) -> Iterator[tuple[str, str]]:
    """Yield (stage, text) of all warnings from poses to evaluation of this run, in the order of the stages."""
    yield from _of_poses(facts.poses or {})
    missing = facts.config.missing_photos
    if missing:
        yield "scene", f"{several(len(missing), 'photo')} missing: {listed(missing)}"
    for note in facts.config.warnings:
        yield "training", note
    rollbacks = max((entry.get("rollbacks", 0) for entry in facts.log), default=0)
    if rollbacks:
        yield (
            "training",
            f"numbers became non-finite {rollbacks} times; training continued from an earlier state with smaller steps",
        )
    if facts.metrics is None:
        yield "evaluation", "this checkpoint was not evaluated: run nerfcli evaluate"
    else:
        yield from (("evaluation", text) for text in facts.metrics.warnings)


def captures_of(runs: Sequence[RunFacts]) -> list[list[int]]:
    """Group the indices of the runs by capture: runs that share a held-out photo belong to the same capture."""
    captures: list[tuple[set[str], list[int]]] = []
    for index, run in enumerate(runs):
        photos = {str(frame.image.resolve()) if frame.image else frame.name for frame in run.frames.test}
        indices = [index]
        for capture in [capture for capture in captures if capture[0] & photos]:
            captures.remove(capture)
            photos |= capture[0]
            indices += capture[1]
        captures.append((photos, sorted(indices)))
    return sorted(indices for _, indices in captures)


def scenes_of(runs: Sequence[RunFacts]) -> list[str]:
    """Return a scene identifier for each run."""
    return [run.config.scene_fingerprint or str(run.path) for run in runs]


def mismatches_of(runs: Sequence[RunFacts]) -> Iterator[str]:
    """Yield the reasons why metrics of these runs must not be compared."""
    measured = [run for run in runs if run.metrics is not None]
    if any(len({runs[i].config.split_sha256 for i in capture}) > 1 for capture in captures_of(runs)):
        yield "the runs have different held-out photos"
    if len({run.metrics.protocol for run in measured if run.metrics}) > 1:
        yield "the runs were evaluated by different protocols"
    if len({run.metrics.device for run in measured if run.metrics}) > 1:
        yield "the runs were evaluated on different machines or threads: compare errors, not times"


def _of_poses(poses: dict[str, Any]) -> Iterator[tuple[str, str]]:
    left_out = [image for image in poses.get("images", []) if not image.get("registered")]
    if left_out:
        reasons = [f"{image['name']} ({image.get('reason') or 'unknown reason'})" for image in left_out]
        yield "poses", f"{several(len(left_out), 'photo')} without a pose: {listed(reasons)}"
    for failure in poses.get("verdict", {}).get("failures", []):
        yield "poses", f"{failure['kind']}: {failure['evidence']}"
    attempts = poses.get("attempts", [])
    if len(attempts) > 1:
        yield "poses", f"mapping took {len(attempts)} attempts: {', '.join(str(one.get('what')) for one in attempts)}"
    for attempt in attempts:
        if "doubt" in attempt:
            yield "poses", attempt["doubt"]
    blur = poses.get("pose_blur_px") or {}
    if (blur.get("largest") or 0.0) > 1.0:  # visible at the size of the photos
        yield "poses", f"the pose of {blur.get('photo')} is uncertain by {blur['largest']:.1f} px"


def _json(path: Path) -> dict[str, Any] | None:
    """Return the JSON object in a file; None if the file does not exist."""
    try:
        os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError:
        pass  # `read_json` says why
    return read_json(path, needed=(), hint="write it again with the command that created it")
