"""What `evaluate` says and saves besides metrics.json: a line and a table for people, and the pictures compared."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfcli.cli.console import Console
from nerfcli.errors import UserError

if TYPE_CHECKING:
    from nerfcli.cameras.frame import Frame
    from nerfcli.evaluate.billboards import Billboards
    from nerfcli.evaluate.protocol import Compared, HeldOut
    from nerfcli.render.model import Model

_COLUMNS = {
    "as rendered": "",
    "unrounded": "_float",
    "colours aligned": "_colour_aligned",
    "right half": "_right_half",
    "right half, pose aligned": "_pose_aligned",
}


def held_out_photos(
    config: dict[str, Any], frames: "Sequence[Frame]", *, model: "Model", threads: int
) -> "list[HeldOut]":
    """Held-out photos as the run was trained on: their size, what their masks mean, and how they are exposed.

    Args:
        config: RUN/config.json.
        frames: the photos.
        model: that they will be compared with.
        threads: to read with.

    Raises:
        UserError: a photo cannot be read.
    """
    from nerfcli.evaluate.protocol import HeldOut
    from nerfcli.photos.held_out_exposure import log_gains_of
    from nerfcli.photos.loading import load_photos
    from nerfcli.runs.folder import chosen_components

    factor, masks = config["settings"]["downscale"], chosen_components(config).masks
    photos = load_photos(frames, factor=factor, threads=threads, masks=masks)
    return [
        HeldOut(photo.frame, photo.pixels, photo.used, log_gains=tuple(gains))
        for photo, gains in zip(photos, log_gains_of(frames, model).tolist(), strict=True)
    ]


def billboards_of(
    config: dict[str, Any], frames: "Sequence[Frame]", *, threads: int, console: Console
) -> "Billboards | None":
    """The model without shape of a run's training photos; None, with a line, where these cannot be read any more."""
    from nerfcli.evaluate.billboards import Billboards, reduction
    from nerfcli.evaluate.protocol import over_white
    from nerfcli.photos.loading import downscaled_camera, load_photos
    from nerfcli.runs.folder import chosen_components

    masks, small, cameras = chosen_components(config).masks, [], []
    try:
        for frame in frames:
            trained = replace(frame, camera=downscaled_camera(frame.camera, config["settings"]["downscale"]))
            factor = config["settings"]["downscale"] * reduction(trained)
            (photo,) = load_photos([frame], factor=factor, threads=1, masks=masks)
            cameras.append(photo.frame)
            small.append(over_white(photo.pixels))
    except UserError as error:
        console.note(f"no comparison with a model without shape: {error}")
        return None
    return Billboards(cameras, small)


def tell_numbers(run: Path, metrics: dict[str, Any], console: Console) -> None:
    """The result in a few lines and a table."""
    from nerfcli.evaluate.billboards import Shape

    mean, kinds = metrics["mean"], metrics["kinds"]
    console.note(
        f"{run}: PSNR {mean['psnr']:.2f} dB, SSIM {_number(mean['ssim'], 3)} on {len(metrics['images'])} held-out "
        f"photos; trained {metrics['training']['seconds']:.0f} s, "
        f"{metrics['render']['seconds_per_image']:.2f} s a picture"
    )
    rows = [
        (name, *(_number(mean.get(f"{measure}{key}"), digits) for measure, digits in _MEASURES))
        for name, key in _COLUMNS.items()
        if mean.get(f"psnr{key}") is not None
    ]
    console.table(("", "PSNR", "SSIM", "LPIPS"), rows, styles={})
    if metrics["shape"] is not None:
        console.note(Shape(**metrics["shape"]).in_words())
    if kinds:
        parts = [f"{group['images']} by {kind}, PSNR {group['psnr']:.2f} dB" for kind, group in kinds.items()]
        console.note(f"views: {'; '.join(parts)}")


_MEASURES = (("psnr", 2), ("ssim", 4), ("lpips", 4))


def tell_spread(folders: Sequence[Path], measured: Sequence[dict[str, Any]], console: Console) -> None:
    """Mean and spread over runs: a table, and with --json one more line.

    Raises:
        UserError: see `spread`.
    """
    from nerfcli.evaluate.spread import spread

    found = spread(measured, [str(folder) for folder in folders])
    if console.json_lines:
        console.fact({"spread": found})
    rows = [
        (name, *(_number(found[name][key], 4) for key in ("mean", "standard_deviation", "lowest", "highest")))
        for name in found
        if name != "runs"
    ]
    columns = (f"{len(folders)} runs", "mean", "standard deviation", "lowest", "highest")
    console.table(columns, rows, styles={})


@contextmanager
def saved_predictions(
    run: Path, frames: "Sequence[Frame]", kind: str | None, *, checkpoint: str
) -> "Iterator[Callable[[Compared], None]]":
    """What takes each comparison and writes it below RUN/predictions, which appears when all are there.

    Args:
        run: the run's folder.
        frames: the held-out frames.
        kind: one of `evaluate.predictions.KINDS`; None to save nothing.
        checkpoint: the hash of the field.
    """
    if kind is None:
        yield lambda compared: None
        return
    from nerfcli.atomic import atomic_folder, write_json
    from nerfcli.evaluate.predictions import INFO, PREDICTIONS, save_compared, save_unrounded
    from nerfcli.export.names import file_names

    stems = dict(zip((frame.name for frame in frames), file_names(frames), strict=True))
    with atomic_folder(run / PREDICTIONS) as folder:

        def keep(compared: "Compared") -> None:
            save_compared(folder, stems[compared.frame.name], compared)
            if kind == "float":
                save_unrounded(folder, stems[compared.frame.name], compared)

        yield keep
        write_json(folder / INFO, {"checkpoint_sha256": checkpoint, "kind": kind, "files": stems})


def predictions_are_there(folder: Path, kind: str, *, checkpoint: str) -> bool:
    """Whether predictions of this checkpoint have been saved, unrounded ones included where they are asked for."""
    from nerfcli.evaluate.predictions import INFO

    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return info.get("checkpoint_sha256") == checkpoint and kind in (info.get("kind"), "png")


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
