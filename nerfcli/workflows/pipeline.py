"""All stages in one call: poses, training, splats, video, evaluation, report, pictures."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from nerfcli.atomic import read_json
from nerfcli.captures.archives import unpacked
from nerfcli.captures.formats.registry import recognised
from nerfcli.errors import UserError
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output, beside
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.render.files.file_facts import RENDERS as DESCRIPTION
from nerfcli.render.job import OUTPUTS, RenderSettings, VideoSettings
from nerfcli.training.runs.run import Run
from nerfcli.training.runs.settings import TrainSettings
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
    holdout: str | None = None,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
    show: Callable[[Path | Evaluation], None] = lambda result: None,
) -> PipelineResult:
    """Go from photos to a trained field, splats, a video, metrics, a report and pictures; keep completed stages.

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
        holdout: photos to hold out, as for `train_scene`; None for what `poses` says.
        resources: threads, device and memory of all stages.
        reporter: receives messages, stage by stage.
        show: called with each result as soon as it is complete.

    Raises:
        UserError: as the functions of the stages do. After a KeyboardInterrupt, the same call continues.
    """
    settings, again = training or TrainSettings(model="auto"), output.overwrite
    settings = replace(settings, threads=resources.cores, device=resources.torch_device)
    scene_output = Output(None if output.path is None else Path(output.path) / "scene", again)
    if holdout is None and poses.holdout != PoseSettings.holdout:
        holdout = poses.holdout
    capture = _capture_of(Path(photos), scene_output, reporter)
    if capture is not None:
        _refuse_unused(Path(photos), poses, frames=frames, intrinsics=intrinsics)
    scene = capture or estimate_poses(
        photos,
        scene_output,
        replace(poses, threads=resources.cores, holdout=holdout or poses.holdout),
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
            holdout=None if capture is None else holdout,
            resources=resources,
            reporter=stage,
        )
    results = _Results(run, again, resources, reporter, show)
    if capture is None:
        show(scene)
    show(run.path)
    # Splats and their video first: the rest takes minutes where many photos are held out.
    splats = None
    if any(frame.camera.is_spherical for frame in run.cameras.train):
        reporter.note("360-degree photos have no splats; the video is made from the field")
    else:
        seconds = (settings.budget_seconds or 2 * SplatSettings.budget_seconds) / 2
        splats = results.splats(SplatSettings(budget_seconds=seconds, resume=None))
    orbit = RenderSettings(OUTPUTS[:2], usual_depth(run, Views("orbit")), video=VideoSettings())
    videos = results.pictures(Views("orbit"), orbit, splats=splats)
    evaluation = results.metrics()
    of_splats = None if splats is None else results.metrics_of_splats(splats)
    report = results.report()
    pictures = results.pictures(Views("test"), RenderSettings(OUTPUTS[:3], usual_depth(run, Views("test"))))
    return PipelineResult(scene, run, evaluation, splats, of_splats, [*pictures, *videos], report)


@dataclass(frozen=True)
class _Results:
    """What is made from a trained field, stage by stage. Results of an earlier field are replaced.

    Args:
        run: the field.
        again: whether everything is replaced.
        resources, reporter, show: see `run_pipeline`.
    """

    run: Run
    again: bool
    resources: Resources
    reporter: Reporter
    show: Callable[[Path | Evaluation], None]

    def metrics(self) -> Evaluation:
        """Evaluate the field."""
        output = self._replacing(self.run.metrics_path, {"checkpoint_sha256": self.run.checkpoint_sha256()})
        with self.reporter.stage("evaluate") as stage:
            evaluation = evaluate_run(self.run.path, output, resources=self.resources, reporter=stage)
        self.show(evaluation)
        return evaluation

    def splats(self, settings: SplatSettings) -> Path:
        """Export splats of the field as .ply."""
        run, splats = self.run.path, default_target(self.run.path, "splats")
        is_old = splats.exists() and not are_of(splats, self.run)
        if self.again or is_old or not splats.exists():
            output = Output(overwrite=self.again or is_old)
            with self.reporter.stage("export splats") as stage:
                export_run(run, output, to="splats", splats=settings, resources=self.resources, reporter=stage)
        self.show(splats)
        return splats

    def metrics_of_splats(self, splats: Path) -> Evaluation:
        """Evaluate the splats."""
        run, digest = self.run.path, file_digest(splats)
        output = self._replacing(run / f"metrics-{splats.name}.json", {"checkpoint_sha256": digest})
        with self.reporter.stage("evaluate splats") as stage:
            evaluation = evaluate_splats(run, splats, output, resources=self.resources, reporter=stage)
        self.show(evaluation)
        return evaluation

    def pictures(self, views: Views, settings: RenderSettings, *, splats: Path | None = None) -> list[Path]:
        """Render views of the splats, or else of the field."""
        run, name = self.run.path, folder_name(views, settings, of_splats=splats is not None)
        made_from = {"field_sha256": self.run.checkpoint_sha256()}
        if splats is not None:
            made_from["splats_sha256"] = file_digest(splats)
        output = self._replacing(run / RENDERS / name / DESCRIPTION, made_from)
        what = {"views": views, "settings": settings, "splats": splats}
        with self.reporter.stage(f"render {views.name}") as stage:
            written = render_run(run, output, **what, resources=self.resources, reporter=stage)
        for path in written:
            self.show(path)
        return written

    def report(self) -> Path:
        """Write the page about the run."""
        output = Output(overwrite=self.again)
        with self.reporter.stage("report") as stage:
            report = report_runs([self.run.path], output, keep=True, resources=self.resources, reporter=stage)
        self.show(report)
        return report

    def _replacing(self, file: Path, made_from: dict[str, str]) -> Output:
        """Return the output of a result that a JSON file describes: one made from something else is replaced."""
        is_old = False
        if file.is_file():
            with suppress(UserError):
                is_old = not made_from.items() <= read_json(file, needed=tuple(made_from), hint="").items()
        return Output(overwrite=self.again or is_old)


def _refuse_unused(photos: Path, poses: PoseSettings, *, frames: int | None, intrinsics: Path | None) -> None:
    """Refuse settings of poses for a capture that has poses."""
    usual = PoseSettings(seed=poses.seed, threads=poses.threads, holdout=poses.holdout)
    if frames is not None or intrinsics is not None or poses != usual:
        what = f"{photos} has poses, which are used: --frames, --intrinsics, --quality and --subfolders do nothing"
        raise UserError(what, "remove them; for new poses, give the folder of its photos", exit_code=2)


def _capture_of(photos: Path, output: Output, reporter: Reporter) -> Path | None:
    """Return the folder of the capture with poses that was given, from a zip archive if it is one; None for photos."""
    folder = unpacked(photos, Output(output.beside(photos, "-scene"), output.overwrite), reporter=reporter)
    found = recognised(folder)
    if found is None:
        return None
    reporter.note(f"{photos} has poses ({found[0].of}), which are used; for new ones, give the folder of its photos")
    return folder
