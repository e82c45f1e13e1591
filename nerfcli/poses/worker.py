"""The child process: pycolmap from photos to a model on disk. Run as `python -m nerfcli.poses.worker JOB.json`.

pycolmap is C++ that may end the process without a Python exception, so it gets one of its own. It reads a job, goes on
from the stages that are complete in the job's folder, leaves `sparse/0` and `result.json` there, and tells its progress
as JSON lines {"stage", "done", "total"} on stdout, and what the user should know as {"note"}. Everything else, glog's
lines included, goes to stderr. It ends by itself when its stdin closes, which is what happens when the parent dies,
however it dies.

Photos go by number here: pycolmap sees `00000.jpg`, `00001.png`..., so that a space or an umlaut in a name
cannot break the list of pairs.
"""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pycolmap

import nerfcli
from nerfcli.poses.database import discard_if_damaged, evidence, name_images
from nerfcli.poses.examine import examine
from nerfcli.poses.features import extract, match, start_matching
from nerfcli.poses.job import Job, Report, Tell, read_job
from nerfcli.poses.ladder import climb
from nerfcli.poses.mapping import describe_cameras, model_keys, photo_numbers, write_model
from nerfcli.poses.retrieval import with_neighbours
from nerfcli.poses.stages import read_stage, stage_key, write_stage
from nerfcli.poses.strict import place_held_out, training_part

# The last stage's file: what the report needs. The model stands beside it, in sparse/0.
RESULT = "result.json"


def main(job_path: str) -> None:
    """Do one job and write its result."""
    report, tell = _take_stdout()
    _end_with_parent()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # sent to all processes of a command: the parent answers it
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value
    job = read_job(Path(job_path))
    pycolmap.set_random_seed(job.seed)
    solve(job, report, tell)


def solve(job: Job, report: Report, tell: Tell) -> None:
    """Extraction, matching, mapping; each goes on from what is there."""
    discard_if_damaged(job.database)
    if job.held_out:
        _solve_strictly(job, report, tell)
        return
    seconds: dict[str, float] = {}
    job = _matched(job, report, seconds=seconds)
    result, key = Path(job.folder) / RESULT, mapping_key(job)
    if not _is_complete(job, key):
        result.unlink(missing_ok=True)
        write_stage(result, key, _map(job, report, tell, seconds=seconds))
    name_images(job)


def _solve_strictly(job: Job, report: Report, tell: Tell) -> None:
    """All that with the training photos alone; the held-out ones are placed in what comes of it."""
    result, key = Path(job.folder) / RESULT, mapping_key(job)
    if not _is_complete(job, key):
        result.unlink(missing_ok=True)
        seconds: dict[str, float] = {}
        training = _matched(training_part(job), report, seconds=seconds)
        found = _map(training, report, tell, seconds=seconds)
        with _timed(seconds, "place"):
            found = place_held_out(job, training, found, report)
        found["model_files"] = model_keys(job)  # which the held-out photos are in now
        write_stage(result, key, found)
    name_images(job)


def _matched(job: Job, report: Report, *, seconds: dict[str, float]) -> Job:
    """Features and matches; the job with its pairs complete."""
    with _timed(seconds, "extract"):
        extract(job, report)
    with _timed(seconds, "match"):
        job = with_neighbours(job, report)
        start_matching(job, job.pairs)
        match(job, job.pairs, report)
    return job


def _is_complete(job: Job, key: str) -> bool:
    """Whether the result is there and its model is the one that was written with it."""
    there = read_stage(Path(job.folder) / RESULT, key)
    return there is not None and there["model_files"].items() <= model_keys(job).items()


def mapping_key(job: Job) -> str:
    """A hash of all that the model depends on."""
    content = asdict(job)
    for name in ("folder", "originals", "threads"):
        del content[name]
    return stage_key(content, nerfcli.__version__, pycolmap.__version__)


def _map(job: Job, report: Report, tell: Tell, *, seconds: dict[str, float]) -> dict[str, Any]:
    """Writes `sparse/0` if there is a model and returns what the report needs."""
    with _timed(seconds, "map"):
        climbed = climb(job, report, tell)
    with _timed(seconds, "check"):
        examined = examine(climbed.models, climbed.job, report, localised=climbed.localised)
    model = examined.model
    placed = [] if model is None else photo_numbers(model, job)
    result: dict[str, Any] = {
        "seconds": seconds,
        "attempts": climbed.rungs,
        "evidence": evidence(climbed.job),
        "pairs": len(climbed.job.pairs),
        "versions": {"pycolmap": pycolmap.__version__, "ceres": pycolmap.__ceres_version__},
        "models": [placed, *(photo_numbers(other, job) for other in climbed.models[1:])] if climbed.models else [],
        "left_out": {str(number): reason for number, reason in examined.left_out.items()},
        "pose_blur_px": {str(number): px for number, px in examined.blur_px.items()},
        "verdict": examined.verdict.to_json(),
        **examined.details,
    }
    if model is not None:
        result["mean_reprojection_error_px"] = model.compute_mean_reprojection_error()
        result["cameras"] = describe_cameras(model, job)
        result["points"] = model.num_points3D()
        write_model(model, job)
    result["model_files"] = model_keys(job) if model is not None else {}
    return result


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = round(time.perf_counter() - start, 3)


def _take_stdout() -> tuple[Report, Tell]:
    """Functions that report on stdout, which from here on is closed to every other writer in the process."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def send(message: dict[str, Any]) -> None:
        channel.write(json.dumps(message) + "\n")
        channel.flush()

    return (
        lambda stage, done, total: send({"stage": stage, "done": done, "total": total}),
        lambda text: send({"note": text}),
    )


def _end_with_parent() -> None:
    """End this process at once when stdin closes."""

    def wait() -> None:
        os.read(0, 1)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    main(sys.argv[1])
