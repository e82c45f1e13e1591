"""nerfcli convert: from one format of captures to another, proved; and which convention a capture follows."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json, Overwrite, Quiet

if TYPE_CHECKING:
    from nerfcli.cameras.frame import Capture
    from nerfcli.convert.conversion import Conversion
    from nerfcli.convert.detect import Answer, Detection, Question

FORMATS_WRITTEN = (
    "nerfcli",
    "colmap",
    "colmap-text",
    "transforms",
    "blender",
    "llff",
    "opensfm",
    "tum",
    "kitti",
    "npz",
    "ply",
)
# Programs whose name people type for the format that they read.
PROGRAMS = {"nerfstudio": "transforms", "instant-ngp": "transforms"}
# Names of files that say nothing of the capture.
COMMON_STEMS = ("transforms", "reconstruction", "bundle", "poses_bounds", "scene", "cameras", "images")
# Hypotheses of a question in the table of --detect.
SHOWN = 3
PIXEL_CENTRES = {"0.5": 0.5, "0": 0.0}
_AXES = "opencv (= rdf), opengl (= rub), llff (= drb), pytorch3d (= luf), ros (= flu), or three such letters"


@command
def convert(
    source: Annotated[str, typer.Argument(metavar="IN", help="A capture: file or folder, or - for paths on stdin.")],
    target: Annotated[
        Path | None, typer.Argument(metavar="OUT", help="File or folder to write; with -, the folder of the results.")
    ] = None,
    to: Annotated[
        str | None, typer.Option(help=f"{', '.join(FORMATS_WRITTEN)}; {' or '.join(PROGRAMS)} for transforms.")
    ] = None,
    detect: Annotated[bool, typer.Option("--detect", help="Write nothing; tell which convention IN follows.")] = False,
    axes: Annotated[str | None, typer.Option(help=f"Camera axes of the poses in OUT: {_AXES}.")] = None,
    pixel_center: Annotated[
        str | None, typer.Option(help="Where cx, cy in OUT put the first pixel's centre: 0.5, or 0 as in OpenCV.")
    ] = None,
    from_axes: Annotated[str | None, typer.Option(help="Camera axes of the poses in IN, if not its format's.")] = None,
    from_inverted: Annotated[
        bool, typer.Option("--from-inverted", help="The transforms in IN are the inverse of its format's.")
    ] = False,
    from_pixel_center: Annotated[str | None, typer.Option(help="As --pixel-center, of IN.")] = None,
    from_size: Annotated[
        float, typer.Option(help="The intrinsics in IN are for pictures this many times as large as it says.", min=1e-3)
    ] = 1.0,
    images: Annotated[Path | None, typer.Option(help="The folder of the photos, where IN does not find them.")] = None,
    intrinsics: Annotated[
        Path | None, typer.Option(help="The camera of tum and kitti: cameras.txt, a JSON camera, or a capture.")
    ] = None,
    world_up: Annotated[
        str | None, typer.Option(help="Turn the world so that up is its x, y, z, -x, -y or -z axis.")
    ] = None,
    origin: Annotated[
        str | None, typer.Option(help="Move the world's origin to centre-of-cameras, focus, or x,y,z of IN.")
    ] = None,
    scale: Annotated[
        str | None, typer.Option(help="Multiply lengths by a number; gps: to metres, by the photos' EXIF.")
    ] = None,
    distance: Annotated[
        list[str] | None,
        typer.Option(
            help='A known distance, to metres: "A B 1.25", A and B images or points x,y,z; many may be given.'
        ),
    ] = None,
    markers: Annotated[
        str | None,
        typer.Option(
            help="To metres by ArUco markers in the photos, DICT_4X4_50:0.05 (their side), or a ChArUco board, "
            "DICT_5X5_100:7x5:0.04:0.03 (squares, sides of square and marker; :legacy after it for OpenCV < 4.6)."
        ),
    ] = None,
    pixels: Annotated[
        str | None,
        typer.Option(
            help="Which pixels of photos with an EXIF orientation the cameras in OUT refer to: stored, as COLMAP, "
            "nerfstudio and most programs read them, or upright.  [default: upright for nerfcli, else stored]"
        ),
    ] = None,
    allow_loss: Annotated[
        bool, typer.Option("--allow-loss", help="Leave out what the format cannot hold (it is listed).")
    ] = False,
    verify: Annotated[bool, typer.Option(help="Read OUT back by other means and compare.")] = True,
    tolerance: Annotated[float, typer.Option(help="The largest residual that passes, pixels.", min=0)] = 1e-6,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Convert a capture to another format, and prove it.

    What was written, cameras, poses and points, is read back by other programs' code (pycolmap, OpenCV, SciPy), every
    3D point is projected by both, and the largest residual is told; above --tolerance the exit code is 7 and nothing is
    kept. What the format cannot hold is listed, and refused without --allow-loss, but for 2D features. Photos are not
    touched.

    \b
    Formats read:     nerfcli, colmap, transforms (nerfstudio, instant-ngp), blender, llff, opensfm, metashape,
                      reality-capture, bundler, tum, kitti, npz, camera-path (of nerfstudio's viewer), run (what
                      nerfcli train wrote, with refined cameras); recognised by their files
    Formats written:  nerfcli (a scene folder as poses writes it), colmap, colmap-text, transforms (nerfstudio,
                      instant-ngp), blender, llff, opensfm, tum, kitti, npz (all of it), ply (points)

    \b
    Inside, camera axes are OpenCV's (x right, y down, z forward) and the first pixel's centre is (0.5, 0.5).
    Each format has its own axes; --axes and --pixel-center are for programs that read a format their own way,
    --from-axes, --from-inverted, --from-pixel-center and --from-size for files that were written so.
    In doubt, --detect compares hypotheses with the photos and says which holds, by how much.

    \b
    Examples:
      nerfcli convert photos-scene transforms.json --to transforms
      nerfcli convert fox/transforms.json fox/sparse/0 --to colmap
      nerfcli convert fern poses.txt --to kitti --allow-loss
      nerfcli convert photos-scene-run refined-scene --to nerfcli
      nerfcli convert poses.txt capture.npz --to npz --intrinsics cameras.txt
      nerfcli convert transforms.json opencv.json --to transforms --axes opencv --pixel-center 0
      nerfcli convert scene/ metric.npz --to npz --world-up z --origin focus --distance "a.jpg b.jpg 1.25"
      nerfcli convert colmap-project metric-scene --to nerfcli --distance "a.jpg b.jpg 1.25"
      nerfcli convert strange/ --detect
      nerfcli convert strange/ mended.json --to transforms --from-axes opencv --from-inverted
      ls -d captures/*/ | nerfcli convert - converted/ --to transforms
    """
    console = Console(quiet=quiet, json_lines=json)
    doubt = {
        "axes": from_axes,
        "inverted": from_inverted,
        "pixel_centre": _pixel_centre(from_pixel_center, "--from-pixel-center"),
        "intrinsics_scale": from_size,
    }
    if detect:
        if to is not None or target is not None:
            raise typer.BadParameter("--detect writes nothing; leave OUT and --to out")

        def work(path: Path, one_of_many: bool) -> None:
            detect_one(path, images=images, intrinsics=intrinsics, doubt=doubt, console=console)
    else:
        to = PROGRAMS.get(to or "", to)
        if to is None or to not in FORMATS_WRITTEN:
            raise typer.BadParameter(f"{to!r}; choose one of {', '.join(FORMATS_WRITTEN)}", param_hint="--to")
        if target is None:
            raise typer.BadParameter("say where the result goes", param_hint="OUT")
        lengths = {"scale": scale, "markers": markers, "distances": tuple(distance or ())}
        world = {"up": world_up, "origin": origin, **lengths}
        if pixels not in (None, "stored", "upright"):
            raise typer.BadParameter(f"{pixels!r}; choose stored or upright", param_hint="--pixels")
        wanted = {
            "pixels": pixels,
            "axes": axes,
            "pixel_centre": _pixel_centre(pixel_center, "--pixel-center"),
            "allow_loss": allow_loss,
            "overwrite": overwrite,
            "verified": verify,
            "tolerance_px": tolerance,
        }

        def work(path: Path, one_of_many: bool) -> None:
            place = target / _named_for(path).resolve().name if one_of_many else target
            convert_one(
                path,
                place,
                to=to,
                images=images,
                intrinsics=intrinsics,
                doubt=doubt,
                world=world,
                wanted=wanted,
                console=console,
            )

    for_each_input(source, work)


def convert_one(
    source: Path,
    target: Path,
    *,
    to: str,
    images: Path | None,
    intrinsics: Path | None,
    doubt: dict[str, Any],
    world: dict[str, Any],
    wanted: dict[str, Any],
    console: Console,
) -> None:
    """Convert one capture and tell what came of it."""
    from nerfcli.cameras.orientation import rescaling_told
    from nerfcli.convert.conversion import Doubt, Wanted, convert, load
    from nerfcli.convert.formats import Given, format_named, recording
    from nerfcli.convert.intrinsics import read_intrinsics
    from nerfcli.convert.pixels import other_sizes
    from nerfcli.convert.world_frame import WorldFrame, in_world_frame

    given = Given(images=images, camera=None if intrinsics is None else read_intrinsics(intrinsics))
    form, found, capture = load(source, given, Doubt(**doubt))
    console.note(f"{found}: {form.name}, {_contents(capture)}")
    for text in rescaling_told(other_sizes(capture)):
        console.note(f"{text.removesuffix(': rescaled')}; {to} gets them as they are")
    capture, new_from_old, scale = in_world_frame(capture, WorldFrame(**world))
    if scale is not None:
        error = "" if scale.standard_error is None else f" +- {scale.standard_error:.2g}"
        unit = "%" if scale.residual_unit == "percent" else "m"
        console.note(
            f"a unit is {scale.metres_per_unit:.6g}{error} metres, from {scale.source}; "
            f"residual {scale.rms_residual:.2g} {unit}" + (f"; {scale.details}" if scale.details else "")
        )
    frame = {"new_from_old": new_from_old.to_json()} | ({} if scale is None else {"scale": scale.to_json()})
    wanted_form = recording(format_named(to), {"source": str(found), **frame})
    done = convert(capture, target, source_format=form.name, wanted=Wanted(wanted_form, **wanted))
    for text in done.notes:
        console.note(text)
    for loss in done.losses:
        console.warn(f"{to} cannot hold {loss}")
    if done.loss_px > wanted["tolerance_px"]:
        console.warn(f"without the lost terms of lenses, pixels are off by up to {done.loss_px:.3g} px")
    _tell_verification(done, console)
    console.result(done.path, _record(done, to) | frame)


def detect_one(
    source: Path,
    *,
    images: Path | None,
    intrinsics: Path | None,
    doubt: dict[str, Any],
    console: Console,
) -> None:
    """Tell which convention a capture follows: a table, or with --json one line."""
    from nerfcli.convert.conversion import Doubt, load
    from nerfcli.convert.detect import detect
    from nerfcli.convert.formats import Given
    from nerfcli.convert.intrinsics import read_intrinsics
    from nerfcli.convert.pixels import STORED, in_pixels

    given = Given(images=images, camera=None if intrinsics is None else read_intrinsics(intrinsics))
    form, found, capture = load(source, given, Doubt(**doubt))
    console.note(f"{found}: {form.name}, {_contents(capture)}")
    capture = in_pixels(capture, STORED).capture
    with console.progress(f"detect {source.name}") as update:
        found_out = detect(capture, axes=form.axes, progress=update)
    if console.json_lines:
        console.result(source, _detection_record(found_out, form.name))
    else:
        typer.echo("\n".join([f"{source} ({form.name}), judged by {found_out.evidence}", *_table(found_out)]))


def _contents(capture: "Capture") -> str:
    cameras = len({frame.camera for frame in capture.frames})
    return f"{len(capture.frames)} images, {cameras} camera{'s' * (cameras != 1)}, {len(capture.points)} points"


def _tell_verification(done: "Conversion", console: Console) -> None:
    checked = done.verification
    if checked is None:
        console.warn(f"{done.path} was not verified")
        return
    against = "what is left of the capture" if done.losses else "the capture"
    if not checked.num_projections:
        console.note(f"{done.path}: read back, its {checked.num_points} points are those of {against}")
        return
    console.note(
        f"{done.path}: read back and compared with {against}: {checked.num_projections} projections of "
        f"{checked.num_points} points in {checked.num_views} images; largest residual {checked.max_px:.2g} px "
        f"(tolerance {checked.tolerance_px:.2g}), rotation {checked.max_deg:.2g} degrees, "
        f"centre {checked.max_centre_shift:.2g} of the scene's size"
        + (f"; the same are {', '.join(checked.parts)}" if checked.parts else "")
    )


def _record(done: "Conversion", to: str) -> dict[str, Any]:
    checked = done.verification
    return {
        "from": done.source_format,
        "to": to,
        "images": len(done.capture.frames),
        "cameras": len({frame.camera for frame in done.capture.frames}),
        "points": len(done.capture.points),
        "losses": list(done.losses),
        "loss_px": done.loss_px,
        "verification": None
        if checked is None
        else {
            "projections": checked.num_projections,
            "points": checked.num_points,
            "max_px": checked.max_px,
            "max_deg": checked.max_deg,
            "max_centre_shift": checked.max_centre_shift,
            "max_point_shift": checked.max_point_shift,
            "tolerance_px": checked.tolerance_px,
            "same": list(checked.parts),
        },
    }


def _table(found: "Detection") -> list[str]:
    """Per question the hypotheses that matter: the best ones, and the one that the format prescribes."""
    lines = [f"  {'hypothesis':<52}{'median error':>14}{'inliers':>9}  verdict"]
    for question in found.questions:
        lines.append(f"  {question.name}")
        for place, answer in enumerate(question.answers):
            if place < SHOWN or answer.as_format_says:
                verdict = _verdict(question) if place == 0 else ""
                error = "behind" if answer.median_px == float("inf") else f"{answer.median_px:.3f} px"
                line = (
                    f"    {_hypothesis(question, answer):<50}{error:>14}{100 * answer.inlier_share:>7.1f} %  {verdict}"
                )
                lines.append(line.rstrip())
    if found.as_format_says:
        lines.append("  Nothing speaks against the convention of the format.")
    elif options := _options(found):
        lines.append(f"  To read it so: nerfcli convert IN OUT --to FORMAT {options}")
    else:
        lines.append("  No hypothesis fits: poses, intrinsics and photos do not belong together in any of these ways.")
    return lines


def _hypothesis(question: "Question", answer: "Answer") -> str:
    convention = answer.convention
    text = {
        "axes and direction": f"{convention.axes}, {'cam_from_world' if convention.inverted else 'world_from_cam'}",
        "image size": f"intrinsics for {convention.intrinsics_scale:g} x the size",
        "pixel centre": f"first pixel's centre at {convention.pixel_centre:g}",
    }[question.name]
    return f"{text} (as its format says)" if answer.as_format_says else text


def _verdict(question: "Question") -> str:
    if question.verdict == "holds":
        return f"holds, {question.ratio:.3g} times better than the next"
    return f"{question.verdict}: {question.reason}"


def _options(found: "Detection") -> str:
    """The options that make `convert` read the capture in the convention that was found."""
    convention, declared = found.convention, found.declared
    options = [] if convention.axes == declared.axes else [f"--from-axes {convention.axes}"]
    options += ["--from-inverted"] if convention.inverted else []
    options += [f"--from-pixel-center {convention.pixel_centre:g}"] if convention.pixel_centre != 0.5 else []
    options += [f"--from-size {convention.intrinsics_scale:g}"] if convention.intrinsics_scale != 1 else []
    return " ".join(options)


def _detection_record(found: "Detection", form: str) -> dict[str, Any]:
    return {
        "format": form,
        "evidence": found.evidence,
        "as_format_says": found.as_format_says,
        "options": _options(found),
        "questions": [
            {
                "question": question.name,
                "verdict": question.verdict,
                "ratio": question.ratio,
                "reason": question.reason,
                "hypotheses": [
                    {
                        "axes": answer.convention.axes,
                        "inverted": answer.convention.inverted,
                        "pixel_centre": answer.convention.pixel_centre,
                        "intrinsics_scale": answer.convention.intrinsics_scale,
                        "as_format_says": answer.as_format_says,
                        "median_px": None if answer.median_px == float("inf") else answer.median_px,
                        "inlier_share": answer.inlier_share,
                    }
                    for answer in question.answers
                ],
            }
            for question in found.questions
        ],
    }


def _pixel_centre(text: str | None, option: str) -> float | None:
    if text is not None and text not in PIXEL_CENTRES:
        raise typer.BadParameter(f"{text!r}; choose 0.5 or 0", param_hint=option)
    return None if text is None else PIXEL_CENTRES[text]


def _named_for(path: Path) -> Path:
    """The place that a result among many is named after: a file without its suffix, or its folder where its name is one
    that all captures of its format have."""
    if not path.is_file():
        return path
    return path.parent if path.stem in COMMON_STEMS else path.with_suffix("")
