"""Captures without pictures: features and matches of known cameras, in the database that pycolmap maps from.

The results of an extractor and a matcher are simulated: noise on every feature, features without a partner, wrong
matches. Everything from the verification of the matches on is real.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from nerfcli.poses.input.job import CameraGroup, Job
from nerfcli.poses.input.pairs import all_pairs
from nerfcli.poses.input.settings import LARGEST_PX

Array = NDArray[np.float64]

# Points farther away are too small to have features.
_FARTHEST = 15.0


@dataclass(frozen=True)
class Lens:
    """A camera: its COLMAP model and true parameters, and the model that the mapper starts from."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    start_model: str = "SIMPLE_RADIAL"


WIDE = Lens("SIMPLE_RADIAL", 1000, 750, (800.0, 500.0, 375.0, -0.05))
LONG = Lens("SIMPLE_RADIAL", 900, 1200, (1600.0, 450.0, 600.0, 0.02))
PHONE = Lens("RADIAL", 1000, 750, (820.0, 510.0, 369.0, 0.12, -0.25))
FISHEYE = Lens("OPENCV_FISHEYE", 1000, 1000, (320.0, 320.0, 500.0, 500.0, 0.03, -0.01, 0.004, -0.001), "OPENCV_FISHEYE")

# The same lens, but unknown, as for photos without EXIF.
UNKNOWN_FISHEYE = replace(FISHEYE, start_model="SIMPLE_RADIAL")


@dataclass(frozen=True)
class Scene:
    """The points of a scene.

    points (n, 3); normals (n, 3): a point is seen only from its front; looks (n,): points with the same number look
    alike, and a matcher may confuse them.
    """

    points: Array
    normals: Array
    looks: NDArray[np.int64]


@dataclass(frozen=True)
class View:
    """A photo: its lens, and the pose (3, 4) of its camera from the world, OpenCV axes."""

    lens: Lens
    cam_from_world: Array

    @property
    def centre(self) -> Array:
        """Centre of the camera in the world."""
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]


@dataclass(frozen=True)
class Noise:
    """features_px: standard deviation. outliers: fraction of wrong matches. missed: fraction of matches not found."""

    features_px: float = 0.5
    outliers: float = 0.1
    missed: float = 0.3


def boulder(count: int, *, seed: int, centre: Sequence[float] = (0.0, 0.0, 0.0)) -> Scene:
    """Return a bumpy ball of radius about 1."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * rng.uniform(0.75, 1.15, size=(count, 1)) + np.asarray(centre)
    return Scene(points, normals, np.arange(count))


def twofold(count: int, *, seed: int) -> Scene:
    """Return a boulder whose back looks like its front: each point has a look-alike across the z axis."""
    half = boulder(count // 2, seed=seed)
    turn = np.diag([-1.0, -1.0, 1.0])
    return Scene(
        np.vstack([half.points, half.points @ turn]),
        np.vstack([half.normals, half.normals @ turn]),
        np.concatenate([half.looks, half.looks]),
    )


def room(count: int, *, seed: int) -> Scene:
    """Return the inside of a box of 8 x 8 x 4."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, size=(count, 3))
    wall, side = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    points[np.arange(count), wall] = side
    normals = np.zeros((count, 3))
    normals[np.arange(count), wall] = -side
    return Scene(points * [4.0, 4.0, 2.0], normals, np.arange(count))


def wall(count: int, *, seed: int, size: float = 6.0, depth: float = 0.0) -> Scene:
    """Return a square facing +z, with points up to `depth` in front of it; a plane for depth 0."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, size=(count, 3)) * [size / 2, size / 2, 0.0]
    points[:, 2] = rng.uniform(0, depth, count)
    return Scene(points, np.tile([0.0, 0.0, 1.0], (count, 1)), np.arange(count))


def courtyard(count: int, *, seed: int, radius: float = 9.0) -> Scene:
    """Return the inside of a round wall of height 4 with a roughness of 1."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0, 2 * np.pi, count)
    outward = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
    points = outward * rng.uniform(radius - 1, radius, size=(count, 1)) + rng.uniform(-2, 2, (count, 1)) * [0, 0, 1]
    return Scene(points, -outward, np.arange(count))


def together(one: Scene, other: Scene) -> Scene:
    """Return both scenes together; no point of one looks like a point of the other."""
    return Scene(
        np.vstack([one.points, other.points]),
        np.vstack([one.normals, other.normals]),
        np.concatenate([one.looks, other.looks + one.looks.max() + 1]),
    )


def looking_at(centre: Array, target: Array) -> Array:
    """Return the pose (3, 4) of a camera at `centre` that looks at `target`, with z up."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ centre])


def ring(
    count: int,
    lenses: Sequence[Lens],
    *,
    seed: int,
    radius: float = 3.5,
    turn_deg: float = 360,
    at: Sequence[float] = (),
) -> list[View]:
    """Return photos around the origin (or `at`) looking at it, from varied heights and distances, lenses in turn."""
    rng = np.random.default_rng(seed)
    middle = np.asarray(at) if at else np.zeros(3)
    views = []
    for index in range(count):
        angle = np.radians(turn_deg) * index / count
        centre = radius * rng.uniform(0.9, 1.1) * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.1, 0.4)])
        target = middle + rng.normal(scale=0.1, size=3)
        views.append(View(lenses[index % len(lenses)], looking_at(middle + centre, target)))
    return views


def dome(count: int, lens: Lens, *, seed: int, radius: float = 4.2, span_deg: float = 60) -> list[View]:
    """Return photos from one side of the origin, in rows that span `span_deg` to both sides, as a robot takes them."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))
    views = []
    for index in range(count):
        across, up = (index % side) / (side - 1), (index // side) / (side - 1)
        angle, height = np.radians([span_deg * (2 * across - 1), 20 + 0.6 * span_deg * up]) + rng.normal(
            scale=0.02, size=2
        )
        ahead = np.array([np.cos(angle) * np.cos(height), np.sin(angle) * np.cos(height), np.sin(height)])
        centre = radius * rng.uniform(0.97, 1.03) * ahead
        views.append(View(lens, looking_at(centre, rng.normal(scale=0.05, size=3))))
    return views


def panorama(count: int, lens: Lens, *, turn_deg: float = 300) -> list[View]:
    """Return photos from one place, by a camera that only rotates."""
    angles = np.radians(turn_deg) * np.arange(count) / count
    centre = np.array([0.3, -0.2, 0.1])
    return [
        View(lens, looking_at(centre, centre + np.array([np.cos(a), np.sin(a), 0.1 * np.sin(3 * a)]))) for a in angles
    ]


def walk(count: int, lens: Lens, *, radius: float = 5.0) -> list[View]:
    """Return a walk around a circle, looking outward: the last photos see what the first ones saw."""
    angles = 2 * np.pi * np.arange(count) / count
    directions = np.column_stack([np.cos(angles), np.sin(angles), 0.1 * np.sin(3 * angles)])
    return [View(lens, looking_at(radius * d, (radius + 1) * d)) for d in directions]


def town(count: int, lens: Lens, *, seed: int, blocks: int = 4) -> tuple[list[View], Scene]:
    """Return a walk around each of `blocks` x `blocks` houses in turn, and the points of their walls.

    Houses are 8 m wide and 4 m high, streets 6 m. The camera looks ahead at the house, and sees others behind it.
    """
    rng = np.random.default_rng(seed)
    pitch, half = 14.0, 4.0
    centres = pitch * np.array([[x, y, 0.0] for x in range(blocks) for y in range(blocks)])
    outward = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
    along = np.roll(outward, -1, axis=0)
    points, normals = [], []
    for middle in centres:
        for out, side in zip(outward, along, strict=True):
            across = rng.uniform(-half, half, (400, 1))
            heights = rng.uniform(-2, 2, (400, 1)) * [0.0, 0.0, 1.0]
            points.append(middle + out * rng.uniform(half - 0.3, half, (400, 1)) + side * across + heights)
            normals.append(np.tile(out, (400, 1)))

    def place(house: int, turn: float) -> Array:
        side, far = int(4 * (turn % 1)), pitch * (4 * turn % 1 - 0.5)
        return centres[house] + outward[side] * pitch / 2 + along[side] * far

    views = []
    for index in range(count):
        house, turn = divmod(index * len(centres) / count, 1.0)
        middle = centres[int(house)]
        ahead = middle + np.clip(place(int(house), turn + 0.12) - middle, -half, half)
        centre = place(int(house), turn) + rng.normal(scale=0.05, size=3)
        views.append(View(lens, looking_at(centre, ahead)))
    return views, Scene(np.vstack(points), np.vstack(normals), np.arange(400 * 4 * len(centres)))


def above(count: int, lens: Lens, *, seed: int, height: float = 5.0, tilt: float = 0.0) -> list[View]:
    """Return photos towards -z from a grid at about one height, as from a drone.

    tilt: largest distance per axis between the target and the point below the camera, as a fraction of the height.
    """
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))
    views = []
    for index in range(count):
        x, y = (index // side, index % side) - np.full(2, (side - 1) / 2)
        centre = np.array([x, y, height * rng.uniform(0.98, 1.02)])
        aim = rng.normal(scale=0.01, size=2) + tilt * rng.uniform(-1, 1, size=2)
        # Slightly off the vertical, where "up" would be undefined.
        views.append(View(lens, looking_at(centre, centre + height * np.array([*aim, -1.0]))))
    return views


def each_its_own(views: Sequence[View], *, seed: int) -> list[View]:
    """Return the same photos, each by a separate camera with a different focal length."""
    rng = np.random.default_rng(seed)
    return [
        replace(view, lens=replace(view.lens, params=(view.lens.params[0] * factor, *view.lens.params[1:])))
        for view, factor in zip(views, rng.uniform(0.8, 1.3, len(views)), strict=True)
    ]


def turned_away(views: Sequence[View]) -> list[View]:
    """Return photos from the same places, looking the other way."""
    return [View(view.lens, looking_at(view.centre, view.centre - view.cam_from_world[2, :3])) for view in views]


def seen(view: View, scene: Scene) -> tuple[NDArray[np.int64], Array]:
    """Return the indices of the points that a view sees from their front, and their pixels (n, 2)."""
    camera = _camera(view.lens, 1)
    towards = view.centre - scene.points
    distances = np.linalg.norm(towards, axis=1)
    facing = (np.einsum("ij,ij->i", towards, scene.normals) > 0.3 * distances) & (distances < _FARTHEST)
    local = scene.points @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
    candidates = np.flatnonzero(facing & (local[:, 2] > 0.1))
    pixels = np.asarray(camera.img_from_cam(local[candidates]), dtype=np.float64).reshape(-1, 2)
    inside = ((pixels > 1) & (pixels < np.array([camera.width, camera.height]) - 1)).all(axis=1)
    return candidates[inside], pixels[inside]


def write_database(
    path: Path,
    views: Sequence[View],
    scene: Scene,
    *,
    noise: Noise,
    seed: int,
    pairs: Callable[[int, int], bool] = lambda i, j: True,
    threads: int = 1,
) -> None:
    """Write features and verified matches of the views; photo i is called 0000i.jpg, with image id i + 1.

    Each lens becomes one camera, with unknown focal length unless it is a fisheye. Only pairs for which `pairs` is true
    are compared. Look-alike points that two photos see are matched as if they were the same.
    """
    rng = np.random.default_rng(seed)
    lenses = list(dict.fromkeys(view.lens for view in views))
    with pycolmap.Database.open(str(path)) as database:
        for number, lens in enumerate(lenses):
            start = pycolmap.Camera.create_from_model_name(
                number + 1, lens.start_model, 1.2 * max(lens.width, lens.height), lens.width, lens.height
            )
            if "FISHEYE" in lens.start_model:  # as given by a user who knows the lens
                start.params = [*lens.params[:4], *[0.0] * (len(start.params) - 4)]
                start.has_prior_focal_length = True
            write_camera(database, start)
        order: list[dict[int, int]] = []
        for number, view in enumerate(views):
            points, pixels = seen(view, scene)
            keypoints, looks, index = _features(points, pixels, view.lens, scene, noise=noise, rng=rng)
            write_image(database, number, lenses.index(view.lens) + 1, keypoints=keypoints, looks=looks)
            order.append(index)
        for i in range(len(views)):
            for j in range(i + 1, len(views)):
                if pairs(i, j):
                    matches = _matches(order[i], order[j], noise=noise, rng=rng)
                    if len(matches) >= 15:
                        database.write_matches(i + 1, j + 1, matches)
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = threads
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = seed
    pycolmap.geometric_verification(str(path), verifier, two_view_geometry_options=geometry)


def write_camera(database: pycolmap.Database, camera: pycolmap.Camera) -> None:
    """Write a camera and its rig under the camera's id."""
    camera_id = database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def write_image(
    database: pycolmap.Database, number: int, camera_id: int, *, keypoints: Array, looks: NDArray[np.int64]
) -> None:
    """Write photo `number` and its features, with the appearance of `looks` (-1: like no point)."""
    image = pycolmap.Image(name=photo_name(number), camera_id=camera_id, image_id=number + 1)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=number + 1, rig_id=camera_id)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)
    database.write_keypoints(number + 1, keypoints.astype(np.float32))
    sift = pycolmap.FeatureExtractorType.SIFT
    database.write_descriptors(number + 1, pycolmap.FeatureDescriptors(sift, _appearance(looks, seed=number)))


def _appearance(looks: NDArray[np.int64], *, seed: int) -> NDArray[np.uint8]:
    """Return descriptors (n, 128) of norm 512, as in pycolmap.

    Scaled to norm 1, those of the same look are 0.35 apart, others 0.85.
    """
    rng = np.random.default_rng([seed, 1])
    descriptors = np.abs(np.random.default_rng(0).normal(size=(looks.max(initial=-1) + 1, 128)))
    found = np.abs(rng.normal(size=(len(looks), 128)))
    found[looks >= 0] = descriptors[looks[looks >= 0]]
    found *= np.exp(rng.normal(scale=0.25, size=found.shape))
    return np.minimum(np.rint(512 * found / np.linalg.norm(found, axis=1, keepdims=True)), 255).astype(np.uint8)


def synthetic_job(folder: Path, views: Sequence[View], *, seed: int) -> Job:
    """Return the job of mapping from folder/database.db, without photos: all features and matches exist already."""
    work = folder / "work"
    (work / "photos").mkdir(parents=True)
    names = tuple(photo_name(number) for number in range(len(views)))
    lenses = dict.fromkeys(view.lens for view in views)
    groups = tuple(
        CameraGroup(
            photos=tuple(number for number, view in enumerate(views) if view.lens == lens),
            model=lens.start_model,
            width=lens.width,
            height=lens.height,
            choose=True,
        )
        for lens in lenses
    )
    return job_of(work, names, groups, pairs=all_pairs(len(views)), seed=seed)


def job_of(work: Path, files: tuple[str, ...], groups: tuple[CameraGroup, ...], **others: Any) -> Job:
    """Return the job of photos in a work folder, on one thread, without pairs but for `others`: any fields of `Job`."""
    usual: dict[str, Any] = {
        "originals": str(work / "photos"),
        "names": files,
        "keys": files,
        "pairs": (),
        "neighbours": 0,
    }
    usual |= {"max_image_size": LARGEST_PX, "max_features": 8192, "seed": 0, "threads": 1}
    return Job(folder=str(work), files=files, groups=groups, **usual | others)


def true_model(views: Sequence[View]) -> pycolmap.Reconstruction:
    """Return the true cameras and poses, with the image ids and names of `write_database`, and no points."""
    model = pycolmap.Reconstruction()
    lenses = list(dict.fromkeys(view.lens for view in views))
    for number, lens in enumerate(lenses):
        model.add_camera_with_trivial_rig(_camera(lens, number + 1))
    for number, view in enumerate(views):
        image = pycolmap.Image(name=photo_name(number), camera_id=lenses.index(view.lens) + 1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world))
    return model


def observed_model(
    views: Sequence[View], scene: Scene, *, noise_px: float, seed: int, shiny: float = 0.0, slide: float = 0.05
) -> pycolmap.Reconstruction:
    """Return the true cameras, poses and points, with noisy observations in each view.

    shiny: fraction of the points that are highlights. They slide along the surface as the view moves, each in its own
    direction, by about `slide` scene units from the middle to the side.
    """
    rng = np.random.default_rng(seed)
    model = true_model(views)
    highlights = np.random.default_rng([seed, 1])
    directions = np.cross(scene.normals, highlights.normal(size=scene.points.shape))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    slides = (
        slide * np.abs(highlights.normal(size=len(directions))) * (highlights.uniform(size=len(directions)) < shiny)
    )
    sightings: dict[int, list[tuple[int, int]]] = {}
    for number, view in enumerate(views):
        points, pixels = seen(view, scene)
        if shiny:
            towards = view.centre - scene.points[points]
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            along = slides[points] * np.einsum("ij,ij->i", towards, directions[points])
            slid = scene.points[points] + along[:, None] * directions[points]
            local = slid @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
            pixels = np.asarray(_camera(view.lens, 1).img_from_cam(local), dtype=np.float64)
        noisy = pixels + rng.normal(scale=noise_px, size=pixels.shape)
        model.image(number + 1).points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in noisy])
        for index, point in enumerate(points):
            sightings.setdefault(int(point), []).append((number + 1, index))
    for point, seen_by in sorted(sightings.items()):
        if len(seen_by) >= 2:
            track = pycolmap.Track([pycolmap.TrackElement(image_id, index) for image_id, index in seen_by])
            model.add_point3D(scene.points[point], track)
    model.update_point_3d_errors()
    return model


def bent(model: pycolmap.Reconstruction, first: int) -> pycolmap.Reconstruction:
    """Return the model with the images from id `first` on, and the points they mostly see, turned by 40 degrees.

    The axis is outside the scene. Residuals within either part do not change; observations across the parts are
    deleted, as by a mapper.
    """
    wrong = pycolmap.Reconstruction(model)
    angle = np.radians(40)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    move = pycolmap.Rigid3d(np.column_stack([turn, [2.0, 0.0, 0.5]]))
    for point_id in sorted(wrong.point3D_ids()):
        elements = [(element.image_id, element.point2D_idx) for element in wrong.point3D(point_id).track.elements]
        moved = sum(image_id >= first for image_id, _ in elements) > len(elements) / 2
        for image_id, index in elements:
            if (image_id >= first) != moved and wrong.exists_point3D(point_id):
                wrong.delete_observation(image_id, index)
        if moved and wrong.exists_point3D(point_id):
            wrong.point3D(point_id).xyz = move * wrong.point3D(point_id).xyz
    for image_id in wrong.reg_image_ids():
        if image_id >= first:
            frame = wrong.frame(wrong.image(image_id).frame_id)
            frame.rig_from_world = wrong.image(image_id).cam_from_world() * move.inverse()
    wrong.update_point_3d_errors()
    return wrong


def photo_name(number: int) -> str:
    """Return the name that the worker gives a photo."""
    return f"{number:05d}.jpg"


def _camera(lens: Lens, camera_id: int) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_name(camera_id, lens.model, 1.0, lens.width, lens.height)
    camera.params = list(lens.params)
    return camera


def _features(
    points: NDArray[np.int64], pixels: Array, lens: Lens, scene: Scene, *, noise: Noise, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64], dict[int, int]]:
    """Return shuffled keypoints including clutter, the look of each (-1: none), and the keypoint of each look."""
    noisy = pixels + rng.normal(scale=noise.features_px, size=pixels.shape)
    clutter = rng.uniform(0, [lens.width, lens.height], size=(len(points) // 4 + 10, 2))
    looks = np.concatenate([scene.looks[points], np.full(len(clutter), -1)])
    shuffled = rng.permutation(len(looks))
    index = {int(looks[old]): new for new, old in enumerate(shuffled) if looks[old] >= 0}
    return np.vstack([noisy, clutter])[shuffled], looks[shuffled], index


def _matches(
    one: dict[int, int], other: dict[int, int], *, noise: Noise, rng: np.random.Generator
) -> NDArray[np.uint32]:
    common = [look for look in one if look in other and rng.uniform() > noise.missed]
    right = [(one[look], other[look]) for look in common]
    wrong_count = round(len(right) * noise.outliers / (1 - noise.outliers))
    if not right:
        return np.zeros((0, 2), np.uint32)
    wrong = np.column_stack(
        [rng.choice(list(one.values()), wrong_count), rng.choice(list(other.values()), wrong_count)]
    )
    return np.vstack([right, wrong]).astype(np.uint32)
