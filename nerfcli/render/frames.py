"""Render the frames of a job: those that are missing, several at a time; then previews, levels and videos of all.

Until a folder is complete, everything is in a hidden folder beside it, named after the job's digest:

    .NAME.unfinished-DIGEST/
        files/rgb/...  files/depth/...   becomes NAME in the end
        frames/FRAME.json                facts about a complete frame, written after its files
        lock                             held by the one command that completes the folder

All files are atomic, so those of a frame are complete if its facts are there. After a command that was killed at any
moment, or several that rendered parts of the frames, the next one renders only what is missing.
"""

import json
import os
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerfcli import __version__
from nerfcli.atomic import cannot_write, clear_leftovers, exclusive, replace_folder, write_json
from nerfcli.errors import UserError, in_shell
from nerfcli.field.background import Background, SphereBackground
from nerfcli.machine import use_threads
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.colours import to_8_bit
from nerfcli.photos.images import write_png
from nerfcli.render.accuracy import IN_WORDS as ERROR_IN_WORDS
from nerfcli.render.accuracy import truncation_bounds
from nerfcli.render.coverage import with_coverage
from nerfcli.render.depth import DepthRequest
from nerfcli.render.depth_errors import DepthErrors
from nerfcli.render.files.depth_files import frame_meta, write_levels, write_maps
from nerfcli.render.files.depth_meta import DepthMeta, limits_in_words
from nerfcli.render.files.file_facts import RENDERS
from nerfcli.render.files.float_maps import scale_in_words
from nerfcli.render.job import BLACK, RenderJob, RenderSettings, depth_meta, with_suffix
from nerfcli.render.pictures import Renderable, RenderedPicture, straight_rgba
from nerfcli.render.presentation import write_previews, write_videos
from nerfcli.render.tracing import TOLERANCE

# Some steps of a picture use one thread, so several are in progress; more would wait for Python's lock.
MOST_AT_A_TIME = 4


def render_job(
    model: Renderable, job: RenderJob, output: Output, *, part: slice | None = None, reporter: Reporter = Reporter()
) -> list[Path]:
    """Render the frames of a job that are missing; without `part`, write the outputs that need all of them, too.

    Layout: rgb/NAME.png, depth/NAME.tiff with depth/NAME.png to look at, opacity/NAME.png; exr/NAME.exr,
    depth16/NAME.png; rgb.mp4, depth.mp4, opacity.mp4; render.json. The colours of all depth previews share one range,
    so that a video does not flicker. The files depend on the model and the job alone, not on the threads, which are as
    many as torch's. Memory does not grow with the number of frames.

    Args:
        output: the folder to write, whose path is given; it appears, or is replaced, when it is complete. The pictures
            of a folder that differs only in videos and levels stay.
        part: which frames; several machines that share a disk may render different ones at the same time.
        reporter: receives messages, and the fraction of the rays that is done.

    Returns:
        The paths to show, see `RenderJob.results`; with `part`, the unfinished folder.

    Raises:
        UserError: the folder holds something else, or cannot be written; or a video cannot be made.
    """
    folder = output.at(Path())
    frames = range(len(job.frames))
    chosen = frames if part is None else frames[part]
    if not chosen:
        raise UserError(
            f"--frames selects none of the {len(frames)} views", f"give a part of 0:{len(frames)}, or K/N", exit_code=2
        )
    if not folder.name:  # "." or the root; a shell in a folder that is replaced goes on to show the old one
        raise UserError(
            f"{folder.resolve()} cannot be the output itself, as a finished folder takes its place",
            f"choose a folder in it: -o {in_shell(folder / 'renders')}",
        )
    place = folder.resolve() if folder.is_symlink() else folder  # a link may lead to another disk
    unfinished = _Unfinished(place.with_name(f".{folder.name}.unfinished-{job.digest}"))
    if job.is_kept_in(folder, output):
        reporter.note(f"{folder} is kept: it is complete and has these settings; add --overwrite to render again")
        clear_leftovers(place.parent)
        unfinished.discard()
        return job.results(folder)
    if job.facts_in(folder) is None and os.path.ismount(place):
        raise UserError(
            f"{folder} is a mounted disk, which no folder can replace",
            f"choose a folder in it: -o {in_shell(folder / 'renders')}",
        )
    job.check()
    unfinished.create(folder)
    if part is not None:
        _render_missing(model, job, chosen, unfinished, reporter)
        there = sum(map(unfinished.has, job.names))
        words = f"{there} of {len(frames)} frames are complete"
        reporter.note(f"{words}; the same command without --frames renders the others")
        return [unfinished.path]
    with exclusive(unfinished.path / "lock", f"nerfcli render is working on {folder}"):
        facts = job.facts_in(folder)
        if facts is not None:
            reporter.progress(1.0, f"of {len(frames)} frames")
            job.remove_other_presentation(folder)
            _write_presentation(model, job, folder, facts, reporter)
        else:
            _render_missing(model, job, chosen, unfinished, reporter)
            facts = {name: unfinished.facts(name) for name in job.names}
            _write_presentation(model, job, unfinished.files, facts, reporter)
            unfinished.finish(folder)
        unfinished.discard()
    return job.results(folder)


@dataclass(frozen=True)
class _Unfinished:
    """The hidden folder that collects the frames of a job."""

    path: Path

    @property
    def files(self) -> Path:
        """What becomes the finished folder."""
        return self.path / "files"

    def create(self, folder: Path) -> None:
        """Create the folder, for what will become `folder`."""
        try:
            (self.path / "frames").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(folder, error) from error

    def has(self, name: str) -> bool:
        """Return whether a frame is complete."""
        return self._facts_file(name).exists()

    def facts(self, name: str) -> dict[str, Any]:
        """Return the facts about a complete frame."""
        return json.loads(self._facts_file(name).read_text(encoding="utf-8"))

    def complete(self, name: str, facts: dict[str, Any]) -> None:
        """Note that all files of a frame are there."""
        write_json(self._facts_file(name), facts)

    def finish(self, folder: Path) -> None:
        """Move the files to their final place, replacing an existing folder in the same step."""
        for leftover in self.files.rglob(".*.partial-*"):  # of commands that were killed while they wrote
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        replace_folder(self.files, folder)

    def discard(self) -> None:
        """Remove what is left of the folder."""
        shutil.rmtree(self.path, ignore_errors=True)

    def _facts_file(self, name: str) -> Path:
        return self.path / "frames" / f"{name}.json"


def _render_missing(
    model: Renderable, job: RenderJob, chosen: Sequence[int], unfinished: _Unfinished, reporter: Reporter
) -> None:
    """Render the chosen frames that are missing, several at a time; the first exception stops all after their tile."""
    missing = [index for index in chosen if not unfinished.has(job.names[index])]
    total = sum(map(job.rays, chosen))
    done = total - sum(map(job.rays, missing))
    stopped, lock, threads = threading.Event(), threading.Lock(), torch.get_num_threads()
    reporter.progress(0.0, "")
    if done:
        count = len(chosen) - len(missing)
        reporter.note(f"resuming: {count} of {len(chosen)} frames are already in {unfinished.path}")
        reporter.progress(done / total, f"of {len(chosen)} frames")

    def on_rays(rays: int) -> None:
        nonlocal done
        if stopped.is_set():
            raise CancelledError
        with lock:
            done += rays
            reporter.progress(done / total, f"of {len(chosen)} frames")

    at_a_time = max(1, min(threads, MOST_AT_A_TIME, len(missing))) if model.thread_safe else 1
    if at_a_time == 1:
        for index in missing:
            _render_frame(model, job, index, unfinished, on_rays)
        return
    each = max(1, threads // at_a_time)
    with ThreadPoolExecutor(at_a_time, initializer=use_threads, initargs=(each,)) as pool:
        try:
            futures = [pool.submit(_render_frame, model, job, index, unfinished, on_rays) for index in missing]
            for future in as_completed(futures):
                future.result()
        except BaseException:  # Ctrl-C arrives in this thread
            stopped.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        finally:
            use_threads(threads)


def _render_frame(
    model: Renderable, job: RenderJob, index: int, unfinished: _Unfinished, on_rays: Callable[[int], None]
) -> None:
    """Render a frame with all that is asked for, and write its files and then its facts."""
    frame, name, settings = job.frames[index], job.names[index], job.settings
    wanted = settings.depth if settings.measured else None
    background = BLACK if settings.rgba else model.background
    picture = model.render(frame, background=background, depth=wanted, on_tile=on_rays)
    if settings.rgba:
        picture = replace(picture, rgb=straight_rgba(picture))
    removed = {}
    if settings.needs_visibility:
        picture = with_coverage(picture, frame, axis=settings.depth.axis, photo_depths=job.photo_depths)
        if job.depth_errors is not None:
            picture = with_measured_errors(picture, job.depth_errors)
        picture, removed = without_unseen_depth(picture, settings.depth)
    facts = truncation_bounds(picture, TOLERANCE)
    if settings.check_accuracy or index in (0, len(job.frames) - 1):
        facts |= model.measured_error(frame, depth=wanted)
    bounds = {**facts, "meaning": ERROR_IN_WORDS}
    meta = frame_meta(depth_meta(model, settings.depth), frame, provenance=job.provenance, error_bounds=bounds)
    _write_outputs(picture, unfinished.files, name, settings=settings, meta=meta, background=model.background)
    unfinished.complete(name, facts | removed)


def _write_presentation(
    model: Renderable, job: RenderJob, folder: Path, facts: dict[str, Any], reporter: Reporter
) -> None:
    """Write what needs all frames beside their files: previews, 16-bit levels, videos, and last the description."""
    meta = depth_meta(model, job.settings.depth)
    ranges = write_previews(folder, job, meta)
    levels = {}
    if job.settings.in_levels:
        written = write_levels(folder, job.names, meaning=meta)
        levels = {"depth16": asdict(written)}
        scale = scale_in_words(replace(meta, units_per_level=written.units_per_level))
        reporter.note(f"16-bit files: {scale}")
        if written.pixels_beyond:
            reporter.note(f"{written.pixels_beyond} pixels are too distant for 16-bit files and have no depth there")
    write_videos(folder, job, meta, ranges=ranges, notify=reporter.note)
    if words := removed_in_words(job.settings.depth, list(facts.values())):
        reporter.note(words)
    description = {
        **job.key(),
        **job.settings.of_presentation(),
        **({"depth_meaning": meta.to_json()} if job.settings.measured else {}),
        **levels,
        "ranges": {output: asdict(colours) for output, colours in ranges.items()},
        "error_meaning": ERROR_IN_WORDS,
        "facts": facts,
    }
    write_json(folder / RENDERS, description)


def with_measured_errors(picture: RenderedPicture, errors: DepthErrors) -> RenderedPicture:
    """Add an interval of depth and a confidence in each pixel to a picture that has median and coverage."""
    assert picture.median is not None
    assert picture.coverage is not None
    lower, upper = errors.bounds(picture.median, picture.coverage)
    confidence = errors.confidence(picture.coverage)
    return replace(picture, lower=lower, upper=upper, confidence=confidence)


def without_unseen_depth(picture: RenderedPicture, request: DepthRequest) -> tuple[RenderedPicture, dict[str, Any]]:
    """Return the picture without depth where coverage or parallax is too small, and the numbers of pixels.

    Returns:
        The picture; "pixels_with_depth" before and "pixels_removed", or nothing if no limit is set.
    """
    if not (request.min_views or request.min_parallax_deg):
        return picture, {}
    assert picture.depth is not None
    assert picture.coverage is not None
    assert picture.parallax is not None
    # NaN, where there is no surface, counts as not seen.
    seen = (picture.coverage >= request.min_views) & (picture.parallax >= request.min_parallax_deg)
    had = np.isfinite(picture.depth)
    depth = np.where(seen, picture.depth, np.float32(np.nan))
    return replace(picture, depth=depth), {
        "pixels_with_depth": int(had.sum()),
        "pixels_removed": int((had & ~seen).sum()),
    }


def removed_in_words(request: DepthRequest, facts: Sequence[Mapping[str, Any]]) -> str:
    """Describe how much depth was removed from pictures, by their facts; empty if no limit is set."""
    had = sum(of_picture.get("pixels_with_depth", 0) for of_picture in facts)
    if not had:
        return ""
    removed = sum(of_picture["pixels_removed"] for of_picture in facts)
    limits = limits_in_words(request.min_views, request.min_parallax_deg)
    return f"depth removed at {100 * removed / had:.1f} % of the pixels that had one: {limits}"


def _write_outputs(
    picture: RenderedPicture,
    folder: Path,
    name: str,
    *,
    settings: RenderSettings,
    meta: DepthMeta,
    background: Background,
) -> None:
    """Write the outputs of a picture, as folder/OUTPUT/name.SUFFIX, each file atomically."""
    if "rgb" in settings.outputs:
        behind = "learned, by direction" if isinstance(background, SphereBackground) else str(background)
        behind = "none: straight alpha" if settings.rgba else behind
        error = {f"error {name}": str(value) for name, value in meta.error_bounds.items()}
        metadata = {"colour": "sRGB", "background": behind, **error, "nerfcli": __version__}
        write_png(with_suffix(folder / "rgb" / name, ".png"), to_8_bit(picture.rgb), metadata=metadata)
    if "opacity" in settings.outputs:
        metadata = {"quantity": "opacity: 0 transparent, 255 opaque", "nerfcli": __version__}
        grey = np.repeat(to_8_bit(picture.opacity)[..., None], 3, axis=-1)
        write_png(with_suffix(folder / "opacity" / name, ".png"), grey, metadata=metadata)
    if settings.measured:
        write_maps(picture, folder, name, settings=settings, meta=meta)
