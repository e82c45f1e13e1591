"""File names of an export."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from nerfcli.cameras.frame import Frame


def file_names(frames: Sequence[Frame]) -> list[str]:
    """Return the frames' names without suffix, with subfolders; the suffix stays where names would be the same.

    ".." in a name ("../images") is replaced by "up", so that nothing is written outside the export.
    """
    names = ["/".join("up" if part == ".." else part for part in PurePosixPath(frame.name).parts) for frame in frames]
    stems = [str(PurePosixPath(name).with_suffix("")) for name in names]
    taken = Counter([*stems, *names])
    # A name without a suffix is its own stem, and counts twice.
    return [stem if taken[stem] == 1 + (stem == name) else name for stem, name in zip(stems, names, strict=True)]


def describe_frames(frames: Sequence[Frame]) -> list[dict[str, Any]]:
    """Return files, cameras and poses of the pictures, as stored in render.json."""
    return [
        {"file": name, "camera": frame.camera.to_json(), "world_from_cam": frame.world_from_cam.tolist()}
        for frame, name in zip(frames, file_names(frames), strict=True)
    ]


def with_suffix(stem: Path, suffix: str) -> Path:
    """Add a suffix to a name; an existing suffix is kept, since it distinguishes a.jpg from a.png."""
    return stem.with_name(stem.name + suffix)
