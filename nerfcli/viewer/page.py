"""One HTML file that renders a field by itself: no server, no download, opened from a disk."""

import base64
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from nerfcli import __version__
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import up_direction
from nerfcli.media.colour_maps import levels_of
from nerfcli.pages import page
from nerfcli.render.model import Model
from nerfcli.render.tracing import TOLERANCE
from nerfcli.viewer.packing import Packed
from nerfcli.viewer.pictures import PagePhotos, frustum_depth, view_of
from nerfcli.viewer.proof import Proof

FORMAT = "nerfcli page 1"
SCRIPTS = ("geometry.js", "field.js", "render.js", "schedule.js", "walk.js", "path.js", "overlay.js", "check.js")


def page_html(
    model: Model,
    packed: Packed,
    *,
    run: Path,
    frames: Sequence[Frame],
    photos: PagePhotos,
    proof: Proof,
    box: Sequence[float],
) -> str:
    """Return the page's text.

    Args:
        model: what it shows.
        packed: its numbers.
        run: the folder; its name stands on the page.
        frames: pinhole ones, at least one; the page begins at the middle one.
        photos: what it holds of photos.
        proof: what it compares itself with.
        box: low and high corner that the crop box begins with, scene units.
    """
    size = 1.0 / model.training_from_scene.scale
    home = view_of(frames[len(frames) // 2])
    name = run.resolve().name
    unit = {"metre": "metres", "arbitrary": "arbitrary units"}.get(model.unit, model.unit)
    source = f" ({model.unit_source})" if model.unit_source else ""
    held_out = sum(entry["split"] == "test" for entry in photos.entries)
    scene = {
        "format": FORMAT,
        "run": name,
        "about": f"nerfcli {__version__}, field {str(model.sha256)[:12]}. Lengths in {unit}{source}, in the frame of "
        f"the scene. {len(photos.entries)} photos, {held_out} held out.",
        "unit": model.unit,
        "training_from_scene": model.training_from_scene.to_json(),
        "tolerance": TOLERANCE,
        "field": packed.field,
        "march": packed.march,
        "size": size,
        "up": up_direction(frames).tolist(),
        "home": {**home, "fov": 2 * float(np.arctan2(home["height"] / 2, home["lens"][1]))},
        "frustum": frustum_depth(frames, size),
        "box": [float(value) for value in box],
        "photos": photos.entries,
        "proof": proof.description,
    }
    arrays = {**packed.arrays, "colours": levels_of("turbo"), "expected": proof.expected}
    shaders = "".join(_element(part, "x-shader/x-fragment", _text(f"{part}.glsl")) for part in ("trace", "show"))
    body = "\n".join(
        [
            _text("body.html"),
            shaders,
            *(_element(key, "text/plain", _base64(values)) for key, values in arrays.items()),
            page.data_element("scene", scene),
        ]
    )
    script = "\n".join(_text(part).replace('"use strict";\n', "") for part in (*SCRIPTS, "main.js"))
    return page.page_html(
        title=name, mark=page.Mark("page", run), style=_text("page.css"), body=body, script=f'"use strict";\n{script}'
    )


def _element(name: str, kind: str, text: str) -> str:
    return f'<script type="{kind}" id="{name}">{text}</script>'


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


@cache
def _text(name: str) -> str:
    """The text of a part of the page that stands beside this file."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
