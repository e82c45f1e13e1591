"""A video where a folder of photos could stand: its sharpest frames become the photos."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.console import Console

# At least as many as structure from motion needs.
Frames = Annotated[
    int | None,
    typer.Option(help="Of a video, how many frames to use.  [default: 120, or all of a shorter one]", min=4),
]


def without_suffix(source: Path) -> Path:
    """What results are named after: clip for clip.mp4, the folder itself for a folder."""
    return source.with_suffix("") if source.is_file() else source


def photos_of(source: Path, scene: Path, *, frames: int | None, overwrite: bool, console: Console) -> Path:
    """The folder of photos: `source` itself, or the one beside `scene` with the frames of the video that it is.

    Raises:
        UserError: see `extract_frames`.
    """
    from nerfcli.poses.video_frames import extract_frames, frames_folder

    if not source.is_file():
        if frames is not None:
            console.note(f"{source} is no video: all of its photos are used, whatever --frames says")
        return source
    folder = frames_folder(scene)
    with console.progress(f"frames of {source.name}") as update:
        extract_frames(source, folder, count=frames, overwrite=overwrite, notify=console.note, progress=update)
    return folder
