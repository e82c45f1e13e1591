"""All stages in one call: poses, training, evaluation, splats, pictures, report."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from nerfcli.captures.archives import unpacked
from nerfcli.captures.formats.registry import recognised
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output, beside
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.render.job import OUTPUTS, ExportSettings, VideoSettings
from nerfcli.training.runs.run import Run
from nerfcli.training.runs.settings import TrainSettings, sizes_for
from nerfcli.workflows.evaluate import Evaluation, evaluate_run, evaluate_splats
from nerfcli.workflows.export import default_target, export_run
from nerfcli.workflows.poses import estimate_poses, without_suffix
from nerfcli.workflows.render import render_run
from nerfcli.workflows.report import report_runs
from nerfcli.workflows.splats import SplatSettings
from nerfcli.workflows.train import train_scene
from nerfcli.workflows.views import Views, usual_depth


@dataclass(frozen=True)
class PipelineResult:
    """What `run_pipeline` made.

    Args:
        scene: the folder with poses, or the capture that was given.
        run: the trained field.
        evaluation, evaluation_of_splats: metrics on the held-out photos.
        splats: a .ply.
        renders: folders of the held-out views, and videos of an orbit around the splats.
        report: a page about all this.
    """

    scene: Path
    run: Run
    evaluation: Evaluation
    splats: Path
    evaluation_of_splats: Evaluation
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
        run = train_scene(scene, Output(run_path, again), settings, resume=None, resources=resources, reporter=stage)
    usual = Output(overwrite=again)
    with reporter.stage("evaluate") as stage:
        evaluation = evaluate_run(run.path, usual, resources=resources, reporter=stage)
    for result in (run.path, evaluation) if capture else (scene, run.path, evaluation):
        show(result)

    splats = default_target(run.path, "splats")
    if again or not splats.exists():
        half = SplatSettings(budget_seconds=(settings.budget_seconds or 2 * SplatSettings.budget_seconds) / 2)
        with reporter.stage("export splats") as stage:
            export_run(run.path, usual, to="splats", splats=half, resources=resources, reporter=stage)
    with reporter.stage("evaluate splats") as stage:
        of_splats = evaluate_splats(run.path, splats, usual, resources=resources, reporter=stage)
    for result in (of_splats, splats):
        show(result)

    renders = []
    for views, outputs, shown in ((Views("test"), OUTPUTS[:3], None), (Views("orbit"), OUTPUTS[:2], splats)):
        wanted = ExportSettings(outputs, usual_depth(run, views), video=VideoSettings() if shown else None)
        with reporter.stage(f"render {views.name}") as stage:
            written = render_run(
                run.path, usual, views=views, settings=wanted, splats=shown, resources=resources, reporter=stage
            )
        for path in written:
            show(path)
        renders += written
    with reporter.stage("report") as stage:
        report = report_runs([run.path], usual, keep=True, resources=resources, reporter=stage)
    show(report)
    return PipelineResult(scene, run, evaluation, splats, of_splats, renders, report)


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
