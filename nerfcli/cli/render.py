"""nerfcli render: render pictures, depth maps and videos of a run."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import command
from nerfcli.cli.options import Computing, Printing, Writing, finite, one_of, refuse_unused, some_of

if TYPE_CHECKING:
    from nerfcli.render.depth import DepthRequest
    from nerfcli.render.job import RenderSettings, VideoSettings
    from nerfcli.workflows.views import PictureOptions, Views


@dataclass(frozen=True)
class ViewOptions:
    """Options of the cameras, and of the size and lens of the pictures."""

    cameras: Annotated[
        str, typer.Option(help="test, train, orbit, ellipse, spiral, interpolate, or any capture that convert reads.")
    ] = "test"
    through: Annotated[
        str | None,
        typer.Option(help="Photos a.jpg,b.jpg,... that define the path, in this order."),
    ] = None
    count: Annotated[int, typer.Option(help="Number of views of orbit, ellipse, spiral and interpolate.", min=2)] = 60
    max_size: Annotated[
        int | None,
        typer.Option(
            help="Maximum length of the longer side of pictures, in pixels.  [default: training resolution]", min=8
        ),
    ] = None
    width: Annotated[
        int | None,
        typer.Option(help="Width of the pictures in pixels; intrinsics are scaled accordingly.", min=1, max=65536),
    ] = None
    height: Annotated[
        int | None,
        typer.Option(
            help="Height of the pictures in pixels; with --width, pictures are cropped, never stretched.",
            min=1,
            max=65536,
        ),
    ] = None
    lens: Annotated[
        str | None,
        typer.Option(help="Lens model: pinhole, fisheye (equidistant) or equirectangular (360 degrees, 2:1)."),
    ] = None
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view of --lens, in degrees.")] = None
    crop: Annotated[
        str | None, typer.Option(help="Render only the window X,Y,WIDTH,HEIGHT of the pictures, in pixels.")
    ] = None
    frames: Annotated[
        str | None,
        typer.Option(
            help="Render only views START:STOP[:STEP] (counted from 0) or part K/N (every N-th from K); no videos."
        ),
    ] = None
    cameras_only: Annotated[
        bool, typer.Option("--cameras-only", help="Render nothing; only write cameras.json and camera_path.json.")
    ] = False

    def views(self) -> "Views":
        """Return the views that the options select."""
        from nerfcli.workflows.views import Views

        if self.max_size is not None and (self.width is not None or self.height is not None):
            raise typer.BadParameter("cannot be combined with --width or --height", param_hint="--max-size")
        part = None if self.frames is None else frame_range(self.frames)
        return Views(self.cameras, self.count, self.through, self.max_size, self._look(), part)

    def _look(self) -> "PictureOptions":
        from nerfcli.cameras.framing import LENSES
        from nerfcli.workflows.views import PictureOptions

        one_of(self.lens, LENSES, "--lens")
        if self.fov is not None and self.lens is None:
            raise typer.BadParameter("needs --lens", param_hint="--fov")
        window = None
        if self.crop is not None:
            match = re.fullmatch(r"(\d+),(\d+),(\d+),(\d+)", self.crop.replace(" ", ""))
            if match is None:
                raise typer.BadParameter(f"{self.crop!r}; write X,Y,WIDTH,HEIGHT in pixels", param_hint="--crop")
            window = (int(match[1]), int(match[2]), int(match[3]), int(match[4]))
        return PictureOptions(self.width, self.height, self.lens, self.fov, window)


@dataclass(frozen=True)
class DepthOptions:
    """Options of the definition of depth, and of where there is none."""

    depth: Annotated[
        str,
        typer.Option(
            help="Definition of depth: conditional, moment, background, max-weight, median or quantile:Q, "
            "such as quantile:0.05."
        ),
    ] = "conditional"
    depth_axis: Annotated[
        str | None, typer.Option(help="ray: along the ray; z: along the optical axis.  [default: z, ray for panoramas]")
    ] = None
    min_opacity: Annotated[
        float,
        typer.Option(help="Pixels with less opacity have no depth (NaN).", min=0, max=1),
    ] = 0.5
    min_views: Annotated[
        int, typer.Option(help="Remove depth (NaN) where fewer training photos see the surface.", min=0)
    ] = 0
    min_parallax: Annotated[
        float,
        typer.Option(
            help="Remove depth (NaN) where no two training photos see the surface at this angle, in degrees.",
            min=0,
            max=180,
        ),
    ] = 0.0
    background_distance: Annotated[
        float | None, typer.Option(help="Distance of light that hits nothing (--depth background), scene units.", min=0)
    ] = None

    def request(self, outputs: tuple[str, ...]) -> "DepthRequest":
        """Return the definition of depth that the options select; along z where no axis is given."""
        from nerfcli.render.depth import AXES, CONVENTIONS, DepthRequest, is_convention

        if not is_convention(self.depth):
            choices = f"{', '.join(CONVENTIONS)} or quantile:Q with 0 < Q < 1"
            raise typer.BadParameter(f"{self.depth!r}; choose {choices}", param_hint="--depth")
        one_of(self.depth_axis, AXES, "--depth-axis")
        finite(self.background_distance, "--background-distance")
        finite(self.min_opacity, "--min-opacity")
        finite(self.min_parallax, "--min-parallax")
        if (self.min_views or self.min_parallax) and "depth" not in outputs:
            hint = "--min-views" if self.min_views else "--min-parallax"
            raise typer.BadParameter("it removes depth; add depth to --outputs", param_hint=hint)
        axis = self.depth_axis or "z"
        return DepthRequest(
            self.depth, axis, self.min_opacity, self.background_distance, self.min_views, self.min_parallax
        )


@dataclass(frozen=True)
class FileOptions:
    """Options of the files: what they hold, their formats, videos, and how exactly they are rendered."""

    outputs: Annotated[
        str,
        typer.Option(
            help="Any of rgb, depth, opacity, spread, disagreement, coverage, parallax, lower, upper, confidence, "
            "with commas between them."
        ),
    ] = "rgb,depth,opacity"
    depth_format: Annotated[
        str,
        typer.Option(
            help="Any of tiff, exr, npy (float32; exr holds all outputs of a view) and png16 (16-bit integers, in "
            "addition to float32)."
        ),
    ] = "tiff"
    step: Annotated[
        float,
        typer.Option(
            help="Length of the steps along rays, relative to training: 2 is about twice as fast, 0.5 more exact.",
            min=0.05,
            max=20,
        ),
    ] = 1.0
    rgba: Annotated[
        bool,
        typer.Option(
            "--rgba", help="Write colour without background, with opacity as alpha (straight; EXR premultiplied)."
        ),
    ] = False
    video: Annotated[
        bool, typer.Option("--video", help="Write a video of each output; same as --video-format mp4.")
    ] = False
    video_format: Annotated[
        str | None, typer.Option(help="mp4 (H.264), gif, or both with a comma between them; implies --video.")
    ] = None
    fps: Annotated[
        float | None,
        typer.Option(help="Frames per second of the video.  [default: 24, or that of a camera path]", min=1, max=240),
    ] = None
    check_accuracy: Annotated[
        bool,
        typer.Option("--check-accuracy", help="Measure the error of every picture, not only of the first and last."),
    ] = False

    @property
    def writes_video(self) -> bool:
        """Whether videos are written."""
        return self.video or self.video_format is not None

    def settings(self, depth: DepthOptions, cameras: str) -> "RenderSettings":
        """Return the settings that the options select."""
        from nerfcli.render.job import OUTPUTS, RenderSettings

        outputs = some_of(self.outputs, OUTPUTS, "--outputs")
        request = depth.request(outputs)
        finite(self.step, "--step")
        return RenderSettings(
            outputs,
            request,
            self._formats(outputs, depth.depth),
            self._videos(self.frames_per_second(cameras)) if self.writes_video else None,
            self.step,
            self.rgba,
            self.check_accuracy,
        )

    def frames_per_second(self, cameras: str) -> float:
        """Return the frame rate, by default that of the file of cameras."""
        from nerfcli.captures.formats.camera_path import DEFAULT_FPS
        from nerfcli.workflows.views import file_fps

        return self.fps or file_fps(cameras) or DEFAULT_FPS

    def _formats(self, outputs: tuple[str, ...], convention: str) -> tuple[str, ...]:
        from nerfcli.render.job import FORMATS

        hint = "--depth-format"
        chosen = some_of(self.depth_format, FORMATS, hint)
        if "png16" in chosen and "depth" not in outputs:
            raise typer.BadParameter("png16 is a depth format; add depth to --outputs", param_hint=hint)
        if "png16" in chosen and convention == "moment":
            message = "png16 uses 0 for no depth, but the moment of an empty ray is 0; use another format"
            raise typer.BadParameter(message, param_hint=hint)
        return chosen

    def _videos(self, fps: float) -> "VideoSettings":
        from nerfcli.render.files.film import ENCODERS, GIF_FASTEST_FPS
        from nerfcli.render.job import VideoSettings

        chosen = some_of(self.video_format or "mp4", ENCODERS, "--video-format")
        if "gif" in chosen and fps > GIF_FASTEST_FPS:
            message = f"{fps:g}; a gif plays at {GIF_FASTEST_FPS:g} frames per second at most"
            raise typer.BadParameter(message, param_hint="--fps")
        return VideoSettings(chosen, fps)


@command
def render(
    run: Annotated[
        str,
        typer.Argument(help="Run folder written by train, a .ply or .spz of splats, or - to read paths from stdin."),
    ],
    *,
    seen: ViewOptions,
    depths: DepthOptions,
    files: FileOptions,
    splats: Annotated[
        Path | None, typer.Option(help="A .ply or .spz of splats to render instead of the run's field.")
    ] = None,
    writing: Writing,
    computing: Computing,
    printing: Printing,
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
    from nerfcli.splats.files import SUFFIXES
    from nerfcli.training.runs.run import load_run
    from nerfcli.workflows.render import render_run, render_splats, write_cameras
    from nerfcli.workflows.views import usual_axis

    views, usual, console = seen.views(), files.settings(depths, seen.cameras), printing.console
    _refuse_unused(seen, depths, files, usual.outputs)
    of_fields = {"--step": files.step != 1.0, "--check-accuracy": files.check_accuracy}
    if splats is not None:
        _refuse_of_runs(splats, of_fields)

    def work(given: Given) -> None:
        path, how = given.path, {"views": views, "settings": usual, "resources": computing.resources}
        if path.suffix.lower() in SUFFIXES:
            _refuse_of_runs(path, {"--cameras-only": seen.cameras_only, "--splats": splats is not None, **of_fields})
            with console.stage(f"render {views.name}") as reporter:
                output = writing.inside(replace(given, path=path.with_suffix("")), "")
                written = render_splats(path, output, **how, reporter=reporter)
        elif seen.cameras_only:
            fps = files.frames_per_second(seen.cameras)
            written = [write_cameras(path, writing.inside(given, ""), views, fps=fps, reporter=console.reporter)]
        else:
            axis = depths.depth_axis or usual_axis(load_run(path), views)
            how["settings"] = replace(usual, depth=replace(usual.depth, axis=axis))
            with console.stage(f"render {views.name}") as reporter:
                written = render_run(path, writing.inside(given, ""), splats=splats, **how, reporter=reporter)
        for result in written:
            console.result(result)

    for_each_input(run, work, command="render")


def _refuse_of_runs(path: Path, options: dict[str, bool]) -> None:
    from nerfcli.errors import UserError

    for option, is_given in options.items():
        if is_given:
            raise UserError(f"{option} works with a run, not with {path}", "remove it", exit_code=2)


def _refuse_unused(seen: ViewOptions, depths: DepthOptions, files: FileOptions, outputs: tuple[str, ...]) -> None:
    """Refuse options that nothing would use, and alpha in videos."""
    from nerfcli.workflows.views import PATHS, Views

    writes_fps, no_depth = files.writes_video or seen.cameras_only, set(outputs) <= {"rgb", "opacity"}
    is_background = depths.depth == "background"
    unused = {
        "--fps": (files.fps is not None and not writes_fps, "--video"),
        "--depth": (depths.depth != "conditional" and no_depth, "--outputs depth"),
        "--depth-axis": (depths.depth_axis is not None and no_depth, "--outputs depth"),
        "--min-opacity": (depths.min_opacity != 0.5 and no_depth, "--outputs depth"),
        "--background-distance": (depths.background_distance is not None and not is_background, "--depth background"),
        "--rgba": (files.rgba and "rgb" not in outputs, "--outputs rgb"),
        "--count": (seen.count != Views.count and seen.cameras not in PATHS, f"--cameras {', '.join(PATHS)}"),
    }
    refuse_unused(unused, "it works with {}; add that, or remove it")
    if files.rgba and files.writes_video:
        message = "videos have no alpha channel; remove --rgba or the video options"
        raise typer.BadParameter(message, param_hint="--rgba")


def frame_range(text: str) -> slice:
    """Parse --frames: START:STOP or START:STOP:STEP, counted from 0, or K/N, every N-th view from the K-th.

    START and STOP may be left out; K counts from 1, as task numbers of array jobs do.
    """
    if one_of_many := re.fullmatch(r"(\d+)/(\d+)", text.strip()):
        number, count = map(int, one_of_many.groups())
        if 1 <= number <= count:
            return slice(number - 1, None, count)
    match = re.fullmatch(r"(\d*):(\d*)(?::(\d+))?", text.strip())
    start, stop, step = (int(part) if part else None for part in match.groups()) if match else (0, 0, 0)
    if match is None or step == 0 or (stop is not None and stop <= (start or 0)):
        message = f"{text!r}; write START:STOP or START:STOP:STEP, for example 100:200 or 0:120:4, or K/N, such as 1/8"
        raise typer.BadParameter(message, param_hint="--frames")
    return slice(start, stop, step)
