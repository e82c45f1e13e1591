"""nerfcli render: render pictures, depth maps and videos of a run."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli import options, render_options
from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.machine import device_name, thread_count

if TYPE_CHECKING:
    from nerfcli.workflows.views import Views


@command
def render(
    run: Annotated[
        str,
        typer.Argument(help="Run folder written by train, a .ply or .spz of splats, or - to read paths from stdin."),
    ],
    cameras: Annotated[
        str,
        typer.Option(help="test, train, orbit, ellipse, spiral, interpolate, or any capture that convert reads."),
    ] = "test",
    through: Annotated[
        str | None, typer.Option(help="Photos a.jpg,b.jpg,... that define the path, in this order.")
    ] = None,
    outputs: Annotated[
        str,
        typer.Option(
            help="Any of rgb, depth, opacity, spread, disagreement, coverage, parallax, lower, upper, confidence, "
            "with commas between them."
        ),
    ] = "rgb,depth,opacity",
    depth: Annotated[
        str,
        typer.Option(help="Definition of depth: conditional, moment, background, max-weight, median or quantile:0.05."),
    ] = "conditional",
    depth_axis: Annotated[
        str | None,
        typer.Option(help="ray: along the ray; z: along the optical axis.  [default: z, ray for panoramas]"),
    ] = None,
    min_opacity: Annotated[
        float, typer.Option(help="Pixels with less opacity have no depth (NaN).", min=0, max=1)
    ] = 0.5,
    min_views: Annotated[
        int, typer.Option(help="Pixels whose surface fewer training photos see have no depth (NaN).", min=0)
    ] = 0,
    min_parallax: Annotated[
        float,
        typer.Option(
            help="Pixels whose surface no two training photos see at this angle, in degrees, have no depth (NaN).",
            min=0,
            max=180,
        ),
    ] = 0.0,
    background_distance: Annotated[
        float | None, typer.Option(help="Distance of light that passes, for --depth background, in scene units.", min=0)
    ] = None,
    depth_format: render_options.DepthFormat = "tiff",
    step: render_options.Step = 1.0,
    rgba: render_options.Rgba = False,
    video: Annotated[
        bool, typer.Option("--video", help="Write a video of each output; same as --video-format mp4.")
    ] = False,
    video_format: Annotated[
        str | None, typer.Option(help="mp4 (H.264), gif, or both with a comma between them; implies --video.")
    ] = None,
    count: Annotated[int, typer.Option(help="Number of views of orbit, ellipse, spiral and interpolate.", min=2)] = 60,
    fps: Annotated[
        float | None,
        typer.Option(help="Frames per second of the video.  [default: 24, or that of a camera path]", min=1, max=240),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(
            help="START:STOP[:STEP], counted from 0, or K/N, every N-th from K: render only these; no videos."
        ),
    ] = None,
    cameras_only: Annotated[
        bool,
        typer.Option("--cameras-only", help="Render nothing; only write cameras.json and camera_path.json."),
    ] = False,
    max_size: Annotated[
        int | None,
        typer.Option(help="Maximum longer side of the pictures, in pixels.  [default: training resolution]", min=8),
    ] = None,
    width: Annotated[
        int | None,
        typer.Option(help="Width of the pictures in pixels; intrinsics are scaled accordingly.", min=1, max=65536),
    ] = None,
    height: Annotated[
        int | None,
        typer.Option(
            help="Height of the pictures in pixels; with --width, pictures are cropped, never stretched.",
            min=1,
            max=65536,
        ),
    ] = None,
    lens: Annotated[
        str | None,
        typer.Option(help="Lens model: pinhole, fisheye (equidistant) or equirectangular (360 degrees, 2:1)."),
    ] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view of --lens, in degrees.")] = None,
    crop: Annotated[
        str | None, typer.Option(help="Render only the window X,Y,WIDTH,HEIGHT of the pictures, in pixels.")
    ] = None,
    splats: Annotated[
        Path | None, typer.Option(help="A .ply or .spz of splats to render instead of the run's field.")
    ] = None,
    output: options.Output = None,
    device: options.Device = "auto",
    threads: options.Threads = 0,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Render views of a run: colour, depth, opacity, videos.

    \b
    Definitions of depth (pixels with less opacity than --min-opacity have none, NaN):
      conditional    mean distance at which light is absorbed, given that it is
      moment         the same, not divided by the opacity                  (every pixel)
      background     mean, with light that passes at --background-distance (every pixel)
      max-weight     mean distance inside the interval that absorbs most light
      median         distance at which half of all light is absorbed       (NaN if less than half is)
      quantile:0.05  distance at which 5 % of all light is absorbed        (NaN if less is)
    spread is the standard deviation of that distance, disagreement |median - conditional|: both are large where no
    single depth is right (edges, glass, fog). coverage is the number of training photos that see the surface (its
    median depth), parallax the largest angle between two of them. lower and upper are a 90 % interval around that
    depth, measured by stereo matching of the held-out photos; confidence is the proportion of depths that were right
    within 2 % in the same measurement. They are NaN where no training photo sees the surface.
    Every file describes its values: nerfcli info FILE.
    \b
    Writes RUN/renders/CAMERAS/. Run the same command again to resume an interrupted one. Other videos of views
    that were already rendered are made without rendering again (add --overwrite to replace existing ones).
    On a cluster, render --frames 1/8, --frames 2/8, ... in parallel, as tasks of an array job; the same command without
    --frames then assembles the videos.

    \b
    Examples:
      nerfcli render photos-scene-run --cameras test --outputs rgb,depth --depth median --depth-axis ray
      nerfcli render photos-scene-run --outputs depth,coverage,parallax --min-views 2 --min-parallax 2
      nerfcli render photos-scene-run --cameras orbit --count 120 --video
      nerfcli render photos-scene-run --cameras orbit --outputs rgb,depth --video-format mp4,gif
      nerfcli render photos-scene-run --cameras ellipse --count 1200 --frames 3/8
      nerfcli render photos-scene-run --cameras interpolate --through a.jpg,k.jpg,c.jpg --video
      nerfcli render photos-scene-run --cameras camera_path.json --video
      nerfcli render photos-scene-run --cameras ellipse --count 240 --cameras-only -o ellipse/
      nerfcli render photos-scene-run --cameras orbit --lens equirectangular --width 2048 --video
      nerfcli render photos-scene-run --cameras test --width 1920 --height 1080 --crop 480,270,960,540
      nerfcli render photos-scene-run --splats kitchen.ply --cameras orbit --video
      nerfcli render kitchen.ply --cameras camera_path.json --video
    """
    values = dict(locals())
    from nerfcli.captures.formats.camera_path import DEFAULT_FPS
    from nerfcli.render.outputs import OUTPUTS, ExportSettings
    from nerfcli.splats.files import SUFFIXES
    from nerfcli.training.runs.run import load_run
    from nerfcli.workflows.render import RENDERS, folder_name, render_run, render_splats
    from nerfcli.workflows.views import Views, file_fps, usual_axis

    console = Console(quiet=quiet, json_lines=json)
    chosen = options.some_of(outputs, OUTPUTS, "--outputs")
    request = render_options.depth_request(
        depth,
        depth_axis,
        outputs=chosen,
        min_opacity=min_opacity,
        background_distance=background_distance,
        min_views=min_views,
        min_parallax_deg=min_parallax,
    )
    formats = render_options.depth_formats(depth_format, outputs=chosen, convention=depth)
    if max_size is not None and (width is not None or height is not None):
        raise typer.BadParameter("cannot be combined with --width or --height", param_hint="--max-size")
    render_options.finite(step, "--step")
    look = render_options.look_of(width, height, lens=lens, fov_deg=fov, crop=crop)
    writes_video = video or video_format is not None
    _refuse_unused(values, outputs=chosen, writes_video=writes_video)
    fps = fps or file_fps(cameras) or DEFAULT_FPS
    part = None if frames is None else render_options.frame_range(frames)
    usual = ExportSettings(
        outputs=chosen,
        depth=request,
        formats=formats,
        video=render_options.video_settings(video_format or "mp4", fps) if writes_video else None,
        step=step,
        rgba=rgba,
    )
    views = Views(cameras, count, through, max_size, look)

    def work(folder: Path, one_of_many: bool) -> None:
        if folder.suffix.lower() in SUFFIXES:
            for option, given in {"--cameras-only": cameras_only, "--splats": splats is not None}.items():
                if given:
                    raise typer.BadParameter(f"it works with a run, not with {folder}; remove it", param_hint=option)
            settings = replace(usual, depth=replace(request, axis=depth_axis or "z"))
            target = output if output is None or not one_of_many else output / folder.stem
            with console.callbacks(f"render {views.name}") as callbacks:
                written = render_splats(
                    folder, target, views=views, settings=settings, threads=thread_count(threads), part=part,
                    overwrite=overwrite, **callbacks,
                )  # fmt: skip
            for path in written:
                console.result(path)
            return
        settings = replace(usual, depth=replace(request, axis=depth_axis or usual_axis(load_run(folder), views)))
        name = f"{views.name}-cameras" if cameras_only else folder_name(views, settings)
        target = folder / RENDERS / (name if splats is None else f"{name}-splats")
        if output is not None:
            target = output / folder.name if one_of_many else output
        if cameras_only:
            _write_cameras(folder, target, views, fps=fps, overwrite=overwrite, console=console)
            return
        with console.callbacks(f"render {views.name}") as callbacks:
            written = render_run(
                folder,
                target,
                views=views,
                settings=settings,
                splats=splats,
                device=device_name(device),
                threads=thread_count(threads),
                part=part,
                overwrite=overwrite,
                **callbacks,
            )
        for path in written:
            console.result(path)

    for_each_input(run, work, command="render")


def _refuse_unused(given: dict[str, Any], *, outputs: tuple[str, ...], writes_video: bool) -> None:
    """Refuse options that nothing would use, and alpha in videos; `given` has the values of all parameters, by name.

    Raises:
        typer.BadParameter: there is one.
    """
    from nerfcli.workflows.views import PATHS, Views

    rgba, depth, background = given["rgba"], given["depth"], given["background_distance"]
    unused = {
        "--fps": (given["fps"] is not None and not (writes_video or given["cameras_only"]), "--video"),
        "--depth": (depth != "conditional" and set(outputs) <= {"rgb", "opacity"}, "--outputs depth"),
        "--background-distance": (background is not None and depth != "background", "--depth background"),
        "--rgba": (rgba and "rgb" not in outputs, "--outputs rgb"),
        "--count": (given["count"] != Views.count and given["cameras"] not in PATHS, f"--cameras {', '.join(PATHS)}"),
    }
    for option, (is_unused, needed) in unused.items():
        if is_unused:
            raise typer.BadParameter(f"it works with {needed}; add that, or remove it", param_hint=option)
    if rgba and writes_video:
        raise typer.BadParameter(
            "videos have no alpha channel; remove --rgba or the video options", param_hint="--rgba"
        )


def _write_cameras(
    folder: Path, target: Path, views: "Views", *, fps: float, overwrite: bool, console: Console
) -> None:
    """Write only the cameras of the views; see `workflows.views.write_frames`."""
    from nerfcli.training.runs.run import Run
    from nerfcli.workflows.views import chosen_frames, write_frames

    run = Run(folder)
    frames = chosen_frames(run, views, depth_hint=1.0 / run.model().training_from_scene.scale)
    write_frames(frames, target, fps=fps, overwrite=overwrite, warn=console.warn)
    console.result(target)
