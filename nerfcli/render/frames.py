"""Export of all frames of a job: render the missing ones, then write the outputs that need all of them."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch

from nerfcli.atomic import write_json
from nerfcli.exclusive import exclusive
from nerfcli.render.accuracy import IN_WORDS as ERROR_IN_WORDS
from nerfcli.render.files.depth_files import write_levels
from nerfcli.render.files.levels import scale_in_words
from nerfcli.render.job import DESCRIPTION, RenderJob
from nerfcli.render.one_frame import removed_in_words, render_frame
from nerfcli.render.outputs import depth_meta
from nerfcli.render.presentation import write_previews, write_videos
from nerfcli.render.renderable import Renderable
from nerfcli.render.unfinished import UnfinishedFrames, take_over, unfinished_of


def export_frames(
    model: Renderable,
    job: RenderJob,
    folder: Path,
    *,
    on_rays: Callable[[int], None],
    notify: Callable[[str], None],
    threads: int = 1,
) -> list[Path]:
    """Render every frame and write the ordered outputs; the folder appears when it is complete.

    Layout: rgb/NAME.png, depth/NAME.tiff with depth/NAME.png to look at, opacity/NAME.png; exr/NAME.exr,
    depth16/NAME.png; rgb.mp4, depth.mp4, opacity.mp4; render.json. The colours of all depth previews share one range,
    so that a video does not flicker. Until the folder is complete, its files are in a hidden folder beside it, which
    stays if the command ends early: the same job then renders only the missing frames. The frames of a finished
    folder that differs only in previews and videos are reused. Memory does not grow with the number of frames.

    Args:
        folder: the folder to write; an existing folder is replaced at the end.
        on_rays: called with numbers of finished rays, including those of frames that already exist.
        threads: number of threads; the files do not depend on it.

    Returns:
        The paths to show, see `RenderJob.results`.

    Raises:
        UserError: the folder cannot be written, or a video cannot be made.
    """
    job.check()
    unfinished = unfinished_of(job, folder)
    with exclusive(unfinished.lock, f"nerfcli render is working on {folder}"):
        if job.shares_pictures_with(folder):
            take_over(unfinished, job, folder)
        everything = range(len(job.frames))
        _render_missing(model, job, everything, unfinished=unfinished, on_rays=on_rays, notify=notify, threads=threads)
        meta = depth_meta(model, job.settings.depth)
        ranges = write_previews(unfinished.folder, job, meta, threads=threads)
        levels = {}
        if job.settings.in_levels:
            written = write_levels(unfinished.folder, job.names, meaning=meta)
            levels = {"depth16": asdict(written)}
            notify(f"16-bit files: {scale_in_words(replace(meta, units_per_level=written.units_per_level))}")
            if written.pixels_beyond:
                notify(f"{written.pixels_beyond} pixels are too distant for 16-bit files and have no depth there")
        write_videos(unfinished.folder, job, meta, ranges=ranges, notify=notify)
        notes = {name: unfinished.noted(name) for name in job.names}
        facts = {name: note["facts"] for name, note in notes.items()}
        if words := removed_in_words(job.settings.depth, list(facts.values())):
            notify(words)
        description = {
            **job.key(),
            **job.settings.of_presentation(),
            **({"depth_meaning": meta.to_json()} if job.settings.measured else {}),
            **levels,
            "ranges": ranges,
            "error_meaning": ERROR_IN_WORDS,
            "facts": facts,
            "files": {name: note["files"] for name, note in notes.items()},
        }
        write_json(unfinished.folder / DESCRIPTION, description)
        unfinished.finish(folder)
        return job.results(folder)


def export_part(
    model: Renderable,
    job: RenderJob,
    folder: Path,
    part: range,
    *,
    on_rays: Callable[[int], None],
    notify: Callable[[str], None],
    threads: int = 1,
) -> Path:
    """Render some frames of a job, which `export_frames` then finds; the other arguments are the same.

    Args:
        part: indices of frames; several machines that share a disk may render different ones at the same time.

    Returns:
        The unfinished folder.
    """
    job.check()
    unfinished = unfinished_of(job, folder)
    _render_missing(model, job, part, unfinished=unfinished, on_rays=on_rays, notify=notify, threads=threads)
    there = sum(map(unfinished.has, job.names))
    notify(f"{there} of {len(job.names)} frames are complete; the same command without --frames renders the others")
    return unfinished.folder


def _render_missing(
    model: Renderable,
    job: RenderJob,
    part: range,
    *,
    unfinished: UnfinishedFrames,
    on_rays: Callable[[int], None],
    notify: Callable[[str], None],
    threads: int,
) -> None:
    held = {index for index in part if unfinished.has(job.names[index])}
    missing = [index for index in part if index not in held]
    if held:
        notify(f"resuming: {len(held)} of {len(part)} frames are already in {unfinished.folder}")
        on_rays(sum(map(job.rays, held)))
    render_one = partial(render_frame, model, job, unfinished=unfinished)
    # Some steps of a picture use one thread, so several are in progress; more would wait for Python's lock.
    at_a_time = min(threads, 4, len(missing))
    if at_a_time > 1 and model.thread_safe:
        _render_in_threads(render_one, missing, at_a_time=at_a_time, threads=threads, on_rays=on_rays)
    else:
        for index in missing:
            render_one(index, on_rays=on_rays)


def _render_in_threads(
    render_one: Callable[..., None],
    indices: Sequence[int],
    *,
    at_a_time: int,
    threads: int,
    on_rays: Callable[[int], None],
) -> None:
    """Render frames on the CPU, several at a time.

    The first exception stops all threads after their current tile; complete frames are kept.

    Args:
        at_a_time: number of frames in progress.
        threads: number of threads of all frames together; each frame has at least one.
        on_rays: called with the number of rays of each tile, by one thread at a time.
    """
    stopped, lock, before = threading.Event(), threading.Lock(), torch.get_num_threads()

    def count(rays: int) -> None:
        if stopped.is_set():
            raise CancelledError
        with lock:
            on_rays(rays)

    def render(index: int) -> None:
        if stopped.is_set():
            return
        try:
            render_one(index, on_rays=count)
        except CancelledError:
            return  # because of another frame's exception, which is raised below
        except BaseException:
            stopped.set()  # here, since the main thread may hear of it only after the others have rendered more
            raise

    each = max(1, threads // at_a_time)
    with ThreadPoolExecutor(at_a_time, initializer=torch.set_num_threads, initargs=(each,)) as pool:
        try:
            for future in as_completed([pool.submit(render, index) for index in indices]):
                future.result()
        except BaseException:
            stopped.set()  # Ctrl-C arrives in this thread
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        finally:
            torch.set_num_threads(before)
