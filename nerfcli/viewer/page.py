"""The page that renders a field: one HTML file by itself, opened from a disk; or live, from a server of ours."""

import base64
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

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
LIVE_SCRIPTS = ("remote.js", "live.js")


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
    """Return the text of a page that needs no server.

    Args:
        model: what it shows.
        packed: its numbers.
        run: the folder; its name stands on the page.
        frames: pinhole ones, at least one; the page begins at the middle one.
        photos: what it holds of photos.
        proof: what it compares itself with.
        box: low and high corner that the crop box begins with, scene units.
    """
    scene = _scene(model, run=run, frames=frames, photos=photos.entries, box=box)
    scene |= {"field": packed.field, "march": packed.march, "proof": proof.description}
    return _html(scene, {**packed.arrays, "expected": proof.expected}, run=run, connect=False)


def live_page_html(
    model: Model,
    *,
    run: Path,
    frames: Sequence[Frame],
    photos: Sequence[dict[str, Any]],
    box: Sequence[float],
    version: int,
    refusal: str | None,
) -> str:
    """Return the text of a page that fetches its field and pictures from the server it came from.

    Args:
        model, run, frames, box: as for `page_html`.
        photos: see `pictures.fetched_photos`.
        version: of the field, see `server.Show.status`.
        refusal: why the page cannot draw this field by itself; None if it can.
    """
    scene = _scene(model, run=run, frames=frames, photos=photos, box=box)
    scene |= {"live": {"refusal": refusal, "version": version}, "march": {"far": model.marching.far}}
    return _html(scene, {}, run=run, connect=True)


def _scene(
    model: Model, *, run: Path, frames: Sequence[Frame], photos: Sequence[dict[str, Any]], box: Sequence[float]
) -> dict[str, Any]:
    """What both kinds of page have, plain values."""
    size = 1.0 / model.training_from_scene.scale
    home = view_of(frames[len(frames) // 2])
    unit = {"metre": "metres", "arbitrary": "arbitrary units"}.get(model.unit, model.unit)
    source = f" ({model.unit_source})" if model.unit_source else ""
    held_out = sum(entry["split"] == "test" for entry in photos)
    return {
        "format": FORMAT,
        "run": run.resolve().name,
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


def _html(scene: dict[str, Any], arrays: Mapping[str, np.ndarray], *, run: Path, connect: bool) -> str:
    """The page around a scene."""
    shaders = "".join(_element(part, "x-shader/x-fragment", _text(f"{part}.glsl")) for part in ("trace", "show"))
    body = "\n".join(
        [
            _text("body.html"),
            shaders,
            *(_element(k, "text/plain", _base64(v)) for k, v in {**arrays, "colours": levels_of("turbo")}.items()),
            page.data_element("scene", scene),
        ]
    )
    parts = (*SCRIPTS, *(LIVE_SCRIPTS if connect else ()), "main.js")
    script = "\n".join(_text(part).replace('"use strict";\n', "") for part in parts)
    return page.page_html(
        title=scene["run"],
        mark=page.Mark("page", run),
        style=_text("page.css"),
        body=body,
        script=f'"use strict";\n{script}',
        connect=connect,
    )


def _element(name: str, kind: str, text: str) -> str:
    return f'<script type="{kind}" id="{name}">{text}</script>'


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


@cache
def _text(name: str) -> str:
    """The text of a part of the page that stands beside this file."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
