"""Outputs that need all frames of a job: previews with a common range of colours, and videos."""

import json
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.photos.images import read_image, write_png
from nerfcli.render.files.depth_files import read_map
from nerfcli.render.files.depth_pictures import KEY, DepthMeta
from nerfcli.render.files.film import write_video
from nerfcli.render.files.preview import COLOURS, preview, quantiles
from nerfcli.render.job import RenderJob
from nerfcli.render.outputs import MEASURED, meaning_of
from nerfcli.version import __version__


def write_previews(
    folder: Path, job: RenderJob, meta: DepthMeta, *, threads: int = 1
) -> dict[str, tuple[float, float]]:
    """Write a false-colour PNG beside each measured file, with one range per output.

    Args:
        folder: holds the complete files of every frame.
        threads: number of previews that are written at the same time.

    Returns:
        The range of each measured output, in the unit of `meta`.

    Raises:
        UserError: a file cannot be read or written.
    """
    ranges = {}
    for output in job.settings.measured:
        meaning = meaning_of(meta, job.settings.depth, output)
        ranges[output] = _write_previews_of(output, folder, job, meaning, threads=threads)
    return ranges


def _write_previews_of(
    output: str, folder: Path, job: RenderJob, meaning: DepthMeta, *, threads: int
) -> tuple[float, float]:
    """Write the previews of one output, and return its range."""
    kept: dict[str, np.ndarray] = {}

    def read(name: str) -> np.ndarray:
        if name in kept:
            return kept[name]
        values = read_map(folder, name, meaning)
        # Maps are read three times; as many as fit into 256 MB are kept in memory.
        if (len(kept) + 1) * values.nbytes <= 2**28:
            kept[name] = values
        return values

    lo, hi = value_range(lambda: map(read, job.names), output)
    metadata = _texts(meaning) | {"range": f"{lo} {hi}", "colour map": COLOURS}

    def write(name: str) -> None:
        picture = preview(read(name), meaning, lo=lo, hi=hi)
        write_png(_picture(folder, output, name), picture, metadata=metadata)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(write, job.names))
    return lo, hi


def write_videos(
    folder: Path,
    job: RenderJob,
    meta: DepthMeta,
    *,
    ranges: dict[str, tuple[float, float]],
    notify: Callable[[str], None],
) -> None:
    """Write the videos that were ordered, from the pictures in the folder; one picture at a time is in memory.

    Args:
        folder: holds every picture and preview.
        job: the rendering job; `job.check` has passed.
        ranges: colour ranges from `write_previews`, for the videos' comments.

    Raises:
        UserError: a video cannot be written.
    """
    settings = job.settings.video
    if settings is None:
        return
    for form in settings.formats:
        for output in job.settings.outputs:

            def pictures(output: str = output) -> Iterator[np.ndarray]:
                for name in job.names:
                    yield read_image(_picture(folder, output, name))[..., :3]

            path = folder / f"{output}.{form}"
            notify(f"encoding {path.name}, {len(job.names)} frames")
            comment = json.dumps(_comment(job, meta, output, ranges), ensure_ascii=False)
            write_video(path, pictures, fps=settings.fps, comment=comment)


def value_range(maps: Callable[[], Iterable[np.ndarray]], output: str) -> tuple[float, float]:
    """Return the range of colours of a clip: the 1st to the 99th percentile; from 0 for outputs that are not distances.

    (0, 1) for confidence, and if no pixel has a value.
    """
    # The ends of a colour range: quantiles of all valid pixels of the clip, so that a single speck does not stretch it.
    found = None if output == "confidence" else quantiles(maps, (0.01, 0.99))
    if not found:
        return 0.0, 1.0
    lo, hi = found
    return (lo if output in ("depth", "lower", "upper") else 0.0), hi


def _comment(job: RenderJob, meta: DepthMeta, output: str, ranges: dict[str, tuple[float, float]]) -> dict[str, Any]:
    """Return the description of a video for its container's comment."""
    description: dict[str, Any] = {"nerfcli": __version__, "outputs": [output], **job.provenance}
    if output in MEASURED:
        description |= meta.to_json()
        description |= {"ranges": {output: ranges[output]}, "colour_map": COLOURS}
    return description


def _picture(folder: Path, output: str, name: str) -> Path:
    return folder / output / f"{name}.png"


def _texts(meta: DepthMeta) -> dict[str, str]:
    """Return texts for a PNG: the definition for programs under one key, and its parts for people."""
    parts = {name: str(value) for name, value in asdict(meta).items() if not isinstance(value, dict) and value}
    return parts | {KEY: meta.to_text()}
