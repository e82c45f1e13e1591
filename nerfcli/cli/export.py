"""nerfcli export: a run as a page, a mesh, points, a volume, or COLMAP's dense folder."""

import math
from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Device, Json, Output, Overwrite, Quiet, Threads, device_name, one_of, thread_count
from nerfcli.cli.render_options import finite


@command
def export(
    run: Annotated[str, typer.Argument(help="The folder that train wrote, or - for runs on standard input.")],
    to: Annotated[str, typer.Option("--to", help="page, mesh, points, volume, tsdf or colmap-dense.")],
    output: Output = None,
    form: Annotated[
        str | None,
        typer.Option("--format", help="Of the file, where -o does not say: ply, glb or obj; npz or nrrd."),
    ] = None,
    box: Annotated[
        str | None,
        typer.Option(help="X0,Y0,Z0,X1,Y1,Z1 in the scene's units.  [default: what the photos are about]"),
    ] = None,
    voxel_size: Annotated[
        float | None, typer.Option(help="In the scene's units.  [default: what the photos resolve]")
    ] = None,
    faces: Annotated[int, typer.Option(help="Triangles of a mesh at most.", min=4)] = 300_000,
    max_size: Annotated[
        int, typer.Option(help="Longer side of the pictures whose depths are fused, pixels.", min=16, max=8192)
    ] = 480,
    device: Device = "auto",
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Export a run as a page, a mesh, points, a volume, or for COLMAP.

    Everything is in the scene's frame and unit, and says so: nerfcli info reads it back.

    \b
    page          one .html that renders the field itself in a browser (WebGL2), opened from the disk, without a server
    mesh          .ply, .glb or .obj: where truncated signed distances of median depths are 0, with colours of the field
    points        .ply: where median and mean agree and two photos see the same, with normals, photos, parallax, spread
    volume        .npz (density, colour) or .nrrd (density, 1 / unit)
    tsdf          .npz (signed distance, weight) or .nrrd (signed distance): what the mesh is made from
    colmap-dense  a folder with undistorted photos, depth and normal maps that COLMAP's fusion reads

    Writes beside the run, RUN.html or RUN-mesh.ply. What no photo sees is never closed by a surface. In a .glb the turn
    to +Y up is the root node's; positions stay in the scene's frame.

    \b
    Examples:
      nerfcli export photos-scene-run --to page
      nerfcli export photos-scene-run --to mesh --voxel-size 0.005 --faces 100000 -o kitchen.glb
      nerfcli export photos-scene-run --to mesh --box=-1,-1,0,1,1,2
      nerfcli export photos-scene-run --to points -o kitchen.ply
      nerfcli export photos-scene-run --to volume --format nrrd
      nerfcli export photos-scene-run --to colmap-dense -o kitchen-dense
    """
    from nerfcli.surface.settings import SurfaceSettings
    from nerfcli.workflows.export import TARGETS, default_target, export_run

    one_of(to, tuple(TARGETS), "--to")
    suffix = None if form is None else f".{form.lstrip('.').lower()}"
    if suffix is not None:
        one_of(suffix[1:], [kind[1:] for kind in TARGETS[to] if kind] or ["none"], "--format")
    finite(voxel_size, "--voxel-size")
    if voxel_size is not None and voxel_size <= 0:
        raise typer.BadParameter(f"{voxel_size:g} is no size", param_hint="--voxel-size")
    settings = SurfaceSettings(
        box=None if box is None else box_of(box), voxel_size=voxel_size, faces=faces, max_size=max_size
    )
    console = Console(quiet=quiet, json_lines=json)

    def work(folder: Path, one_of_many: bool) -> None:
        target = output
        if output is None or one_of_many:
            usual = default_target(folder, to, suffix)
            target = usual if output is None else output / usual.name
        with console.progress(f"export {to}") as update:
            written = export_run(
                folder,
                target,
                to=to,
                settings=settings,
                device=device_name(device),
                threads=thread_count(threads),
                overwrite=overwrite,
                notify=console.note,
                progress=update,
            )
        console.result(written)

    for_each_input(run, work)


def box_of(text: str) -> tuple[float, ...]:
    """Six numbers with commas between them.

    Raises:
        typer.BadParameter: anything else, or a low corner that is not below the high one.
    """
    try:
        box = tuple(float(value) for value in text.split(","))
    except ValueError:
        box = ()
    if len(box) != 6 or not all(math.isfinite(value) for value in box):
        raise typer.BadParameter(f"{text!r}; write X0,Y0,Z0,X1,Y1,Z1", param_hint="--box")
    if not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise typer.BadParameter(f"{text!r}; the low corner comes first", param_hint="--box")
    return box
