"""RUN/photo_depths.npz and RUN/depth_errors.json: depths of the training photos, and errors of the field's depth.

Both are stored with the digest of what they depend on, because computing them takes seconds.
"""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerfcli.atomic import atomic_path
from nerfcli.cameras.frame import Frame
from nerfcli.render.depth_errors import STRATA, DepthErrors
from nerfcli.render.visibility import STEEPEST_DEG, DepthMap, small_frame
from nerfcli.runs.files import DEPTH_ERRORS, PHOTO_DEPTHS
from nerfcli.sealed import digest, read_sealed, write_sealed

FORMAT, ERRORS_FORMAT = "nerfcli photo depths 1", "nerfcli depth errors 1"


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


def read_depth_errors(run: Path, *, expected: str) -> DepthErrors | None:
    """Return the stored errors; None if they are missing, damaged, or have another digest."""
    try:
        content = read_sealed(run / DEPTH_ERRORS)
        if (content["format"], content["digest"], content["strata"]) != (ERRORS_FORMAT, expected, list(STRATA)):
            return None
        return DepthErrors.from_json(content)
    except (OSError, ValueError, LookupError, TypeError):
        return None  # the caller measures them again


def write_depth_errors(run: Path, errors: DepthErrors, *, digest: str) -> None:
    """Write the errors, atomically.

    Raises:
        UserError: the file cannot be written.
    """
    write_sealed(run / DEPTH_ERRORS, {"format": ERRORS_FORMAT, "digest": digest, **errors.to_json()})
