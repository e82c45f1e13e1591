"""COLMAP models: cameras, images and points3D, as .bin or .txt.

They are read here and not through pycolmap.Reconstruction, because pycolmap 4.2.1 does not fail on a truncated
points3D.bin or frames.bin: it loops forever and fills the memory. The three files hold all that is needed. The rigs and
frames files of COLMAP 4 say which images were taken together by a camera rig, but each image's own pose is in
images.bin, and pycolmap reads a model without those two files.
Source: colmap.github.io/format.html; colmap src/colmap/scene/reconstruction_io_binary.cc.
"""

import struct
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from nerfcli.atomic import atomic_folder
from nerfcli.cameras.camera import Camera
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import colmap_binary, colmap_text
from nerfcli.captures.formats.colmap_model import ColmapImage, ColmapModel, capture_of, model_of
from nerfcli.captures.formats.fields import malformed, opened
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.limits import largest_of
from nerfcli.captures.formats.photo_names import with_photos
from nerfcli.captures.formats.unsupported import lost_parts
from nerfcli.errors import UserError

FILES = ("cameras", "images", "points3D")
# Models are replaced as a whole: new files would be wrong together with remaining files of another model.
MODEL_FILES = tuple(f"{name}{suffix}" for name in (*FILES, "rigs", "frames") for suffix in (".bin", ".txt"))

_ENCODINGS = {".bin": colmap_binary, ".txt": colmap_text}

T = TypeVar("T")


def is_model(folder: Path) -> bool:
    """Return whether a folder contains the cameras and images of a COLMAP model, binary or text; points may be lost."""
    return any(all((folder / f"{name}{suffix}").is_file() for name in FILES[:2]) for suffix in _ENCODINGS)


def parse_colmap(model_dir: Path) -> Capture:
    """Read a COLMAP model: cameras, poses, points with colours, and all 2D features.

    Frames are in the order of their image ids, and frames of one camera share the camera object. A capture does not
    hold the ids, the mean reprojection error of each point, or rigs.

    Args:
        model_dir: holds cameras, images and points3D, as .bin (which wins) or .txt; points3D may be missing.
    """
    model = read_model(model_dir)
    try:
        return capture_of(model)
    except ValueError as error:
        what = f"{_file(model_dir, 'images')} and {_file(model_dir, 'points3D').name} do not belong together: {error}"
        raise UserError(what, "the files come from different reconstructions; copy all of them again") from error


def parse_model(model_dir: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read a COLMAP model, with its photos in the given folder, or in the model's folder or up to three above it.

    Other models of the same reconstruction are named in a note.
    """
    capture = with_photos(parse_colmap(model_dir), model_dir, *model_dir.resolve().parents[:3], given=given.images)
    home = model_dir.parent if model_dir.name.isdecimal() else model_dir
    counts = {_seen(model): num_images(model) for model in _models_in(home)} | {_seen(model_dir): len(capture.frames)}
    return replace(capture, notes=(*largest_of("", counts, _seen(model_dir), others="other models"), *capture.notes))


def read_model(model_dir: Path) -> ColmapModel:
    """Read a COLMAP model as its files hold it, whether or not pictures are on disk; images are sorted by name.

    Raises:
        UserError: a file is missing, truncated or inconsistent; the file is named.
    """
    cameras_file, images_file, points_file = (_file(model_dir, name) for name in FILES)
    encoding = _ENCODINGS[cameras_file.suffix]
    cameras = _parse(cameras_file, encoding.cameras_from_bytes)
    images, notes = _images_of(images_file, cameras)
    if points_file.exists():
        point_ids, points, colours = _parse(points_file, encoding.points_from_bytes)
    else:
        point_ids, points, colours = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        notes = (*notes, f"{points_file} does not exist: no points are read")
    if not images:
        raise UserError(f"{model_dir} has no registered images", "the reconstruction is empty; run it again")
    twice, count = Counter(image.name for image in images).most_common(1)[0]
    if count > 1:
        hint = "each image must have one pose; reconstruct the model again"
        raise malformed(model_dir, f"image {twice} is registered twice", hint)
    return ColmapModel(cameras, tuple(sorted(images, key=lambda image: image.name)), points, point_ids, colours, notes)


def read_cameras(path: Path) -> tuple[dict[int, Camera], dict[str, int]]:
    """Read the cameras of a cameras.bin or cameras.txt by id, and the camera ids by image name.

    Image names are known only if the model's images file is beside it.
    """
    cameras = _parse(path, _ENCODINGS[path.suffix].cameras_from_bytes)
    images_file = path.with_name(f"images{path.suffix}")
    images, _ = _images_of(images_file, cameras) if images_file.is_file() else ([], ())
    return cameras, {image.name: image.camera_id for image in images}


def _images_of(path: Path, cameras: Mapping[int, Camera]) -> tuple[list[ColmapImage], tuple[str, ...]]:
    """Return the images of a file, whose cameras there must be, and notes."""
    images, notes = _parse(path, _ENCODINGS[path.suffix].images_from_bytes)
    for image in images:
        if image.camera_id not in cameras:
            what = f"image {image.name} refers to camera {image.camera_id}, which does not exist"
            raise malformed(path, what, "the files come from different reconstructions; copy all of them again")
    return images, notes


def _file(model_dir: Path, name: str) -> Path:
    """Return the file of a model, binary if its cameras are binary."""
    return model_dir / f"{name}{'.bin' if (model_dir / 'cameras.bin').is_file() else '.txt'}"


def _parse(path: Path, reader: Callable[[bytes], T]) -> T:
    """Parse a file's bytes with `reader`, reporting any damage as one error that names the file."""
    try:
        data = path.read_bytes()
    except OSError as error:
        hint = "a COLMAP model needs cameras and images, as .bin or .txt"
        raise malformed(path, error.strerror or str(error), hint) from error
    try:
        return reader(data)
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}: the name of a photo is not in UTF-8 (byte 0x{error.object[error.start]:02x})",
            "COLMAP for Windows writes such names of photos in its code page: rename the photos to plain letters and "
            "digits, and reconstruct the model again",
        ) from error
    except (struct.error, ValueError, IndexError, KeyError) as error:
        hint = "the file is truncated or was changed; copy or reconstruct the model again"
        raise UserError(f"{path} is damaged: {error}", hint) from error
    except UserError as error:
        raise UserError(f"{path}: {error.message}", error.hint) from error


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
    reprojection errors -1 (not measured), as in COLMAP. A folder with other files is refused.
    """
    _write(capture, path, ".bin", wrong=[f.name for f in capture.frames if not f.name or "\0" in f.name])


def write_colmap_text(capture: Capture, path: Path) -> None:
    """Write cameras.txt, images.txt and points3D.txt as `write_colmap_binary` does, with numbers in full precision."""
    names = [frame.name for frame in capture.frames]
    wrong = [name for name in names if not name or name != name.strip() or "\n" in name or "\r" in name]
    _write(capture, path, ".txt", wrong=wrong)


def _write(capture: Capture, path: Path, suffix: str, *, wrong: list[str]) -> None:
    if wrong:
        raise UserError(f"the name {wrong[0]!r} cannot be written to a COLMAP model", "rename the photo")
    if path.is_file():
        raise UserError(f"{path} is a file", "give the folder of the model, such as sparse/0")
    others = {item.name for item in path.iterdir()} - set(MODEL_FILES) if path.is_dir() else set()
    if others:
        hint = "use a separate folder, such as sparse/0 in it"
        raise UserError(f"{path} contains files other than a COLMAP model, such as {min(others)}", hint)
    encoding, model = _ENCODINGS[suffix], model_of(capture)
    with atomic_folder(path) as partial:
        (partial / f"cameras{suffix}").write_bytes(encoding.cameras_to_bytes(model))
        (partial / f"images{suffix}").write_bytes(encoding.images_to_bytes(model))
        (partial / f"points3D{suffix}").write_bytes(encoding.points_to_bytes(model))


_FOLDERS = ("sparse", "colmap/sparse", ".", "distorted/sparse", "dense/sparse", "dense/0/sparse")


def find_model(path: Path) -> Path | None:
    """Find the folder of a COLMAP model, or the one that a file of it is in; of several models, that of most images."""
    if path.is_file():
        return path.parent if path.name in MODEL_FILES and is_model(path.parent) else None
    found = next(filter(None, (_models_in(path / name) for name in _FOLDERS)), [])
    return max(found, key=num_images, default=None)


def num_images(model_dir: Path) -> int:
    """Return the number of images that a model announces; 0 if its file is damaged."""
    path = _file(model_dir, "images")
    if path.suffix == ".txt":
        with opened(path) as stream:
            # The line after an image's line lists its features.
            lines = (line for line in stream if line.strip() and not line.lstrip().startswith("#"))
            return sum(1 for _ in lines if next(stream, "") or True)
    with path.open("rb") as stream:
        head = stream.read(8)
    return int.from_bytes(head, "little") if len(head) == 8 else 0


def _models_in(folder: Path) -> list[Path]:
    """Return the models in the numbered folders of a folder, then the one in the folder itself."""
    numbered = [path for path in folder.iterdir() if path.name.isdecimal()] if folder.is_dir() else []
    return [path for path in (*sorted(numbered, key=lambda path: int(path.name)), folder) if is_model(path)]


def _seen(model_dir: Path) -> str:
    return "/".join(model_dir.resolve().parts[-2:])


BINARY = Format(
    "colmap",
    "a COLMAP model",
    find_model,
    parse_model,
    files=MODEL_FILES,
    is_unordered=True,  # ids of a model are in no particular order
    write=write_colmap_binary,
    losses=losses_colmap,
)


TEXT = replace(
    BINARY, name="colmap-text", of="a COLMAP model as text", write=write_colmap_text, losses=losses_colmap_text
)
