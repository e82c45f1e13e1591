"""The files of one rendered picture: one function per output, and the way back to its floats."""

from pathlib import Path

import numpy as np

from nerfcli import __version__
from nerfcli.export.settings import ExportSettings
from nerfcli.media.arrays import write_npy
from nerfcli.media.depth import DepthMeta
from nerfcli.media.float_tiff import read_tiff, write_tiff
from nerfcli.media.images import write_png
from nerfcli.render.pictures import Picture


def write_picture(
    picture: Picture,
    folder: Path,
    name: str,
    *,
    settings: ExportSettings,
    meta: DepthMeta,
    background: tuple[float, float, float],
) -> list[Path]:
    """Write what `settings` asks for; each file atomically.

    Args:
        picture: what was rendered.
        folder: of the export; the files are folder/OUTPUT/name.SUFFIX.
        name: without suffix, with "/" between folders.
        settings: the outputs, and the formats of depth.
        meta: what depth means.
        background: sRGB that the picture stands on.

    Returns:
        The files, complete.

    Raises:
        UserError: a file cannot be written.
    """
    written = []
    if "rgb" in settings.outputs:
        written += _write_rgb(picture.rgb, folder / "rgb" / name, background=background)
    if "opacity" in settings.outputs:
        written += _write_opacity(picture.opacity, folder / "opacity" / name)
    if picture.depth is not None:
        written += _write_depth(picture.depth, folder / "depth" / name, settings=settings, meta=meta)
    return written


def read_values(folder: Path, output: str, name: str) -> np.ndarray:
    """The floats (height, width) that `write_picture` wrote for an output that is measured, NaN where invalid."""
    return read_tiff(_with_suffix(folder / output / name, ".tiff"))[0]


def _write_rgb(rgb: np.ndarray, stem: Path, *, background: tuple[float, float, float]) -> list[Path]:
    path = _with_suffix(stem, ".png")
    write_png(path, _to_bytes(rgb), metadata={"colour": "sRGB", "background": str(background), "nerfcli": __version__})
    return [path]


def _write_opacity(opacity: np.ndarray, stem: Path) -> list[Path]:
    path = _with_suffix(stem, ".png")
    metadata = {"quantity": "opacity: 0 transparent, 255 opaque", "nerfcli": __version__}
    write_png(path, np.repeat(_to_bytes(opacity)[..., None], 3, axis=-1), metadata=metadata)
    return [path]


def _write_depth(depth: np.ndarray, stem: Path, *, settings: ExportSettings, meta: DepthMeta) -> list[Path]:
    paths = [_with_suffix(stem, ".tiff")]
    write_tiff(paths[0], depth, meta)
    if settings.npy:
        paths += [_with_suffix(stem, ".npy"), _with_suffix(stem, ".json")]
        write_npy(paths[1], depth, meta)
    return paths


def _with_suffix(stem: Path, suffix: str) -> Path:
    """The name with a suffix added; one that it has already stays, as it tells a.jpg from a.png."""
    return stem.with_name(stem.name + suffix)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.round(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
