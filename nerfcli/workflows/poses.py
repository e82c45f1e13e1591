"""Estimate poses of photos or a video, keep an existing scene, or refuse to overwrite another one."""

from pathlib import Path

from nerfcli.captures.calibration import Calibration, read_calibration
from nerfcli.captures.formats.scene_folder import SCENE_FILE
from nerfcli.errors import UserError, duration
from nerfcli.notices import Notify, Progress, no_progress, silent, warn_python
from nerfcli.poses import structure_from_motion
from nerfcli.poses.input.plan import Plan, TimeEstimate
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.input.video_frames import extract_frames, frames_folder
from nerfcli.poses.structure_from_motion import photo_notes, plan_poses
from nerfcli.poses.workspace import is_same_scene

_STAGES = {
    "read": "photos read",
    "extract": "photos, extracting features",
    "enlarge": "photos, extracting finer features",
    "faint": "photos, extracting faint features",
    "faint-enlarged": "photos, extracting faint features at double size",
    "features": "features per photo",
    "pair": "photos, finding similar ones",
    "match": "pairs compared",
    "matches": "verified matches per photo",
    "map": "photos registered",
    "merge": "sub-models, merging them",
    "locate": "trials to locate single photos",
    "check": "checks of the poses",
    "stabilise": "adjustments, trying a principal point for each photo",
    "settle": "adjustments with a principal point for each photo",
}


def estimate_poses(
    photos: str | Path,
    scene: str | Path,
    settings: PoseSettings = PoseSettings(),
    *,
    memory_bytes: int | None = None,
    intrinsics: Calibration | None = None,
    overwrite: bool = False,
    notify: Notify = silent,
    warn: Notify = warn_python,
    progress: Progress = no_progress,
) -> Path:
    """Estimate the poses of one scene, or keep a scene that was made from the same photos with the same settings.

    Example:
        >>> import nerfcli
        >>> folder = nerfcli.estimate_poses("photos", "photos-scene")
        >>> len(nerfcli.load_scene(folder).train_frames)

    Args:
        photos: a folder of photos; for a video see `folder_of_photos`.
        scene: the folder to write.
        settings: features, pairs, seed, threads; by default those of `nerfcli poses`.
        memory_bytes: limit of the memory of structure from motion; None for no limit.
        intrinsics: known intrinsics of the cameras, see `given_intrinsics`; None to estimate them.
        overwrite: replace an existing scene at `scene`.
        notify, warn: called with lines for the user.
        progress: called with the fraction done and a short text.

    Returns:
        The folder of the scene.

    Raises:
        UserError: see `nerfcli.poses.structure_from_motion.estimate_poses`; or a different scene exists at `scene`.
    """
    folder, target = Path(photos), Path(scene)
    if (target / SCENE_FILE).exists() and not overwrite:
        if is_same_scene(target, folder, settings, given=intrinsics):
            notify(
                f"{target} is kept: it is complete and has these photos and settings; add --overwrite to estimate "
                "poses again"
            )
            return target
        raise UserError(f"{target} exists", "add --overwrite to replace it, or choose another folder with -o")
    time_estimate: TimeEstimate | None = None

    def planned(plan: Plan) -> None:
        nonlocal time_estimate
        notify(plan.describe())
        time_estimate = TimeEstimate(plan)

    def on_stage(stage: str, done: int, total: int) -> None:
        fraction, left = (0.0, None) if time_estimate is None else time_estimate.update(stage, done, total)
        about = "" if left is None else f", about {duration(left)} left"
        progress(fraction, f"({done} of {total} {_STAGES[stage]}{about})")

    report = structure_from_motion.estimate_poses(
        folder,
        target,
        settings=settings,
        notify=notify,
        progress=on_stage,
        memory_bytes=memory_bytes,
        planned=planned,
        given=intrinsics,
    )
    left_out = [image for image in report.images if not image.registered]
    for image in left_out[:8]:
        warn(f"{image.name} was not registered: {image.reason}")
    if len(left_out) > 8:
        warn(f"{len(left_out) - 8} more are listed in {target / 'poses_report.json'}")
    notify(
        f"{target}: {report.registered} of {report.total} photos registered in {report.seconds['total']:.0f} s, "
        f"mean reprojection error {report.mean_reprojection_error_px:.2f} px"
    )
    return target


def plan_scene(
    folder: Path,
    settings: PoseSettings,
    *,
    intrinsics: Calibration | None = None,
    notify: Notify = silent,
    progress: Progress = no_progress,
) -> Plan:
    """Plan what `estimate_poses` would do with a folder of photos, and how long it would take.

    Raises:
        UserError: see `plan_poses`.
    """
    photos, grouped, _, plan = plan_poses(
        folder,
        settings=settings,
        progress=lambda stage, done, total: progress(done / max(total, 1), _STAGES[stage]),
        given=intrinsics,
    )
    for note in photo_notes(photos, grouped):
        notify(note)
    return plan


def without_suffix(source: Path) -> Path:
    """Return the path that results are named after: clip for clip.mp4, the folder itself for a folder."""
    return source.with_suffix("") if source.is_file() else source


def folder_of_photos(
    source: Path,
    scene: Path,
    *,
    frames: int | None = None,
    overwrite: bool = False,
    notify: Notify = silent,
    progress: Progress = no_progress,
) -> Path:
    """Return the folder of photos: `source` itself or, for a video, the extracted frames beside `scene`.

    Raises:
        UserError: see `extract_frames`.
    """
    if not source.is_file():
        if frames is not None:
            notify(f"{source} is not a video: using all of its photos and ignoring --frames")
        return source
    folder = frames_folder(scene)
    extract_frames(source, folder, count=frames, overwrite=overwrite, notify=notify, progress=progress)
    return folder


def folder_with_frames(source: Path, scene: Path) -> Path:
    """Return the folder of photos: `source` itself or, for a video, the folder with the frames extracted earlier.

    Raises:
        UserError: the frames of a video have not been extracted.
    """
    folder = frames_folder(scene) if source.is_file() else source
    if source.is_file() and not folder.exists():
        raise UserError(
            f"--dry-run: the frames of {source} are not in {folder} yet, and a dry run does not extract them",
            "run it without --dry-run, or give a folder of photos",
        )
    return folder


def given_intrinsics(file: Path | None, photos: Path) -> Calibration | None:
    """Read the intrinsics of the photos in a folder from a file; None without a file.

    Raises:
        UserError: see `read_calibration`.
    """
    return None if file is None else read_calibration(file, images=photos)
