"""Photos with known truth for the tests of `doctor`: textured boards at several distances, seen by a camera."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL_PX = 448, 336, 400.0
# Boards: centre x, y and distance in front of the first camera, and width; the first fills the background.
BOARDS = (
    (0.0, 0.0, 6.0, 16.0),
    (-1.3, -0.5, 3.2, 1.2),
    (1.2, 0.7, 2.6, 1.0),
    (0.1, -0.8, 4.0, 1.4),
    (-0.6, 0.9, 3.6, 1.1),
)
K = np.array([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]])


def texture(seed: int, side: int = 768) -> np.ndarray:
    """Return a board's picture (side, side, 3): noise of equal amplitude in every octave, and sharp-edged shapes."""
    rng = np.random.default_rng(seed)
    picture = np.full((side, side, 3), 120.0)
    for level in range(2, 10):
        coarse = rng.normal(size=(2**level, 2**level, 3)).astype(np.float32)
        picture += 12 * cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    picture = picture.clip(20, 235).astype(np.uint8)
    for _ in range(150):
        centre = rng.integers(0, side, 2)
        corners = (centre + rng.integers(-side // 20, side // 20, (rng.integers(3, 6), 2))).astype(np.int32)
        cv2.fillPoly(picture, [corners], rng.integers(30, 225, 3).tolist(), lineType=cv2.LINE_AA)
    return picture


def view(
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    pan_deg: float = 0.0,
    boards: tuple[tuple[float, float, float, float], ...] = BOARDS,
    seed: int = 0,
) -> np.ndarray:
    """Render boards parallel to z = 0, seen from `centre` by a camera turned by `pan_deg` about the vertical axis."""
    angle = np.radians(pan_deg)
    cam_from_world = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    photo = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    for index, (x, y, z, width) in enumerate(boards):
        picture = _texture(seed + index)
        step = width / len(picture)
        corner = np.array([x - width / 2, y - width / 2, z]) - centre
        # World point of a board's pixel (u, v): corner + step (u, v, 0).
        homography = K @ cam_from_world @ np.column_stack([(step, 0, 0), (0, step, 0), corner])
        # Drawn at twice the size and halved, so that edges are as smooth as a lens makes them and not jagged.
        large = np.diag([2.0, 2.0, 1.0]) @ homography
        size = (2 * WIDTH, 2 * HEIGHT)
        layer = cv2.warpPerspective(picture, large, size, flags=cv2.INTER_AREA)
        cover = cv2.warpPerspective(np.full(picture.shape[:2], 255, np.uint8), large, size)
        layer, cover = (cv2.resize(part, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for part in (layer, cover))
        left, top, across, down = cv2.boundingRect(cover)
        there = slice(top, top + down), slice(left, left + across)
        fraction = cover[there][..., None] / 255
        photo[there] = np.rint(layer[there] * fraction + photo[there] * (1 - fraction)).astype(np.uint8)
    return photo


def walk(count: int = 7, *, seed: int = 0) -> list[np.ndarray]:
    """Return photos of a camera that moves sideways and turns a little."""
    steps = np.linspace(-1, 1, count)
    return [view((0.9 * step, 0.1 * step**2, 0.0), pan_deg=-6 * step, seed=seed) for step in steps]


def write(folder: Path, photos: list[np.ndarray]) -> Path:
    """Write the photos as 00.jpg, 01.jpg, ... into a new folder and return it."""
    folder.mkdir(parents=True)
    for index, photo in enumerate(photos):
        Image.fromarray(photo).save(folder / f"{index:02d}.jpg", quality=93)
    return folder


_TEXTURES: dict[int, np.ndarray] = {}


def _texture(seed: int) -> np.ndarray:
    if seed not in _TEXTURES:
        _TEXTURES[seed] = texture(seed)
    return _TEXTURES[seed]
