"""Panoramas of a room with textured walls and a box, with known poses: a small capture of a 360-degree camera."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from corner import wall
from PIL import Image
from scipy.spatial.transform import Rotation

WIDTH = 768
ROOM = np.array([5.0, 4.0, 2.8])
BOX = np.array([[3.4, 2.6, 0.0], [4.2, 3.4, 1.2]])
CENTRES = np.array(
    [(1.6, 1.4, 1.5), (2.1, 1.2, 1.6), (2.7, 1.5, 1.4), (2.9, 2.1, 1.55), (2.3, 2.5, 1.45), (1.7, 2.1, 1.6)]
)
# The camera is held almost upright, and turned by any angle.
YAWS_DEG, TILTS_DEG = np.array([0.0, 40.0, -70.0, 120.0, -150.0, 15.0]), np.array([0.0, 2.0, -3.0, 1.0, 2.5, -1.5])


def world_from_cam(number: int) -> np.ndarray:
    """Return the rotation (3, 3) of a camera, with OpenCV's axes."""
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    turned = Rotation.from_euler("zx", [YAWS_DEG[number], TILTS_DEG[number]], degrees=True)
    return turned.as_matrix() @ level


def render(centre: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the panorama seen from `centre`, and the distances along its rays.

    Columns are longitudes, in the middle that of the camera's z axis.
    """
    width = WIDTH
    longitude, latitude = np.meshgrid(
        ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi, ((np.arange(width // 2) + 0.5) / width - 0.25) * 2 * np.pi
    )
    local = np.stack(
        [np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)], axis=-1
    )
    directions = (local @ rotation.T).astype(np.float32)
    nearest, picture = np.full(longitude.shape, np.inf), np.zeros((*longitude.shape, 3), np.uint8)
    for seed, (low, high) in enumerate([(np.zeros(3), ROOM), BOX]):
        for axis in range(3):
            others = [other for other in range(3) if other != axis]
            for side in (low[axis], high[axis]):
                with np.errstate(divide="ignore"):
                    along = (side - centre[axis]) / directions[..., axis]
                hit = (along > 0) & (along < nearest)
                places = [centre[other] + np.minimum(along, 1e3) * directions[..., other] for other in others]
                for place, other in zip(places, others, strict=True):
                    hit &= (place >= low[other]) & (place <= high[other])
                if not hit.any():
                    continue
                u, v = ((120 * place).astype(np.float32) for place in places)
                painted = cv2.remap(wall(2 * seed + axis), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
                nearest, picture = np.where(hit, along, nearest), np.where(hit[..., None], painted, picture)
    return picture, nearest


@cache
def panorama(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the panorama of a camera, and the distances along its rays. Do not write into them."""
    return render(CENTRES[number], world_from_cam(number))


def write_panoramas(folder: Path) -> None:
    """Write the panoramas, as a 360-degree camera without metadata stores them."""
    folder.mkdir(parents=True)
    for number in range(len(CENTRES)):
        Image.fromarray(panorama(number)[0]).save(folder / f"{number}.png")
