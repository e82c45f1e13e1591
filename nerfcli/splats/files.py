"""Files of splats by their suffix, and the page with a viewer and splats inside."""

import gzip
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured

from nerfcli.errors import UserError, listed, several
from nerfcli.export.mesh_facts import NOT_STATED
from nerfcli.pages.page import Mark, array_element, asset, data_element, page_html, write_page
from nerfcli.ply import description_in, ply_bytes, read_ply_header, read_ply_vertices, write_ply
from nerfcli.splats.gaussians import Gaussians
from nerfcli.splats.spz import packed, read_spz, unpacked, write_spz

# Logit that stands for an infinite one, in files in which an opacity of exactly 1 or 0 was converted: 1 - 2e-9.
_CERTAIN = 20.0
# Rows converted at a time: 16 MB of a file of degree 3.
_ROWS = 2**16
_ELSEWHERE = "open it in SuperSplat (superspl.at/editor) and export it as .ply"


def splat_columns(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the properties (N,) of a file by name, in the order of files; quaternions have norm 1."""
    count, harmonics = len(gaussians), gaussians.harmonics
    norms = np.linalg.norm(gaussians.quaternions.astype(np.float64), axis=1, keepdims=True)
    values = [
        *(gaussians.means, np.zeros((count, 3)), harmonics[:, 0]),
        *(harmonics[:, 1:].transpose(0, 2, 1).reshape(count, -1), gaussians.logits[:, None]),
        *(gaussians.log_scales, gaussians.quaternions / norms),
    ]
    names = [*("x", "y", "z", "nx", "ny", "nz"), *_names(gaussians.degree)[3:]]
    columns = np.concatenate(values, axis=1, dtype=np.float32, casting="same_kind").T
    return dict(zip(names, columns, strict=True))


def read_splat_ply(path: Path, notify: Callable[[str], None]) -> Gaussians:
    """Read Gaussians that any program wrote: properties in any order, further ones and further elements ignored.

    A binary file is mapped, not loaded. Infinite logits become +-20; Gaussians with other numbers that are not finite,
    or with a quaternion of norm 0, are left out, and `notify` is called with their number.

    Raises:
        UserError: it is no such file, or truncated, or none of its Gaussians is finite.
    """
    header = read_ply_header(path)
    properties = header.vertex_properties
    if "packed_position" in properties or header.count("chunk"):
        raise UserError(f"{path} is a compressed .ply of PlayCanvas, which nerfcli does not read", _ELSEWHERE)
    if missing := [name for name in _names(0) if name not in properties]:
        what = "a mesh" if header.count("face") else "points" if "x" in properties else "something else"
        hint = "expected the .ply of 3D Gaussian splatting, whose vertices have x, f_dc_0, opacity, scale_0, rot_0, ..."
        raise UserError(f"{path} holds {what}, not splats: {listed(missing)} missing", hint)
    rest = sum(name.startswith("f_rest_") for name in properties)
    degree = {0: 0, 9: 1, 24: 2, 45: 3}.get(rest)
    if degree is None or not properties.keys() >= set(_names(degree)):
        raise UserError(
            f"{path} has {rest} properties f_rest_, expected f_rest_0 to f_rest_8, f_rest_23 or f_rest_44, or none",
            f"nerfcli reads harmonics of degrees 0 to 3; {_ELSEWHERE}",
        )
    table = read_ply_vertices(path)
    if not len(table):
        raise UserError(f"{path} contains no splats", "export it again")
    return _from_table(path, table, _names(degree), notify=notify)


def _from_table(path: Path, table: np.ndarray, names: list[str], *, notify: Callable[[str], None]) -> Gaussians:
    """Return the Gaussians of a table whose columns have the names of `_names`."""
    shapes = ((3,), (3,), (4,), (), ((len(names) - 11) // 3, 3))
    arrays = [np.empty((len(table), *shape), np.float32) for shape in shapes]
    kept = 0
    for at in range(0, len(table), _ROWS):
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite, and is left out below
            values = structured_to_unstructured(table[at : at + _ROWS][names], np.float32, copy=True)
        logits = values[:, -8]
        np.copyto(logits, np.sign(logits) * np.float32(_CERTAIN), where=np.isinf(logits))
        # The norm of smaller ones, squared, is 0 in float32.
        values = values[np.isfinite(values).all(axis=1) & (np.abs(values[:, -4:]).max(axis=1) > 1e-18)]
        rest = values[:, 6:-8].reshape(len(values), 3, (len(names) - 14) // 3)
        harmonics = np.concatenate([values[:, None, 3:6], rest.transpose(0, 2, 1)], axis=1)
        parts = (values[:, :3], values[:, -7:-4], values[:, -4:], values[:, -8], harmonics)
        for array, part in zip(arrays, parts, strict=True):
            array[kept : kept + len(values)] = part
        kept += len(values)
    if not kept:
        raise UserError(f"{path}: none of its {several(len(table), 'splat')} has finite numbers", "export it again")
    if kept < len(table):
        notify(f"{path}: {len(table) - kept} of {len(table)} splats left out, whose numbers are not finite")
    return Gaussians(*(array[:kept] for array in arrays))


def _names(degree: int) -> list[str]:
    """Return the names of the properties, in the order of files, without the normals."""
    return [
        *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{index}" for index in range(3 * ((degree + 1) ** 2 - 1))),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


SUFFIXES = (".ply", ".spz")


def read_splats(path: Path, notify: Callable[[str], None]) -> tuple[Gaussians, dict[str, Any]]:
    """Read Gaussians from a .ply or .spz of any program, in the frame of the file, and nerfcli's description of them.

    Returns:
        The Gaussians; the description that `write_splats` was given, empty in files of other programs.

    Raises:
        UserError: the file is missing, damaged or of another kind.
    """
    if not path.is_file():
        raise UserError(f"{path} does not exist", "give a .ply or .spz of splats")
    if _suffix(path) == ".spz":
        return read_spz(path, notify)
    return read_splat_ply(path, notify), description_in(read_ply_header(path).comments)


def write_splats(
    path: Path, gaussians: Gaussians, *, description: Mapping[str, Any] | None, notify: Callable[[str], None]
) -> None:
    """Write Gaussians, atomically, as .ply or .spz by the suffix.

    Viewers expect y to point down; see `Gaussians.moved`.

    Args:
        description: unit, frame and others, as in `export.meshes`; in a .spz it is the comment of the gzip stream.
    """
    if _suffix(path) == ".spz":
        write_spz(path, gaussians, description, notify=notify)
    else:
        write_ply(path, splat_columns(gaussians), description=description)


def splat_facts(path: Path) -> dict[str, Any]:
    """Return the facts about a file of splats as plain values, for `nerfcli info`."""
    gaussians, described = read_splats(path, lambda text: None)
    low, high = (np.round(np.quantile(gaussians.means, share, axis=0), 4).tolist() for share in (0.01, 0.99))
    opacities = 1.0 / (1.0 + np.exp(-gaussians.logits.astype(np.float64)))
    return {
        "kind": "splats",
        "splats": len(gaussians),
        "degree": gaussians.degree,
        "median_opacity": round(float(np.median(opacities)), 3),
        "98_percent_between": [low, high],
        **(described or {"not_stated": NOT_STATED}),
        "format": path.suffix[1:].upper(),
    }


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(
            f"{path} is not a supported file of splats: its suffix is neither .ply nor .spz",
            "convert others: npx @playcanvas/splat-transform in.sog out.ply",
        )
    return suffix


_FULL_WINDOW = "html,body,main,#stage{height:100%;overflow:hidden}main{max-width:none;padding:0}"
# The viewer in the page compiles WebAssembly, and makes pictures and workers itself.
_SOURCES = {"script-src": "'unsafe-inline' 'wasm-unsafe-eval'", "img-src": "data: blob:", "worker-src": "blob:"}


def write_splat_page(
    path: Path,
    gaussians: Gaussians,
    *,
    run: Path,
    world_from_cam: np.ndarray,
    fov_deg: float,
    background: Sequence[float],
    notify: Callable[[str], None],
) -> None:
    """Write a page with the Gaussians in the precision of .spz (see `spz.packed`), atomically.

    Args:
        gaussians: in a frame whose y points down; the viewer's horizon is level in it.
        world_from_cam: (4, 4) camera of the first view, in that frame; its roll is not kept.
        fov_deg: vertical field of view of the first view, in degrees.
    """
    centre, forward = world_from_cam[:3, 3], world_from_cam[:3, 2]
    target = centre + _distance(gaussians, world_from_cam, fov_deg) * forward
    turned = np.array([-1.0, -1.0, 1.0])  # the viewer turns every file half around z, for y to point up
    first = {"position": (turned * centre).tolist(), "target": (turned * target).tolist(), "fov": float(fov_deg)}
    data, note = packed(gaussians)
    shown = ply_bytes(splat_columns(unpacked(data)))
    level = ",".join(str(round(255 * value)) for value in background)
    body = (
        f"<!--\n{_part('supersplat_viewer.txt').decode()}-->",
        '<div id="stage"></div>',
        "<noscript>This page draws its splats with JavaScript, which is switched off here.</noscript>",
        data_element("scene", {"first": first, "background": [float(value) for value in background]}),
        array_element("viewer", np.frombuffer(gzip.decompress(_part("supersplat_viewer.js.gz")), np.uint8)),
        array_element("splats", np.frombuffer(shown, np.uint8)),
    )
    text = page_html(
        title=run.resolve().name,
        mark=Mark("splats", run),
        style=f"{_FULL_WINDOW}#stage{{background:rgb({level})}}\n{_part('supersplat_viewer.css').decode()}",
        body="\n".join(body),
        script=asset("arrays.js") + _part("page.js").decode(),
        sources=_SOURCES,
    )
    write_page(text, path)
    if note:
        notify(f"{path}: {note}")


def _part(name: str) -> bytes:
    """Read a part of the page from the file of that name beside this one."""
    return Path(__file__).with_name(name).read_bytes()


def _distance(gaussians: Gaussians, world_from_cam: np.ndarray, fov_deg: float) -> float:
    """Return the distance around which the view turns: the median depth in the middle of the first view."""
    x, y, z = ((gaussians.means - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]).T
    reach = math.tan(math.radians(fov_deg) / 2) / 4
    seen = (z > 0) & (gaussians.logits > 0)
    middle = seen & (np.maximum(np.abs(x), np.abs(y)) < reach * z)
    return float(np.median(z[middle])) if middle.any() else float(np.median(z[seen])) if seen.any() else 1.0
