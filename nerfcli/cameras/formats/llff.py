"""LLFF captures: poses_bounds.npy beside images/ or images_4/, images_8/.

Each row of the array holds a 3x5 matrix, row by row (the pose with axes down, right, backward; the centre; height,
width, focal length of the full-size photo), and the depths of the nearest and farthest point. Rows are in the order of
the sorted file names. Source: Fyusion/LLFF README, "Using your own poses without running COLMAP".
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.conventions import opencv_from_llff_pose
from nerfcli.cameras.formats.transforms import rigid_pose
from nerfcli.cameras.frame import Capture, Frame
from nerfcli.cameras.orientation import Measure, fit_to_picture
from nerfcli.errors import UserError

IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8")


def read_llff(folder: Path, measure: Measure, list_images: Callable[[Path], list[Path]]) -> Capture:
    """A capture in LLFF's format, with the first image folder that holds one image per row.

    Args:
        folder: holds poses_bounds.npy.
        measure: tells an image's upright size and EXIF orientation.
        list_images: the image files of a folder, sorted by name.

    Raises:
        UserError: the array is damaged or of another shape, or no image folder has as many images as it has rows.
    """
    path = folder / "poses_bounds.npy"
    rows = _read_rows(path)
    images = _images_of_rows(folder, len(rows), list_images)
    frames = []
    for index, (row, image) in enumerate(zip(rows, images, strict=True)):
        where = f"{path}: row {index}"
        matrix = row[:15].reshape(3, 5)
        camera = _camera(matrix[:, 4], where)
        world_from_cam = opencv_from_llff_pose(rigid_pose(matrix[:, :4], where))
        camera, world_from_cam = fit_to_picture(camera, world_from_cam, path=image, measure=measure)
        frames.append(Frame(f"{image.parent.name}/{image.name}", camera, world_from_cam, image=image))
        near, far = row[15:]
        if not 0 < near < far < np.inf:
            raise UserError(
                f"{where}: depth bounds {near:g} and {far:g}", "expected 0 < near < far in the last two columns"
            )
    return Capture(tuple(frames), np.zeros((0, 3)), (), rows[:, 15:].copy(), "llff")


def _read_rows(path: Path) -> np.ndarray:
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(
            f"{path}: no readable NumPy array ({error})",
            "the file is cut off or something else; copy it again from the source",
        ) from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0:
        shape = rows.shape if isinstance(rows, np.ndarray) else type(rows).__name__
        raise UserError(
            f"{path}: an array of {shape}", "expected (images, 17): 3x5 pose and intrinsics, near and far depth"
        )
    return rows.astype(np.float64)


def _images_of_rows(folder: Path, count: int, list_images: Callable[[Path], list[Path]]) -> list[Path]:
    found = []
    for name in IMAGE_FOLDERS:
        if not (folder / name).is_dir():
            continue
        images = list_images(folder / name)
        if len(images) == count:
            return images
        found.append(f"{name}/ has {len(images)}")
    raise UserError(
        f"{folder / 'poses_bounds.npy'} has {count} rows, but {', '.join(found) or 'there is no folder images/'}",
        "the photos must be exactly the ones that the poses were made from, one per row, sorted by name",
    )


def _camera(size_and_focal: np.ndarray, where: str) -> Camera:
    height, width, focal = size_and_focal
    if not np.isfinite(size_and_focal).all() or min(height, width, focal) <= 0:
        raise UserError(
            f"{where}: height, width and focal length are {height:g}, {width:g}, {focal:g}",
            "expected three numbers above 0 in the fifth column of the pose",
        )
    return Camera.pinhole(round(width), round(height), float(focal))
