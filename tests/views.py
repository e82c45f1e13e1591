"""Synthetic captures without photos: cameras around a cloud of points, with exact observations."""

from collections.abc import Sequence

from captures import ring

from nerfcli.cameras.camera import Camera
from nerfcli.captures.capture import Capture

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
    """Return a `ring` with plain names, whose features all show a point."""
    name = "photo {:02d}.png"
    return ring(*cameras, num_frames=count, num_points=num_points, seed=seed, num_loose=0, name=name)
