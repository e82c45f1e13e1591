"""Measure training settings: each is trained in a separate process, within a common time plan."""

import json
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfcli import child
from nerfcli.bench.sample_pictures import FOLDER, slug
from nerfcli.bench.session import Session
from nerfcli.bench.sweep import TrainSetting, affordable
from nerfcli.runs.files import FIELD
from nerfcli.runs.settings import TrainSettings

# Time of a process besides its training, for libraries, photos, kernels and held-out pixels, until one is measured.
_FIRST_OVERHEAD_SECONDS = 12.0
KEPT_FIELD = FIELD


@dataclass(frozen=True)
class Trainings:
    """Common data of all trainings of a bench.

    Args:
        base: settings that are not varied.
        shown: the name of the held-out photo that is rendered.
        kept: the name of the setting whose field is kept in the folder of the bench; None for none.
    """

    scene: Path
    base: TrainSettings
    shown: str
    kept: str | None


def measure_trainings(
    trainings: Trainings, settings: Sequence[TrainSetting], *, session: Session, seconds: float
) -> None:
    """Train as many settings as time allows, continuing an earlier call.

    Args:
        settings: training settings, the most informative first.
        session: records the measurements: "training plan", "training" and "failed".
        seconds: time limit for all of this.
    """
    ends = session.spent + seconds
    plan: dict[str, Any] | None = session.records.last("training plan")
    if plan is None:
        chosen, unit = affordable(settings, seconds, overhead=_FIRST_OVERHEAD_SECONDS)
        plan = {"settings": [setting.name for setting in chosen], "unit_seconds": unit}
        session.record("training plan", **plan)
    done = {entry["point"] for kind in ("training", "failed") for entry in session.records.of_kind(kind)}
    planned = [setting for setting in settings if setting.name in plan["settings"]]
    for number, setting in enumerate(planned, start=1):
        if setting.name in done:
            continue
        needs = setting.fraction * plan["unit_seconds"] + _overhead(session)
        if done and session.spent + needs > ends:
            session.notify(f"skipping the training {setting.name} for lack of time (about {needs:.0f} s)")
            continue
        outcome = _train(trainings, setting, plan["unit_seconds"], f"training {number} of {len(planned)}", session)
        if "error" in outcome:
            session.notify(f"{setting.name} failed: {outcome['error']}")
            session.record("failed", point=setting.name, reason=outcome["error"])
        else:
            described = {"group": setting.group, "options": setting.options, "settings": setting.to_json()}
            session.record("training", point=setting.name, **described, **outcome["result"])
        done.add(setting.name)


def _overhead(session: Session) -> float:
    """Estimate the seconds of a process besides its training: the mean over measured ones, those in plain torch too."""
    measured = [entry["took"] - entry["seconds"] for entry in session.records.of_kind("training")]
    return sum(measured) / len(measured) if measured else _FIRST_OVERHEAD_SECONDS


def _train(
    trainings: Trainings, setting: TrainSetting, unit_seconds: float, title: str, session: Session
) -> dict[str, Any]:
    """Run one training in a worker, and return its last message: {"result"} or {"error"}."""
    prefix = slug(f"training {setting.name}")
    (session.folder / FOLDER).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=session.folder, prefix=".training-") as folder:
        run, job = Path(folder) / "run", Path(folder) / "job.json"
        content = {
            "scene": str(trainings.scene.resolve()),
            "run": str(run.resolve()),
            "settings": setting.settings(trainings.base, unit_seconds).to_json(),
            "pictures": str((session.folder / FOLDER).resolve()),
            "prefix": prefix,
            "shown": trainings.shown,
            "pixel_seed": 0,
        }
        job.write_text(json.dumps(content), encoding="utf-8")
        session.say(f"{title}: {setting.name}")
        reply = _run_worker(job, lambda detail: session.say(f"{title}: {setting.name}, {detail}"))
        if "result" in reply and setting.name == trainings.kept:
            os.replace(run / FIELD, session.folder / KEPT_FIELD)
    return reply


def _run_worker(job: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Run `nerfcli.bench.worker`; its process has ended when this returns or raises."""
    log = job.with_name("worker.log")
    last: dict[str, Any] = {}
    with log.open("wb") as stderr:
        worker = child.spawn("nerfcli.bench.worker", job, log=stderr)
        messages = child.messages(worker)
        try:
            for last in messages:
                if "fraction" in last:
                    say(last["detail"])
        finally:
            messages.close()
    if "result" in last or "error" in last:
        return last
    words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return {"error": f"the training crashed (exit status {worker.returncode}): {words[-1] if words else 'no message'}"}
