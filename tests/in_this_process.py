"""Structure from motion without a process of its own, which takes longer to start than to place a few small photos."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from nerfcli.poses import structure_from_motion
from nerfcli.poses.engine import worker
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.report import PosesReport


@contextmanager
def worker_in_this_process() -> Iterator[None]:
    """Have `estimate_poses` do the worker's job itself; limits do not hold, and what `progress` raises ends the job."""

    def run_worker(
        job_path: Path, *, progress: Callable[[str, int, int], None], notify: Callable[[str], None], **_: object
    ) -> None:
        def send(message: dict[str, Any]) -> None:
            if "note" in message:
                notify(message["note"])
            else:
                progress(message["stage"], message["done"], message["total"])

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(worker, "take_stdout", lambda: send)
            worker.main(str(job_path))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(structure_from_motion, "run_worker", run_worker)
        yield


def poses_in_this_process(photos: Path, scene: Path, settings: PoseSettings) -> PosesReport:
    """Estimate poses without messages and progress."""
    with worker_in_this_process():
        return structure_from_motion.estimate_poses(photos, scene, settings=settings)
