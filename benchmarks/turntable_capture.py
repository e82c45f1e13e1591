"""A turntable: boxes on a disc that turns before a still room, rendered by casting rays, with the true poses beside it.

    python benchmarks/turntable_capture.py captures/turntable
    python benchmarks/turntable_capture.py captures/turntable-two-heights --photos 60 --heights 2
    python benchmarks/poses.py captures/turntable -o poses

Writes images/, masks/ (white where the turning object is) and transforms.json, which holds the cameras as the object
sees them: the camera stands on a tripod, and to the object it seems to go around it.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[np.float64]
Picture = NDArray[np.float32]

# Centres (x, y) of the boxes on the disc, their sizes (x, y, z), and their rotation in radians.
_BOXES = (
    ((0.0, 0.0), (0.7, 0.5, 0.9), 0.3),
    ((0.55, 0.3), (0.3, 0.3, 0.5), 0.9),
    ((-0.5, 0.45), (0.35, 0.25, 0.35), -0.4),
    ((-0.1, -0.6), (0.5, 0.22, 0.3), 0.1),
)
_DISC_RADIUS, _DISC_HEIGHT = 1.0, 0.05
_TEXTURE_PX = 256


@dataclass(frozen=True)
class Turntable:
    """A capture.

    photos (n, height, width, 3) uint8; masks (n, height, width) bool, true on the object; object_from_cam (n, 4, 4),
    OpenCV axes; focal_px of all photos, with the principal point in the middle.
    """

    photos: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    object_from_cam: Array
    focal_px: float


def turntable(
    count: int,
    *,
    size: tuple[int, int] = (800, 600),
    heights: int = 1,
    turn_deg: float = 360.0,
    texture: float = 1.0,
    shift_px: float = 0.0,
    supersampled: int = 2,
    seed: int = 0,
) -> Turntable:
    """Return photos of the object in equal steps of its rotation.

    Args:
        count: of photos.
        size: (width, height).
        heights: number of camera positions, one after the other, each with a part of the photos over a whole turn.
        turn_deg: angle of a whole turn.
        texture: contrast of the room, 0...1: at 0 it is grey.
        shift_px: standard deviation of the shift of the background by camera shake between photos.
        supersampled: rays per pixel, in each direction.
        seed: of textures and noise.
    """
    rng = np.random.default_rng(seed)
    width, height = size
    textures = [_texture(rng, _TEXTURE_PX, _TEXTURE_PX) for _ in range(3 * len(_BOXES) + 1)]
    focal = 1.3 * width
    photos, masks, poses = [], [], []
    for place in range(heights):
        elevation = np.radians(22 + 24 * place)
        centre = np.array([0.0, 0.4, 0.0]) if place else np.zeros(3)
        centre = centre + 4.6 * np.array([np.cos(elevation), 0.0, np.sin(elevation)])
        world_from_cam = _looking_at(centre, np.array([0.0, 0.0, 0.35]))
        room = 128 + texture * (_texture(rng, width + 64, height + 64) - 128)
        steps = len(range(place, count, heights))
        for step in range(steps):
            angle = np.radians(turn_deg) * step / steps
            object_from_world = np.eye(4)
            object_from_world[:2, :2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
            pose = object_from_world @ world_from_cam
            colour, alpha = _render(pose, textures, focal * supersampled, (width * supersampled, height * supersampled))
            colour, alpha = (cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in (colour, alpha))
            right, down = 32 + rng.normal(scale=shift_px, size=2)
            move = np.array([[1, 0, right], [0, 1, down]])
            behind = cv2.warpAffine(room, move, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            picture = colour + (1 - alpha[..., None]) * behind + rng.normal(scale=2.0, size=(height, width, 3))
            photos.append(np.clip(np.rint(picture), 0, 255).astype(np.uint8))
            masks.append(alpha > 0.5)
            poses.append(pose)
    return Turntable(np.array(photos), np.array(masks), np.array(poses), focal)


def write(capture: Turntable, folder: Path, *, stem: str = "turn") -> None:
    """Write images/, masks/ and transforms.json, which is in NeRF's axes: y up, looking along -z."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "masks").mkdir(exist_ok=True)
    height, width = capture.masks.shape[1:]
    frames = []
    for number, (photo, mask, pose) in enumerate(
        zip(capture.photos, capture.masks, capture.object_from_cam, strict=True)
    ):
        name = f"{stem}_{number:03d}.jpg"
        Image.fromarray(photo).save(folder / "images" / name, quality=93)
        Image.fromarray(mask).save(folder / "masks" / f"{name}.png")
        flipped = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{name}", "transform_matrix": flipped.tolist()})
    intrinsics = {"w": width, "h": height, "fl_x": capture.focal_px, "fl_y": capture.focal_px}
    content = {**intrinsics, "cx": width / 2, "cy": height / 2, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def _render(
    object_from_cam: Array, textures: list[Picture], focal_px: float, size: tuple[int, int]
) -> tuple[Picture, Picture]:
    """Return the object on black, (height, width, 3), and its coverage, (height, width) 0 or 1."""
    width, height = size
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = np.stack([(columns - width / 2) / focal_px, (rows - height / 2) / focal_px, np.ones_like(rows)], axis=-1)
    directions = (local.reshape(-1, 3) @ object_from_cam[:3, :3].T).astype(np.float32)
    origin = object_from_cam[:3, 3].astype(np.float32)
    nearest = np.full(len(directions), np.inf, dtype=np.float32)
    colour = np.zeros((len(directions), 3), dtype=np.float32)
    _add_disc(origin, directions, textures[-1], nearest, colour)
    for number, ((x, y), sides, turn) in enumerate(_BOXES):
        middle = np.array([x, y, sides[2] / 2], dtype=np.float32)
        box_from_object = np.array(
            [[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]], dtype=np.float32
        )
        faces = textures[3 * number : 3 * number + 3]
        half = np.array(sides, dtype=np.float32) / np.float32(2)
        local_origin = (box_from_object @ (origin - middle)).astype(np.float32)
        _add_box(local_origin, directions @ box_from_object.T, half, faces, nearest, colour)
    shape = (height, width)
    return colour.reshape(*shape, 3), np.isfinite(nearest).astype(np.float32).reshape(shape)


def _add_disc(origin: Picture, directions: Picture, texture: Picture, nearest: Picture, colour: Picture) -> None:
    """Draw the disc, whose top is at z = 0, and its rim, which is grey."""
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -origin[2] / directions[:, 2]
    hit = origin + depth[:, None] * directions
    inside = (depth > 0) & (np.hypot(hit[:, 0], hit[:, 1]) < _DISC_RADIUS)
    below = origin + ((-_DISC_HEIGHT - origin[2]) / directions[:, 2])[:, None] * directions
    rim = ~inside & (directions[:, 2] < 0) & (np.hypot(below[:, 0], below[:, 1]) < _DISC_RADIUS)
    nearest[inside], nearest[rim] = depth[inside], depth[rim]
    colour[inside] = _looked_up(texture, hit[inside, :2] / (2 * _DISC_RADIUS) + 0.5)
    colour[rim] = 90


def _add_box(
    origin: Picture, directions: Picture, half: Picture, faces: list[Picture], nearest: Picture, colour: Picture
) -> None:
    """Draw an axis-aligned box around 0 where it is nearer.

    Opposite faces have the same texture, one of them upside down and darker.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - origin) / directions, (half - origin) / directions
    entering, leaving = np.minimum(one, other), np.maximum(one, other)
    # A twentieth of the time of max(axis=1) and min(axis=1).
    depth = np.maximum(np.maximum(entering[:, 0], entering[:, 1]), entering[:, 2])
    until = np.minimum(np.minimum(leaving[:, 0], leaving[:, 1]), leaving[:, 2])
    seen = np.flatnonzero((depth < until) & (depth > 0) & (depth < nearest))
    axis = entering[seen].argmax(axis=1)
    hit = (origin + depth[seen, None] * directions[seen]) / (2 * half) + 0.5
    nearest[seen] = depth[seen]
    for which in range(3):
        on = axis == which
        across = hit[on][:, [k for k in range(3) if k != which]]
        back = directions[seen[on], which] > 0
        across[back] = 1 - across[back][:, ::-1]
        colour[seen[on]] = _looked_up(faces[which], across) * np.where(back, 0.75, 1.0)[:, None].astype(np.float32)


def _looked_up(texture: Picture, places: Picture) -> Picture:
    """Return the colours (n, 3) of a texture at places (n, 2) in 0...1."""
    across, down = (places * np.array(texture.shape[1::-1], dtype=np.float32)).astype(np.float32).T.reshape(2, -1, 1)
    found = np.empty((len(places), 3), dtype=np.float32)
    for start in range(0, len(places), 30_000):  # remap is limited to fewer than 32768 rows
        rows = slice(start, start + 30_000)
        looked_up = cv2.remap(texture, across[rows], down[rows], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        found[rows] = looked_up.reshape(-1, 3)
    return found


def _texture(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Return noise of many sizes with rectangles, (height, width, 3) in 0...255."""
    picture = np.zeros((height, width, 3), dtype=np.float32)
    for cells in (4, 10, 24, 60):
        coarse = rng.uniform(-1, 1, size=(cells, cells, 3)).astype(np.float32)
        picture += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) * (70 / cells**0.35)
    for _ in range(60):
        x, y = (int(rng.integers(0, side)) for side in (width, height))
        w, h = (int(rng.integers(4, side // 6)) for side in (width, height))
        picture[y : y + h, x : x + w] += rng.uniform(-60, 60, size=3)
    return np.clip(128 + picture, 5, 250).astype(np.float32)


def _looking_at(centre: Array, target: Array) -> Array:
    """Return world_from_cam (4, 4) in OpenCV axes, with z up in the world."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = centre
    return pose


def main() -> None:
    """Write a capture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder to write")
    parser.add_argument("--photos", type=int, default=36)
    parser.add_argument("--heights", type=int, default=1, help="places of the camera")
    parser.add_argument("--texture", type=float, default=1.0, help="contrast of the room, 0...1")
    parser.add_argument("--shift-px", type=float, default=0.0, help="how far the camera is shaken")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    capture = turntable(args.photos, heights=args.heights, texture=args.texture, shift_px=args.shift_px, seed=args.seed)
    write(capture, args.out)


if __name__ == "__main__":
    main()
