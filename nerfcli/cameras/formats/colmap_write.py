"""Writing COLMAP models, binary or text: the three files that every version of COLMAP and related programs read.

pycolmap 4.2.1 reads a model without rigs and frames and makes a rig of each camera.
"""

from collections.abc import Callable
from pathlib import Path

from nerfcli.atomic import atomic_folder
from nerfcli.cameras.formats import colmap_binary, colmap_text
from nerfcli.cameras.formats.colmap_model import ColmapModel, model_of
from nerfcli.cameras.formats.unsupported import lost_parts
from nerfcli.cameras.frame import Capture
from nerfcli.errors import UserError

# Models are replaced as a whole: new files would be wrong together with remaining files of another model.
_MODEL_FILES = {
    f"{name}{end}" for name in ("cameras", "images", "points3D", "rigs", "frames") for end in (".bin", ".txt")
}


def losses_colmap(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that a binary COLMAP model cannot hold."""
    return tuple(lost_parts(capture, holds=("points", "colours", "observations")))


def losses_colmap_text(capture: Capture) -> tuple[str, ...]:
    """List the parts of a capture that a COLMAP text model cannot hold: COLMAP truncates names at their first space."""
    spaced = sum(" " in frame.name for frame in capture.frames)
    names = [f"{spaced} names with spaces (COLMAP truncates them at the first space)"] if spaced else []
    return (*losses_colmap(capture), *names)


def write_colmap_binary(capture: Capture, path: Path) -> None:
    """Write a capture as cameras.bin, images.bin and points3D.bin into the folder `path`, all or none.

    Ids count from 1 in the order of the frames, equal cameras have one id, points without colours are black and their
    reprojection errors -1 (not measured), as in COLMAP.

    Raises:
        UserError: a name that the files cannot hold, or a folder that cannot be written or holds other files.
    """
    for frame in capture.frames:
        if not frame.name or "\0" in frame.name:
            raise _bad_name(frame.name)
    _write(
        capture,
        path,
        {
            "cameras.bin": colmap_binary.cameras_to_bytes,
            "images.bin": colmap_binary.images_to_bytes,
            "points3D.bin": colmap_binary.points_to_bytes,
        },
    )


def write_colmap_text(capture: Capture, path: Path) -> None:
    """Write a capture as cameras.txt, images.txt and points3D.txt into the folder `path`, all or none.

    As `write_colmap_binary`; numbers are written with full precision.

    Raises:
        UserError: a name that the files cannot hold, or a folder that cannot be written or holds other files.
    """
    for frame in capture.frames:
        if not frame.name or frame.name != frame.name.strip() or "\n" in frame.name or "\r" in frame.name:
            raise _bad_name(frame.name)
    _write(
        capture,
        path,
        {
            "cameras.txt": colmap_text.cameras_to_text,
            "images.txt": colmap_text.images_to_text,
            "points3D.txt": colmap_text.points_to_text,
        },
    )


def _write(capture: Capture, path: Path, files: dict[str, Callable[[ColmapModel], bytes]]) -> None:
    others = {item.name for item in path.iterdir()} - _MODEL_FILES if path.is_dir() else set()
    if others:
        raise UserError(
            f"{path} contains files other than a COLMAP model, such as {min(others)}",
            "use a separate folder, such as sparse/0 in it",
        )
    model = model_of(capture)
    with atomic_folder(path) as partial:
        for name, to_bytes in files.items():
            (partial / name).write_bytes(to_bytes(model))


def _bad_name(name: str) -> UserError:
    return UserError(f"the name {name!r} cannot be written to a COLMAP model", "rename the photo")
