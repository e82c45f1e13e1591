"""The walk over all frames of an export: each rendered and written, then what needs all of them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli import __version__
from nerfcli.atomic import atomic_folder, write_json
from nerfcli.cameras.frame import Frame
from nerfcli.export.names import describe_frames, file_names
from nerfcli.export.picture_files import read_values, write_picture
from nerfcli.export.settings import ExportSettings, depth_meta
from nerfcli.media.depth import DepthMeta
from nerfcli.media.images import read_image, write_png
from nerfcli.media.preview import depth_range, preview
from nerfcli.media.video import VideoWriter
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture

DESCRIPTION = "render.json"


def export_frames(
    model: Model,
    frames: Sequence[Frame],
    folder: Path,
    settings: ExportSettings,
    *,
    provenance: dict[str, Any],
    on_rays: Callable[[int], None],
) -> list[Path]:
    """Render every frame and write what `settings` asks for; the folder appears when it is complete.

    Layout: rgb/NAME.png, depth/NAME.tiff with depth/NAME.png to look at, opacity/NAME.png; rgb.mp4, depth.mp4,
    opacity.mp4; render.json with settings, cameras and `provenance`. The colours of all depth previews share one
    range, so that a video does not flicker.

    Args:
        model: the trained model.
        frames: cameras and poses in the scene's frame.
        folder: the folder to write; a folder that stands there is replaced at the end.
        settings: what to write.
        provenance: goes into render.json.
        on_rays: called with the number of rays after each tile.

    Returns:
        The videos if there are any, else the folders of the outputs.

    Raises:
        UserError: the folder cannot be written.
    """
    meta = depth_meta(model, settings.depth)
    names = file_names(frames)
    wanted = settings.depth if "depth" in settings.outputs else None
    with atomic_folder(folder) as partial:
        for frame, name in zip(frames, names, strict=True):
            picture = render_picture(model, frame, background=model.background, depth=wanted, on_tile=on_rays)
            write_picture(picture, partial, name, settings=settings, meta=meta, background=model.background)
        if "depth" in settings.outputs:
            _write_previews(partial, names, meta)
        if settings.video:
            for output in settings.outputs:
                with VideoWriter(partial / f"{output}.mp4", fps=settings.fps) as video:
                    for name in names:
                        video.add(read_image(partial / output / f"{name}.png")[..., :3])
        description = {
            "nerfcli": __version__,
            "settings": settings.to_json(),
            **({"depth_meaning": meta.to_json()} if "depth" in settings.outputs else {}),
            "frames": describe_frames(frames),
            **provenance,
        }
        write_json(partial / DESCRIPTION, description)
    return [folder / (f"{output}.mp4" if settings.video else output) for output in settings.outputs]


def _write_previews(folder: Path, names: Sequence[str], meta: DepthMeta) -> None:
    """A coloured PNG beside each depth file, all on one range."""

    def depths() -> Iterator[np.ndarray]:
        for name in names:
            yield read_values(folder, "depth", name)

    lo, hi = depth_range(depths())
    metadata = {key: str(value) for key, value in asdict(meta).items() if value not in (None, {})} | {
        "range": f"{lo} {hi}"
    }
    for name, depth in zip(names, depths(), strict=True):
        write_png(folder / "depth" / f"{name}.png", preview(depth, meta, lo=lo, hi=hi), metadata=metadata)
