"""Compute models from matches by single runs of the incremental or global mapper, and keep them on disk.

    WORK/NAME/0, 1, ...   the models, largest first, with the photos' numbers as names
    WORK/NAME.json        the stage: what was tried, and a hash of each file of the models

Models on disk are always read back, even in the call that wrote them, so that the checks give the same bits after a
call that was killed during the checks. Photos without a pose are not on disk, and no check sees them.
"""

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pycolmap

import nerfcli
from nerfcli.poses.input.job import Job, Report, file_key, job_from_json, read_stage, repeatedly, stage_key, write_stage
from nerfcli.poses.input.plan import LEAST_LIMIT_SECONDS, limit_seconds, mapping_seconds
from nerfcli.poses.model.reasons import FEW_MATCHES

# Change this whenever the mapper would make other models of the same matches.
_VERSION = "rough adjustments to few points, then all of them"
# Everything is adjusted each time the photos or the points have grown by this factor: where photos have few matches it
# is quickly done, and needed. They have many if there are more than this many verified ones for each photo.
_GROWTH, _DENSE = (1.1, 1.3), 3000
# Snapshots of the model during a run of the mapper, and the number of photos from which mapping takes so long that a
# call goes on from those of one that was killed, and that every attempt is rough. With fewer photos it begins again,
# which takes seconds and gives the same bits as without interruption.
_SNAPSHOTS, _MANY_PHOTOS = 10, 100
# Stage with the models of the mapping attempts.
_MAPPED = "mapped"


@dataclass(frozen=True)
class MapperOptions:
    """How the mapper begins and what it accepts: pycolmap's names and defaults; init_pair holds image ids."""

    init_min_tri_angle: float = 16.0
    init_min_num_inliers: int = 100
    init_max_forward_motion: float = 0.95
    filter_min_tri_angle: float = 1.5
    init_pair: tuple[int, int] | None = None


def map_photos(
    job: Job,
    report: Report,
    *,
    attempt: int,
    start: MapperOptions,
    base: pycolmap.Reconstruction | None = None,
    stalled: Callable[[float], None] = lambda seconds: None,
) -> list[pycolmap.Reconstruction]:
    """Run the incremental mapper once, from scratch or from a model, unless an earlier call has done so.

    Its models are read back from disk, largest first, with point errors. A call that was killed leaves snapshots; with
    many photos, the next one goes on from the largest of them.

    Args:
        stalled: called with a number of seconds if the mapper was ended because it placed no photo for so long. Then
            only the largest snapshot is left: pycolmap gives none of its models, not even finished ones.
    """
    output = Path(job.folder) / f"{job.variant}models_{attempt}"
    base_folder = output.with_name(f"{output.name}_base")
    if base is not None:
        base_folder.mkdir(exist_ok=True)
        base.write(base_folder)
    key = stage_key(mapping_key(job), _VERSION, attempt, asdict(start), base is not None and file_keys(base_folder))
    if (found := read_models(output, key)) is not None:
        return found[0]
    snapshots = output.with_name(f"{output.name}_snapshots") / key
    if len(job.files) < _MANY_PHOTOS:
        shutil.rmtree(snapshots, ignore_errors=True)
    snapshots.mkdir(parents=True, exist_ok=True)
    placed, begin = _largest_snapshot(snapshots) or (0 if base is None else base.num_reg_images(), base_folder)
    options = _options(job, attempt=attempt, start=start)
    options.snapshot_path = snapshots
    options.snapshot_frames_freq = max(1, len(job.files) // _SNAPSHOTS)
    models = _run_mapper(job, report, options, begin if placed else None, placed=placed, stalled=stalled)
    models = write_models(output, models, key)
    shutil.rmtree(snapshots.parent)
    return models


def _largest_snapshot(snapshots: Path) -> tuple[int, Path] | None:
    """Return the largest number of photos of an intact snapshot, and its folder; None if there is none."""
    found = []
    for folder in snapshots.iterdir():
        try:
            found.append((pycolmap.Reconstruction(folder).num_reg_images(), folder))
        except (RuntimeError, ValueError):  # killed while it was written
            continue
    return max(found, default=None)


def mapper_limit_seconds(photos: int) -> int:
    """Return the time after which no further attempt to map begins."""
    return round(limit_seconds(mapping_seconds(photos)))


def stall_seconds(photos: int) -> float:
    """Return the time without another photo after which a run of the mapper ends with its largest snapshot."""
    return max(mapping_seconds(photos), LEAST_LIMIT_SECONDS)


def map_globally(job: Job) -> list[pycolmap.Reconstruction]:
    """Run the global mapper once (all rotations, then all positions), unless an earlier call has done so.

    The intrinsics in the database must be about right. The models are read back from disk, largest first, with errors.
    """
    kept, key = Path(job.folder) / f"{job.variant}models_globally", stage_key(mapping_key(job), _VERSION)
    if (found := read_models(kept, key)) is not None:
        return found[0]
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = job.threads
    options.random_seed = options.mapper.random_seed = job.seed
    options.mapper.global_positioning.use_gpu = False
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    with TemporaryDirectory(dir=job.folder, prefix="mapper-") as output:
        models = pycolmap.global_mapping(job.database, job.photos, output, options)
    return write_models(kept, _largest_first(models), key)


def _options(job: Job, *, attempt: int, start: MapperOptions) -> pycolmap.IncrementalPipelineOptions:
    seed, fixed = job.seed + attempt, set(job.solver.fixed)
    with pycolmap.Database.open(job.database) as database:
        growth = _GROWTH[database.num_inlier_matches() > _DENSE * len(job.files)]
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads,
        random_seed=seed,
        min_model_size=3,  # models of small captures count too; the largest is chosen below
        constant_cameras=fixed,
        extract_colors=False,  # see `colour_points`
        ba_global_frames_ratio=growth,
        ba_global_points_ratio=growth,
    )
    # Until all photos are placed, rough local adjustments suffice, and global ones to few points, see `_adjust_fully`.
    # Shorter global ones find the way back from a wrong turn less often, and so do fewer of them. Where that left out
    # photos of a small capture, thorough ones take little time, and may place more.
    if attempt == 0 or len(job.files) >= _MANY_PHOTOS:
        options.ba_local_max_refinements, options.ba_local_max_num_iterations = 1, 10
        options.mapper.ba_global_ignore_redundant_points3D = True
    thresholds = asdict(start)
    init_pair = thresholds.pop("init_pair")
    options.mapper.mergedict(thresholds | {"abs_pose_min_num_inliers": FEW_MATCHES, "constant_cameras": fixed})
    options.mapper.random_seed = options.triangulation.random_seed = seed
    if init_pair:
        options.init_image_id1, options.init_image_id2 = init_pair
        options.init_num_trials = 1  # every trial would begin with this pair
    return options


def _run_mapper(
    job: Job,
    report: Report,
    options: pycolmap.IncrementalPipelineOptions,
    base_folder: Path | None,
    *,
    placed: int,
    stalled: Callable[[float], None],
) -> list[pycolmap.Reconstruction]:
    beginnings = iter([placed] if placed else [])  # a given model; every other one begins with two photos
    most, latest = 0, time.monotonic()
    token, longest = pycolmap.CancellationToken(), stall_seconds(len(job.files))

    def tell(count: int) -> None:
        nonlocal placed, most, latest
        latest = time.monotonic()
        # Report the largest model so far: each further one begins again with two of the few photos left.
        placed, most = count, max(most, min(count, len(job.files)))
        report("map", most, len(job.files))

    with (
        TemporaryDirectory(dir=job.folder, prefix="mapper-") as output,
        repeatedly(lambda: token.cancel() if time.monotonic() - latest > longest else None),
    ):
        try:
            models = pycolmap.incremental_mapping(
                job.database,
                job.photos,
                output,
                options=options,
                input_path="" if base_folder is None else base_folder,
                initial_image_pair_callback=lambda: tell(next(beginnings, 2)),
                next_image_callback=lambda: tell(placed + 1),
                cancellation_token=token,
            )
        except InterruptedError:  # by the token
            stalled(longest)
            last = _largest_snapshot(Path(options.snapshot_path))
            models = {} if last is None else {0: pycolmap.Reconstruction(last[1])}
    for model in models.values():
        _adjust_fully(model, job, options)
    return _largest_first(models)


def _adjust_fully(model: pycolmap.Reconstruction, job: Job, options: pycolmap.IncrementalPipelineOptions) -> None:
    """Triangulate a mapped model again and adjust it with all of its points until it converges, in place."""
    thorough = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads, constant_cameras=set(job.solver.fixed), ba_global_function_tolerance=1e-6
    )
    with pycolmap.Database.open(job.database) as database:
        wanted = pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches)
        cache = pycolmap.DatabaseCache.create(database, wanted)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    mapper.iterative_global_refinement(
        thorough.ba_global_max_refinements,
        thorough.ba_global_max_refinement_change,
        options.mapper,
        thorough.get_global_bundle_adjustment(),
        options.triangulation,
    )
    mapper.end_reconstruction(discard=False)


def _largest_first(models: Mapping[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    for model in models.values():
        model.update_point_3d_errors()
    return sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)


@dataclass(frozen=True)
class MappedModels:
    """The mapped models, largest first, and the job whose features and matches they use.

    attempts: in order, {"what", "models": sizes, largest first}; the one that locates single photos also has "photos":
    the result for each. located: ids of images located from points of the first model, without a pair that supports
    them; it may have lost some since. seconds: spent on mapping. cut_short: what was stopped because it took far longer
    than planned.
    """

    models: list[pycolmap.Reconstruction]
    job: Job
    attempts: list[dict[str, Any]]
    located: tuple[int, ...] = ()
    seconds: float = 0.0
    cut_short: tuple[str, ...] = ()


def write_mapped(mapped: MappedModels, key: str) -> MappedModels:
    """Write models and stage into the work folder, replacing earlier ones, and read the models back."""
    also = {field: getattr(mapped, field) for field in ("attempts", "located", "seconds", "cut_short")}
    also["job"] = asdict(mapped.job)
    return replace(mapped, models=write_models(Path(mapped.job.folder) / _MAPPED, mapped.models, key, also=also))


def read_mapped(job: Job, key: str) -> MappedModels | None:
    """Read what `write_mapped` wrote for this key; None if it is damaged or missing, or its database is missing."""
    found = read_models(Path(job.folder) / _MAPPED, key)
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
    located, cut_short = tuple(content["located"]), tuple(content.get("cut_short", ()))
    return MappedModels(models, there, content["attempts"], located, content["seconds"], cut_short)


def write_models(
    folder: Path, models: Sequence[pycolmap.Reconstruction], key: str, *, also: Mapping[str, Any] | None = None
) -> list[pycolmap.Reconstruction]:
    """Write models below a folder, replacing earlier ones, then FOLDER.json, the stage with their hashes; read them."""
    stage = folder.with_suffix(".json")
    stage.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    for index, model in enumerate(models):
        target = folder / str(index)
        target.mkdir(parents=True)
        model.write_binary(target)
    write_stage(stage, key, {**(also or {}), "models": len(models), "files": file_keys(folder)})
    found = read_models(folder, key)
    if found is None:
        raise OSError(f"cannot read back the models in {folder}")
    return found[0]


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
