"""The page that renders a field: a self-contained HTML file, or a live page from nerfcli's own server."""

from collections.abc import Sequence
from functools import cache
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli import __version__
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import up_direction
from nerfcli.errors import in_shell
from nerfcli.pages import page
from nerfcli.photos.colours import levels_of
from nerfcli.render.model import Model
from nerfcli.render.tracing import TOLERANCE
from nerfcli.viewer.packing import PackedField
from nerfcli.viewer.pictures import Proof, frustum_depth, view_of

FORMAT = "nerfcli page 1"
SCRIPTS = ("geometry.js", "field.js", "render.js", "schedule.js", "walk.js", "path.js", "overlay.js", "check.js")
LIVE_SCRIPTS = ("remote.js", "live.js")


def numbers_of(packed: PackedField, proof: Proof, seen: np.ndarray) -> tuple[dict[str, Any], str]:
    """Return a packed field with its proof and its `seen_cells`, as the page stores them.

    Returns:
        Plain values, and HTML elements with the compressed arrays.
    """
    description = {"field": packed.field, "march": packed.march, "proof": proof.description, "seen": len(seen)}
    arrays = {**packed.arrays, "expected": proof.expected, "seen": seen}
    return description, "\n".join(starmap(page.array_element, arrays.items()))


def live_page_html(scene: dict[str, Any], *, version: int, refusal: str | None, far: float) -> str:
    """Return the text of a page that fetches its field and pictures from the server that sent it.

    Args:
        scene: see `scene_of`, with the photos of `pictures.fetched_photos`.
        version: version of the field, see `server.PageData.version`.
        refusal: reason why the page cannot draw this field itself; None if it can.
        far: end of the rays, training frame.
    """
    live = {"live": {"refusal": refusal, "version": version}, "march": {"far": far}}
    return page_html(scene | live, "")


def scene_of(
    model: Model, *, run: Path, frames: Sequence[Frame], photos: Sequence[dict[str, Any]], box: Sequence[float]
) -> dict[str, Any]:
    """Return the plain values that both kinds of page contain.

    Args:
        frames: pinhole frames, at least one; the first view is that of the middle one.
        box: low and high corner of the initial crop box, scene units.
    """
    name, size = run.resolve().name, 1.0 / model.training_from_scene.scale
    home = view_of(frames[len(frames) // 2])
    unit = {"metre": "metres", "arbitrary": "arbitrary units"}.get(model.unit, model.unit)
    source = f" ({model.unit_source})" if model.unit_source else ""
    held_out = sum(entry["split"] == "test" for entry in photos)
    return {
        "format": FORMAT,
        "run": name,
        "run_in_shell": in_shell(Path(name)),
        "about": f"nerfcli {__version__}, field {str(model.sha256)[:12]}. Lengths in {unit}{source}, in the frame of "
        f"the scene. {len(photos)} photos, {held_out} held out.",
        "unit": model.unit,
        "training_from_scene": model.training_from_scene.to_json(),
        "tolerance": TOLERANCE,
        "size": size,
        "up": up_direction(frames).tolist(),
        "home": {**home, "fov": 2 * float(np.arctan2(home["height"] / 2, home["lens"][1]))},
        "frustum": frustum_depth(frames, size),
        "box": [float(value) for value in box],
        "photos": list(photos),
    }


def page_html(scene: dict[str, Any], numbers: str) -> str:
    """Return the text of a page.

    Args:
        scene: see `scene_of`, with the plain values of `numbers_of`; or "live" for a page that fetches its field.
        numbers: the elements of `numbers_of`.
    """
    shaders = "".join(
        f'<script type="x-shader/x-fragment" id="{part}">{_text(f"{part}.glsl")}</script>' for part in ("trace", "show")
    )
    body = "\n".join(
        [
            _text("body.html"),
            shaders,
            page.array_element("colours", levels_of("turbo")),
            numbers,
            page.data_element("scene", scene),
        ]
    )
    is_live = "live" in scene
    parts = (*SCRIPTS, *(LIVE_SCRIPTS if is_live else ()), "main.js")
    script = "\n".join((page.asset("arrays.js"), *map(_text, parts))).replace('"use strict";\n', "")
    return page.page_html(
        title=scene["run"],
        mark=page.Mark("page", Path(scene["run"])),
        style=_text("page.css"),
        body=body,
        script=f'"use strict";\n{script}',
        sources=page.FROM_ITS_SERVER if is_live else page.FROM_INSIDE,
    )


@cache
def _text(name: str) -> str:
    """Read a part of the page from the file of that name beside this one."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
