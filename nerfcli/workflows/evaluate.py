"""Evaluate a run on its held-out photos, or keep the metrics of the same checkpoint."""

import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from nerfcli.atomic import atomic_folder, clear_leftovers, read_json, refuse_read_only, write_json
from nerfcli.cameras.frame import Frame
from nerfcli.errors import GATE_NOT_MET, UserError
from nerfcli.evaluate.ledger import leak_ledger
from nerfcli.evaluate.metrics import find_perceptual
from nerfcli.evaluate.photos import (
    INFO,
    PREDICTIONS,
    ComparedImages,
    held_out_photos,
    predictions_are_there,
    save_compared,
    training_billboards,
)
from nerfcli.evaluate.protocol import PROTOCOL, RunMetrics, evaluate_model
from nerfcli.evaluate.requirements import WHY_ABSENT, Requirement, known_numbers, unmet
from nerfcli.machine import Resources
from nerfcli.notices import Reporter, silent
from nerfcli.output import Output
from nerfcli.render.job import file_names
from nerfcli.training.runs.files import LOG
from nerfcli.training.runs.run import Run
from nerfcli.workflows.splats import file_digest, load_splats


@dataclass(frozen=True)
class Evaluation:
    """Metrics of a run, or of a reconstruction.

    Args:
        path: RUN/metrics.json.
        metrics: its content.
        is_kept: whether the file already existed.
    """

    path: Path
    metrics: RunMetrics
    is_kept: bool


def evaluate_run(
    run: str | Path,
    output: Output = Output(),
    *,
    predictions: str | None = None,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> Evaluation:
    """Write RUN/metrics.json, or keep an existing one of the same checkpoint.

    Example:
        >>> import nerfcli
        >>> evaluation = nerfcli.evaluate_run("photos-scene-run")
        >>> evaluation.metrics.mean.psnr

    Args:
        run: the folder that `train_scene` wrote.
        output: the file to write, RUN/metrics.json by default.
        predictions: "png" saves the compared pictures in RUN/predictions, "float" also unrounded ones; None saves none.
        resources: threads and device.
        reporter: receives messages, and the fraction of the rays that is done.

    Raises:
        UserError: the folder is not a run, its split is not the one it was trained with, a photo cannot be read, or
            existing metrics are of another checkpoint or lack the predictions.
    """
    trained = Run(Path(run))
    path, torch_device, cores = output.at(trained.metrics_path), resources.torch_device, resources.begin()
    trained.check_split()
    clear_leftovers(trained.path)
    model = trained.model(torch_device)
    checkpoint = model.sha256
    assert checkpoint is not None
    if (kept := _kept(path, checkpoint, output, reporter, predictions=predictions, run=trained.path)) is not None:
        return kept

    summary = trained.summary
    if summary is None:
        raise UserError(f"{trained.path} has no {LOG}, which records the training time", "train again with --overwrite")
    refuse_read_only(path)
    test = trained.cameras.test
    held_out = held_out_photos(trained, test)
    perceptual = find_perceptual(reporter.note)
    billboards = training_billboards(trained, notify=reporter.note)
    reporter.progress(0.0, "")
    with saved_predictions(trained.path, test, predictions, checkpoint=checkpoint) as keep:
        metrics = evaluate_model(
            model,
            held_out,
            on_image=lambda done, total: reporter.progress(done / total, f"of {total} rays"),
            training=trained.cameras.train,
            perceptual=perceptual,
            billboards=billboards,
            keep=keep,
        )
    metrics = replace(
        metrics,
        training=summary,
        ledger=tuple(leak_ledger(trained.config)),
        holdout=trained.config.holdout,
        split_sha256=trained.config.split_sha256,
        device=f"{torch_device}, {cores} threads, {platform.machine()}",
        checkpoint_sha256=checkpoint,
    )
    write_json(path, metrics.to_json())
    return Evaluation(path, metrics, is_kept=False)


def evaluate_splats(
    run: str | Path,
    splats: str | Path,
    output: Output = Output(),
    *,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> Evaluation:
    """Measure splats on the held-out photos of a run by the protocol of `evaluate_run`: RUN/metrics-FILE.json.

    Args:
        run: the folder that `train_scene` wrote.
        splats: a .ply or .spz.
        output: the file to write, RUN/metrics-FILE.json by default.
        resources, reporter: see `evaluate_run`.

    Raises:
        UserError: as for `evaluate_run`, or the splats cannot be read.
    """
    trained, file, cores = Run(Path(run)), Path(splats), resources.begin()
    trained.check_split()
    scene, digest = load_splats(file, notify=reporter.note), file_digest(file)
    path = output.at(trained.path / f"metrics-{file.name}.json")
    if (kept := _kept(path, digest, output, reporter, run=trained.path)) is not None:
        return kept
    refuse_read_only(path)
    held_out = held_out_photos(trained, trained.cameras.test)
    metrics = evaluate_model(
        scene,
        held_out,
        on_image=lambda done, total: reporter.progress(done / total, f"of {total} pixels"),
        training=trained.cameras.train,
        # The evaluation of the field has already said why there is no LPIPS.
        perceptual=find_perceptual(silent),
    )
    metrics = replace(
        metrics,
        splats={"file": file.name, "count": len(scene.gaussians), "degree": scene.gaussians.degree},
        device=f"cpu, {cores} threads, {platform.machine()}",
        checkpoint_sha256=digest,
    )
    write_json(path, metrics.to_json())
    return Evaluation(path, metrics, is_kept=False)


def check_requirements(run: Run, metrics: RunMetrics, requirements: Sequence[Requirement]) -> None:
    """Refuse metrics that do not meet a requirement, with the exit code `GATE_NOT_MET`."""
    if not requirements:
        return
    numbers = known_numbers(metrics, run.config)
    failures = unmet(requirements, numbers)
    if failures:
        absent = [requirement.name for requirement in requirements if numbers.get(requirement.name) is None]
        only_absent = len(absent) == len(failures) and absent[0] in WHY_ABSENT
        raise UserError(
            f"{run.path} does not meet --require {', '.join(failures)}",
            WHY_ABSENT[absent[0]]
            if only_absent
            else "train longer (--budget, --resume), or check the photos with nerfcli doctor",
            GATE_NOT_MET,
        )


@contextmanager
def saved_predictions(
    run: Path, frames: Sequence[Frame], kind: str | None, *, checkpoint: str
) -> Iterator[Callable[[ComparedImages], None]]:
    """Yield a function that saves one comparison in RUN/predictions; the folder appears when all are saved.

    Args:
        kind: one of `evaluate.photos.KINDS`; None to save nothing.
    """
    if kind is None:
        yield lambda compared: None
        return
    stems = dict(zip((frame.name for frame in frames), file_names(frames), strict=True))
    with atomic_folder(run / PREDICTIONS) as folder:
        yield lambda compared: save_compared(folder, stems[compared.frame.name], compared, kind=kind)
        write_json(folder / INFO, {"checkpoint_sha256": checkpoint, "kind": kind, "files": stems})


def _kept(
    path: Path, checkpoint: str, output: Output, reporter: Reporter, *, run: Path, predictions: str | None = None
) -> Evaluation | None:
    """Return existing metrics that stay; raise if they are of another checkpoint or lack the predictions."""
    if output.overwrite or not path.exists():
        return None
    content = read_json(path, needed=("protocol", "mean", "images"), hint="add --overwrite to evaluate again")
    metrics = RunMetrics.from_json(content, path)
    if metrics.checkpoint_sha256 != checkpoint:
        raise UserError(f"{path} belongs to an earlier checkpoint or file", "add --overwrite to replace it")
    if predictions is not None and not predictions_are_there(run / PREDICTIONS, predictions, checkpoint=checkpoint):
        raise UserError(f"{path} was written without saved predictions", "add --overwrite to evaluate again")
    made_by = metrics.protocol.split(":")[0]
    older = "" if made_by == PROTOCOL else f" (by {made_by})"
    reporter.note(f"{path} is kept{older}: it is up to date; add --overwrite to evaluate again")
    return Evaluation(path, metrics, is_kept=True)
