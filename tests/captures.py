"""Small captures of every camera model with known truth, and comparisons of captures, for tests of capture formats."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture, Observations
from nerfcli.errors import BAD_INPUT, UserError

# Every model of COLMAP, with all of its terms in use.
_PARAMS: dict[str, tuple[float, ...]] = {
    "SIMPLE_PINHOLE": (500.0, 321.0, 239.0),
    "PINHOLE": (500.0, 501.0, 321.0, 239.0),
    "SIMPLE_RADIAL": (500.0, 321.0, 239.0, 0.05),
    "RADIAL": (500.0, 321.0, 239.0, 0.05, -0.02),
    "OPENCV": (500.0, 501.0, 321.0, 239.0, 0.05, -0.02, 0.001, 0.002),
    "FULL_OPENCV": (500.0, 501.0, 321.0, 239.0, 0.05, -0.02, 0.001, 0.002, 0.01, 0.02, 0.01, 0.003),
    "SIMPLE_FISHEYE": (300.0, 321.0, 239.0),
    "FISHEYE": (300.0, 301.0, 321.0, 239.0),
    "SIMPLE_RADIAL_FISHEYE": (300.0, 321.0, 239.0, 0.05),
    "RADIAL_FISHEYE": (300.0, 321.0, 239.0, 0.05, -0.02),
    "OPENCV_FISHEYE": (300.0, 301.0, 321.0, 239.0, 0.05, -0.02, 0.01, -0.003),
    "THIN_PRISM_FISHEYE": (300.0, 301.0, 321.0, 239.0, 0.05, -0.02, 0.001, 0.002, 0.01, -0.003, 0.001, 0.002),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *(300.0, 301.0, 321.0, 239.0, 0.05, -0.02, 0.01, -0.003, 0.001, 0.0005),
        *(0.001, 0.002, 0.001, 2e-4, 0.002, 1e-4),
    ),
    "FOV": (500.0, 501.0, 321.0, 239.0, 0.5),
    "SIMPLE_DIVISION": (500.0, 321.0, 239.0, -0.1),
    "DIVISION": (500.0, 501.0, 321.0, 239.0, -0.1),
    "EUCM": (500.0, 501.0, 321.0, 239.0, 0.6, 1.1),
}
CAMERAS = {model: Camera(model, 640, 480, params) for model, params in _PARAMS.items()}
CAMERAS["EQUIRECTANGULAR"] = Camera("EQUIRECTANGULAR", 640, 320, (640.0, 320.0))


def ring(
    *cameras: Camera,
    num_frames: int = 6,
    num_points: int = 40,
    seed: int = 0,
    num_loose: int = 2,
    name: str = "my photos/ä {:02d}.jpg",
) -> Capture:
    """Return frames around a cloud of coloured points near the origin, with everything that a COLMAP model holds.

    Frames cycle through the cameras. Every point that a frame sees is observed at its projection, and each frame has
    some features without a point. Names contain spaces and non-ASCII letters.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.7, 0.7, size=(num_points, 3))
    frames, frame_index, point_index, pixels = [], [], [], []
    for index in range(num_frames):
        angle = 2 * np.pi * index / num_frames
        centre = np.array([3 * np.cos(angle), 3 * np.sin(angle), rng.uniform(0.2, 1.0)])
        pose = rigid.look_at(centre, rng.normal(scale=0.1, size=3), np.array([0.0, 0.0, 1.0]))
        camera = cameras[index % len(cameras)]
        frames.append(Frame(name.format(index), camera, pose))
        projected, valid = camera.project(rigid.apply(rigid.inverse(pose), points))
        frame_index += [index] * (int(valid.sum()) + num_loose)
        point_index += [*np.flatnonzero(valid), *[-1] * num_loose]
        pixels += [*projected[valid], *rng.uniform(0, 300, size=(num_loose, 2))]
    observations = Observations(np.array(frame_index), np.array(point_index), np.array(pixels).reshape(-1, 2))
    colours = rng.integers(1, 256, size=(num_points, 3), dtype=np.uint8)
    return Capture(tuple(frames), points, (), None, "colmap", colours=colours, observations=observations)


def random_similarity(rng: np.random.Generator, scale: float | None = None) -> rigid.Similarity:
    """Return a random similarity, of a random scale from 0.001 to 1000 unless it is given."""
    scale = 10.0 ** rng.uniform(-3, 3) if scale is None else scale
    return rigid.Similarity(scale, Rotation.from_quat(rng.normal(size=4)).as_matrix(), scale * rng.normal(size=3))


def photograph(frames: Sequence[Frame]) -> None:
    """Put a picture where each frame has its image."""
    for frame in frames:
        assert frame.image is not None
        frame.image.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", frame.camera.size).save(frame.image)


def put_photos(
    folder: Path, *names: str, size: tuple[int, int] = (64, 48), orientation: int = 1, noise: bool = False
) -> None:
    """Put pictures of a size as it is stored and of an EXIF orientation into a folder: black, or each its own noise."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    for seed, path in enumerate(folder / name for name in names):
        path.parent.mkdir(parents=True, exist_ok=True)
        levels = np.random.default_rng(seed).integers(0, 256 if noise else 1, (*size[::-1], 3), dtype=np.uint8)
        Image.fromarray(levels).save(path, exif=exif)


def with_photos(capture: Capture, folder: Path) -> Capture:
    """Return the capture with image paths in a folder, named like the frames."""
    return replace(capture, frames=tuple(replace(frame, image=folder / frame.name) for frame in capture.frames))


def reprojection_px(truth: Capture, other: Capture) -> float:
    """Return the largest distance in pixels between two captures' projections of the first one's points.

    Frames are compared in order, at the picture sizes of the first capture.
    """
    assert len(truth.frames) == len(other.frames)
    worst = 0.0
    for frame, again in zip(truth.frames, other.frames, strict=True):
        pixels, valid = frame.camera.project(frame.in_camera(truth.points))
        camera = again.camera.resized(frame.camera.width, frame.camera.height)
        pixels_again, valid_again = camera.project(again.in_camera(truth.points))
        assert valid.sum() > 10
        np.testing.assert_array_equal(valid_again, valid)
        worst = max(worst, float(np.linalg.norm(pixels_again - pixels, axis=1)[valid].max()))
    return worst


def assert_projects(camera: Camera, formula: Callable[[np.ndarray], np.ndarray]) -> None:
    """Assert that a camera projects points before it to the pixels (N, 2) that a formula gives for points (N, 3)."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.ones(200)]) * rng.uniform(1, 9, (200, 1))
    pixels, valid = camera.project(points)
    assert valid.all()
    np.testing.assert_allclose(pixels, formula(points), rtol=0, atol=1e-9)


def assert_same(capture: Capture, other: Capture, *, pose_tolerance: float = 0.0) -> None:
    """Assert that all parts of two captures agree exactly, and poses within a tolerance."""
    assert len(capture.frames) == len(other.frames)
    for frame, again in zip(capture.frames, other.frames, strict=True):
        assert (again.name, again.camera, again.split) == (frame.name, frame.camera, frame.split)
        assert (again.image, again.mask) == (frame.image, frame.mask)
        np.testing.assert_allclose(again.world_from_cam, frame.world_from_cam, rtol=0, atol=pose_tolerance)
    np.testing.assert_array_equal(other.points, capture.points)
    assert (other.unit, other.missing) == (capture.unit, capture.missing)
    for mine, theirs in ((capture.colours, other.colours), (capture.depth_bounds, other.depth_bounds)):
        assert (mine is None) == (theirs is None)
        if mine is not None and theirs is not None:
            np.testing.assert_array_equal(theirs, mine)
    assert (capture.observations is None) == (other.observations is None)
    if capture.observations is not None and other.observations is not None:
        np.testing.assert_array_equal(other.observations.frame_index, capture.observations.frame_index)
        np.testing.assert_array_equal(other.observations.point_index, capture.observations.point_index)
        np.testing.assert_array_equal(other.observations.pixels, capture.observations.pixels)


@contextmanager
def refused(what: str, path: Path) -> Iterator[None]:
    """Assert that a block refuses its input with a message that names the file and matches a pattern."""
    with pytest.raises(UserError, match=what) as caught:
        yield
    assert caught.value.exit_code == BAD_INPUT
    assert str(path) in caught.value.message
