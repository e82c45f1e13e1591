"""Options that earlier versions had and what to use instead, for one release each."""

from collections.abc import Sequence
from typing import NamedTuple

from nerfcli.errors import UserError


class Removed(NamedTuple):
    """An option that a command no longer has, or no longer takes a value of.

    Args:
        command: name of the command.
        name: the option, "--members", or the option with one of its values, "--to tsdf".
        since: date of the removal.
        instead: what to use, for the hint.
    """

    command: str
    name: str
    since: str
    instead: str


REMOVED: tuple[Removed, ...] = (
    Removed("ablate", "--holdout", "2026-11-29", "the split of the scene is used"),
    Removed("ablate", "--memory", "2026-11-29", "the default, 4/5 of the memory, is used"),
    Removed("ablate", "--model", "2026-11-29", "the variants are of the model that is selected for the scene"),
    Removed("ablate", "--whole", "2026-11-29", "evaluate the runs in the folder of the ablation"),
    Removed("ablate", "--with", "2026-11-29", "name the components to vary with --only"),
    Removed("ablate", "--without", "2026-11-29", "name the components to vary with --only"),
    Removed("bench", "--seed", "2026-11-29", "trainings with other seeds are among the settings of a scene"),
    Removed("bench", "--sweep", "2026-11-29", "give a run for rendering settings, a scene for trainings"),
    Removed("convert", "--georeference", "2026-11-29", "use --scale gps for metres; for surveys, see docs/formats.md"),
    Removed("convert", "--no-verify", "2026-11-29", "remove it: every file is read back and compared"),
    Removed("convert", "--to astra", "2026-11-29", "scene.json in the folder of the scan has the vectors of ASTRA"),
    Removed("convert", "--to npz", "2026-11-29", "use --to nerfcli (a scene folder), or --to colmap without photos"),
    Removed("convert", "--tolerance", "2026-11-29", "remove it: a file is kept if no ray is off by more than 1e-6 px"),
    Removed("convert", "--verify", "2026-11-29", "remove it: every file is read back and compared"),
    Removed("doctor", "--views", "2026-11-29", "find what few photos see with render RUN --outputs coverage,parallax"),
    Removed("evaluate", "--align", "2026-11-29", "psnr_colour_aligned in metrics.json is after a colour correction"),
    Removed("evaluate", "--dry-run", "2026-11-29", "time three views: nerfcli render RUN --frames 0:3 -o three"),
    Removed("evaluate", "--members", "2026-11-29", "train with --seed 1, --seed 2, ... and evaluate each run"),
    Removed("evaluate", "--seeds", "2026-11-29", "train with --seed 1, --seed 2, ... and evaluate each run"),
    Removed("export", "--format las", "2026-11-29", "use --format ply, which CloudCompare and PDAL turn into las"),
    Removed("export", "--format laz", "2026-11-29", "use --format ply, which CloudCompare and PDAL turn into laz"),
    Removed("export", "--max-size", "2026-11-29", "set the detail of a mesh with --voxel-size"),
    Removed("export", "--to colmap-dense", "2026-11-29", "use --to points, which has normals, colours and parallax"),
    Removed("export", "--to ortho", "2026-11-29", "make maps with OpenDroneMap; see docs/formats.md, Surveys"),
    Removed("export", "--to tsdf", "2026-11-29", "use --to mesh, the surface of the signed distances"),
    Removed("poses", "--component", "2026-11-29", "put the photos of the other model into a folder of their own"),
    Removed("poses", "--drop-database", "2026-11-29", "delete database.db in the scene folder"),
    Removed("poses", "--intrinsics-as", "2026-11-29", "intrinsics are kept; without --intrinsics they are estimated"),
    Removed("poses", "--max-features", "2026-11-29", "use --quality fast, default or best"),
    Removed("poses", "--memory", "2026-11-29", "4/5 of the memory are used; --quality fast takes less"),
    Removed("poses", "--time-limit", "2026-11-29", "use timeout 10m nerfcli poses ..., and run it again to continue"),
    Removed("render", "--colour-map", "2026-11-29", "colour the depth files yourself, as docs/depth.md reads them"),
    Removed("render", "--colour-range", "2026-11-29", "colour the depth files yourself, as docs/depth.md reads them"),
    Removed("render", "--crf", "2026-11-29", "an mp4 has a constant rate factor of 16; make it smaller with ffmpeg"),
    Removed("render", "--depth-format npz", "2026-11-29", "use exr, which also holds all outputs of a view"),
    Removed("render", "--depth-scale", "2026-11-29", "each png16 states its scale; for another, scale the tiff"),
    Removed("render", "--depth-tolerance", "2026-11-29", "confidence counts depths within 2 %; see lower and upper"),
    Removed("render", "--direction", "2026-11-29", "reverse the video: ffmpeg -i in.mp4 -vf reverse out.mp4"),
    Removed("render", "--dry-run", "2026-11-29", "time three views: add --frames 0:3 -o three"),
    Removed("render", "--jobs", "2026-11-29", "use --threads, and --frames 1/2 and 2/2 for two processes"),
    Removed("render", "--level", "2026-11-29", "lower and upper are the ends of the 90 % interval"),
    Removed("render", "--loop", "2026-11-29", "a gif repeats forever; repeat an mp4 with ffmpeg -stream_loop"),
    Removed("render", "--nerfstudio-frame", "2026-11-29", "draw the path in nerfcli view, in the frame of the scene"),
    Removed("render", "--outputs colour_deviation", "2026-11-29", "use --outputs coverage,parallax; see docs/trust.md"),
    Removed("render", "--outputs depth_deviation", "2026-11-29", "use --outputs coverage,lower,upper; docs/trust.md"),
    Removed("render", "--samples-per-pixel", "2026-11-29", "render at twice the --width and --height, and reduce"),
    Removed("render", "--tolerance", "2026-11-29", "use --step: 2 is about twice as fast, 0.5 more exact"),
    Removed("render", "--video-format h265", "2026-11-29", "write mp4 (H.264), and encode it again with ffmpeg"),
    Removed("render", "--video-format webm", "2026-11-29", "write mp4 (H.264), and encode it again with ffmpeg"),
    Removed("render", "--video-layout", "2026-11-29", "put two videos beside each other with ffmpeg's filter hstack"),
    Removed("report", "--depth", "2026-11-29", "render RUN --depth shows other definitions of depth"),
    Removed("report", "--depth-axis", "2026-11-29", "depth is along the optical axis, of panoramas along the ray"),
    Removed("report", "--device", "2026-11-29", "a GPU is used if there is one; hide it with CUDA_VISIBLE_DEVICES="),
    Removed("report", "--views", "2026-11-29", "up to eight held-out photos are shown, from the worst to the best"),
    Removed("run", "--count", "2026-11-29", "render the run: nerfcli render RUN --cameras orbit --count 120"),
    Removed("run", "--intrinsics-as", "2026-11-29", "intrinsics are kept; without --intrinsics they are estimated"),
    Removed("run", "--max-size", "2026-11-29", "render the finished run: nerfcli render RUN --max-size 400"),
    Removed("run", "--model", "2026-11-29", "run the stages one by one; train has --model"),
    Removed("run", "--strict", "2026-11-29", "run the stages one by one; poses has --strict"),
    Removed("run", "--with", "2026-11-29", "run the stages one by one; train has --with"),
    Removed("run", "--without", "2026-11-29", "run the stages one by one; train has --without"),
    Removed("selftest", "--textbook", "2026-11-29", "the table of selftest has the textbook errors in two columns"),
    Removed("selftest", "--threads", "2026-11-29", "all threads are used; results do not depend on their number"),
    Removed("train", "--blocks", "2026-11-29", "train one field; see docs/many-captures.md for what it bears"),
    Removed("train", "--contraction linf", "2026-11-29", "use --contraction l2, the default for what fills the frame"),
    Removed("train", "--levels", "2026-11-29", "8 levels are used; set the size of the field with --log2-rows"),
    Removed("train", "--members", "2026-11-29", "train with --seed 1, --seed 2, ...; see docs/uncertainty.md"),
    Removed("train", "--vary", "2026-11-29", "train with --seed 1, --seed 2, ...; see docs/uncertainty.md"),
    Removed("train", "--view", "2026-11-29", "in another terminal, nerfcli view RUN shows the newest checkpoint"),
    Removed("train", "--width", "2026-11-29", "networks have width 32; set the size of the field with --log2-rows"),
    Removed("train", "--with entropy", "2026-11-29", "use --with distortion, which also clears haze"),
    Removed("train", "--with movers", "2026-11-29", "mask what moves; occluders are left out without it"),
    Removed("train", "--with overlap", "2026-11-29", "use --with points and --with near, which is on by default"),
    Removed("train", "--with pixels", "2026-11-29", "leave it out: pixels are drawn anywhere"),
    Removed("view", "--json", "2026-11-29", "the address is the only line on stdout"),
    Removed("view", "--quiet", "2026-11-29", "notes go to stderr: add 2>/dev/null"),
)


def refuse_removed(command: str, arguments: Sequence[str]) -> None:
    """Refuse the arguments of a command if one of them is an option, or a value of one, that was removed.

    Raises:
        UserError: one is; the hint says what to use instead.
    """
    for removed in REMOVED:
        option, _, value = removed.name.partition(" ")
        if removed.command == command and any(value in ("", *given) for given in _values(option, arguments)):
            raise UserError(f"{removed.name} was removed on {removed.since}", removed.instead, 2)


def _values(option: str, arguments: Sequence[str]) -> list[list[str]]:
    """Return what follows each use of an option: the items of a comma-separated list, each without "=VALUE" too."""
    found = []
    for argument, following in zip(arguments, [*arguments, ""][1:], strict=True):
        name, joined, text = argument.partition("=")
        if name == option:
            items = (text if joined else following).split(",")
            found.append([*items, *(item.partition("=")[0] for item in items)])
    return found
