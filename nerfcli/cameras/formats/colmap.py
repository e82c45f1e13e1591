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
from pathlib import Path
from typing import TypeVar

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats import colmap_binary, colmap_text
from nerfcli.cameras.formats.colmap_model import ColmapImage, ColmapModel, capture_of
from nerfcli.cameras.frame import Capture, Frame
from nerfcli.cameras.orientation import Measure, counted, fit_to_picture, rescaling
from nerfcli.errors import UserError

FILES = ("cameras", "images", "points3D")

T = TypeVar("T")


def is_model(folder: Path) -> bool:
    """Return whether a folder contains the three files of a COLMAP model, binary or text."""
    return any(all((folder / f"{name}{suffix}").is_file() for name in FILES) for suffix in (".bin", ".txt"))


def read_colmap(model_dir: Path, image_dir: Path, measure: Measure) -> Capture:
    """Read the registered images of a COLMAP model, with the pictures found under `image_dir`.

    Args:
        model_dir: holds cameras, images and points3D, as .bin (which wins) or .txt.
        image_dir: image names are relative to it; they may contain subfolders.

    Raises:
        UserError: a file of the model is missing or damaged, or no image is on disk.
    """
    return colmap_on_disk(read_model(model_dir), image_dir, measure, model_dir)


def colmap_on_disk(model: ColmapModel, image_dir: Path, measure: Measure, model_dir: Path) -> Capture:
    """Return `read_colmap` for a model that was already read from `model_dir`."""
    frames, missing, rescaled = [], [], []
    for image in model.images:
        path = image_dir / image.name
        if not path.is_file():
            missing.append(image.name)
            continue
        calibrated = model.cameras[image.camera_id]
        camera, world_from_cam = fit_to_picture(calibrated, image.world_from_cam, path=path, measure=measure)
        rescaled.append(rescaling(calibrated, camera))
        frames.append(Frame(image.name, camera, world_from_cam, image=path))
    if not frames:
        raise UserError(
            f"none of the {len(missing)} images of the model {model_dir} exists in {image_dir}"
            + (f", such as {missing[0]}" if missing else ""),
            "put the photos there, with the names listed in the model",
        )
    return Capture(
        tuple(frames), model.points, tuple(missing), None, "colmap", pixels="upright", rescaled=counted(rescaled)
    )


def parse_colmap(model_dir: Path, image_dir: Path | None = None) -> Capture:
    """Read a COLMAP model: cameras, poses, points with colours, and all 2D features.

    Frames are in the order of their image ids, and frames of one camera share the camera object. A capture does not
    hold the ids, the mean reprojection error of each point, or rigs.

    Args:
        model_dir: holds cameras, images and points3D, as .bin (which wins) or .txt.
        image_dir: the folder that the names of the images are relative to; nothing is looked up there.

    Raises:
        UserError: a file is missing, truncated or inconsistent; the file is named.
    """
    model = read_model(model_dir)
    try:
        return capture_of(model, image_dir)
    except ValueError as error:
        raise UserError(
            f"{_file(model_dir, 'images')} and {_file(model_dir, 'points3D').name} do not belong together: {error}",
            "the files come from different reconstructions; copy all of them again",
        ) from error


def read_model(model_dir: Path) -> ColmapModel:
    """Read a COLMAP model as its files hold it, whether or not pictures are on disk; images are sorted by name.

    Raises:
        UserError: a file is missing, truncated or inconsistent; the file is named.
    """
    cameras_file, images_file, points_file = (_file(model_dir, name) for name in FILES)
    if cameras_file.suffix == ".bin":
        cameras = _parse(cameras_file, colmap_binary.cameras_from_bytes)
        images = _parse(images_file, colmap_binary.images_from_bytes)
        point_ids, points, colours = _parse(points_file, colmap_binary.points_from_bytes)
    else:
        cameras = _parse(cameras_file, colmap_text.cameras_from_text)
        images = _parse(images_file, colmap_text.images_from_text)
        point_ids, points, colours = _parse(points_file, colmap_text.points_from_text)
    if not images:
        raise UserError(f"{model_dir} has no registered images", "the reconstruction is empty; run it again")
    for image in images:
        _check_camera(image, cameras, images_file)
    twice, count = Counter(image.name for image in images).most_common(1)[0]
    if count > 1:
        raise UserError(
            f"{model_dir}: image {twice} is registered twice",
            "each image must have one pose; reconstruct the model again",
        )
    return ColmapModel(cameras, tuple(sorted(images, key=lambda image: image.name)), points, point_ids, colours)


def read_cameras(path: Path) -> tuple[dict[int, Camera], dict[str, int]]:
    """Read the cameras of a cameras.bin or cameras.txt by id, and the camera ids by image name.

    Image names are known only if the model's images file is beside it.

    Raises:
        UserError: a file is not readable, truncated or inconsistent; the file is named.
    """
    binary = path.suffix == ".bin"
    cameras = _parse(path, colmap_binary.cameras_from_bytes if binary else colmap_text.cameras_from_text)
    images_file = path.with_name(f"images{path.suffix}")
    if not images_file.is_file():
        return cameras, {}
    images = _parse(images_file, colmap_binary.images_from_bytes if binary else colmap_text.images_from_text)
    for image in images:
        _check_camera(image, cameras, images_file)
    return cameras, {image.name: image.camera_id for image in images}


def _check_camera(image: ColmapImage, cameras: Mapping[int, Camera], images_file: Path) -> None:
    if image.camera_id not in cameras:
        raise UserError(
            f"{images_file}: image {image.name} refers to camera {image.camera_id}, which does not exist",
            "the files come from different reconstructions; copy all of them again",
        )


def _file(model_dir: Path, name: str) -> Path:
    """Return the file of a model, binary if its cameras are binary."""
    return model_dir / f"{name}{'.bin' if (model_dir / 'cameras.bin').is_file() else '.txt'}"


def _parse(path: Path, reader: Callable[[bytes], T]) -> T:
    """Parse a file's bytes with `reader`, reporting any damage as one error that names the file."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(
            f"{path}: {error.strerror or error}", "a COLMAP model needs cameras, images and points3D, as .bin or .txt"
        ) from error
    try:
        return reader(data)
    except (struct.error, ValueError, IndexError, KeyError) as error:
        raise UserError(
            f"{path} is damaged: {error}", "the file is truncated or was changed; copy or reconstruct the model again"
        ) from error
    except UserError as error:
        raise UserError(f"{path}: {error.message}", error.hint) from error
