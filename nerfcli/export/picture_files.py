"""The files of one rendered picture: one function per output."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli import __version__
from nerfcli.export.depth_files import write_maps
from nerfcli.export.file_names import with_suffix
from nerfcli.export.settings import ExportSettings
from nerfcli.field.background import Background, SphereBackground
from nerfcli.media.depth_pictures import DepthMeta
from nerfcli.media.images import write_png
from nerfcli.render.pictures import RenderedPicture


def write_picture(
    picture: RenderedPicture,
    folder: Path,
    name: str,
    *,
    settings: ExportSettings,
    meta: DepthMeta,
    background: Background,
) -> list[Path]:
    """Write the outputs of one picture; each file atomically.

    Args:
        picture: the rendered picture; rgb with or without straight alpha.
        folder: the folder of the export; the files are folder/OUTPUT/name.SUFFIX.
        name: file name without suffix, with "/" between folders.
        meta: the definition of the depth of this frame, see `depth_files.frame_meta`.

    Returns:
        The files, complete.

    Raises:
        UserError: a file cannot be written.
    """
    written = []
    if "rgb" in settings.outputs:
        written += _write_rgb(picture.rgb, folder / "rgb" / name, background=background, bounds=meta.error_bounds)
    if "opacity" in settings.outputs:
        written += _write_opacity(picture.opacity, folder / "opacity" / name)
    if settings.measured:
        written += write_maps(picture, folder, name, settings=settings, meta=meta)
    return written


def _write_rgb(rgb: np.ndarray, stem: Path, *, background: Background, bounds: Mapping[str, Any]) -> list[Path]:
    path = with_suffix(stem, ".png")
    behind = "learned, by direction" if isinstance(background, SphereBackground) else str(background)
    behind = behind if rgb.shape[-1] == 3 else "none: straight alpha"
    error = {f"error {name}": str(value) for name, value in bounds.items()}
    metadata = {"colour": "sRGB", "background": behind, **error, "nerfcli": __version__}
    write_png(path, _to_bytes(rgb), metadata=metadata)
    return [path]


def _write_opacity(opacity: np.ndarray, stem: Path) -> list[Path]:
    path = with_suffix(stem, ".png")
    metadata = {"quantity": "opacity: 0 transparent, 255 opaque", "nerfcli": __version__}
    write_png(path, np.repeat(_to_bytes(opacity)[..., None], 3, axis=-1), metadata=metadata)
    return [path]


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.round(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
