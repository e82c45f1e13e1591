"""Train a large scene in blocks, one after another or each in its own process, and join them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from nerfcli import scene as scenes
from nerfcli.cameras.formats.run_cameras import write_cameras
from nerfcli.errors import UserError
from nerfcli.render.model import save_model
from nerfcli.runs.blocks import block_path, divide, joined
from nerfcli.runs.config import RunConfig, write_config
from nerfcli.runs.files import CONFIG, FIELD, LOG
from nerfcli.runs.log import LogEntry, append_log
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings
from nerfcli.scene import Scene
from nerfcli.train.left_out import remove_left_out
from nerfcli.workflows.notices import Notify, Progress, no_progress, one_of_several, silent, warn_python
from nerfcli.workflows.train import train_or_continue

# Components left out of the automatic selection: blocks must agree on them, but would select them separately.
_SHARED = ("background", "exposure", "cameras")


def block_settings(settings: TrainSettings, number: int, count: int) -> TrainSettings:
    """Return the settings of block `number` of `count`, or of the joined run if the number is 0.

    Raises:
        UserError: the settings do not work with blocks.
    """
    return replace(settings, blocks=count, block=number, fixed=tuple(dict.fromkeys((*settings.fixed, *_SHARED))))


def train_blocks(
    scene: str | Path,
    run: str | Path,
    settings: TrainSettings = TrainSettings(),
    *,
    count: int,
    only: int | None = None,
    memory_bytes: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    holdout: str | None = None,
    notify: Notify = silent,
    warn: Notify = warn_python,
    progress: Progress = no_progress,
) -> Path:
    """Train the blocks of a scene into RUN/blocks/1, 2, ..., each with the whole budget, and join them in RUN.

    Complete blocks are kept and interrupted ones are resumed. Processes that train one block each need no
    communication: the one that finds all blocks complete joins them.

    Example:
        >>> from nerfcli.runs.settings import TrainSettings
        >>> from nerfcli.workflows.blocks import train_blocks
        >>> train_blocks("photos-scene", "photos-scene-run", TrainSettings(budget_seconds=60), count=4)

    Args:
        scene, run, settings, memory_bytes, overwrite, holdout, notify, warn: see `train_scene`.
        only: the block to train, counted from 1; None for all.
        resume: also continue complete blocks to a larger budget.

    Returns:
        The run; or, if some blocks are not complete, the folder of the first block trained here.

    Raises:
        UserError: see `train_scene` and `runs.blocks.divide`; or `run` exists with another number of blocks.
    """
    folder, run = Path(scene), Path(run)
    if (run / CONFIG).exists() and Run(run).config.settings.blocks != count and not overwrite:
        before = Run(run).config.settings.blocks
        raise UserError(
            f"{run} exists and has {before or 'no'} blocks", "add --overwrite to replace it, or choose another folder"
        )
    loaded = scenes.load(folder, holdout=holdout)
    division = divide(loaded, count)
    notify(
        f"{count} blocks of {', '.join(str(len(one.train_frames)) for one in division.scenes)} training photos, "
        f"of {len(loaded.train_frames)} in all"
    )
    numbers = range(1, count + 1)
    chosen = numbers if only is None else [only]
    for place, number in enumerate(chosen):
        train_or_continue(
            folder,
            block_path(run, number),
            block_settings(settings, number, count),
            memory_bytes=memory_bytes,
            resume=resume,
            overwrite=overwrite,
            holdout=holdout,
            notify=notify,
            warn=warn,
            progress=one_of_several(progress, place, len(chosen), f"block {number} of {count}"),
        )
    blocks = [Run(block_path(run, number)) for number in numbers]
    waiting = [
        str(number)
        for number, block in zip(numbers, blocks, strict=True)
        if not block.is_complete(block_settings(settings, number, count))
    ]
    if waiting:
        notify(f"blocks {', '.join(waiting)} are not complete; all are joined when the last one is")
        return block_path(run, chosen[0])
    for block, of_block in zip(blocks, division.scenes, strict=True):
        if block.config.scene_fingerprint != scenes.fingerprint(of_block):
            raise UserError(
                f"{block.path} was trained on other photos than {folder} has now", "train again with --overwrite"
            )
    model = joined([block.model() for block in blocks], division)
    _write(run, loaded, blocks, block_settings(settings, 0, count))
    save_model(run / FIELD, model)
    notify(f"{run} joins {count} blocks")
    return run


def _write(run: Path, scene: Scene, blocks: Sequence[Run], settings: TrainSettings) -> None:
    """Write the files of a joined run besides its field: cameras, configuration, and a combined log of the blocks."""
    remove_left_out(run)  # of a training without blocks
    write_cameras(run, scene.train_frames, scene.test_frames)
    write_config(run, RunConfig.describing(scene, settings, factor=blocks[0].config.downscale, contraction="l2"))
    last = [block.log[-1] for block in blocks]
    seconds = sum(entry["seconds"] for entry in last)
    samples, rays = sum(entry["samples"] for entry in last), sum(entry["rays"] for entry in last)
    entry: LogEntry = {
        "step": sum(entry["step"] for entry in last),
        "seconds": round(seconds, 3),
        "loss": sum(entry["loss"] for entry in last) / len(last),
        "samples": samples,
        "rays": rays,
        "samples_per_second": round(samples / seconds),
        "rays_per_second": round(rays / seconds),
        "peak_memory_bytes": max(entry["peak_memory_bytes"] for block in blocks for entry in block.log),
        "rollbacks": sum(entry["rollbacks"] for entry in last),
    }
    (run / LOG).unlink(missing_ok=True)
    append_log(run, entry)
