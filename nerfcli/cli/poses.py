"""nerfcli poses: from photos to a scene."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.clips import Frames, photos_of, without_suffix
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import (
    Holdout,
    Json,
    Memory,
    Output,
    Overwrite,
    Quiet,
    Seed,
    Strict,
    Threads,
    holdout_rule,
    memory_limit,
    seconds_from_text,
    thread_count,
)
from nerfcli.errors import UserError

if TYPE_CHECKING:
    from nerfcli.poses.cameras import GivenIntrinsics
    from nerfcli.poses.plan import Plan
    from nerfcli.poses.settings import Limits, PoseSettings

NAMES_SHOWN = 8
_STAGES = {
    "read": "photos read",
    "extract": "photos searched for features",
    "enlarge": "photos searched for finer features",
    "pair": "photos looked up",
    "match": "pairs compared",
    "map": "photos placed",
    "check": "checks of the poses",
}

Intrinsics = Annotated[
    Path | None,
    typer.Option(help="A file with the photos' cameras: COLMAP's cameras.txt or .bin, a scene, transforms.json..."),
]
IntrinsicsAs = Annotated[
    str | None,
    typer.Option(help="fixed: the intrinsics are exact; prior: the adjustment starts there.  [default: fixed]"),
]
Quality = Annotated[str, typer.Option(help="Of the poses: fast, default or best: sizes and numbers of features.")]


@command
def poses(
    photos: Annotated[str, typer.Argument(help="A folder of photos or a video, or - for such on standard input.")],
    output: Output = None,
    frames: Frames = None,
    masks: Annotated[
        Path | None, typer.Option(help="A folder of masks named after the photos; black is not used.")
    ] = None,
    quality: Quality = "default",
    max_size: Annotated[
        int | None, typer.Option(help="Longer side for feature extraction, pixels.  [default: by --quality]", min=100)
    ] = None,
    max_features: Annotated[
        int | None, typer.Option(help="SIFT features per photo.  [default: by --quality]", min=100)
    ] = None,
    pairing: Annotated[
        str, typer.Option(help="Photos to compare: auto, exhaustive, sequential, retrieval or spatial.")
    ] = "auto",
    pairs: Annotated[
        Path | None, typer.Option(help="A file with the pairs to compare, two names per line.", dir_okay=False)
    ] = None,
    camera_model: Annotated[str, typer.Option(help="auto, or a COLMAP model such as SIMPLE_RADIAL, OPENCV.")] = "auto",
    intrinsics: Intrinsics = None,
    intrinsics_as: IntrinsicsAs = None,
    holdout: Holdout = None,
    strict: Strict = False,
    min_registered: Annotated[float, typer.Option(help="Share of photos that must register.", min=0, max=1)] = 0.5,
    component: Annotated[
        int, typer.Option(help="Which model becomes the scene if the photos form several: 1 is the largest.", min=1)
    ] = 1,
    accept_refused: Annotated[
        bool, typer.Option("--accept-refused", help="Write the scene even if the checks refuse the poses.")
    ] = False,
    memory: Memory = None,
    time_limit: Annotated[
        str | None, typer.Option(help="Time it may take: 90s, 10m, 2h; then it ends, and a second call goes on.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be done, and how long it takes.")] = False,
    drop_database: Annotated[
        bool, typer.Option("--drop-database", help="Delete features and matches once the scene is there.")
    ] = False,
    seed: Seed = 0,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Find camera poses and intrinsics by structure from motion.

    With pycolmap. Writes PHOTOS-scene/ with a COLMAP model, scene.json and poses_report.json. The photos are neither
    copied nor changed. Photos that do not register are listed with the reason. Of a video, the sharpest frames are
    written to VIDEO-frames/ first; where the camera stands still it gives none.

    A call that was interrupted is gone on from by the next one. database.db stays in the scene, so that with
    --overwrite and another setting only what depends on it is done again.

    \b
    Examples:
      nerfcli poses photos/kitchen
      nerfcli poses photos/kitchen -o kitchen --quality fast
      nerfcli poses photos/kitchen --dry-run --json
      nerfcli poses kitchen.mp4 --frames 200
      nerfcli poses photos/kitchen --strict --holdout block:0.15
      nerfcli poses statue/ --masks statue-masks/
      nerfcli poses photos/kitchen --intrinsics calibration/cameras.txt
      nerfcli poses photos/flat -o second-room --component 2
      ls -d captures/*/ | nerfcli poses - -o scenes/
    """
    from nerfcli.holdout import DEFAULT_HOLDOUT
    from nerfcli.poses.pairs import PAIRINGS
    from nerfcli.poses.settings import CAMERA_MODELS, Limits, PoseSettings

    for value, choices, option in (
        (camera_model, CAMERA_MODELS, "--camera-model"),
        (pairing, PAIRINGS, "--pairing"),
    ):
        if value not in choices:
            raise typer.BadParameter(f"{value!r}; choose {', '.join(choices)}", param_hint=option)
    if pairs is not None and pairing != "auto":
        raise typer.BadParameter("the pairs come from --pairs; leave out --pairing", param_hint="--pairing")
    use = use_of(intrinsics, intrinsics_as)
    if intrinsics is not None and camera_model != "auto":
        raise typer.BadParameter(
            "the camera models come from --intrinsics; leave out --camera-model", param_hint="--camera-model"
        )
    console = Console(quiet=quiet, json_lines=json)
    usual_size, usual_features = sizes_of(quality)
    settings = PoseSettings(
        max_image_size=usual_size if max_size is None else max_size,
        max_features=usual_features if max_features is None else max_features,
        seed=seed,
        threads=thread_count(threads),
        camera_model=camera_model,
        min_registered=min_registered,
        pairing=pairing,
        pairs_file=None if pairs is None else str(pairs.absolute()),
        masks=str(masks.resolve()) if masks else None,
        holdout=holdout_rule(holdout) or DEFAULT_HOLDOUT,
        strict=strict,
        component=component,
        accept_refused=accept_refused,
    )
    limits = Limits(
        memory_bytes=memory_limit(memory),
        seconds=None if time_limit is None else seconds_from_text(time_limit),
    )

    def work(source: Path, one_of_many: bool) -> None:
        scene = result_path(without_suffix(source), suffix="-scene", output=output, one_of_many=one_of_many)
        if dry_run:
            folder = frames_there(source, scene)
            given = given_intrinsics(intrinsics, folder, use=use)
            plan_scene(source, folder, settings=settings, given=given, console=console)
            return
        folder = photos_of(source, scene, frames=frames, overwrite=overwrite, console=console)
        given = given_intrinsics(intrinsics, folder, use=use)
        estimate_scene(
            folder, scene, settings=settings, limits=limits, overwrite=overwrite, console=console, given=given
        )
        tell_of_database(scene, drop=drop_database, console=console)
        console.result(scene)

    for_each_input(photos, work)


def sizes_of(quality: str) -> tuple[int, int]:
    """(max_image_size, max_features) of a quality.

    Raises:
        typer.BadParameter: there is none of that name.
    """
    from nerfcli.poses.settings import QUALITIES

    if quality not in QUALITIES:
        raise typer.BadParameter(f"{quality!r}; choose {', '.join(QUALITIES)}", param_hint="--quality")
    return QUALITIES[quality]


def use_of(intrinsics: Path | None, intrinsics_as: str | None) -> str:
    """How intrinsics are used, by --intrinsics-as.

    Raises:
        typer.BadParameter: not a way to use them, or there are none.
    """
    from nerfcli.poses.cameras import USES

    if intrinsics_as is not None and intrinsics_as not in USES:
        raise typer.BadParameter(f"{intrinsics_as!r}; choose {', '.join(USES)}", param_hint="--intrinsics-as")
    if intrinsics_as is not None and intrinsics is None:
        raise typer.BadParameter("there are no intrinsics to use so; add --intrinsics", param_hint="--intrinsics-as")
    return intrinsics_as or USES[0]


def given_intrinsics(file: Path | None, photos: Path, *, use: str) -> "GivenIntrinsics | None":
    """The intrinsics of a file, for the photos of a folder; None without a file.

    Raises:
        UserError: see `read_calibration`.
    """
    if file is None:
        return None
    from nerfcli.convert.intrinsics import read_calibration
    from nerfcli.poses.cameras import GivenIntrinsics

    return GivenIntrinsics(read_calibration(file, images=photos), use)


def frames_there(source: Path, scene: Path) -> Path:
    """The folder of photos, `source` itself, or the one with the frames of a video that were written before.

    Raises:
        UserError: a video's frames are not there.
    """
    from nerfcli.poses.video_frames import frames_folder

    folder = frames_folder(scene) if source.is_file() else source
    if source.is_file() and not folder.exists():
        raise UserError(
            f"--dry-run: the frames of {source} are not in {folder} yet, and a dry run writes nothing",
            "call it without --dry-run, or give a folder of photos",
        )
    return folder


def plan_scene(
    source: Path, folder: Path, *, settings: "PoseSettings", given: "GivenIntrinsics | None", console: Console
) -> None:
    """Print what would be done with a folder of photos, which may hold the frames of the video `source`.

    Raises:
        UserError: see `plan_poses`.
    """
    from nerfcli.poses.structure_from_motion import plan_poses

    with console.progress(f"poses {folder.name}") as update:
        _, grouped, _, plan = plan_poses(
            folder,
            settings=settings,
            progress=lambda stage, done, total: update(done / max(total, 1), _STAGES[stage]),
            given=given,
        )
    for note in grouped.notes:
        console.note(note)
    if console.json_lines:
        console.result(source, plan.to_json())
    else:
        typer.echo(f"{source}: {plan.describe()}")


def estimate_scene(
    folder: Path,
    scene: Path,
    *,
    settings: "PoseSettings",
    limits: "Limits",
    overwrite: bool,
    console: Console,
    given: "GivenIntrinsics | None" = None,
) -> None:
    """Estimate one scene, or keep the one that was made from the same photos with the same settings.

    Raises:
        UserError: see `estimate_poses`; or something else stands at `scene`.
    """
    from nerfcli.poses.plan import Outlook, duration
    from nerfcli.poses.structure_from_motion import estimate_poses, is_same_scene
    from nerfcli.scene import SCENE_FILE

    if (scene / SCENE_FILE).exists() and not overwrite:
        if is_same_scene(scene, folder, settings, given=given):
            console.note(f"{scene} is kept: it was made from these photos; --overwrite makes it again")
            return
        raise UserError(f"{scene} exists", "add --overwrite to replace it, or choose another place with -o")
    outlook: Outlook | None = None

    def planned(plan: "Plan") -> None:
        nonlocal outlook
        console.note(plan.describe())
        outlook = Outlook(plan)

    with console.progress(f"poses {folder.name}") as update:

        def progress(stage: str, done: int, total: int) -> None:
            share, left = (0.0, None) if outlook is None else outlook.update(stage, done, total)
            about = "" if left is None else f", about {duration(left)} left"
            update(share, f"({done} of {total} {_STAGES[stage]}{about})")

        report = estimate_poses(
            folder,
            scene,
            settings=settings,
            notify=console.note,
            progress=progress,
            limits=limits,
            planned=planned,
            given=given,
        )
    left_out = [image for image in report.images if not image.registered]
    for image in left_out[:NAMES_SHOWN]:
        console.warn(f"{image.name} was not registered: {image.reason}")
    if len(left_out) > NAMES_SHOWN:
        console.warn(f"{len(left_out) - NAMES_SHOWN} more are listed in {scene / 'poses_report.json'}")
    console.note(
        f"{scene}: {report.registered} of {report.total} photos registered in {report.seconds['total']:.0f} s, "
        f"mean reprojection error {report.mean_reprojection_error_px:.2f} px"
    )


def tell_of_database(scene: Path, *, drop: bool, console: Console) -> None:
    """Delete the database of features and matches, or say what it takes and what for."""
    from nerfcli.poses.workspace import database_bytes, drop_database

    if drop:
        drop_database(scene)
    elif size := database_bytes(scene):
        console.note(
            f"{scene / 'database.db'}: features and matches, {size / 1e6:.0f} MB, make other settings quick; "
            "--drop-database deletes them"
        )
