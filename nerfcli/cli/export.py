"""nerfcli export: export a run as a page, a mesh, points or splats."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import STDIN, Given, for_each_input
from nerfcli.cli.console import command
from nerfcli.cli.options import Computing, Printing, Writing, finite, one_of, refuse_unused, seconds_from_text

if TYPE_CHECKING:
    from nerfcli.export.extent import SurfaceSettings
    from nerfcli.workflows.splats import SplatSettings


@dataclass(frozen=True)
class SurfaceOptions:
    """Options of meshes and points."""

    box: Annotated[
        str | None,
        typer.Option(help="Exported region X0,Y0,Z0,X1,Y1,Z1, in scene units.  [default: the subject of the photos]"),
    ] = None
    voxel_size: Annotated[
        float | None, typer.Option(help="Size of a voxel in scene units.  [default: the resolution of the photos]")
    ] = None
    faces: Annotated[
        int | None,
        typer.Option(help="Maximum number of triangles of a mesh.  [default: 300000]", min=4, show_default=False),
    ] = None

    def settings(self) -> "SurfaceSettings":
        """Return the settings that the options select."""
        from nerfcli.export.extent import FACES, SurfaceSettings

        finite(self.voxel_size, "--voxel-size")
        if self.voxel_size is not None and self.voxel_size <= 0:
            raise typer.BadParameter(f"{self.voxel_size:g} is not a positive size", param_hint="--voxel-size")
        try:
            box = None if self.box is None else tuple(map(float, self.box.split(",")))
        except ValueError as error:
            raise typer.BadParameter(f"{self.box!r}; write X0,Y0,Z0,X1,Y1,Z1", param_hint="--box") from error
        return SurfaceSettings(box, self.voxel_size, faces=self.faces or FACES)


@dataclass(frozen=True)
class SplatOptions:
    """Options of splats."""

    count: Annotated[
        int | None,
        typer.Option(help="Maximum number of splats.  [default: by photos and budget]", min=100, max=10_000_000),
    ] = None
    budget: Annotated[
        str | None, typer.Option(help="Time to refine splats on the training photos.  [default: 60s]")
    ] = None
    sh: Annotated[
        int | None, typer.Option(help="Degree of the spherical harmonics of splat colours.  [default: 2]", min=0, max=3)
    ] = None
    frame: Annotated[
        str | None,
        typer.Option(help="Frame of splats: viewer (y down, as viewers expect) or scene.  [default: viewer]"),
    ] = None
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue to refine the splats of the run, to a larger --budget.")
    ] = False

    def settings(self) -> "SplatSettings":
        """Return the settings that the options select."""
        from nerfcli.workflows.splats import SplatSettings

        return SplatSettings(
            self.count,
            60.0 if self.budget is None else seconds_from_text(self.budget),
            2 if self.sh is None else self.sh,
            one_of(self.frame or "viewer", ("viewer", "scene"), "--frame"),
            self.resume,
        )


@command
def export(
    run: Annotated[str, typer.Argument(help="Run folder written by train, or - to read paths from standard input.")],
    to: Annotated[str, typer.Option("--to", help="What to export: page, mesh, points or splats.")],
    *,
    form: Annotated[
        str | None, typer.Option("--format", help="File format if -o does not determine it: ply, glb, obj, spz, html.")
    ] = None,
    surface: SurfaceOptions,
    splats: SplatOptions,
    writing: Writing,
    computing: Computing,
    printing: Printing,
) -> None:
    """Export a run: page, mesh, points, splats.

    All results are in the frame and unit of the scene, splats turned so that y points down. Files state both; nerfcli
    info shows them.

    \b
    page    one .html that renders the field in a browser (WebGL2), from the disk, without a server
    mesh    .ply, .glb or .obj: zero level of truncated signed distances from median depths, with colours
    points  .ply: where median and mean depth agree and two photos see the same point, with normals,
            photos, parallax and spread
    splats  Gaussians for SuperSplat, Spark, Blender and game engines: .ply, .spz (a fifth of the size), or one
            .html that shows them without a network; refined on the training photos

    Writes RUN.html, RUN-mesh.ply, ... next to the run. Regions that no photo sees stay open. In a .glb, the rotation to
    +Y up is in the root node; positions stay in the scene's frame.

    \b
    Examples:
      nerfcli export photos-scene-run --to page
      nerfcli export photos-scene-run --to mesh --voxel-size 0.005 --faces 100000 -o kitchen.glb
      nerfcli export photos-scene-run --to mesh --box=-1,-1,0,1,1,2
      nerfcli export photos-scene-run --to points -o kitchen.ply
      nerfcli export photos-scene-run --to splats -o kitchen.spz --budget 2m
      nerfcli export photos-scene-run --to splats -o kitchen.html --budget 5m --resume
    """
    from nerfcli.workflows.export import TARGETS, default_target, export_run

    one_of(to, TARGETS, "--to")
    suffix = None if form is None else f".{form.lstrip('.').lower()}"
    if suffix is not None:
        one_of(suffix[1:], [kind[1:] for kind in TARGETS[to]], "--format")
    _refuse_unused(to, surface, splats)
    output = writing.output
    if suffix is not None and output is not None and run != STDIN and output.suffix.lower() not in ("", suffix):
        raise typer.BadParameter(f"{form!r} contradicts -o {output}; remove one of them", param_hint="--format")
    geometry, gaussians, console = surface.settings(), splats.settings(), printing.console

    def work(given: Given) -> None:
        target = writing.named(given, default_target(given.path, to, suffix))
        if suffix is not None and target.path is not None and not Path(target.path).suffix:
            target = replace(target, path=Path(target.path).with_suffix(suffix))
        with console.stage(f"export {to}") as reporter:
            written = export_run(
                given.path,
                target,
                to=to,
                settings=geometry,
                splats=gaussians,
                resources=computing.resources,
                reporter=reporter,
            )
        console.result(written)

    for_each_input(run, work, command="export")


def _refuse_unused(to: str, surface: SurfaceOptions, splats: SplatOptions) -> None:
    unused = {
        "--box": (surface.box is not None and to == "splats", "pages, meshes and points"),
        "--faces": (surface.faces is not None and to != "mesh", "meshes"),
        "--voxel-size": (surface.voxel_size is not None and to not in ("mesh", "points"), "meshes and points"),
    }
    for name, value in vars(splats).items():
        unused[f"--{name}"] = (to != "splats" and value is not None and value is not False, "splats")
    refuse_unused(unused, "it is for {}; remove it")
