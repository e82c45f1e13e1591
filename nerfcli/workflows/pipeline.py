"""All stages in one call: poses, training, evaluation, splats, pictures, report."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from nerfcli.atomic import read_json
from nerfcli.captures.archives import unpacked
from nerfcli.captures.formats.registry import recognised
from nerfcli.captures.holdout import DEFAULT_HOLDOUT
from nerfcli.errors import UserError
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output, beside
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.render.files.file_facts import RENDERS as DESCRIPTION
from nerfcli.render.job import OUTPUTS, ExportSettings, VideoSettings
from nerfcli.training.runs.run import Run
from nerfcli.training.runs.settings import TrainSettings, sizes_for
from nerfcli.workflows.evaluate import Evaluation, evaluate_run, evaluate_splats
from nerfcli.workflows.export import default_target, export_run
from nerfcli.workflows.poses import estimate_poses, without_suffix
from nerfcli.workflows.render import RENDERS, folder_name, render_run
from nerfcli.workflows.report import report_runs
from nerfcli.workflows.splats import SplatSettings, are_of, file_digest
from nerfcli.workflows.train import train_scene
from nerfcli.workflows.views import Views, usual_depth


@dataclass(frozen=True)
class PipelineResult:
    """What `run_pipeline` made.

    Args:
        scene: the folder with poses, or the capture that was given.
        run: the trained field.
        evaluation, evaluation_of_splats: metrics on the held-out photos.
        splats: a .ply; None for 360-degree photos, for which there are no splats.
        renders: folders of the held-out views, and videos of an orbit around the splats, or else the field.
        report: a page about all this.
    """

    scene: Path
    run: Run
    evaluation: Evaluation
    splats: Path | None
    evaluation_of_splats: Evaluation | None
    renders: list[Path]
    report: Path


def run_pipeline(
    photos: str | Path,
    output: Output = Output(),
    *,
    poses: PoseSettings = PoseSettings(),
    training: TrainSettings | None = None,
    frames: int | None = None,
    intrinsics: Path | None = None,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
    show: Callable[[Path | Evaluation], None] = lambda result: None,
) -> PipelineResult:
    """Go from photos to a trained field, its metrics, splats, pictures, a video and a report; keep completed stages.

    Example:
        >>> import nerfcli
        >>> done = nerfcli.run_pipeline("photos", nerfcli.Output("kitchen"))
        >>> done.evaluation.metrics.mean.psnr, done.report

    Args:
        photos: a folder of photos, or a video; or a capture with poses, such as a COLMAP project, which are used.
        output: the folder for scene/, run/ and run-splats.ply; by default PHOTOS-scene, ... beside the photos.
        poses, training: settings of the stages; by default those of `nerfcli run`. Splats are refined for half of the
            budget of the training.
        frames: number of frames to use from a video; None for 120.
        intrinsics: file with intrinsics of the cameras, which are kept; None to estimate them.
        resources: threads, device and memory of all stages.
        reporter: receives messages, stage by stage.
        show: called with each result as soon as it is complete.

    Raises:
        UserError: as the functions of the stages do. After a KeyboardInterrupt, the same call continues.
    """
    settings, again = training or _usual_training(resources), output.overwrite
    settings = replace(settings, threads=resources.cores, device=resources.torch_device)
    scene_output = Output(None if output.path is None else Path(output.path) / "scene", again)
    capture = _capture_of(Path(photos), scene_output, reporter)
    if capture is not None:
        _refuse_unused(Path(photos), poses, frames=frames, intrinsics=intrinsics)
    scene = capture or estimate_poses(
        photos,
        scene_output,
        replace(poses, threads=resources.cores),
        frames=frames,
        intrinsics=intrinsics,
        resources=resources,
        reporter=reporter,
    )
    named = without_suffix(Path(photos) if capture else scene)
    run_path = beside(named, "-run") if output.path is None else Path(output.path) / "run"
    with reporter.stage(f"train {scene.name}") as stage:
        run = train_scene(
            scene,
            Output(run_path, again),
            settings,
            resume=None,
            holdout=poses.holdout if capture is not None and poses.holdout != DEFAULT_HOLDOUT else None,
            resources=resources,
            reporter=stage,
        )
    usual, field = Output(overwrite=again), run.checkpoint_sha256()

    def replacing(file: Path, key: str, made_from: str | None) -> Output:
        """Return the output of a result that is described in a file: one of an earlier field is replaced."""
        made = None
        if file.is_file():
            with suppress(UserError):
                made = read_json(file, needed=(key,), hint="")[key]
        return Output(overwrite=again or made not in (None, made_from))

    with reporter.stage("evaluate") as stage:
        output_of_metrics = replacing(run.metrics_path, "checkpoint_sha256", field)
        evaluation = evaluate_run(run.path, output_of_metrics, resources=resources, reporter=stage)
    for result in (run.path, evaluation) if capture else (scene, run.path, evaluation):
        show(result)

    splats = of_splats = None
    if any(frame.camera.is_spherical for frame in run.cameras.train):
        reporter.note("360-degree photos have no splats; the video is made from the field")
    else:
        splats = default_target(run.path, "splats")
        is_old = splats.exists() and not are_of(splats, run)
        if again or is_old or not splats.exists():
            seconds = (settings.budget_seconds or 2 * SplatSettings.budget_seconds) / 2
            half = SplatSettings(budget_seconds=seconds, resume=None)
            with reporter.stage("export splats") as stage:
                replaced = Output(overwrite=again or is_old)
                export_run(run.path, replaced, to="splats", splats=half, resources=resources, reporter=stage)
        with reporter.stage("evaluate splats") as stage:
            file = run.path / f"metrics-{splats.name}.json"
            replaced = replacing(file, "checkpoint_sha256", file_digest(splats))
            of_splats = evaluate_splats(run.path, splats, replaced, resources=resources, reporter=stage)
        for result in (of_splats, splats):
            show(result)

    renders = []
    for views, outputs, shown in ((Views("test"), OUTPUTS[:3], None), (Views("orbit"), OUTPUTS[:2], splats)):
        video = VideoSettings() if views.cameras == "orbit" else None
        wanted = ExportSettings(outputs, usual_depth(run, views), video=video)
        folder = run.path / RENDERS / folder_name(views, wanted, of_splats=shown is not None)
        replaced = replacing(folder / DESCRIPTION, "field_sha256", field)
        with reporter.stage(f"render {views.name}") as stage:
            written = render_run(
                run.path, replaced, views=views, settings=wanted, splats=shown, resources=resources, reporter=stage
            )
        for path in written:
            show(path)
        renders += written
    with reporter.stage("report") as stage:
        report = report_runs([run.path], usual, keep=True, resources=resources, reporter=stage)
    show(report)
    return PipelineResult(scene, run, evaluation, splats, of_splats, renders, report)


def _refuse_unused(photos: Path, poses: PoseSettings, *, frames: int | None, intrinsics: Path | None) -> None:
    """Refuse settings of poses for a capture that has poses."""
    usual = PoseSettings(seed=poses.seed, threads=poses.threads, holdout=poses.holdout)
    if frames is not None or intrinsics is not None or poses != usual:
        raise UserError(
            f"{photos} has poses, which are used: --frames, --intrinsics, --quality and --subfolders do nothing",
            "remove them; for new poses, give the folder of its photos",
            exit_code=2,
        )


def _usual_training(resources: Resources) -> TrainSettings:
    return TrainSettings(budget_seconds=120.0, model="auto", **sizes_for(resources.torch_device))


def _capture_of(photos: Path, output: Output, reporter: Reporter) -> Path | None:
    """Return the folder of the capture with poses that was given, from a zip archive if it is one; None for photos."""
    folder = unpacked(photos, Output(output.beside(photos, "-scene"), output.overwrite), reporter=reporter)
    found = recognised(folder)
    if found is None:
        return None
    reporter.note(f"{photos} has poses ({found[0].of}), which are used; for new ones, give the folder of its photos")
    return folder
