"""nerfcli convert: convert cameras between formats; detect conventions."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Overwrite, Printing, one_of
from nerfcli.output import beside

if TYPE_CHECKING:
    from nerfcli.captures.axes import Convention
    from nerfcli.captures.conversion import TargetOptions
    from nerfcli.captures.detect import Detection, HypothesisScore, Question
    from nerfcli.captures.formats.format import UserInputs
    from nerfcli.captures.world import WorldFrame

FORMATS_WRITTEN = (
    *("nerfcli", "colmap", "colmap-text", "transforms", "blender", "llff", "opensfm"),
    *("tum", "kitti", "ply"),
)
# Names of programs that are accepted for the format that they read.
PROGRAMS = {"nerfstudio": "transforms", "instant-ngp": "transforms"}
# Names of files that do not identify the capture.
COMMON_STEMS = (
    *("transforms", "transforms_train", "transforms_test", "reconstruction", "bundle", "poses_bounds", "scene"),
    *("cameras", "images", "meta_data", "scan"),
)
PIXEL_CENTRES = {"0.5": 0.5, "0": 0.0}
# Number of best hypotheses per question in the table of --detect.
_MOST_HYPOTHESES = 3
_AXES = "opencv (= rdf), opengl (= rub), llff (= drb), pytorch3d (= luf), ros (= flu), or three such letters"

Source = Annotated[
    str,
    typer.Argument(
        metavar="IN", help="Capture to read: file, folder or zip archive, or - to read paths from standard input."
    ),
]
Target = Annotated[
    Path | None,
    typer.Argument(metavar="OUT", help="File or folder to write; with -, the folder that will contain the results."),
]


@dataclass(frozen=True)
class SourceOptions:
    """Options of what the source does not say, or says wrongly."""

    from_axes: Annotated[
        str | None, typer.Option(help="Camera axes of the poses in IN, if they differ from its format's.")
    ] = None
    from_inverted: Annotated[
        bool,
        typer.Option(
            "--from-inverted",
            help="The transforms in IN are inverted (camera-from-world instead of world-from-camera, or vice versa).",
        ),
    ] = False
    from_pixel_center: Annotated[str | None, typer.Option(help="Like --pixel-center, for IN.")] = None
    from_size: Annotated[
        float, typer.Option(help="The intrinsics in IN refer to pictures larger than stated by this factor.", min=1e-3)
    ] = 1.0
    images: Annotated[Path | None, typer.Option(help="Folder of the photos, if IN does not point to them.")] = None
    masks: Annotated[
        Path | None,
        typer.Option(help="Folder of masks named after the photos, if IN has none; black is ignored in training."),
    ] = None
    intrinsics: Annotated[
        Path | None,
        typer.Option(
            help="File with the camera for tum, kitti, pose-files, tum-rgbd and kapture: cameras.txt, a JSON camera, "
            "or a capture."
        ),
    ] = None

    def convention(self) -> "Convention":
        """Return the convention of the source."""
        from nerfcli.captures.axes import Convention

        centre = _pixel_centre(self.from_pixel_center, "--from-pixel-center")
        return Convention(_axes(self.from_axes, "--from-axes"), self.from_inverted, centre, self.from_size)

    def given(self) -> "UserInputs":
        """Return photos, masks and camera; reads the file of intrinsics."""
        from nerfcli.captures.calibration import read_intrinsics
        from nerfcli.captures.formats.format import UserInputs

        camera = None if self.intrinsics is None else read_intrinsics(self.intrinsics)
        return UserInputs(images=self.images, camera=camera, masks=self.masks)


@dataclass(frozen=True)
class WorldOptions:
    """Options of the frame and the unit of the result."""

    world_up: Annotated[
        str | None, typer.Option(help="Rotate the world so that this axis points up: x, y, z, -x, -y or -z.")
    ] = None
    origin: Annotated[
        str | None, typer.Option(help="Move the world's origin to centre-of-cameras, focus, or a point x,y,z of IN.")
    ] = None
    scale: Annotated[
        str | None,
        typer.Option(help="Multiply lengths by this number; gps: scale to metres by the GPS positions in EXIF."),
    ] = None
    distance: Annotated[
        list[str] | None,
        typer.Option(
            help='Scale to metres by a known distance: "A B 1.25", A and B images or points x,y,z. Repeatable.'
        ),
    ] = None
    markers: Annotated[
        str | None,
        typer.Option(
            help="Scale to metres by ArUco markers, DICT_4X4_50:0.05 (side length), or a ChArUco board, "
            "DICT_5X5_100:7x5:0.04:0.03 (squares, sides of square and marker; append :legacy for OpenCV < 4.6)."
        ),
    ] = None

    def frame(self) -> "WorldFrame":
        """Return the frame that the options select."""
        from nerfcli.captures.world import WorldFrame

        return WorldFrame(self.world_up, self.origin, self.scale, self.markers, tuple(self.distance or ()))


@dataclass(frozen=True)
class FormatOptions:
    """Options of what is written."""

    to: Annotated[
        str | None,
        typer.Option(help=f"Output format: {', '.join(FORMATS_WRITTEN)}; {' or '.join(PROGRAMS)} for transforms."),
    ] = None
    axes: Annotated[str | None, typer.Option(help=f"Camera axes of the poses in OUT: {_AXES}.")] = None
    pixel_center: Annotated[
        str | None,
        typer.Option(help="Pixel coordinates of the top-left pixel's centre in OUT: 0.5, or 0 as in OpenCV."),
    ] = None
    pixels: Annotated[
        str | None,
        typer.Option(
            help="For photos with an EXIF orientation, whether cameras in OUT refer to the pixels as stored (COLMAP, "
            "nerfstudio and most programs) or upright.  [default: upright for nerfcli, else stored]"
        ),
    ] = None
    allow_loss: Annotated[
        bool, typer.Option("--allow-loss", help="Drop what the format cannot hold (it is listed).")
    ] = False
    overwrite: Overwrite = False

    def target(self) -> "TargetOptions":
        """Return how to write."""
        from nerfcli.captures.conversion import TargetOptions
        from nerfcli.captures.formats.registry import format_named

        to = PROGRAMS.get(self.to or "", self.to)
        if to is None or to not in FORMATS_WRITTEN:
            stated = "missing" if to is None else repr(to)
            raise typer.BadParameter(f"{stated}; choose one of {', '.join(FORMATS_WRITTEN)}", param_hint="--to")
        one_of(self.pixels, ("stored", "upright"), "--pixels")
        centre = _pixel_centre(self.pixel_center, "--pixel-center")
        axes = _axes(self.axes, "--axes")
        return TargetOptions(format_named(to), axes, centre, self.allow_loss, self.overwrite, self.pixels)


@command
def convert(
    source: Source,
    target: Target = None,
    *,
    detect: Annotated[
        bool, typer.Option("--detect", help="Write nothing; detect which convention IN follows.")
    ] = False,
    written: FormatOptions,
    read: SourceOptions,
    world: WorldOptions,
    printing: Printing,
) -> None:
    """Convert a capture to another format.

    What was written is read back, and its points and the rays of its pixels are compared with the capture; if they
    differ, nothing is kept and the exit code is 7.
    Anything that the format cannot hold is listed, and the conversion is refused without --allow-loss (2D features may
    be dropped without it). Photos are not changed.

    \b
    Formats read:     nerfcli, colmap, transforms (nerfstudio, instant-ngp), blender, llff, opensfm, metashape,
                      reality-capture and realityscan-xmp, alicevision (Meshroom), openmvg, kapture, bundler, polycam,
                      record3d, stray-scanner, 3d-scanner-app, nerfies (also HyperNeRF), scannetpp, euroc, tum-rgbd,
                      mvsnet (also BlendedMVS), neus (also IDR), pose-files (a matrix per photo, as in ScanNet,
                      7-Scenes, NSVF), tum, kitti, camera-path (nerfstudio's viewer), run (a folder written by
                      nerfcli train, with its refined cameras); detected from the files. Archives (.zip, .r3d) are
                      unpacked beside OUT, as are frames of a video that is part of a capture.
    Formats written:  nerfcli (a scene folder), colmap, colmap-text, transforms (nerfstudio, instant-ngp), blender,
                      llff, opensfm, tum, kitti, ply (points only)

    \b
    Internally, camera axes are OpenCV's (x right, y down, z forward) and the top-left pixel's centre is (0.5, 0.5).
    Each format has its own axes. Use --axes and --pixel-center for programs that read a format differently, and
    --from-axes, --from-inverted, --from-pixel-center and --from-size for files that were written differently.
    If you are not sure, --detect compares the possible conventions with the photos.

    \b
    Examples:
      nerfcli convert photos-scene transforms.json --to transforms
      nerfcli convert fox/transforms.json fox/sparse/0 --to colmap
      nerfcli convert fern poses.txt --to kitti --allow-loss
      nerfcli convert photos-scene-run refined-scene --to nerfcli
      nerfcli convert colmap-project statue-scene --to nerfcli --masks statue-masks
      nerfcli convert poses.txt sparse/0 --to colmap --intrinsics cameras.txt
      nerfcli convert transforms.json opencv.json --to transforms --axes opencv --pixel-center 0
      nerfcli convert scene metric.json --to transforms --world-up z --origin focus --scale 0.25
      nerfcli convert colmap-project metric-scene --to nerfcli --distance "a.jpg b.jpg 1.25"
      nerfcli convert strange/ --detect
      nerfcli convert strange/ repaired.json --to transforms --from-axes opencv --from-inverted
      nerfcli convert capture.zip office-scene --to nerfcli
      ls -d captures/*/ | nerfcli convert - converted/ --to transforms
    """
    console, convention = printing.console, read.convention()
    if detect:
        if written.to is not None or target is not None:
            raise typer.BadParameter("--detect writes nothing; remove OUT and --to")
        for_each_input(source, lambda given: _detect(given.path, read, console), command="convert")
        return
    wanted, frame = written.target(), world.frame()
    if target is None:
        raise typer.BadParameter("missing; give the file or folder to write", param_hint="OUT")
    from nerfcli.workflows.convert import convert_capture

    def work(given: Given) -> None:
        done, record = convert_capture(
            given.path,
            place_of(given, target),
            wanted,
            given=read.given(),
            convention=convention,
            world=frame,
            reporter=console.reporter,
        )
        off = f", {done.check.rays} rays are off by at most {done.check.max_px:.2g} px" if done.check.rays else ""
        console.note(f"{done.path}: read back{off}")
        console.result(done.path, record)

    for_each_input(source, work, command="convert")


def _detect(path: Path, read: SourceOptions, console: Console) -> None:
    from nerfcli.workflows.convert import detect_convention, detection_record

    with console.stage(f"detect {path.name}") as reporter:
        form, found = detect_convention(path, given=read.given(), convention=read.convention(), reporter=reporter)
    lines = [f"{path} ({form.name}), judged by {found.evidence}", *_table(found)]
    console.facts(path, detection_record(found, form.name), "\n".join(lines))


def _table(found: "Detection") -> list[str]:
    """Return the lines of a table: for each question, the best hypotheses and the one that the format prescribes."""
    from nerfcli.workflows.convert import options_of

    lines = [f"  {'hypothesis':<52}{'median error':>14}{'inliers':>9}  verdict"]
    for question in found.questions:
        lines.append(f"  {question.name}")
        for place, answer in enumerate(question.answers):
            if place < _MOST_HYPOTHESES or answer.as_format_says:
                verdict = _verdict(question) if place == 0 else ""
                error = "behind" if answer.median_px == float("inf") else f"{answer.median_px:.3f} px"
                inliers = f"{100 * answer.inlier_fraction:>7.1f} %"
                line = f"    {_hypothesis(question, answer):<50}{error:>14}{inliers}  {verdict}"
                lines.append(line.rstrip())
    if found.as_format_says:
        lines.append("  Nothing contradicts the convention of the format.")
    elif options := options_of(found):
        lines.append(f"  To read it this way: nerfcli convert IN OUT --to FORMAT {options}")
    else:
        lines.append("  No hypothesis fits: poses, intrinsics and photos do not match under any of these conventions.")
    return lines


def _hypothesis(question: "Question", answer: "HypothesisScore") -> str:
    convention = answer.convention
    text = {
        "axes and direction": f"{convention.axes}, {'cam_from_world' if convention.inverted else 'world_from_cam'}",
        "image size": f"intrinsics for {convention.intrinsics_scale:g} x the size",
        "pixel centre": f"first pixel's centre at {convention.pixel_centre:g}",
    }[question.name]
    return f"{text} (the format's own)" if answer.as_format_says else text


def _verdict(question: "Question") -> str:
    if question.verdict != "holds":
        return f"{question.verdict}: {question.reason}"
    if question.ratio == float("inf"):
        return "fits; the next puts most of the evidence behind the cameras"
    return f"fits, {question.ratio:.3g} times better than the next"


def _axes(text: str | None, option: str) -> str:
    """Return the axes that are given; "", which stands for those of the format, if the option is left out."""
    if text == "":
        raise typer.BadParameter("'' names no axes; leave the option out for those of the format", param_hint=option)
    return text or ""


def _pixel_centre(text: str | None, option: str) -> float:
    return PIXEL_CENTRES[one_of("0.5" if text is None else text, PIXEL_CENTRES, option)]


def place_of(given: Given, target: Path) -> Path:
    """Return where an input is converted to: of several, to a path in the folder `target` that is named after it.

    This is a file's name without suffix, or that of its folder if its own tells nothing.
    """
    if not given.one_of_many:
        return target
    named = given.path
    if os.path.isfile(named):
        named = named.parent if named.stem in COMMON_STEMS else named.with_suffix("")
    place = target / beside(named, "").name
    given.refuse_taken(place)
    return place
