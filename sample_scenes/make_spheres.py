"""Makes sample_scenes/spheres: 24 small RGBA views of five balls and a box, exact in colour, alpha and depth.

    python make_spheres.py --out spheres

Needs NumPy and Pillow only. The layout is that of the Blender captures of the NeRF paper. Every ray is intersected
in closed form; a pixel is the mean of SUBPIXELS x SUBPIXELS rays.
"""

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 96, 72
CAMERA_ANGLE_X = 0.8
NUM_VIEWS = 24
REACH = 4.4
SUBPIXELS = 8
LIGHT = np.array((0.4, -0.5, 0.77)) / np.linalg.norm((0.4, -0.5, 0.77))


@dataclass(frozen=True)
class Ball:
    """A sphere whose colour varies about `base` with waves of `frequency` radians per unit."""

    centre: tuple[float, float, float]
    radius: float
    base: tuple[float, float, float]
    frequency: float


@dataclass(frozen=True)
class Box:
    """A box along the axes, coloured like a Ball."""

    centre: tuple[float, float, float]
    half_size: tuple[float, float, float]
    base: tuple[float, float, float]
    frequency: float


BALLS = (
    Ball((0.0, 0.0, 0.3), 0.55, (0.72, 0.36, 0.28), 9.0),
    Ball((0.75, 0.25, 0.07), 0.32, (0.25, 0.55, 0.66), 14.0),
    Ball((-0.65, 0.55, 0.15), 0.4, (0.66, 0.6, 0.25), 11.0),
    Ball((-0.35, -0.72, -0.01), 0.24, (0.36, 0.62, 0.35), 17.0),
    Ball((0.3, -0.5, 0.78), 0.16, (0.6, 0.42, 0.68), 22.0),
)
BOX = Box((0.05, 0.0, -0.37), (1.05, 0.95, 0.12), (0.55, 0.53, 0.5), 8.0)
THINGS: tuple[Ball | Box, ...] = (*BALLS, BOX)


def camera_pose(index: int) -> np.ndarray:
    """world_from_cam (4, 4) with OpenGL axes (x right, y up, z backward): evenly spread over a band of a sphere."""
    azimuth = index * math.pi * (3 - math.sqrt(5))
    height = 0.12 + 0.72 * (index + 0.5) / NUM_VIEWS
    ring = math.sqrt(1 - height**2)
    backward = np.array((ring * math.cos(azimuth), ring * math.sin(azimuth), height))
    right = np.cross((0, 0, 1), backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(backward, right), backward), axis=1)
    pose[:3, 3] = REACH * backward
    return pose


def directions(pose: np.ndarray, *, subpixels: int) -> np.ndarray:
    """Unit directions (HEIGHT * subpixels, WIDTH * subpixels, 3) through the centres of a subdivided pixel grid."""
    focal = 0.5 * WIDTH / math.tan(0.5 * CAMERA_ANGLE_X)
    rows, columns = np.mgrid[0 : HEIGHT * subpixels, 0 : WIDTH * subpixels]
    x = ((columns + 0.5) / subpixels - WIDTH / 2) / focal
    y = ((rows + 0.5) / subpixels - HEIGHT / 2) / focal
    rays = np.stack((x, -y, -np.ones_like(x)), axis=-1)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return rays @ pose[:3, :3].T


def hit_ball(ball: Ball, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance (h, w) to the near side of a ball, infinite where it is missed."""
    offset = origin - np.array(ball.centre)
    along = rays @ offset
    # The squared distance of the centre from the ray, as a vector's length, so that nothing cancels at the rim.
    miss = np.linalg.norm(offset - along[..., None] * rays, axis=-1)
    half = np.sqrt(np.maximum(ball.radius**2 - miss**2, 0))
    return np.where(miss < ball.radius, -along - half, np.inf)


def hit_box(box: Box, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance (h, w) to the near side of a box, infinite where it is missed."""
    offset = origin - np.array(box.centre)
    with np.errstate(divide="ignore"):
        a = (-np.array(box.half_size) - offset) / rays
        b = (np.array(box.half_size) - offset) / rays
    entry, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    return np.where((entry < leave) & (entry > 0), entry, np.inf)


def colour(thing: Ball | Box, points: np.ndarray) -> np.ndarray:
    """Colour (..., 3) in [0, 1] of surface points: waves in three directions under a fixed, matt light.

    It depends on the point alone, not on the view, and it is the stored (sRGB) value.
    """
    local = points - np.array(thing.centre)
    if isinstance(thing, Ball):
        normal = local / thing.radius
    else:
        fraction = np.abs(local) / np.array(thing.half_size)
        normal = np.where(fraction == fraction.max(axis=-1, keepdims=True), np.sign(local), 0.0)
    shading = 0.62 + 0.38 * np.clip(normal @ LIGHT, -1, 1)
    f = thing.frequency
    waves = np.stack(
        (
            np.sin(f * local[..., 0] + 1.7 * np.sin(0.6 * f * local[..., 2])),
            np.sin(f * local[..., 1] + 1.3 * np.sin(0.7 * f * local[..., 0]) + 1.0),
            np.sin(f * local[..., 2] + 0.8 * f * local[..., 0] + 2.0),
        ),
        axis=-1,
    )
    return np.clip((np.array(thing.base) + 0.24 * waves) * shading[..., None], 0, 1)


def hit(thing: Ball | Box, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance (h, w) to the near side of a thing, infinite where it is missed."""
    return hit_ball(thing, origin, rays) if isinstance(thing, Ball) else hit_box(thing, origin, rays)


def trace(
    origin: np.ndarray, rays: np.ndarray, *, things: tuple[Ball | Box, ...] = THINGS
) -> tuple[np.ndarray, np.ndarray]:
    """Colour (h, w, 3) and distance (h, w) of what each ray meets first; black and infinite where nothing is."""
    distances = np.stack([hit(thing, origin, rays) for thing in things])
    nearest = distances.argmin(axis=0)
    distance = distances.min(axis=0)
    rgb = np.zeros(rays.shape)
    for index, thing in enumerate(things):
        seen = (nearest == index) & np.isfinite(distance)
        rgb[seen] = colour(thing, origin + distance[seen][:, None] * rays[seen])
    return rgb, distance


def picture(pose: np.ndarray, *, things: tuple[Ball | Box, ...] = THINGS) -> np.ndarray:
    """RGBA (HEIGHT, WIDTH, 4) uint8, straight alpha.

    Alpha is the covered share of the pixel and RGB the mean over the covered part, so that blending the stored
    values over any background gives the mean over the pixel.
    """
    rgb, distance = trace(pose[:3, 3], directions(pose, subpixels=SUBPIXELS), things=things)
    covered = np.isfinite(distance).astype(float)[..., None]
    cells = np.concatenate((rgb * covered, covered), axis=-1)
    mean = cells.reshape(HEIGHT, SUBPIXELS, WIDTH, SUBPIXELS, 4).mean(axis=(1, 3))
    alpha = mean[..., 3:]
    straight = mean[..., :3] / np.maximum(alpha, 1e-9)
    return np.rint(255 * np.concatenate((straight, alpha), axis=-1)).astype(np.uint8)


def write_depth(path: Path, depth: np.ndarray, *, axis: str) -> None:
    """float32 TIFF, deflated, with its meaning in ImageDescription; NaN where nothing is hit."""
    meaning = {
        "convention": "first surface", "axis": axis, "unit": "arbitrary", "opacity_floor": 0.0, "invalid": "nan",
        "background_distance": None,
    }  # fmt: skip
    image = Image.fromarray(np.where(np.isfinite(depth), depth, np.nan).astype(np.float32))
    image.save(path, "TIFF", compression="tiff_adobe_deflate", tiffinfo={270: json.dumps(meaning)})


def main() -> None:
    """Writes pictures, transforms and truth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the capture")
    out = parser.parse_args().out
    (out / "truth").mkdir(parents=True, exist_ok=True)
    frames: dict[str, list[dict]] = {"train": [], "test": []}
    for index in range(NUM_VIEWS):
        # Every eighth view is held out, starting in the middle so that none of them is at the rim of the band.
        split = "test" if index % 8 == 4 else "train"
        name = f"r_{len(frames[split]):03d}"
        pose = camera_pose(index)
        (out / split).mkdir(exist_ok=True)
        Image.fromarray(picture(pose)).save(out / split / f"{name}.png", optimize=True)
        frames[split].append({"file_path": f"./{split}/{name}", "transform_matrix": pose.tolist()})
        if split == "test":
            rays = directions(pose, subpixels=1)
            distance = trace(pose[:3, 3], rays)[1]
            write_depth(out / "truth" / f"{name}_distance.tiff", distance, axis="ray")
            write_depth(out / "truth" / f"{name}_z.tiff", distance * -(rays @ pose[:3, 2]), axis="z")
    for split, listed in frames.items():
        content = {"camera_angle_x": CAMERA_ANGLE_X, "frames": listed}
        (out / f"transforms_{split}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    geometry = {
        "balls": [{"centre": ball.centre, "radius": ball.radius} for ball in BALLS],
        "box": {"centre": BOX.centre, "half_size": BOX.half_size},
    }
    (out / "truth" / "geometry.json").write_text(json.dumps(geometry, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
