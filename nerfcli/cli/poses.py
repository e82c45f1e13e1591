"""nerfcli poses: from photos to a scene."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.clips import Frames, photos_of, without_suffix
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json, Output, Overwrite, Quiet, Seed, Threads, thread_count
from nerfcli.errors import UserError

if TYPE_CHECKING:
    from nerfcli.poses.settings import PoseSettings

NAMES_SHOWN = 8


@command
def poses(
    photos: Annotated[str, typer.Argument(help="A folder of photos or a video, or - for such on standard input.")],
    output: Output = None,
    frames: Frames = None,
    masks: Annotated[
        Path | None, typer.Option(help="A folder of masks named after the photos; black is not used.")
    ] = None,
    max_size: Annotated[int, typer.Option(help="Longer side for feature extraction, pixels.", min=100)] = 1600,
    max_features: Annotated[int, typer.Option(help="SIFT features per photo.", min=100)] = 4096,
    camera_model: Annotated[str, typer.Option(help="auto, or a COLMAP model such as SIMPLE_RADIAL, OPENCV.")] = "auto",
    min_registered: Annotated[float, typer.Option(help="Share of photos that must register.", min=0, max=1)] = 0.5,
    seed: Seed = 0,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Estimate camera poses and intrinsics (structure from motion with pycolmap).

    Writes PHOTOS-scene/ with a COLMAP model, scene.json and poses_report.json. The photos are neither copied nor
    changed. Photos that do not register are listed with the reason. Of a video, the sharpest frames are written to
    VIDEO-frames/ first; where the camera stands still it gives none.

    \b
    Examples:
      nerfcli poses photos/kitchen
      nerfcli poses photos/kitchen -o kitchen --max-size 1000 --max-features 2048
      nerfcli poses kitchen.mp4 --frames 200
      nerfcli poses statue/ --masks statue-masks/
      ls -d captures/*/ | nerfcli poses - -o scenes/
    """
    from nerfcli.poses.settings import CAMERA_MODELS, PoseSettings

    if camera_model not in CAMERA_MODELS:
        raise typer.BadParameter(f"{camera_model!r}; choose {', '.join(CAMERA_MODELS)}", param_hint="--camera-model")
    console = Console(quiet=quiet, json_lines=json)
    settings = PoseSettings(
        max_image_size=max_size,
        max_features=max_features,
        seed=seed,
        threads=thread_count(threads),
        camera_model=camera_model,
        min_registered=min_registered,
        masks=str(masks.resolve()) if masks else None,
    )

    def work(source: Path, one_of_many: bool) -> None:
        scene = result_path(without_suffix(source), suffix="-scene", output=output, one_of_many=one_of_many)
        folder = photos_of(source, scene, frames=frames, overwrite=overwrite, console=console)
        estimate_scene(folder, scene, settings=settings, overwrite=overwrite, console=console)
        console.result(scene)

    for_each_input(photos, work)


def estimate_scene(folder: Path, scene: Path, *, settings: "PoseSettings", overwrite: bool, console: Console) -> None:
    """Estimate one scene, or keep the one that was made from the same photos with the same settings.

    Raises:
        UserError: see `estimate_poses`; or something else stands at `scene`.
    """
    from nerfcli.poses.structure_from_motion import estimate_poses, is_same_scene
    from nerfcli.scene import SCENE_FILE

    if (scene / SCENE_FILE).exists() and not overwrite:
        if is_same_scene(scene, folder, settings):
            console.note(f"{scene} is kept: it was made from these photos; --overwrite makes it again")
            return
        raise UserError(f"{scene} exists", "add --overwrite to replace it, or choose another place with -o")
    with console.progress(f"poses {folder.name}") as update:
        report = estimate_poses(
            folder,
            scene,
            settings=settings,
            notify=console.note,
            progress=lambda stage, done, total: update(done / max(total, 1), stage),
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
