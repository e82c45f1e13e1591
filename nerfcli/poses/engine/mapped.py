"""Store the mapper's models on disk before any check; the checks and every later call read them back.

    WORK/NAME/0, 1, ...   the models, largest first, with the photos' numbers as names
    WORK/NAME.json        the stage: what was tried, and a hash of each file of the models

The checks always read the models from disk, even in the call that wrote them, so that the result has the same bits
after a call that was killed during the checks. Photos without a pose are not on disk, and no check sees them.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

import nerfcli
from nerfcli.poses.input.job import Job, job_from_json
from nerfcli.poses.input.stages import file_key, read_stage, stage_key, write_stage

# Stage with the models of the mapping attempts.
FIRST = "mapped"


@dataclass(frozen=True)
class MappedModels:
    """The mapped models, largest first, and the job whose features and matches they use.

    attempts: in order, {"what", "models": sizes, largest first}; the one that locates single photos also has "photos":
    the result for each. localised: ids of images located from the model's points, without a pair that supports them.
    seconds: spent on mapping. cut_short: what was stopped because it took far longer than planned.
    """

    models: list[pycolmap.Reconstruction]
    job: Job
    attempts: list[dict[str, Any]]
    localised: tuple[int, ...] = ()
    seconds: float = 0.0
    cut_short: tuple[str, ...] = ()


def write_mapped(mapped: MappedModels, key: str, *, name: str = FIRST) -> None:
    """Write models and stage into the work folder, replacing earlier ones of this name."""
    also = {field: getattr(mapped, field) for field in ("attempts", "localised", "seconds", "cut_short")}
    write_models(Path(mapped.job.folder) / name, mapped.models, key, also={"job": asdict(mapped.job), **also})


def read_mapped(job: Job, key: str, *, name: str = FIRST) -> MappedModels | None:
    """Read what `write_mapped` wrote for this key; None if it is damaged or missing, or its database is missing."""
    found = read_models(Path(job.folder) / name, key)
    if found is None:
        return None
    models, content = found
    there = replace(
        job_from_json(content["job"]),
        folder=job.folder,
        originals=job.originals,
        threads=job.threads,
        skipped_checks=job.skipped_checks,
    )
    if not there.database.exists():
        return None
    localised, cut_short = tuple(content["localised"]), tuple(content.get("cut_short", ()))
    return MappedModels(models, there, content["attempts"], localised, content["seconds"], cut_short)


def write_models(
    folder: Path, models: Sequence[pycolmap.Reconstruction], key: str, *, also: Mapping[str, Any] | None = None
) -> None:
    """Write models below a folder, replacing earlier ones, and then FOLDER.json, the stage with their hashes."""
    stage = folder.with_suffix(".json")
    stage.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    for index, model in enumerate(models):
        target = folder / str(index)
        target.mkdir(parents=True)
        model.write_binary(target)
    write_stage(stage, key, {**(also or {}), "models": len(models), "files": file_keys(folder)})


def read_models(folder: Path, key: str) -> tuple[list[pycolmap.Reconstruction], dict[str, Any]] | None:
    """Read the models that `write_models` wrote for this key, and the stage's content; None if they are not intact."""
    content = read_stage(folder.with_suffix(".json"), key)
    if content is None or content["files"] != file_keys(folder):
        return None
    return [pycolmap.Reconstruction(folder / str(index)) for index in range(content["models"])], content


def mapping_key(job: Job) -> str:
    """Return a hash of everything that the models of a job depend on."""
    content: dict[str, Any] = asdict(job)
    for name in ("folder", "originals", "threads", "skipped_checks"):
        del content[name]
    return stage_key(content, nerfcli.__version__, pycolmap.__version__)


def file_keys(folder: Path) -> dict[str, str]:
    """Return a hash of each file below a folder, by its relative path; empty if the folder does not exist."""
    files = sorted(path for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else []
    return {str(path.relative_to(folder)): file_key(path) for path in files}
