"""nerfcli poses: from photos to a scene."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import command
from nerfcli.errors import in_shell
from nerfcli.machine import Resources

if TYPE_CHECKING:
    from nerfcli.poses.input.settings import PoseSettings

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


@dataclass(frozen=True)
class PhotoOptions:
    """Options of what photos there are, and of how much is computed of each."""

    # The minimum is the number of photos that structure from motion needs.
    frames: Annotated[
        int | None,
        typer.Option(help="Number of frames to use from a video.  [default: 120, or all of a shorter one]", min=4),
    ] = None
    subfolders: Subfolders = False
    quality: Annotated[str, typer.Option(help="fast, default or best: image size and number of features.")] = "default"
    intrinsics: Intrinsics = None
    holdout: options.Holdout = None

    def settings(self, seed: int, threads: int) -> "PoseSettings":
        """Return the settings that the options select."""
        from nerfcli.captures.holdout import DEFAULT_HOLDOUT
        from nerfcli.poses.input.settings import QUALITIES, PoseSettings

        quality = QUALITIES[options.one_of(self.quality, QUALITIES, "--quality")]
        return PoseSettings(
            *(*quality, seed, threads),
            holdout=options.holdout_rule(self.holdout) or DEFAULT_HOLDOUT,
            subfolders=self.subfolders,
        )


@dataclass(frozen=True)
class MatchingOptions:
    """Options of features, pairs, lenses and acceptance."""

    masks: Annotated[Path | None, typer.Option(help="Folder of masks named after the photos; black is ignored.")] = None
    max_size: Annotated[
        int | None,
        typer.Option(help="Longer side of images for feature extraction, in pixels.  [default: by --quality]", min=100),
    ] = None
    pairing: Annotated[
        str, typer.Option(help="Which pairs of photos to match: auto, exhaustive, sequential, retrieval or spatial.")
    ] = "auto"
    pairs: Annotated[
        Path | None, typer.Option(help="File with the pairs of photos to match, two names per line.", dir_okay=False)
    ] = None
    camera_model: Annotated[
        str, typer.Option(help="auto, or a COLMAP camera model: SIMPLE_RADIAL, OPENCV, EQUIRECTANGULAR...")
    ] = "auto"
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Estimate poses from training photos only; locate held-out photos afterwards."),
    ] = False
    min_registered: Annotated[float, typer.Option(help="Fraction of photos that must register.", min=0, max=1)] = 0.5
    accept_refused: Annotated[
        bool, typer.Option("--accept-refused", help="Write the scene even if the checks refuse the poses.")
    ] = False

    def added_to(self, settings: "PoseSettings") -> "PoseSettings":
        """Return the settings with these."""
        from nerfcli.poses.input.pairs import PAIRINGS
        from nerfcli.poses.input.settings import CAMERA_MODELS

        options.one_of(self.camera_model, CAMERA_MODELS, "--camera-model")
        options.one_of(self.pairing, PAIRINGS, "--pairing")
        if self.pairs is not None and self.pairing != "auto":
            raise typer.BadParameter("cannot be combined with --pairs; remove --pairing", param_hint="--pairing")
        return replace(
            settings,
            max_image_size=self.max_size or settings.max_image_size,
            camera_model=self.camera_model,
            min_registered=self.min_registered,
            pairing=self.pairing,
            pairs_file=None if self.pairs is None else str(self.pairs.absolute()),
            masks=str(self.masks.resolve()) if self.masks else None,
            strict=self.strict,
            accept_refused=self.accept_refused,
        )


@command
def poses(
    photos: Annotated[
        str,
        typer.Argument(help="Folder of photos, zip archive of one, or video; or - to read paths from standard input."),
    ],
    *,
    writing: options.Writing,
    taken: PhotoOptions,
    matching: MatchingOptions,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show what would be done and how long it would take.")
    ] = False,
    seed: options.Seed = 0,
    threads: options.Threads = 0,
    printing: options.Printing,
) -> None:
    """Estimate camera poses and intrinsics by structure from motion.

    Uses pycolmap. Writes PHOTOS-scene/ with a COLMAP model, scene.json and poses_report.json. Photos are neither
    copied nor changed. Photos that do not register are listed with the reason. For a video, the sharpest frames are
    first written to VIDEO-frames/; parts where the camera stands still are skipped. An archive is unpacked beside the
    scene.

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
    from nerfcli.poses.workspace import database_bytes
    from nerfcli.workflows.poses import estimate_poses, folder_with_frames, plan_scene, without_suffix

    if taken.intrinsics is not None and matching.camera_model != "auto":
        message = "cannot be combined with --intrinsics, which gives the camera models; remove --camera-model"
        raise typer.BadParameter(message, param_hint="--camera-model")
    console, resources = printing.console, Resources(threads)
    settings = matching.added_to(taken.settings(seed, resources.cores))

    def work(given: Given) -> None:
        scene = writing.beside(replace(given, path=without_suffix(given.path)), "-scene")
        if dry_run:
            folder = folder_with_frames(given.path, scene.at(given.path))
            with console.stage(f"poses {folder.name}") as reporter:
                plan = plan_scene(folder, settings, intrinsics=taken.intrinsics, reporter=reporter)
            console.facts(given.path, asdict(plan), f"{given.path}: {plan.describe()}")
            return
        done = estimate_poses(
            given.path,
            scene,
            settings,
            frames=taken.frames,
            intrinsics=taken.intrinsics,
            resources=resources,
            reporter=console.reporter,
        )
        if size := database_bytes(done):
            path = done / "database.db"
            console.note(f"{path} keeps features and matches ({size / 1e6:.0f} MB) so that other settings run faster")
        console.result(done)
        if not given.one_of_many:
            console.note(f"next: nerfcli train {in_shell(done)} --budget 90s")

    for_each_input(photos, work, command="poses")
