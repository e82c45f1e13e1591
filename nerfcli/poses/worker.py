"""The child process: pycolmap from photos to a model on disk. Run as `python -m nerfcli.poses.worker JOB.json`.

pycolmap is C++ that may end the process without a Python exception, so it gets one of its own. It reads a job, writes
`sparse/0` and `result.json` into the job's folder, and tells its progress as JSON lines {"stage", "done", "total"} on
stdout. Everything else, glog's lines included, goes to stderr. It ends by itself when its stdin closes, which is
what happens when the parent dies, however it dies.

Photos go by number here: pycolmap sees `00000.jpg`, `00001.png`..., so that a space or an umlaut in a name
cannot break the list of pairs.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pycolmap

from nerfcli.poses.features import evidence, extract, match
from nerfcli.poses.job import Job, Report, read_job
from nerfcli.poses.mapping import (
    describe_cameras,
    photo_numbers,
    reconstruct,
    refine_principal_point,
    write_model,
)


def main(job_path: str) -> None:
    """Do one job and write its result."""
    report = _take_stdout()
    _end_with_parent()
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value
    job = read_job(Path(job_path))
    pycolmap.set_random_seed(job.seed)
    result = solve(job, report)
    (Path(job.folder) / "result.json").write_text(json.dumps(result), encoding="utf-8")


def solve(job: Job, report: Report) -> dict[str, Any]:
    """Extraction, matching, mapping; writes `sparse/0` if there is a model and returns what the report needs."""
    seconds: dict[str, float] = {}
    with _timed(seconds, "extract"):
        extract(job, report)
    with _timed(seconds, "match"):
        match(job, job.pairs, report)
    with _timed(seconds, "map"):
        models, attempts = reconstruct(job, report)
        best = refine_principal_point(models[0], job.threads) if models else None
    result: dict[str, Any] = {"seconds": seconds, "attempts": attempts, "evidence": evidence(job)}
    result["versions"] = {"pycolmap": pycolmap.__version__, "ceres": pycolmap.__ceres_version__}
    result["models"] = [photo_numbers(model, job) for model in models]
    if best is not None:
        result["mean_reprojection_error_px"] = best.compute_mean_reprojection_error()
        result["cameras"] = describe_cameras(best)
        result["principal_point_refined"] = best is not models[0]
        result["points"] = best.num_points3D()
        write_model(best, job)
    return result


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = round(time.perf_counter() - start, 3)


def _take_stdout() -> Report:
    """A function that reports on stdout, which from here on is closed to every other writer in the process."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def report(stage: str, done: int, total: int) -> None:
        channel.write(json.dumps({"stage": stage, "done": done, "total": total}) + "\n")
        channel.flush()

    return report


def _end_with_parent() -> None:
    """End this process at once when stdin closes."""

    def wait() -> None:
        os.read(0, 1)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    main(sys.argv[1])
