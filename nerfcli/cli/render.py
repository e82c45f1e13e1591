"""nerfcli render: pictures, depth maps and videos of a run."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import (
    Device,
    Json,
    Output,
    Overwrite,
    Quiet,
    Threads,
    device_name,
    one_of,
    some_of,
    thread_count,
)
from nerfcli.cli.render_options import (
    DepthFormat,
    DepthScale,
    Rgba,
    SamplesPerPixel,
    Step,
    Tolerance,
    colour_range_of,
    depth_formats,
    finite,
    frame_range,
    level_scale,
    look_of,
    tolerance_of,
    video_settings,
)

DEFAULT_FPS = 24.0


@command
def render(
    run: Annotated[str, typer.Argument(help="The folder that train wrote, or - for runs on standard input.")],
    cameras: Annotated[
        str,
        typer.Option(
            help="test, train, orbit, ellipse, spiral, interpolate, or any file or folder that convert reads."
        ),
    ] = "test",
    through: Annotated[
        str | None, typer.Option(help="Photos a.jpg,b.jpg,... that the path is made from, in this order.")
    ] = None,
    nerfstudio_frame: Annotated[
        Path | None,
        typer.Option(help="The dataparser_transforms.json of the nerfstudio run in whose world --cameras FILE is."),
    ] = None,
    outputs: Annotated[str, typer.Option(help="Some of rgb,depth,opacity,spread,disagreement.")] = "rgb,depth,opacity",
    depth: Annotated[
        str, typer.Option(help="Which depth: conditional, moment, background, max-weight, median or quantile:0.05.")
    ] = "conditional",
    depth_axis: Annotated[
        str | None,
        typer.Option(help="ray: along the ray; z: along the optical axis.  [default: z, ray if equirectangular]"),
    ] = None,
    min_opacity: Annotated[float, typer.Option(help="Less opaque pixels have no depth (NaN).", min=0, max=1)] = 0.5,
    background_distance: Annotated[
        float | None, typer.Option(help="What --depth background counts for light that passes, scene units.", min=0)
    ] = None,
    depth_format: DepthFormat = "tiff",
    depth_scale: DepthScale = "auto",
    tolerance: Tolerance = "1/1020",
    step: Step = 1.0,
    samples_per_pixel: SamplesPerPixel = 1,
    rgba: Rgba = False,
    colour_map: Annotated[str, typer.Option(help="Of depth to look at: turbo, viridis or grey.")] = "turbo",
    colour_range: Annotated[
        str | None,
        typer.Option(help="LOW:HIGH, the depths of the first and last colour.  [default: 1 % to 99 % of all pixels]"),
    ] = None,
    video: Annotated[bool, typer.Option("--video", help="A video of each output: --video-format mp4.")] = False,
    video_format: Annotated[
        str | None, typer.Option(help="Some of mp4 (H.264), h265 (in mp4), webm (VP9), gif; implies --video.")
    ] = None,
    video_layout: Annotated[
        str, typer.Option(help="separate: a video of each output; side-by-side: all outputs in one.")
    ] = "separate",
    direction: Annotated[str, typer.Option(help="forward, reverse or ping-pong.")] = "forward",
    crf: Annotated[
        int | None,
        typer.Option(help="Constant quality of videos, 0 is best.  [default: mp4 16, h265 18, webm 20]", min=0),
    ] = None,
    loop: Annotated[
        int | None, typer.Option(help="Times a video plays; 0 is for ever, gif only.  [default: 1, gif 0]", min=0)
    ] = None,
    count: Annotated[int, typer.Option(help="Views of orbit, ellipse, spiral and interpolate.", min=2)] = 60,
    fps: Annotated[
        float | None,
        typer.Option(help="Frames per second of the video.  [default: 24, or what a camera path says]", min=1, max=240),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(help="START:STOP[:STEP]: render these views alone, counted from 0; assemble nothing."),
    ] = None,
    jobs: Annotated[
        int, typer.Option(help="Processes that share the views, and --threads; 0 chooses by the work.", min=0)
    ] = 0,
    cameras_only: Annotated[
        bool,
        typer.Option("--cameras-only", help="Render nothing; write cameras.json and camera_path.json."),
    ] = False,
    max_size: Annotated[
        int | None, typer.Option(help="Longer side of the pictures at most, pixels.  [default: as trained]", min=8)
    ] = None,
    width: Annotated[
        int | None, typer.Option(help="Of the pictures, pixels; the lens is scaled with it.", min=1, max=65536)
    ] = None,
    height: Annotated[
        int | None, typer.Option(help="As --width; with both, pictures are cut, never stretched.", min=1, max=65536)
    ] = None,
    lens: Annotated[
        str | None, typer.Option(help="pinhole, fisheye (equidistant) or equirectangular (360 degrees, 2:1).")
    ] = None,
    fov: Annotated[float | None, typer.Option(help="Of --lens, degrees between the left and right edge.")] = None,
    crop: Annotated[str | None, typer.Option(help="Render the part X,Y,WIDTH,HEIGHT of the pictures, pixels.")] = None,
    output: Output = None,
    device: Device = "auto",
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Render a trained run: colours, depths, opacity, videos.

    \b
    The depths of a ray, exact inside each interval; less opaque pixels than --min-opacity have none (NaN):
      conditional    mean distance of where light ends, given that it ends
      moment         the same, not divided by the opacity                  (every pixel)
      background     mean, with what passes at --background-distance       (every pixel)
      max-weight     mean inside the interval that stops most light
      median         where half of all light has ended                     (NaN if less than half ends)
      quantile:0.05  where that share of all light has ended               (NaN if less ends)
    spread is the standard deviation of where light ends, disagreement |median - conditional|: both are large where no
    single depth is right (edges, glass, fog). Every file says what its numbers mean: nerfcli info FILE.
    Writes RUN/renders/CAMERAS/. A command that was interrupted goes on with the missing views when it is given again.
    Other videos and colours of views that are there are made without rendering (--overwrite where they replace some).
    A cluster renders --frames 0:100, --frames 100:200, ... at a time; without --frames the same command then assembles.

    \b
    Examples:
      nerfcli render photos-scene-run --cameras test --outputs rgb,depth --depth median --depth-axis ray
      nerfcli render photos-scene-run --cameras orbit --count 120 --video
      nerfcli render photos-scene-run --cameras orbit --outputs rgb,depth --video-layout side-by-side --video-format gif
      nerfcli render photos-scene-run --cameras ellipse --count 1200 --frames 100:200 --jobs 4
      nerfcli render photos-scene-run --cameras interpolate --through a.jpg,k.jpg,c.jpg --video
      nerfcli render photos-scene-run --cameras camera_path.json --nerfstudio-frame dataparser_transforms.json --video
      nerfcli render photos-scene-run --cameras ellipse --count 240 --cameras-only -o ellipse/
      nerfcli render photos-scene-run --cameras orbit --lens equirectangular --width 2048 --video
      nerfcli render photos-scene-run --cameras test --width 1920 --height 1080 --crop 480,270,960,540
    """
    from nerfcli.export.settings import OUTPUTS, ExportSettings
    from nerfcli.media.colour_maps import COLOUR_MAPS
    from nerfcli.render.depth import CONVENTIONS, DepthRequest, is_convention
    from nerfcli.render.pictures import Quality
    from nerfcli.runs.run import Run
    from nerfcli.workflows.render import RENDERS, folder_name, render_run
    from nerfcli.workflows.views import Views, chosen_frames, file_fps, write_frames

    chosen = some_of(outputs, OUTPUTS, "--outputs")
    if not is_convention(depth):
        known = f"{', '.join(CONVENTIONS)} or quantile:Q with 0 < Q < 1"
        raise typer.BadParameter(f"{depth!r}; choose {known}", param_hint="--depth")
    one_of(depth_axis, ("ray", "z"), "--depth-axis")
    formats = depth_formats(depth_format, outputs=chosen, convention=depth)
    scale = level_scale(depth_scale, formats=formats)
    finite(background_distance, "--background-distance")
    finite(min_opacity, "--min-opacity")
    finite(step, "--step")
    console = Console(quiet=quiet, json_lines=json)
    request = DepthRequest(
        convention=depth,
        axis=depth_axis or ("ray" if lens == "equirectangular" else "z"),
        min_opacity=min_opacity,
        background_distance=background_distance,
    )
    one_of(colour_map, COLOUR_MAPS, "--colour-map")
    if max_size is not None and (width is not None or height is not None):
        raise typer.BadParameter("give it or --width and --height", param_hint="--max-size")
    look = look_of(width, height, lens=lens, fov_deg=fov, crop=crop)
    fps = fps or file_fps(cameras) or DEFAULT_FPS
    part = None if frames is None else frame_range(frames)
    videos = None
    if video or video_format is not None:
        videos = video_settings(
            video_format or "mp4", layout=video_layout, direction=direction, fps=fps, crf=crf, loop=loop
        )
    settings = ExportSettings(
        outputs=chosen,
        depth=request,
        formats=formats,
        depth_scale=scale,
        colour_map=colour_map,
        colour_range=colour_range_of(colour_range, outputs=chosen),
        video=videos,
        quality=Quality(tolerance_of(tolerance), samples_per_pixel),
        rgba=rgba,
    )
    if rgba and videos is not None:
        raise typer.BadParameter("a video has no alpha; leave out --rgba or the video", param_hint="--rgba")
    views = Views(cameras, count, through, nerfstudio_frame, max_size, look)

    def work(folder: Path, one_of_many: bool) -> None:
        name = f"{views.name}-cameras" if cameras_only else folder_name(views, settings)
        target = folder / RENDERS / name
        if output is not None:
            target = output / folder.name if one_of_many else output
        if cameras_only:
            of = Run(folder)
            chosen_views = chosen_frames(of, views, depth_hint=1.0 / of.model().training_from_scene.scale)
            write_frames(chosen_views, target, fps=fps, overwrite=overwrite, warn=console.warn)
            console.result(target)
            return
        with console.progress(f"render {views.name}") as update:
            written = render_run(
                folder,
                target,
                views=views,
                settings=settings,
                device=device_name(device),
                threads=thread_count(threads),
                step=step,
                jobs=jobs,
                part=part,
                overwrite=overwrite,
                notify=console.note,
                progress=update,
            )
        for path in written:
            console.result(path)

    for_each_input(run, work)
