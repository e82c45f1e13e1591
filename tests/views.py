"""Synthetic captures without photos: cameras around a cloud of points, with exact observations."""

from collections.abc import Sequence

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture, Observations

PINHOLE = Camera("PINHOLE", 640, 480, (500.0, 505.0, 321.25, 238.5))
SQUARE = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
RADIAL = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.05))
BROWN = Camera("OPENCV", 480, 640, (500.0, 505.0, 236.5, 322.0, -0.05, 0.01, 0.002, -0.001))
RATIONAL = Camera(
    "FULL_OPENCV", 640, 480, (500.0, 505.0, 321.0, 238.5, -0.05, 0.01, 0.002, -0.001, 0.003, 0.01, 0.002, 0.001)
)
FISHEYE = Camera("OPENCV_FISHEYE", 640, 480, (300.0, 305.0, 321.0, 238.5, 0.02, -0.01, 0.003, -0.001))
PRISM = Camera("THIN_PRISM_FISHEYE", 640, 480, (300, 305, 321, 238.5, 0.02, -0.01, 1e-3, 2e-3, 3e-3, 1e-3, 1e-3, 2e-3))
PANORAMA = Camera("EQUIRECTANGULAR", 640, 320, (640.0, 320.0))


def capture_of(cameras: Sequence[Camera], *, count: int = 6, num_points: int = 60, seed: int = 0) -> Capture:
    """Return frames about 4 units from a cloud of points of radius 1, randomly tilted, with exact observations.

    Frames cycle through the cameras.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.6, 0.6, (num_points, 3))
    frames, seen = [], []
    for index in range(count):
        angle = 2 * np.pi * index / count
        centre = 4 * np.array([np.cos(angle), np.sin(angle), 0.4]) + rng.normal(0, 0.2, 3)
        pose = rigid.look_at(centre, rng.normal(0, 0.2, 3), np.array([0.1, 0.2, 1.0]) + rng.normal(0, 0.2, 3))
        camera = cameras[index % len(cameras)]
        frames.append(Frame(f"photo {index:02d}.png", camera, pose))
        pixels, valid = camera.project(rigid.apply(rigid.inverse(pose), points))
        inside = valid & ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
        seen.append((np.full(inside.sum(), index), np.flatnonzero(inside), pixels[inside]))
    observations = Observations(*(np.concatenate(column) for column in zip(*seen, strict=True)))
    colours = rng.integers(1, 256, (num_points, 3)).astype(np.uint8)
    return Capture(tuple(frames), points, (), None, "colmap", colours=colours, observations=observations)
