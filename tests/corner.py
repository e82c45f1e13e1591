"""A room corner of three textured walls, rendered with known poses: a small capture for structure from motion.

It has the irregularities of real folders: photos stored on their side, photos of a second size, a blank photo, names
with spaces.
"""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL_PX = 480, 360, 450.0
# Camera centres; then the photos stored on their side (EXIF orientation 6), and those of the smaller size.
CENTRES = np.array(
    [
        *((3.4, 1.6, 1.5), (3.1, 2.2, 1.6), (2.7, 2.7, 1.4), (2.2, 3.1, 1.7), (1.6, 3.4, 1.5)),
        *((2.9, 2.4, 2.3), (2.4, 2.9, 2.4)),
    ]
)
NAMES = ("view 0.png", "view 1.jpg", "view 2.png", "view 3.png", "view 4.jpg", "view 5.png", "view 6.png")
LYING = {1, 4}
SMALLER = {5, 6}


@cache
def wall(seed: int) -> np.ndarray:
    """Return a 400 x 400 texture with detail at all scales, so that it has features from any distance."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.uniform(-1, 1, (cells, cells, 3)), (400, 400), interpolation=cv2.INTER_CUBIC) * cells**-0.3
        for cells in (12, 25, 50, 100, 200)
    ]
    total = sum(layers, start=np.zeros((400, 400, 3)))
    return np.clip(128 + 190 * total, 0, 255).astype(np.uint8)


def cam_from_world(centre: np.ndarray) -> np.ndarray:
    """Return the (3, 4) pose of a camera at `centre` that looks at (0.5, 0.5, 0.5), with z up and OpenCV axes."""
    forward = np.array([0.5, 0.5, 0.5]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ centre])


def render(centre: np.ndarray, scale: float, shift: np.ndarray) -> np.ndarray:
    """Render the corner x = 0, y = 0, z = 0 with walls of side 2, each by its homography; no wall hides another.

    `shift` (2,) is the distance of the principal point from the middle of the picture, before scaling.
    """
    x, y = np.array([WIDTH / 2, HEIGHT / 2]) + shift
    intrinsics = np.array([[FOCAL_PX, 0, x], [0, FOCAL_PX, y], [0, 0, 1]]) * [[scale], [scale], [1]]
    size = (round(WIDTH * scale), round(HEIGHT * scale))
    pose = cam_from_world(centre)
    image = np.full((size[1], size[0], 3), 90, np.uint8)
    # OpenCV's pixel centres are whole numbers, ours are at the halves.
    ours_from_cv = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    for seed, (u_axis, v_axis) in enumerate([(0, 1), (1, 2), (0, 2)]):
        wall_from_texture = np.diag([2 / 400, 2 / 400, 1.0]) @ ours_from_cv
        cam_from_wall = pose[:, [u_axis, v_axis, 3]]
        homography = np.linalg.inv(ours_from_cv) @ intrinsics @ cam_from_wall @ wall_from_texture
        drawn = cv2.warpPerspective(wall(seed), homography, size, flags=cv2.INTER_AREA)
        covered = cv2.warpPerspective(np.full((400, 400), 255, np.uint8), homography, size) > 127
        image[covered] = drawn[covered]
    return image


def write_capture(folder: Path, shifts: np.ndarray = np.zeros((len(NAMES), 2))) -> Path:
    """Write the seven views, with shifts (7, 2) of their principal points, and a blank photo; return the folder."""
    folder.mkdir()
    for index, name in enumerate(NAMES):
        picture = Image.fromarray(render(CENTRES[index], 0.8 if index in SMALLER else 1.0, shifts[index]))
        exif = Image.Exif()
        if index in LYING:
            picture = picture.transpose(Image.Transpose.ROTATE_90)
            exif[0x0112] = 6
        picture.save(folder / name, quality=97, exif=exif)
    Image.new("RGB", (WIDTH, HEIGHT), (200, 200, 200)).save(folder / "wall.png")
    return folder
