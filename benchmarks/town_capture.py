"""A walk through a small town: several loops through the same streets, rendered, with the true poses beside it.

    python benchmarks/town_capture.py captures/town --photos 1000 --size 320x240
    python benchmarks/town_capture.py captures/town-200 --photos 200 --size 320x240 --shuffled
    python benchmarks/poses.py captures/town -o poses

Writes images/ and transforms.json. The first loop goes around one block and closes after 151 photos, the second around
four blocks after 459, the third around the same four in the opposite direction after 765; the fourth, around nine
blocks, would close after 1,230. So some streets are seen again from where they were seen before, and others in the
opposite direction, where nothing matches. Every wall has a texture of its own. With --shuffled the names say nothing of
the order of the photos.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[np.float64]

# Metres: from crossing to crossing, and the streets' width.
_PITCH, _STREET = 24.0, 8.0
_EYE, _FARTHEST = 1.6, 150.0
# Moves from crossing to crossing. Each loop ends where it began, then the next one starts.
_LOOPS = ("RULD", "RRUULLDD", "UURRDDLL", "RRRUUULLLDDD")
_MOVES = {"R": (1.0, 0.0), "L": (-1.0, 0.0), "U": (0.0, 1.0), "D": (0.0, -1.0)}
# Metres by which corners are cut.
_CORNER = 4.0
_SUPERSAMPLED = 2


def walk(count: int, *, step: float = 0.6) -> Array:
    """Return poses (count, 4, 4), world from camera, OpenCV axes, z of the world upwards, in steps of `step` metres."""
    crossings = np.cumsum([(0.0, 0.0), *(_MOVES[move] for loop in _LOOPS for move in loop)], axis=0) * _PITCH
    path = _rounded(crossings)
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    along = step * np.arange(count)
    if along[-1] > lengths[-1]:
        raise ValueError(f"the walk has {lengths[-1]:.0f} m, got {count} steps of {step} m")
    places = np.stack([np.interp(along, lengths, path[:, axis]) for axis in (0, 1)], axis=1)
    ahead = np.stack([np.interp(along + 0.5, lengths, path[:, axis]) for axis in (0, 1)], axis=1)
    heading = np.arctan2(*(ahead - places).T[::-1]) + np.radians(20) * np.sin(along / 7)
    pitch = np.radians(4) * np.sin(along / 11)
    # A second pass along the same street does not follow exactly the same line.
    side = 0.5 * np.sin(along / 17)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, (x, y), angle, up, off, where in zip(poses, places, heading, pitch, side, along, strict=True):
        forward = np.array([np.cos(angle) * np.cos(up), np.sin(angle) * np.cos(up), np.sin(up)])
        right = np.array([np.sin(angle), -np.cos(angle), 0.0])
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = np.array([x, y, _EYE + 0.05 * np.sin(3 * where)]) + off * right
    return poses


def photo(world_from_cam: Array, *, size: tuple[int, int], focal_px: float) -> NDArray[np.float32]:
    """Return the picture (height, width, 3), 0...255, that a pinhole camera takes."""
    width, height = (_SUPERSAMPLED * side for side in size)
    large = _rendered(np.ascontiguousarray(world_from_cam[:3]), width, height, _SUPERSAMPLED * focal_px)
    return cv2.resize(large, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def write(folder: Path, *, count: int, size: tuple[int, int], shuffled: bool = False, seed: int = 0) -> None:
    """Write images/ and transforms.json, which is in NeRF's axes: y up, looking along -z."""
    rng = np.random.default_rng(seed)
    numbers = rng.permutation(count) if shuffled else np.arange(count)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    width, height = size
    focal_px = 0.7 * width
    frames = []
    for number, pose in zip(numbers.tolist(), walk(count), strict=True):
        name = f"frame_{number:04d}.jpg"
        brightness = 1 + 0.05 * np.sin(number / 13)
        picture = brightness * photo(pose, size=size, focal_px=focal_px) + rng.normal(
            scale=2.0, size=(height, width, 3)
        )
        Image.fromarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8)).save(folder / "images" / name, quality=93)
        flipped = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{name}", "transform_matrix": flipped.tolist()})
    intrinsics = {"w": width, "h": height, "fl_x": focal_px, "fl_y": focal_px, "cx": width / 2, "cy": height / 2}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}, indent=1), encoding="utf-8")


def _rounded(corners: Array) -> Array:
    """Return a path along corners that rounds each of them with an arc."""
    path = [corners[:1]]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        start, end = (corner + _CORNER / _PITCH * (other - corner) for other in (before, after))
        t = np.linspace(0, 1, 20)[:, None]
        path.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.concatenate([*path, corners[-1:]])


@njit
def _rendered(world_from_cam: Array, width: int, height: int, focal_px: float) -> NDArray[np.float32]:
    picture = np.empty((height, width, 3), np.float32)
    origin = world_from_cam[:, 3]
    for row in range(height):
        for column in range(width):
            x, y = (column + 0.5 - width / 2) / focal_px, (row + 0.5 - height / 2) / focal_px
            direction = world_from_cam[:, 0] * x + world_from_cam[:, 1] * y + world_from_cam[:, 2]
            distance, wall = hit(origin, direction)
            if wall < 0:
                picture[row, column] = 200
                continue
            place = origin + distance * direction
            # Size of a pixel on the surface; at grazing angles, walls get slightly more detail than pixels resolve.
            pixel = distance / focal_px
            face = wall % 5
            u = place[1] if face in (1, 2) else place[0]
            v = place[1] if face == 0 else place[2]
            grey = _texture(wall, u, v, pixel)
            for channel in range(3):
                tint = 0.8 + 0.4 * _random(wall, 77, channel, 0)
                picture[row, column, channel] = min(max(tint * grey, 5.0), 250.0)
    return picture


@njit
def hit(origin: Array, direction: Array) -> tuple[float, int]:
    """Return the distance to the first hit of a ray, in lengths of `direction`, and its number; -1 for the sky.

    Number % 5 is the face: 0 the ground, 1 and 2 walls across x, 3 and 4 walls across y.
    """
    ground = -origin[2] / direction[2] if direction[2] < 0 else np.inf
    entered = 0.0
    while entered < min(ground, _FARTHEST):
        middle = entered + 1e-6
        i = int(np.floor((origin[0] + middle * direction[0]) / _PITCH))
        j = int(np.floor((origin[1] + middle * direction[1]) / _PITCH))
        corner = np.array([i * _PITCH, j * _PITCH])
        leaving, into, out, face = np.inf, 0.0, np.inf, 0
        for axis in range(2):
            if direction[axis] == 0:
                continue
            low = corner[axis] + _STREET / 2 - origin[axis]
            high = corner[axis] + _PITCH - _STREET / 2 - origin[axis]
            near, far = low / direction[axis], high / direction[axis]
            side = 1 + 2 * axis
            if near > far:
                near, far, side = far, near, side + 1
            if near > into:
                into, face = near, side
            out = min(out, far)
            beyond = corner[axis] + (_PITCH if direction[axis] > 0 else 0.0)
            leaving = min(leaving, (beyond - origin[axis]) / direction[axis])
        building = 1 + 5 * (1000 * (i + 500) + j + 500)
        top = 6 + 8 * _random(building, 1, 2, 3)
        if face > 0 and into < out and into < ground and origin[2] + into * direction[2] < top:
            return into, building - 1 + face
        entered = leaving + 1e-6
    if ground < _FARTHEST:
        return ground, 0
    return _FARTHEST, -1


@njit
def _texture(wall: int, u: float, v: float, pixel: float) -> float:
    """Return smooth noise of many sizes and sharp-edged rectangles, without details smaller than two pixels."""
    grey = 120.0
    size = 4.0
    for octave in range(8):
        seen = min(max(size / (2 * pixel) - 1, 0.0), 1.0)
        if seen == 0:
            break
        x, y = u / size, v / size
        i, j = int(np.floor(x)), int(np.floor(y))
        fx, fy = x - i, y - j
        sx, sy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
        top = (1 - sx) * _random(wall, octave, i, j) + sx * _random(wall, octave, i + 1, j)
        bottom = (1 - sx) * _random(wall, octave, i, j + 1) + sx * _random(wall, octave, i + 1, j + 1)
        grey += seen * 60 * ((1 - sy) * top + sy * bottom - 0.5)
        if octave in (1, 2, 3, 4):  # a rectangle in each cell of this size
            wide, high = 0.3 + 0.6 * _random(wall, 20 + octave, i, j), 0.3 + 0.6 * _random(wall, 30 + octave, i, j)
            if fx < wide and fy < high:
                grey += seen * 90 * (_random(wall, 40 + octave, i, j) - 0.5)
        size /= 2
    return grey


@njit
def _random(wall: int, kind: int, i: int, j: int) -> float:
    """Return a pseudo-random number in 0...1 that depends only on the arguments."""
    mixed = np.uint64(wall * 73856093 ^ kind * 19349663 ^ (i + 100000) * 83492791 ^ (j + 100000) * 2654435761)
    mixed ^= mixed >> np.uint64(33)
    mixed *= np.uint64(0xFF51AFD7ED558CCD)
    mixed ^= mixed >> np.uint64(33)
    mixed *= np.uint64(0xC4CEB9FE1A85EC53)
    mixed ^= mixed >> np.uint64(33)
    return float(mixed & np.uint64(0xFFFFFF)) / 0x1000000


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photos", type=int, default=1000)
    parser.add_argument("--size", default="320x240", help="width x height in pixels")
    parser.add_argument("--shuffled", action="store_true", help="names in no order")
    parser.add_argument("--seed", type=int, default=0, help="of the noise and of the order of the names")
    given = parser.parse_args()
    width, height = (int(side) for side in given.size.split("x"))
    write(given.folder, count=given.photos, size=(width, height), shuffled=given.shuffled, seed=given.seed)


if __name__ == "__main__":
    _main()
