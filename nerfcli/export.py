"""Rendered frames as files: PNG colours, float depth with its meaning, previews, videos."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from nerfcli import __version__
from nerfcli.atomic import atomic_folder, write_json
from nerfcli.cameras.frame import Frame
from nerfcli.media.depth import DepthMeta, depth_range, preview, read_tiff, write_npy, write_tiff
from nerfcli.media.images import read_image, write_png
from nerfcli.media.video import VideoWriter
from nerfcli.render.model import Model
from nerfcli.render.pictures import DepthRequest, render_picture

OUTPUTS = ("rgb", "depth", "opacity")
DESCRIPTION = "render.json"


@dataclass(frozen=True)
class ExportSettings:
    """What to write.

    Args:
        outputs: some of `OUTPUTS`.
        depth: which depth, where "depth" is among the outputs.
        npy: depth as .npy beside the TIFF.
        video: an MP4 of each output.
        fps: frames per second of the videos.
    """

    outputs: tuple[str, ...]
    depth: DepthRequest
    npy: bool
    video: bool
    fps: float

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "outputs": list(self.outputs)}


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
    with atomic_folder(folder) as partial:
        for frame, name in zip(frames, names, strict=True):
            _export_frame(model, frame, partial, name, settings=settings, meta=meta, on_rays=on_rays)
        if "depth" in settings.outputs:
            _write_previews([partial / "depth" / name for name in names], meta)
        if settings.video:
            for output in settings.outputs:
                with VideoWriter(partial / f"{output}.mp4", fps=settings.fps) as video:
                    for name in names:
                        video.add(_as_rgb(read_image(partial / output / f"{name}.png")))
        description = {
            "nerfcli": __version__,
            "settings": settings.to_json(),
            **({"depth_meaning": asdict(meta)} if "depth" in settings.outputs else {}),
            "frames": describe_frames(frames),
            **provenance,
        }
        write_json(partial / DESCRIPTION, description)
    return [folder / (f"{output}.mp4" if settings.video else output) for output in settings.outputs]


def describe_frames(frames: Sequence[Frame]) -> list[dict[str, Any]]:
    """The files, cameras and poses of the pictures, as they stand in render.json."""
    return [
        {"file": name, "camera": frame.camera.to_json(), "world_from_cam": frame.world_from_cam.tolist()}
        for frame, name in zip(frames, file_names(frames), strict=True)
    ]


def depth_meta(model: Model, request: DepthRequest) -> DepthMeta:
    """The meaning of the depth files that `request` makes."""
    return DepthMeta(
        convention=request.convention,
        axis=request.axis,
        unit=model.unit,
        opacity_floor=effective_floor(request),
        background_distance=request.background_distance if request.convention == "background" else None,
    )


def effective_floor(request: DepthRequest) -> float:
    """The opacity below which a pixel has no depth: none for the conventions that every ray has, 1/2 for the median."""
    return {"moment": 0.0, "background": 0.0, "median": 0.5}.get(request.convention, request.opacity_floor)


def file_names(frames: Sequence[Frame]) -> list[str]:
    """File names without suffix: the frames' own, subfolders kept; the suffix stays where names would be the same.

    A folder above the capture's ("../images") is called "up": nothing is written outside of the export.
    """
    names = ["/".join("up" if part == ".." else part for part in PurePosixPath(frame.name).parts) for frame in frames]
    stems = [str(PurePosixPath(name).with_suffix("")) for name in names]
    taken = Counter([*stems, *names])
    # A name without a suffix is its own stem, and counts twice.
    return [stem if taken[stem] == 1 + (stem == name) else name for stem, name in zip(stems, names, strict=True)]


def _export_frame(
    model: Model,
    frame: Frame,
    folder: Path,
    name: str,
    *,
    settings: ExportSettings,
    meta: DepthMeta,
    on_rays: Callable[[int], None],
) -> None:
    wanted = settings.depth if "depth" in settings.outputs else None
    picture = render_picture(model, frame, background=model.background, depth=wanted, on_tile=on_rays)
    if "rgb" in settings.outputs:
        metadata = {"colour": "sRGB", "background": str(model.background), "nerfcli": __version__}
        write_png(folder / "rgb" / f"{name}.png", _to_bytes(picture.rgb), metadata=metadata)
    if "opacity" in settings.outputs:
        grey = _to_bytes(picture.opacity)
        metadata = {"quantity": "opacity: 0 transparent, 255 opaque", "nerfcli": __version__}
        write_png(folder / "opacity" / f"{name}.png", np.repeat(grey[..., None], 3, axis=-1), metadata=metadata)
    if picture.depth is not None:
        write_tiff(folder / "depth" / f"{name}.tiff", picture.depth, meta)
        if settings.npy:
            write_npy(folder / "depth" / f"{name}.npy", picture.depth, meta)


def _write_previews(stems: Iterable[Path], meta: DepthMeta) -> None:
    """A coloured PNG beside each depth TIFF, all on one range."""
    stems = list(stems)

    def depths() -> Iterator[np.ndarray]:
        for stem in stems:
            yield read_tiff(stem.with_name(stem.name + ".tiff"))[0]

    lo, hi = depth_range(depths())
    for stem, depth in zip(stems, depths(), strict=True):
        metadata = {key: str(value) for key, value in asdict(meta).items()} | {"range": f"{lo} {hi}"}
        write_png(stem.with_name(stem.name + ".png"), preview(depth, meta, lo=lo, hi=hi), metadata=metadata)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.round(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)


def _as_rgb(image: np.ndarray) -> np.ndarray:
    return image[..., :3]
