"""A COLMAP model in memory, as its files hold it, and conversions between it and a capture."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.formats.limits import left_out, plausible
from nerfcli.errors import UserError

# Point id of a feature without a point: in the file, the largest unsigned 64-bit number, which is -1 if signed.
NO_POINT = -1

_REGISTER = "register the image again, or remove its lines"


@dataclass(frozen=True)
class ColmapImage:
    """A registered image of a model.

    Args:
        name: with forward slashes, relative to the folder of the photos.
        world_from_cam: (4, 4).
        pixels: (F, 2) positions of its features, float64.
        point_ids: (F,) int64 ids of their points, -1 where a feature has none.
    """

    image_id: int
    name: str
    camera_id: int
    world_from_cam: np.ndarray
    pixels: np.ndarray
    point_ids: np.ndarray


@dataclass(frozen=True)
class ColmapModel:
    """Cameras by id, images in any order, and points (N, 3) float64 with ids (N,) int64 and colours (N, 3) uint8.

    `notes` says which images were left out, for people.
    """

    cameras: dict[int, Camera]
    images: tuple[ColmapImage, ...]
    points: np.ndarray
    point_ids: np.ndarray
    colours: np.ndarray
    notes: tuple[str, ...] = ()


# An image as a file holds it: its id, name, camera's id, `cam_from_world` as a quaternion wxyz and a translation (7,),
# positions (F, 2) of its features, and ids (F,) of their points.
ImageRow = tuple[int, str, int, Sequence[float], np.ndarray, np.ndarray]


def images_of_rows(rows: list[ImageRow]) -> tuple[list[ColmapImage], tuple[str, ...]]:
    """Return the images of a file, without those whose pose is not finite or has no rotation, and a note about these.

    Raises:
        ValueError: a number is invalid, in which case its image is named, or two images have the same id.
        UserError: too few images have a usable pose.
    """
    if len({row[0] for row in rows}) < len(rows):
        raise ValueError("two images have the same id")
    cam_from_world = np.array([row[3] for row in rows], dtype=np.float64).reshape(-1, 7)
    usable = np.asarray(np.isfinite(cam_from_world).all(axis=1) & cam_from_world[:, :4].any(axis=1))
    wrong = usable & ~plausible(cam_from_world)
    if wrong.any():
        values = ", ".join(f"{value:g}" for value in cam_from_world[np.argmax(wrong)])
        raise ValueError(f"the pose of image {rows[np.argmax(wrong)][1]} is not in a plausible range: {values}")
    lost = [
        (rows[i][1], UserError(f"the pose of image {rows[i][1]} is not finite, or a quaternion of length 0", _REGISTER))
        for i in np.flatnonzero(~usable)
    ]
    notes = left_out(lost, len(rows))
    rotations = rigid.rotation_from_quaternion(cam_from_world[usable, :4])
    poses = rigid.inverse(rigid.from_parts(rotations, cam_from_world[usable, 4:]))
    images = []
    for index, pose in zip(np.flatnonzero(usable).tolist(), poses, strict=True):
        image_id, name, camera_id, _, pixels, point_ids = rows[index]
        if not name or not plausible(pixels.reshape(1, -1)).all():
            raise ValueError(f"image {image_id} ({name!r}) has no name, or a feature with invalid coordinates")
        images.append(ColmapImage(image_id, name, camera_id, pose, pixels, point_ids))
    return images, notes


def capture_of(model: ColmapModel) -> Capture:
    """Convert a model to a capture, with frames ordered by image id.

    Cameras stay shared: frames of one camera id hold the same object. If the model has no points at all (some people
    empty that file), features have no point. COLMAP leaves points black until it has looked up their colours, so if all
    are black, the capture has no colours.

    Raises:
        ValueError: a feature has a point that is not in the model, or two points have the same id.
    """
    images = sorted(model.images, key=lambda image: image.image_id)
    frames = tuple(Frame(image.name, model.cameras[image.camera_id], image.world_from_cam) for image in images)
    counts = [len(image.pixels) for image in images]
    observations = None
    if sum(counts):
        point_ids = np.concatenate([image.point_ids for image in images])
        observations = Observations(
            frame_index=np.repeat(np.arange(len(images)), counts),
            point_index=_point_index(point_ids, model.point_ids),
            pixels=np.concatenate([image.pixels for image in images]),
        )
    colours = model.colours if model.colours.any() else None
    return Capture(
        frames, model.points, (), None, "colmap", colours=colours, observations=observations, notes=model.notes
    )


def model_of(capture: Capture) -> ColmapModel:
    """Convert a capture to a model; ids count from 1, and equal cameras share one id."""
    camera_ids: dict[Camera, int] = {}
    for frame in capture.frames:
        camera_ids.setdefault(frame.camera, len(camera_ids) + 1)
    num_frames, num_points = len(capture.frames), len(capture.points)
    seen = capture.observations
    if seen is None:
        seen = Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    order = np.argsort(seen.frame_index, kind="stable")
    bounds = np.searchsorted(seen.frame_index[order], np.arange(num_frames + 1))
    pixels = np.asarray(seen.pixels, dtype=np.float64)[order]
    point_ids = np.where(seen.point_index >= 0, seen.point_index + 1, NO_POINT).astype(np.int64)[order]
    images = tuple(
        ColmapImage(
            index + 1,
            frame.name,
            camera_ids[frame.camera],
            frame.world_from_cam,
            pixels[bounds[index] : bounds[index + 1]],
            point_ids[bounds[index] : bounds[index + 1]],
        )
        for index, frame in enumerate(capture.frames)
    )
    colours = np.zeros((num_points, 3), np.uint8) if capture.colours is None else capture.colours
    return ColmapModel(
        {camera_id: camera for camera, camera_id in camera_ids.items()},
        images,
        np.asarray(capture.points, dtype=np.float64),
        np.arange(1, num_points + 1, dtype=np.int64),
        np.asarray(colours, dtype=np.uint8),
    )


def pose_rows(model: ColmapModel) -> np.ndarray:
    """Return `cam_from_world` of the images as COLMAP writes it: (images, 7) quaternions wxyz and translations."""
    poses = np.array([image.world_from_cam for image in model.images]).reshape(-1, 4, 4)
    cam_from_world = rigid.inverse(poses)
    quaternions = rigid.quaternion_from_rotation(cam_from_world[:, :3, :3])
    return np.concatenate([quaternions, cam_from_world[:, :3, 3]], axis=1)


def tracks(model: ColmapModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the observations of the points of a model.

    Returns:
        elements (M, 2) uint32: image id and index of the feature in that image, point after point; lengths (N,) int64:
        the number of elements of each point.
    """
    counts = [len(image.point_ids) for image in model.images]
    image_ids = np.repeat([image.image_id for image in model.images], counts)
    starts = np.cumsum([0, *counts])[:-1] if counts else np.zeros(0, np.int64)
    feature_index = np.arange(sum(counts)) - np.repeat(starts, counts)
    point_ids = np.concatenate([np.zeros(0, np.int64), *(image.point_ids for image in model.images)])
    point_index = _point_index(point_ids, model.point_ids)
    order = np.argsort(point_index, kind="stable")
    order = order[np.searchsorted(point_index[order], 0) :]  # features without a point have -1 and come first
    elements = np.stack([image_ids[order], feature_index[order]], axis=-1).astype(np.uint32)
    return elements, np.bincount(point_index[order], minlength=len(model.point_ids))


def _point_index(ids: np.ndarray, known_ids: np.ndarray) -> np.ndarray:
    """Return the index of each id (M,) in `known_ids` (N,); -1 for `NO_POINT`, and for all if `known_ids` is empty."""
    if not len(known_ids):
        return np.full(len(ids), -1, dtype=np.int64)
    order = np.argsort(known_ids, kind="stable")
    ordered = known_ids[order]
    if (ordered[1:] == ordered[:-1]).any():
        raise ValueError(f"two points have the id {ordered[1:][ordered[1:] == ordered[:-1]][0]}")
    place = np.minimum(np.searchsorted(ordered, ids), len(ordered) - 1)
    found = ordered[place] == ids
    if not (found | (ids == NO_POINT)).all():
        raise ValueError(f"a feature refers to point {ids[~found & (ids != NO_POINT)][0]}, which does not exist")
    return np.where(found, order[place], -1).astype(np.int64)
