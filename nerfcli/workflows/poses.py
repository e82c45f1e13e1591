"""Estimate poses of photos or a video, keep an existing scene, or refuse to overwrite another one."""

from pathlib import Path

from nerfcli.captures.archives import is_archive, unpacked
from nerfcli.captures.calibration import Calibration, read_calibration
from nerfcli.captures.formats.registry import photo_folder
from nerfcli.captures.formats.scene_folder import SCENE_FILE
from nerfcli.errors import UserError, duration
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.poses import structure_from_motion
from nerfcli.poses.input.photos import refuse_odd_names
from nerfcli.poses.input.plan import STAGES, Plan, TimeEstimate
from nerfcli.poses.input.settings import PoseSettings, check_settings
from nerfcli.poses.input.video_frames import extract_frames, frames_folder
from nerfcli.poses.structure_from_motion import plan_poses
from nerfcli.poses.workspace import check_destination, is_same_scene


def estimate_poses(
    photos: str | Path,
    output: Output = Output(),
    settings: PoseSettings = PoseSettings(),
    *,
    frames: int | None = None,
    intrinsics: str | Path | None = None,
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> Path:
    """Estimate the poses of one scene, or keep a scene that was made from the same photos with the same settings.

    Example:
        >>> import nerfcli
        >>> folder = nerfcli.estimate_poses("photos", nerfcli.Output("photos-scene"))
        >>> len(nerfcli.load_scene(folder).train_frames)

    Args:
        photos: a folder of photos or a zip archive of one, which is first unpacked beside the scene; or a video, whose
            sharpest frames are first written beside the scene.
        output: the folder to write; PHOTOS-scene by default.
        settings: features, pairs, seed, threads; by default those of `nerfcli poses`.
        frames: number of frames to use from a video; None for 120.
        intrinsics: file with intrinsics of the cameras, which are kept; None to estimate them.
        resources: limit of the memory of structure from motion; the threads are those of the settings.
        reporter: receives messages.

    Returns:
        The folder of the scene.

    Raises:
        UserError: see `extract_frames`, `read_calibration` and `nerfcli.poses.structure_from_motion.estimate_poses`; or
            a different scene exists at the output.
    """
    source = Path(photos)
    target = output.beside(without_suffix(source), "-scene")
    folder = frames_folder(target) if source.is_file() else source
    if source.is_file() and (output.overwrite or not (target / SCENE_FILE).exists()):
        # Before its files or frames are written.
        check_settings(settings)
        if intrinsics is not None and not Path(intrinsics).exists():
            raise UserError(f"{intrinsics} does not exist", "give a file with intrinsics of the cameras")
        check_destination(target, folder, subfolders=settings.subfolders)
    if is_archive(source):
        files = unpacked(source, Output(target, output.overwrite), reporter=reporter)
        folder = photo_folder(files) or files
    elif source.is_file():
        refuse_odd_names(folder, ())
        with reporter.stage(f"extract frames of {source.name}") as stage:
            extract_frames(source, folder, count=frames, overwrite=output.overwrite, reporter=stage)
    elif frames is not None:
        reporter.note(f"{source} is not a video: using all of its photos and ignoring --frames")
    calibration = _given_intrinsics(intrinsics, folder)
    with reporter.stage(f"poses {folder.name}") as stage:
        return _estimated(folder, target, settings, calibration, output, resources=resources, reporter=stage)


def _estimated(
    folder: Path,
    target: Path,
    settings: PoseSettings,
    given: Calibration | None,
    output: Output,
    *,
    resources: Resources,
    reporter: Reporter,
) -> Path:
    """Estimate the poses of a folder of photos; see `estimate_poses`."""
    if (target / SCENE_FILE).exists() and output.keeps(
        target, lambda: is_same_scene(target, folder, settings, given=given)
    ):
        reporter.note(
            f"{target} is kept: it is complete and has these photos and settings; add --overwrite to estimate poses "
            "again"
        )
        return target
    time_estimate: TimeEstimate | None = None

    def planned(plan: Plan) -> None:
        nonlocal time_estimate
        reporter.note(plan.describe())
        time_estimate = TimeEstimate(plan)

    def on_stage(stage: str, done: int, total: int) -> None:
        fraction, left = (0.0, None) if time_estimate is None else time_estimate.update(stage, done, total)
        about = "" if left is None else f", about {duration(left)} left"
        amount = f"{done}" if stage == "matches" else f"{done} of {total}"
        reporter.progress(fraction, f"({amount} {STAGES[stage].counted}{about})")

    report = structure_from_motion.estimate_poses(
        folder,
        target,
        settings=settings,
        notify=reporter.note,
        progress=on_stage,
        memory_bytes=resources.memory_limit(),
        planned=planned,
        given=given,
    )
    left_out = [image for image in report.images if not image.registered]
    for image in left_out[:8]:
        reporter.warn(f"{image.name} was not registered: {image.reason}")
    if len(left_out) > 8:
        reporter.warn(f"{len(left_out) - 8} more are listed in {target / 'poses_report.json'}")
    reporter.note(
        f"{target}: {report.registered} of {report.total} photos registered in {report.seconds['total']:.0f} s, "
        f"mean reprojection error {report.mean_reprojection_error_px:.2f} px"
    )
    return target


def plan_scene(
    folder: Path, settings: PoseSettings, *, intrinsics: str | Path | None = None, reporter: Reporter = Reporter()
) -> Plan:
    """Plan what `estimate_poses` would do with a folder of photos, and how long it would take."""
    prepared = plan_poses(
        folder,
        settings=settings,
        progress=lambda stage, done, total: reporter.progress(done / max(total, 1), STAGES[stage].counted),
        given=_given_intrinsics(intrinsics, folder),
    )
    for note in prepared.notes():
        reporter.note(note)
    return prepared.plan


def without_suffix(source: Path) -> Path:
    """Return the path that results are named after: clip for clip.mp4 or clip.zip, the folder itself for a folder."""
    return source.with_suffix("") if source.is_file() else source


def folder_with_frames(source: Path, scene: Path) -> Path:
    """Return the folder of photos: `source` itself or, for a video, the folder with the frames extracted earlier.

    Raises:
        UserError: the frames of a video have not been extracted, or it is an archive.
    """
    if is_archive(source):
        hint = "run it without --dry-run, or unpack it and give the folder"
        raise UserError(f"--dry-run: {source} is an archive, and a dry run does not unpack it", hint)
    folder = frames_folder(scene) if source.is_file() else source
    if source.is_file() and not folder.exists():
        what = f"--dry-run: the frames of {source} are not in {folder} yet, and a dry run does not extract them"
        raise UserError(what, "run it without --dry-run, or give a folder of photos")
    return folder


def _given_intrinsics(file: str | Path | None, photos: Path) -> Calibration | None:
    """Read the intrinsics of the photos in a folder from a file; None without a file."""
    return None if file is None else read_calibration(Path(file), images=photos)
