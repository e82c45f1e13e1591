"""nerfcli poses: from photos to a scene."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.machine import thread_count

# The minimum is the number of photos that structure from motion needs.
Frames = Annotated[
    int | None,
    typer.Option(help="Number of frames to use from a video.  [default: 120, or all of a shorter one]", min=4),
]
Intrinsics = Annotated[
    Path | None,
    typer.Option(
        help="File with intrinsics of the cameras, which are kept: COLMAP's cameras.txt, a scene, transforms.json..."
    ),
]
Subfolders = Annotated[
    bool,
    typer.Option(
        "--subfolders", help="Use the photos in all subfolders, such as left/ and right/; each has its own camera."
    ),
]
Quality = Annotated[str, typer.Option(help="fast, default or best: image size and number of features.")]


@command
def poses(
    photos: Annotated[str, typer.Argument(help="Folder of photos or a video, or - to read paths from standard input.")],
    output: options.Output = None,
    frames: Frames = None,
    subfolders: Subfolders = False,
    masks: Annotated[
        Path | None, typer.Option(help="Folder of masks named after the photos; black is ignored.")
    ] = None,
    quality: Quality = "default",
    max_size: Annotated[
        int | None,
        typer.Option(help="Longer side of images for feature extraction, in pixels.  [default: by --quality]", min=100),
    ] = None,
    pairing: Annotated[
        str, typer.Option(help="Which pairs of photos to match: auto, exhaustive, sequential, retrieval or spatial.")
    ] = "auto",
    pairs: Annotated[
        Path | None, typer.Option(help="File with the pairs of photos to match, two names per line.", dir_okay=False)
    ] = None,
    camera_model: Annotated[
        str, typer.Option(help="auto, or a COLMAP camera model: SIMPLE_RADIAL, OPENCV, EQUIRECTANGULAR...")
    ] = "auto",
    intrinsics: Intrinsics = None,
    holdout: options.Holdout = None,
    strict: options.Strict = False,
    min_registered: Annotated[float, typer.Option(help="Fraction of photos that must register.", min=0, max=1)] = 0.5,
    accept_refused: Annotated[
        bool, typer.Option("--accept-refused", help="Write the scene even if the checks refuse the poses.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show what would be done and how long it would take.")
    ] = False,
    seed: options.Seed = 0,
    threads: options.Threads = 0,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Estimate camera poses and intrinsics by structure from motion.

    Uses pycolmap. Writes PHOTOS-scene/ with a COLMAP model, scene.json and poses_report.json. Photos are neither
    copied nor changed. Photos that do not register are listed with the reason. For a video, the sharpest frames are
    first written to VIDEO-frames/; parts where the camera stands still are skipped.

    Run the same command again to resume an interrupted one. database.db stays in the scene: with --overwrite and other
    settings, only the steps that depend on them are repeated.

    \b
    Examples:
      nerfcli poses photos/kitchen
      nerfcli poses photos/kitchen -o kitchen --quality fast
      nerfcli poses photos/kitchen --dry-run --json
      nerfcli poses kitchen.mp4 --frames 200
      nerfcli poses photos/kitchen --strict --holdout block:0.15
      nerfcli poses statue/ --masks statue-masks/
      nerfcli poses stereo-rig/ --subfolders
      nerfcli poses photos/kitchen --intrinsics calibration/cameras.txt
      ls -d captures/*/ | nerfcli poses - -o scenes/
    """
    from nerfcli.captures.holdout import DEFAULT_HOLDOUT
    from nerfcli.memory import default_memory_limit
    from nerfcli.poses.input.pairs import PAIRINGS
    from nerfcli.poses.input.settings import CAMERA_MODELS, PoseSettings
    from nerfcli.poses.workspace import database_bytes
    from nerfcli.workflows.poses import (
        estimate_poses,
        folder_of_photos,
        folder_with_frames,
        given_intrinsics,
        plan_scene,
        without_suffix,
    )

    options.one_of(camera_model, CAMERA_MODELS, "--camera-model")
    options.one_of(pairing, PAIRINGS, "--pairing")
    if pairs is not None and pairing != "auto":
        raise typer.BadParameter("cannot be combined with --pairs; remove --pairing", param_hint="--pairing")
    if intrinsics is not None and camera_model != "auto":
        raise typer.BadParameter(
            "cannot be combined with --intrinsics, which gives the camera models; remove --camera-model",
            param_hint="--camera-model",
        )
    console = Console(quiet=quiet, json_lines=json)
    usual_size, features = sizes_of(quality)
    settings = PoseSettings(
        max_image_size=usual_size if max_size is None else max_size,
        max_features=features,
        seed=seed,
        threads=thread_count(threads),
        camera_model=camera_model,
        min_registered=min_registered,
        pairing=pairing,
        pairs_file=None if pairs is None else str(pairs.absolute()),
        masks=str(masks.resolve()) if masks else None,
        holdout=options.holdout_rule(holdout) or DEFAULT_HOLDOUT,
        strict=strict,
        accept_refused=accept_refused,
        subfolders=subfolders,
    )

    def work(source: Path, one_of_many: bool) -> None:
        scene = result_path(without_suffix(source), suffix="-scene", output=output, one_of_many=one_of_many)
        if dry_run:
            folder = folder_with_frames(source, scene)
            given = given_intrinsics(intrinsics, folder)
            with console.callbacks(f"poses {folder.name}") as callbacks:
                plan = plan_scene(folder, settings, intrinsics=given, **callbacks)
            console.facts(source, plan.to_json(), f"{source}: {plan.describe()}")
            return
        with console.callbacks(f"extract frames of {source.name}") as callbacks:
            folder = folder_of_photos(source, scene, frames=frames, overwrite=overwrite, **callbacks)
        given = given_intrinsics(intrinsics, folder)
        with console.callbacks(f"poses {folder.name}") as callbacks:
            estimate_poses(
                folder,
                scene,
                settings,
                memory_bytes=default_memory_limit(),
                intrinsics=given,
                overwrite=overwrite,
                warn=console.warn,
                **callbacks,
            )
        if size := database_bytes(scene):
            path = scene / "database.db"
            console.note(f"{path} keeps features and matches ({size / 1e6:.0f} MB) so that other settings run faster")
        console.result(scene)

    for_each_input(photos, work, command="poses")


def sizes_of(quality: str) -> tuple[int, int]:
    """Return (max_image_size, max_features) of a quality.

    Raises:
        typer.BadParameter: there is no such quality.
    """
    from nerfcli.poses.input.settings import QUALITIES

    return QUALITIES[options.one_of(quality, QUALITIES, "--quality")]
