"""RUN/photo_depths.npz: depth map of the surface for each training photo, stored because rendering takes seconds."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.cameras.frame import Frame
from nerfcli.render.visibility import STEEPEST_DEG, DepthMap, small_frame
from nerfcli.runs.files import PHOTO_DEPTHS
from nerfcli.sealed import digest

FORMAT = "nerfcli photo depths 1"


def photo_depths_digest(field_sha256: str | None, frames: Sequence[Frame], *, max_size: int) -> str:
    """Return the hash of everything that the maps depend on: the field, the cameras of the photos, the size."""
    cameras = [[frame.name, frame.camera.to_json(), frame.world_from_cam.tolist()] for frame in frames]
    return digest([FORMAT, field_sha256, cameras, max_size, STEEPEST_DEG])


def read_photo_depths(run: Path, frames: Sequence[Frame], *, max_size: int, expected: str) -> list[DepthMap] | None:
    """Return the stored maps; None if they are missing, damaged, or have another digest."""
    try:
        # Opened here, because NumPy does not close a file that it cannot read.
        with (run / PHOTO_DEPTHS).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            if str(archive["digest"]) != expected:
                return None
            return [DepthMap(small_frame(frame, max_size), archive[str(i)]) for i, frame in enumerate(frames)]
    except (OSError, ValueError, LookupError, EOFError, zipfile.BadZipFile):
        return None  # the caller renders them again


def write_photo_depths(run: Path, maps: Sequence[DepthMap], *, digest: str) -> None:
    """Write the maps with their digest, atomically.

    Raises:
        UserError: the file cannot be written.
    """
    arrays = {str(index): view.distances for index, view in enumerate(maps)}
    with atomic_path(run / PHOTO_DEPTHS) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays, digest=np.array(digest))
