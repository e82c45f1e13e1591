"""nerfcli run: all stages, from photos to splats, a video and a report."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli import options
from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.cli.poses import Frames, Intrinsics, Quality, Subfolders, sizes_of
from nerfcli.machine import device_name, thread_count


@command
def run(
    photos: Annotated[str, typer.Argument(help="Folder of photos or a video, or - to read paths from standard input.")],
    output: options.Output = None,
    frames: Frames = None,
    subfolders: Subfolders = False,
    quality: Quality = "default",
    intrinsics: Intrinsics = None,
    budget: Annotated[str, typer.Option(help="Training time: 90s, 5m, 1h. Splats are refined for half of it.")] = "2m",
    downscale: options.Downscale = "auto",
    holdout: options.Holdout = None,
    require: options.Require = None,
    device: options.Device = "auto",
    seed: options.Seed = 0,
    threads: options.Threads = 0,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Run all stages: poses, train, evaluate, splats, video, report.

    Writes PHOTOS-scene/, PHOTOS-scene-run/ and PHOTOS-scene-run-splats.ply next to the photos, or scene/, run/ and
    run-splats.ply inside --output. The video is made from the splats. Completed stages are kept: run the same command
    again to resume an interrupted run. For other settings, run the stages one by one.

    \b
    Examples:
      nerfcli run photos/kitchen
      nerfcli run photos/kitchen -o kitchen --budget 5m
      nerfcli run photos/kitchen --intrinsics calibration/cameras.txt
      nerfcli run kitchen.mp4
      nerfcli run photos/kitchen --require "psnr>=25,registered>=0.9"
    """
    from nerfcli.captures.holdout import DEFAULT_HOLDOUT
    from nerfcli.cli.evaluate import print_beside_field, print_numbers, requirements_of
    from nerfcli.memory import default_memory_limit
    from nerfcli.poses.input.settings import PoseSettings
    from nerfcli.render.outputs import OUTPUTS, ExportSettings, VideoSettings
    from nerfcli.training.runs.run import load_run
    from nerfcli.training.runs.settings import TrainSettings, sizes_for
    from nerfcli.workflows.evaluate import check_requirements, evaluate_run, evaluate_splats
    from nerfcli.workflows.export import default_target, export_run
    from nerfcli.workflows.poses import estimate_poses, folder_of_photos, given_intrinsics, without_suffix
    from nerfcli.workflows.render import render_run
    from nerfcli.workflows.report import report_runs
    from nerfcli.workflows.splats import SplatSettings
    from nerfcli.workflows.train import train_scene, was_interrupted
    from nerfcli.workflows.views import Views, usual_depth

    console = Console(quiet=quiet, json_lines=json)
    requirements, rule = requirements_of(require), options.holdout_rule(holdout)
    cores, torch_device = thread_count(threads), device_name(device)
    max_image_size, max_features = sizes_of(quality)
    pose_settings = PoseSettings(
        max_image_size=max_image_size,
        max_features=max_features,
        seed=seed,
        threads=cores,
        holdout=rule or DEFAULT_HOLDOUT,
        subfolders=subfolders,
    )
    train_settings = TrainSettings(
        budget_seconds=options.seconds_from_text(budget),
        downscale=options.downscale_factor(downscale),
        seed=seed,
        device=torch_device,
        threads=cores,
        model="auto",
        **sizes_for(torch_device),
    )

    def work(source: Path, one_of_many: bool) -> None:
        scene = result_path(without_suffix(source), suffix="-scene", output=output, one_of_many=one_of_many)
        field = result_path(scene, suffix="-run", output=None, one_of_many=False)
        if output is not None:
            scene, field = scene / "scene", scene / "run"
        with console.callbacks(f"extract frames of {source.name}") as callbacks:
            folder = folder_of_photos(source, scene, frames=frames, overwrite=overwrite, **callbacks)
        with console.callbacks(f"poses {folder.name}") as callbacks:
            estimate_poses(
                folder,
                scene,
                pose_settings,
                memory_bytes=default_memory_limit(),
                intrinsics=given_intrinsics(intrinsics, folder),
                overwrite=overwrite,
                warn=console.warn,
                **callbacks,
            )
        with console.callbacks(f"train {scene.name}") as callbacks:
            trained = train_scene(
                scene,
                field,
                train_settings,
                memory_bytes=default_memory_limit(torch_device),
                resume=not overwrite and was_interrupted(scene, field, train_settings),
                overwrite=overwrite,
                warn=console.warn,
                **callbacks,
            )
        where = {"device": torch_device, "threads": cores, "overwrite": overwrite}
        with console.callbacks("evaluate") as callbacks:
            evaluation = evaluate_run(field, **where, **callbacks)
        print_numbers(field, evaluation, console)
        console.result(scene)
        console.result(field)
        console.result(evaluation.path, evaluation.metrics)
        splats = default_target(field, "splats")
        if overwrite or not splats.exists():
            with console.callbacks("export splats") as callbacks:
                half = SplatSettings(budget_seconds=options.seconds_from_text(budget) / 2)
                export_run(field, splats, to="splats", splats=half, **where, **callbacks)
        with console.callbacks("evaluate splats") as callbacks:
            of_splats = evaluate_splats(field, splats, threads=cores, overwrite=overwrite, **callbacks)
        print_beside_field(evaluation.metrics, of_splats, console)
        console.result(of_splats.path, of_splats.metrics)
        console.result(splats)
        for cameras, video in (("test", False), ("orbit", True)):
            views = Views(cameras)
            settings = ExportSettings(
                outputs=OUTPUTS[: 2 if video else 3],
                depth=usual_depth(load_run(field), views),
                video=VideoSettings() if video else None,
            )
            with console.callbacks(f"render {views.name}") as callbacks:
                shown = splats if video else None
                written = render_run(field, views=views, settings=settings, splats=shown, **where, **callbacks)
            for path in written:
                console.result(path)
        with console.callbacks("report") as callbacks:
            page = report_runs([field], keep=True, **where, **callbacks)
        console.note(f"report with all results: {page}")
        console.result(page)
        check_requirements(trained, evaluation.metrics, requirements)

    for_each_input(photos, work, command="run")
