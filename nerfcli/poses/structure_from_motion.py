"""Structure from motion: from a folder of photos to a scene folder with poses, intrinsics and points.

The photos are not copied into the scene and not changed. The cameras refer to upright pictures, as
`photos.images.read_image` returns them: pycolmap 4.2 does not apply the EXIF orientation, so the work folder gets
upright copies of photos that are stored rotated.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from nerfcli.atomic import write_json
from nerfcli.captures.calibration import Calibration
from nerfcli.captures.formats import scene_folder
from nerfcli.captures.formats.registry import depths_beside
from nerfcli.captures.holdout import names_held_out
from nerfcli.errors import UserError, several
from nerfcli.poses.engine.held_out_photos import move_held_out_last
from nerfcli.poses.engine.supervise import WorkerDiedError, run_worker
from nerfcli.poses.engine.turntable import MASKS, add_advice
from nerfcli.poses.input.job import Job, Report, Tell, write_job
from nerfcli.poses.input.layout import find_masks, lay_out_masks, lay_out_photos
from nerfcli.poses.input.pairs import Pairing, choose_pairs, read_pairs
from nerfcli.poses.input.photos import Photos, find_photos
from nerfcli.poses.input.plan import Plan, make_plan
from nerfcli.poses.input.settings import PoseSettings, Search, check_settings, for_panoramas, search_for
from nerfcli.poses.judge.checks import UNDERWAY
from nerfcli.poses.model.cameras import PhotoGroups, group_by_given, group_photos
from nerfcli.poses.report import PosesReport, closing_notes, make_report, refusal
from nerfcli.poses.workspace import (
    POINTS_FILE,
    check_destination,
    hash_inputs,
    keep_refused,
    publish,
    read_json,
    workspace,
)


def estimate_poses(
    photos_dir: Path,
    scene_dir: Path,
    *,
    settings: PoseSettings,
    notify: Tell = lambda note: None,
    progress: Report = lambda stage, done, total: None,
    memory_bytes: int | None = None,
    planned: Callable[[Plan], None] = lambda plan: None,
    given: Calibration | None = None,
) -> PosesReport:
    """Estimate where the photos of a folder were taken, and write a scene.

    Writes sparse/0 (the model with the most photos), poses_report.json and, last, scene.json; the database of features
    and matches stays beside them. An existing scene at `scene_dir` is replaced. Work that an earlier call left there,
    complete or not, is reused: only steps that depend on changed photos or settings are repeated.

    Args:
        notify: receives messages for the user, one sentence at a time.
        progress: receives (stage, done, total) of the stages of `input.plan.STAGES`, in their order.
        planned: receives the plan before the long work starts.
        given: known intrinsics, if any.

    Raises:
        ValueError: a setting is out of its range.
        UserError: the photos are too few or cannot be read, too few of them could be placed or the evidence contradicts
            the result (exit code 4), the scene cannot be written, another process is working on it, a limit was
            reached, or pycolmap died.
    """
    start = time.perf_counter()
    check_destination(scene_dir, photos_dir, subfolders=settings.subfolders)
    prepared = plan_poses(photos_dir, settings=settings, progress=progress, given=given)
    for note in prepared.notes():
        notify(note)
    planned(prepared.plan)
    work, hashes = scene_dir / "work", hash_inputs(photos_dir, settings)
    with workspace(scene_dir) as lock:
        job = _lay_out(prepared, work, notify)
        solve = partial(run_worker, progress=progress, memory_bytes=memory_bytes, lock=lock, notify=notify)
        _run(job, work, solve, notify)
        result = read_json(work / "result.json")["content"]  # written by the worker, or complete from before
        result["seconds"]["total"] = round(time.perf_counter() - start, 3)
        matching = {"rule": prepared.pairing.rule, "pairs": result["pairs"], **hashes}
        intrinsics = prepared.grouped.given
        report = make_report(prepared.photos, settings, result=result, matching=matching, intrinsics=intrinsics)
        if error := refusal(report, photos_dir):
            if not (settings.accept_refused and report.models):
                raise _refused(add_advice(error, report.moving_foreground), report, scene_dir)
            notify(f"accepted because of --accept-refused: {error.message}")
        try:
            split = _split(report)  # before an earlier scene, which may hold the list, is replaced
        except UserError as error:
            raise _reported(error, report, scene_dir) from error
        publish(scene_dir, lambda: _describe_scene(report, scene_dir, photos_dir, given=given, split=split))
    for note in closing_notes(report):
        notify(note)
    return report


@dataclass(frozen=True)
class PreparedPhotos:
    """What is known before the work: the photos, their cameras, the pairs to match, the first search, and the plan."""

    photos: Photos
    grouped: PhotoGroups
    pairing: Pairing
    settings: PoseSettings
    search: Search
    plan: Plan

    def notes(self) -> list[str]:
        """List the skipped files with reasons, and notes on the pages and cameras of the other photos."""
        photos = self.photos
        notes = [f"{name} is skipped: {why}" for name, why in photos.unreadable.items()]
        if photos.skipped:
            notes.append(f"other files, not used: {photos.skipped}")
        paged = [photo for photo in photos.photos if photo.exif.pages > 1]
        if paged:
            first = f"{paged[0].name}, {paged[0].width}x{paged[0].height}"
            notes.append(f"{several(len(paged), 'file')} with several pages: the largest is used, such as {first}")
        return [*notes, *self.grouped.notes]


def plan_poses(
    photos_dir: Path,
    *,
    settings: PoseSettings,
    progress: Report = lambda stage, done, total: None,
    given: Calibration | None = None,
) -> PreparedPhotos:
    """Read the photos, choose cameras and pairs, and estimate how long the work will take; nothing is written.

    Raises:
        ValueError, UserError: as for `estimate_poses`, if the cause can be found before the work.
    """
    check_settings(settings)
    photos = find_photos(photos_dir, lambda done, total: progress("read", done, total), subfolders=settings.subfolders)
    names_held_out(settings.holdout, photos.names, others=photos.unreadable)  # before the work rather than after it
    if settings.masks is not None:
        find_masks(photos, Path(settings.masks))
    grouped = group_photos(photos, model=settings.camera_model) if given is None else group_by_given(photos, given)
    if settings.pairs_file is None:
        pairing = choose_pairs(photos.photos, rule=settings.pairing)
    else:
        pairing = read_pairs(Path(settings.pairs_file), photos)
    search = search_for(settings, len(photos.photos))
    if any(group.is_panorama for group in grouped.groups):
        search = for_panoramas(search)
    plan = make_plan(photos, pairing, search, threads=settings.cores)
    return PreparedPhotos(photos, grouped, pairing, settings, search, plan)


def _run(job: Job, work: Path, solve: Callable[..., None], notify: Tell) -> None:
    """Run the worker; if a check ends it, run it again without that check, since the model is on disk by then."""
    while True:
        (work / UNDERWAY).unlink(missing_ok=True)
        write_job(work / "job.json", job)
        try:
            solve(work / "job.json", threads=job.threads)
            return
        except WorkerDiedError as error:
            if error.check is None:
                raise
            notify(f"could not compute a check ({error.check}): {error.message}; continuing with the others")
            job = replace(job, skipped_checks=(*job.skipped_checks, (error.check, error.message)))


def _lay_out(prepared: PreparedPhotos, work: Path, notify: Tell) -> Job:
    """Lay out the photos and masks for the worker."""
    photos, settings, pairing = prepared.photos, prepared.settings, prepared.pairing
    laid_out = lay_out_photos(photos, work)
    files = tuple(photo.file for photo in laid_out)
    masks = Path(settings.masks) if settings.masks else None
    held_out = names_held_out(settings.holdout, photos.names, others=photos.unreadable) if settings.strict else ()
    job = Job(
        folder=str(work.absolute()),
        files=files,
        originals=str(photos.folder.absolute()),
        names=photos.names,
        keys=tuple(photo.key for photo in laid_out),
        groups=prepared.grouped.groups,
        pairs=pairing.pairs,
        neighbours=pairing.neighbours,
        **asdict(prepared.search),
        seed=settings.seed % 2**30,  # pycolmap's have 31 bits, and the numbers of attempts to map are added
        threads=settings.cores,
        masks=lay_out_masks(photos, files, masks, folder=work / "masks", notify=notify) if masks else (),
        held_out=tuple(sorted(photos.names.index(name) for name in held_out)),
    )
    return move_held_out_last(job)


def _describe_scene(
    report: PosesReport, scene_dir: Path, photos_dir: Path, *, given: Calibration | None, split: dict[str, str | None]
) -> None:
    """Write poses_report.json and scene.json."""
    write_json(scene_dir / "poses_report.json", asdict(report))
    provenance = {"command": "poses", "settings": asdict(report.settings), "versions": report.versions}
    provenance |= {} if given is None else {"intrinsics": given.to_json()}
    provenance |= {"registered": report.registered, "total": report.total}
    scene_folder.save(
        scene_dir,
        image_folder=photos_dir,
        provenance=provenance,
        unit="arbitrary",
        masks=_masks_of(report, scene_dir),
        depths=depths_beside(photos_dir),
        split=split,
    )


def _masks_of(report: PosesReport, scene_dir: Path) -> Path | None:
    """Return the folder of the masks used for the poses: the user's, those of a turning object, or None."""
    if report.settings.masks:
        return Path(report.settings.masks)
    found = report.moving_foreground
    return scene_dir / MASKS if found is not None and found["masked"] else None


def _split(report: PosesReport) -> dict[str, str | None]:
    """Return "train" or "test" for each of the placed photos; a UserError if all of them, or none, are held out."""
    placed = [image.name for image in report.images if image.registered]
    if report.strict is not None:
        test = frozenset(report.strict["placed"])
        if not test:
            raise UserError(
                f"0 of {several(len(report.strict['held_out']), 'held-out photo')} could be placed",
                "hold out photos that overlap with training photos, see --holdout",
            )
    else:
        test = names_held_out(report.settings.holdout, placed, others=[image.name for image in report.images])
    return {name: "test" if name in test else "train" for name in placed}


def _refused(error: UserError, report: PosesReport, scene_dir: Path) -> UserError:
    """Make the error for a refused result, and keep its report and its model, but not as a scene."""
    error = _reported(error, report, scene_dir)
    if not report.models:
        return error
    model = keep_refused(scene_dir, _folder_of_refused(scene_dir))
    hint = (
        f"{error.hint}, the refused model of {report.registered} photos is in {model} (open "
        f"{POINTS_FILE} in a mesh viewer), and --accept-refused uses it anyway"
    )
    return UserError(error.message, hint, error.exit_code)


def _reported(error: UserError, report: PosesReport, scene_dir: Path) -> UserError:
    """Make the error for a result that does not become the scene, and keep its report."""
    path = _folder_of_refused(scene_dir) / "poses_report.json"
    write_json(path, asdict(report))
    return UserError(error.message, f"{error.hint}; details are in {path}", error.exit_code)


def _folder_of_refused(scene_dir: Path) -> Path:
    older = (scene_dir / scene_folder.SCENE_FILE).is_file()
    return scene_dir / "work" if older else scene_dir
