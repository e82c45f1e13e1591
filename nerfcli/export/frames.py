"""Export of all frames of an order: render the missing ones, then write the outputs that need all of them."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from nerfcli.atomic import write_json
from nerfcli.exclusive import exclusive
from nerfcli.export.depth_files import write_levels
from nerfcli.export.one_frame import removed_in_words, render_frame
from nerfcli.export.order import DESCRIPTION, Order
from nerfcli.export.presentation import write_previews, write_videos
from nerfcli.export.settings import depth_meta
from nerfcli.export.unfinished import UnfinishedFrames, take_over, unfinished_of
from nerfcli.export.workers import render_in_processes, render_in_threads
from nerfcli.media.levels import scale_in_words
from nerfcli.render.accuracy import IN_WORDS as ERROR_IN_WORDS
from nerfcli.render.model import Model

# A process takes seconds to start: it must have at least this many rays to render, about 20 s of work for a core.
RAYS_PER_PROCESS = 2**22
# Each process holds the model, a picture, and a few hundred megabytes of libraries. More threads with a picture each
# would wait for Python's lock.
MOST_PROCESSES = 4
MOST_AT_A_TIME = 4


@dataclass(frozen=True)
class Workers:
    """Number of processes and threads to render with.

    Args:
        jobs: number of processes, each with one frame at a time; 1 renders in this process, on CPUs a frame per thread.
        threads: number of threads of all processes together.
    """

    jobs: int = 1
    threads: int = 1


def automatic_workers(rays: int, *, threads: int, thread_safe: bool) -> Workers:
    """Return one process, or several if its threads cannot render different frames and there is enough work.

    One picture per thread is faster than several threads per picture, because some steps of a picture use one thread.

    Args:
        thread_safe: see `Model.thread_safe`; also True for a GPU, which is used by one process.
    """
    if thread_safe:
        return Workers(1, threads)
    return Workers(max(1, min(threads, MOST_PROCESSES, rays // RAYS_PER_PROCESS)), threads)


def export_frames(
    model: Model,
    order: Order,
    folder: Path,
    *,
    on_rays: Callable[[int], None],
    notify: Callable[[str], None],
    workers: Workers = Workers(),
) -> list[Path]:
    """Render every frame and write the ordered outputs; the folder appears when it is complete.

    Layout: rgb/NAME.png, depth/NAME.tiff with depth/NAME.png to look at, opacity/NAME.png; exr/NAME.exr,
    depth16/NAME.png; rgb.mp4, depth.mp4, opacity.mp4; render.json. The colours of all depth previews share one range,
    so that a video does not flicker. Until the folder is complete, its files are in a hidden folder beside it, which
    stays if the command ends early: the same order then renders only the missing frames. The frames of a finished
    folder that differs only in previews and videos are reused. Memory does not grow with the number of frames.

    Args:
        folder: the folder to write; an existing folder is replaced at the end.
        on_rays: called with numbers of finished rays, including those of frames that already exist.
        workers: processes and threads to render with; the files do not depend on them.

    Returns:
        The paths to show, see `Order.results`.

    Raises:
        UserError: the folder cannot be written, a video cannot be made, or processes die repeatedly.
    """
    order.check()
    unfinished = unfinished_of(order, folder)
    with exclusive(unfinished.lock, f"nerfcli render is working on {folder}"):
        if order.shares_pictures_with(folder):
            take_over(unfinished, order, folder)
        everything = range(len(order.frames))
        _render_missing(
            model, order, everything, unfinished=unfinished, on_rays=on_rays, notify=notify, workers=workers
        )
        meta = depth_meta(model, order.settings.depth)
        ranges = write_previews(unfinished.folder, order, meta, threads=workers.threads)
        levels = {}
        if order.settings.in_levels:
            written = write_levels(unfinished.folder, order.names, settings=order.settings, meaning=meta)
            levels = {"depth16": asdict(written)}
            notify(f"16-bit files: {scale_in_words(replace(meta, units_per_level=written.units_per_level))}")
            if written.pixels_beyond:
                notify(f"{written.pixels_beyond} pixels are too distant for 16-bit files and have no depth there")
        write_videos(unfinished.folder, order, meta, ranges=ranges, notify=notify)
        notes = {name: unfinished.noted(name) for name in order.names}
        facts = {name: note["facts"] for name, note in notes.items()}
        if words := removed_in_words(order.settings.depth, list(facts.values())):
            notify(words)
        description = {
            **order.of_pictures(),
            **order.settings.of_presentation(),
            **({"depth_meaning": meta.to_json()} if order.settings.measured else {}),
            **levels,
            "ranges": ranges,
            "error_meaning": ERROR_IN_WORDS,
            "facts": facts,
            "files": {name: note["files"] for name, note in notes.items()},
        }
        write_json(unfinished.folder / DESCRIPTION, description)
        unfinished.finish(folder)
        return order.results(folder)


def export_part(
    model: Model,
    order: Order,
    folder: Path,
    part: range,
    *,
    on_rays: Callable[[int], None],
    notify: Callable[[str], None],
    workers: Workers = Workers(),
) -> Path:
    """Render some frames of an order, which `export_frames` then finds; the other arguments are the same.

    Args:
        part: indices of frames; several machines that share a disk may render different ones at the same time.

    Returns:
        The unfinished folder.
    """
    order.check()
    unfinished = unfinished_of(order, folder)
    _render_missing(model, order, part, unfinished=unfinished, on_rays=on_rays, notify=notify, workers=workers)
    there = sum(map(unfinished.has, order.names))
    notify(f"{there} of {len(order.names)} frames are complete; the same command without --frames renders the others")
    return unfinished.folder


def _render_missing(
    model: Model,
    order: Order,
    part: range,
    *,
    unfinished: UnfinishedFrames,
    on_rays: Callable[[int], None],
    notify: Callable[[str], None],
    workers: Workers,
) -> None:
    held = {index for index in part if unfinished.has(order.names[index])}
    missing = [index for index in part if index not in held]
    if held:
        notify(f"resuming: {len(held)} of {len(part)} frames are already in {unfinished.folder}")
        on_rays(sum(map(order.rays, held)))
    render_one = partial(render_frame, model, order, unfinished=unfinished)
    jobs, threads = min(workers.jobs, len(missing)), workers.threads
    at_a_time = min(threads, MOST_AT_A_TIME, len(missing))
    if jobs > 1:
        render_in_processes(render_one, order, missing, jobs=jobs, threads=threads, on_rays=on_rays, notify=notify)
    elif at_a_time > 1 and model.thread_safe:
        render_in_threads(render_one, missing, at_a_time=at_a_time, threads=threads, on_rays=on_rays)
    else:
        for index in missing:
            render_one(index, on_rays=on_rays)
