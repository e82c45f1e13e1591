"""Scenes that each need one component, made from sample_scenes with known truth, reproducible from a seed.

    python benchmarks/component_scenes.py scenes
    python benchmarks/component_scenes.py scenes --only exposure --only poses --seed 3

Each scene is a folder OUT/NAME (COLMAP model and scene.json); OUT/NAME/truth.json records how it was changed. Held-out
photos keep the true exposure, poses and lens, so that a gain on them is a gain of the field. Needs only nerfcli;
`--only` may be repeated, and the seed determines every random choice.
"""

import importlib.util
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import numpy as np
import typer
from PIL import ExifTags, Image

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import rotation_from_vector
from nerfcli.captures.axes import opencv_pose
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import scene_folder
from nerfcli.captures.formats.colmap import write_colmap_binary
from nerfcli.captures.holdout import default_split
from nerfcli.photos.images import downscale, read_image

SAMPLES = Path(__file__).parent.parent / "sample_scenes"
DESK_DOWNSCALE = 2
# Reduction factors of the photos of `scales`, and how much finer its patterns are.
SCALES, FINER = (1, 4), 4.0
# Views of the balls.
VIEWS, WIDTH, HEIGHT, SUBPIXELS, REACH, FOV_X = 48, 160, 120, 3, 4.4, 0.8
EXPOSURE_SPREAD, WHITE_BALANCE_SPREAD = 0.3, 0.06
POSE_NOISE_DEG = 0.5
# Standard deviation per axis, as a fraction of the cameras' mean distance from their centre.
MOVE_NOISE = 0.0087
FOCAL_ERROR = 0.02


@dataclass(frozen=True)
class View:
    """A photo to be written: camera, pose, pixels uint8 (H, W, 3 or 4), whether it is held out."""

    name: str
    camera: Camera
    world_from_cam: np.ndarray
    pixels: np.ndarray
    test: bool
    exposure_seconds: float | None = None


def linear(levels: np.ndarray) -> np.ndarray:
    """Return the linear light of sRGB levels in [0, 1]."""
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def srgb(light: np.ndarray) -> np.ndarray:
    """Return the sRGB levels of linear light, clipped to [0, 1] as in a camera."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def to_8_bit(levels: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(levels, 0.0, 1.0)).astype(np.uint8)


# --- the desk ---------------------------------------------------------------------------------------------------------


def desk_views() -> list[View]:
    """Return the photos of the desk at half size, with their true cameras."""
    recorded = json.loads((SAMPLES / "desk" / "truth" / "cameras.json").read_text(encoding="utf-8"))
    whole = Camera.from_json(recorded["camera"])
    camera = whole.resized(whole.width // DESK_DOWNSCALE, whole.height // DESK_DOWNSCALE)
    test = default_split(view["name"] for view in recorded["images"])
    return [
        View(
            view["name"],
            camera,
            np.array(view["world_from_cam"]),
            downscale(read_image(SAMPLES / "desk" / "images" / view["name"]), DESK_DOWNSCALE),
            view["name"] in test,
        )
        for view in recorded["images"]
    ]


def log_gains(views: list[View], generator: np.random.Generator) -> np.ndarray:
    """Return log gains (views, 3) in linear light, with a mean of 0 over the training photos."""
    common = np.clip(generator.normal(0.0, EXPOSURE_SPREAD, (len(views), 1)), -0.6, 0.6)
    gains = common + generator.normal(0.0, WHITE_BALANCE_SPREAD, (len(views), 3))
    return gains - gains[[not view.test for view in views]].mean(axis=0)


def exposed(view: View, gain: np.ndarray) -> np.ndarray:
    light = srgb(linear(view.pixels[..., :3] / 255.0) * np.exp(gain))
    return np.concatenate([to_8_bit(light), view.pixels[..., 3:]], axis=-1)


def exposure(views: list[View], generator: np.random.Generator) -> tuple[list[View], dict[str, Any]]:
    """Vary exposure and white balance of the training photos, without EXIF; held-out photos have the mean."""
    gains = log_gains(views, generator)
    changed = [
        view if view.test else replace(view, pixels=exposed(view, gain))
        for view, gain in zip(views, gains, strict=True)
    ]
    return changed, {"log_gains": {v.name: g.tolist() for v, g in zip(views, gains, strict=True) if not v.test}}


def exposure_exif(views: list[View], generator: np.random.Generator) -> tuple[list[View], dict[str, Any]]:
    """Vary the exposure of all photos, including held-out ones, with shutter times in EXIF."""
    gains = log_gains(views, generator).mean(axis=1, keepdims=True)
    changed = [
        replace(view, pixels=exposed(view, gain), exposure_seconds=math.exp(gain[0]) / 60)
        for view, gain in zip(views, gains, strict=True)
    ]
    return changed, {"log_gains": {v.name: [g[0]] * 3 for v, g in zip(views, gains, strict=True)}}


def poses(views: list[View], generator: np.random.Generator) -> tuple[list[View], dict[str, Any]]:
    """Rotate the training cameras by half a degree about random axes through their centres."""
    changed, angles = [], {}
    for view in views:
        axis = generator.normal(size=3)
        turn = math.radians(POSE_NOISE_DEG) * axis / np.linalg.norm(axis)
        pose = view.world_from_cam.copy()
        pose[:3, :3] = pose[:3, :3] @ rotation_from_vector(turn)
        changed.append(view if view.test else replace(view, world_from_cam=pose))
        if not view.test:
            angles[view.name] = turn.tolist()
    truth = {view.name: view.world_from_cam.tolist() for view in views}
    return changed, {"turned_by_rad": angles, "world_from_cam": truth}


def moves(views: list[View], generator: np.random.Generator) -> tuple[list[View], dict[str, Any]]:
    """Move the training cameras along each axis by normal noise of 0.87 % of their mean distance from their centre."""
    centres = np.array([view.world_from_cam[:3, 3] for view in views if not view.test])
    reach = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())
    changed, moved = [], {}
    for view in views:
        move = MOVE_NOISE * reach * generator.normal(size=3)
        pose = view.world_from_cam.copy()
        pose[:3, 3] += move
        changed.append(view if view.test else replace(view, world_from_cam=pose))
        if not view.test:
            moved[view.name] = move.tolist()
    truth = {view.name: view.world_from_cam.tolist() for view in views}
    return changed, {"moved_by": moved, "world_from_cam": truth}


def focal(views: list[View], generator: np.random.Generator) -> tuple[list[View], dict[str, Any]]:
    """Make the focal length of the training photos 2 % too long."""
    camera = views[0].camera
    wrong = replace(camera, params=(camera.params[0] * (1 + FOCAL_ERROR), *camera.params[1:]))
    return [view if view.test else replace(view, camera=wrong) for view in views], {"params": list(camera.params)}


# --- the balls --------------------------------------------------------------------------------------------------------


def ball_tracer() -> ModuleType:
    """Load the script that made sample_scenes/spheres: its objects, and their closed-form ray tracing."""
    spec = importlib.util.spec_from_file_location("make_spheres", SAMPLES / "make_spheres.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def ball_pose(index: int, count: int) -> np.ndarray:
    """Return one of `count` poses spread evenly over a band of a sphere: world_from_cam (4, 4), OpenCV axes."""
    azimuth, height = index * math.pi * (3 - math.sqrt(5)), 0.12 + 0.72 * (index + 0.5) / count
    ring = math.sqrt(1 - height**2)
    backward = np.array((ring * math.cos(azimuth), ring * math.sin(azimuth), height))
    right = np.cross((0, 0, 1), backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(backward, right), backward), axis=1)
    pose[:3, 3] = REACH * backward
    return opencv_pose(pose, "opengl")


def ball_camera() -> Camera:
    return Camera("SIMPLE_PINHOLE", WIDTH, HEIGHT, (0.5 * WIDTH / math.tan(0.5 * FOV_X), WIDTH / 2, HEIGHT / 2))


# Light (..., 3) from infinity by directions (..., 3), in world or camera axes.
Light = Callable[[np.ndarray], np.ndarray]


def room_light(directions: np.ndarray) -> np.ndarray:
    """Return the light (..., 3) of three soft lamps in fixed directions."""
    lamps = np.array([[0.6, 0.2, 0.77], [-0.7, 0.5, 0.5], [0.1, -0.8, 0.6]])
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    shades = np.array([[1.0, 0.95, 0.85], [0.7, 0.85, 1.0], [0.9, 1.0, 0.8]])
    return np.exp(14.0 * (directions @ lamps.T - 1.0)) @ shades


def surroundings(directions: np.ndarray) -> np.ndarray:
    """Return the sRGB (..., 3) of a background at infinity: a sky, a horizon, hills and clouds."""
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    around = np.arctan2(y, x)
    hills = 0.08 * np.sin(3 * around) + 0.05 * np.sin(7 * around + 1)
    cloud = 0.5 + 0.25 * np.sin(9 * x + 3 * np.sin(5 * y)) + 0.25 * np.sin(8 * y + 4 * z)
    sky = np.stack([0.35 + 0.4 * cloud, 0.5 + 0.3 * cloud, 0.75 + 0.15 * cloud], axis=-1)
    stripes = 0.5 + 0.5 * np.sin(14 * x + 11 * y)
    ground = np.stack([0.35 + 0.15 * stripes, 0.3 + 0.2 * stripes, 0.2 + 0.1 * stripes], axis=-1)
    fraction = 1.0 / (1.0 + np.exp(-40.0 * (z - hills + 0.25)))
    return fraction[..., None] * sky + (1.0 - fraction[..., None]) * ground


def ball_views(
    *,
    behind: Light | None = None,
    gloss: float = 0.0,
    views: int = VIEWS,
    finer: float = 1.0,
) -> list[View]:
    """Return views of the balls, every 8th held out: RGBA, or RGB in front of a background at infinity.

    Args:
        behind: the background by directions in the world.
        gloss: fraction of `room_light` that the surfaces reflect.
        views: number of views.
        finer: factor by which the patterns are finer than those of sample_scenes/spheres.
    """
    tracer, camera, made = ball_tracer(), ball_camera(), []
    balls = tuple(replace(ball, frequency=finer * ball.frequency) for ball in tracer.BALLS)
    vars(tracer).update(BALLS=balls, BOX=replace(tracer.BOX, frequency=finer * tracer.BOX.frequency))
    fine = camera.resized(WIDTH * SUBPIXELS, HEIGHT * SUBPIXELS)
    bearings = fine.pixel_bearings()[0].reshape(fine.height, fine.width, 3)
    for index in range(views):
        pose = ball_pose(index, views)
        rays = bearings @ pose[:3, :3].T
        rgb, distance = tracer.trace(pose[:3, 3], rays)
        hit = np.isfinite(distance)
        if gloss:
            normals = surface_normals(tracer, pose[:3, 3] + distance[hit][:, None] * rays[hit])
            mirrored = rays[hit] - 2 * (rays[hit] * normals).sum(-1, keepdims=True) * normals
            rgb[hit] = np.clip((1 - 0.3 * gloss) * rgb[hit] + gloss * room_light(mirrored), 0, 1)
        alpha = hit[..., None].astype(float)
        far = behind(rays) if behind else None
        cells = np.concatenate([rgb * alpha if far is None else np.where(alpha > 0, rgb, far), alpha], axis=-1)
        mean = cells.reshape(HEIGHT, SUBPIXELS, WIDTH, SUBPIXELS, 4).mean(axis=(1, 3))
        if far is None:
            pixels = np.concatenate([mean[..., :3] / np.maximum(mean[..., 3:], 1e-9), mean[..., 3:]], axis=-1)
        else:
            pixels = mean[..., :3]
        made.append(View(f"view_{index:03d}.png", camera, pose, to_8_bit(pixels), index % 8 == 4))
    return made


def surface_normals(tracer: ModuleType, points: np.ndarray) -> np.ndarray:
    """Return outward normals (N, 3) at points on the surfaces."""
    best, normals = np.full(len(points), np.inf), np.zeros_like(points)
    for ball in tracer.BALLS:
        local = (points - np.array(ball.centre)) / ball.radius
        off = np.abs(np.linalg.norm(local, axis=-1) - 1.0)
        normals[off < best] = local[off < best]
        best = np.minimum(off, best)
    fraction = (points - np.array(tracer.BOX.centre)) / np.array(tracer.BOX.half_size)
    largest = np.abs(fraction).max(axis=-1)
    flat = np.where(np.abs(fraction) == largest[:, None], np.sign(fraction), 0.0)
    nearer = np.abs(largest - 1.0) < best
    normals[nearer] = flat[nearer]
    return normals


def alpha() -> list[View]:
    """Return RGBA views of a matt object: colours depend only on the point, and nothing is behind it."""
    return ball_views()


def scales() -> list[View]:
    """Return views of finer patterns at full and quarter size in turn, among training and held-out photos alike.

    The small photos look as from four times as far: details of a few pixels become smaller than a pixel.
    """
    views = ball_views(finer=FINER)
    places = {view.name: i for held in (False, True) for i, view in enumerate(v for v in views if v.test == held)}
    changed = []
    for view in views:
        factor = SCALES[places[view.name] % len(SCALES)]
        camera = view.camera.resized(view.camera.width // factor, view.camera.height // factor)
        changed.append(replace(view, camera=camera, pixels=downscale(view.pixels, factor)))
    return changed


def glossy() -> list[View]:
    """Return the same object with a polish: reflections of lamps move over it with the view."""
    return ball_views(gloss=0.7)


def unbounded() -> list[View]:
    """Return the object in front of a background at infinity, whose colours depend only on the direction."""
    return ball_views(behind=surroundings)


# --- writing ----------------------------------------------------------------------------------------------------------

Change = Callable[[list[View], np.random.Generator], tuple[list[View], dict[str, Any]]]

CHANGES: dict[str, Change] = {
    "exposure": exposure,
    "exposure-exif": exposure_exif,
    "poses": poses,
    "focal": focal,
}
# The scenes: a function that makes the views, and the change applied to them.
MAKERS: dict[str, tuple[Callable[[], list[View]], Change | None]] = {
    "desk": (desk_views, None),
    **{name: (desk_views, change) for name, change in CHANGES.items()},
    "alpha": (alpha, None),
    **{f"{name}-balls": (alpha, change) for name, change in CHANGES.items()},
    "glossy": (glossy, None),
    "unbounded": (unbounded, None),
    "scales": (scales, None),
    "moves": (desk_views, moves),
    "moves-balls": (alpha, moves),
}


def write_photo(view: View, path: Path) -> None:
    """Write a JPEG or PNG, by the name's suffix, with the exposure time in EXIF if known."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 1  # without a top-level entry, Pillow writes no EXIF into a PNG
    if view.exposure_seconds is not None:
        camera = exif.get_ifd(ExifTags.IFD.Exif)
        camera[ExifTags.Base.ExposureTime] = view.exposure_seconds
        camera[ExifTags.Base.ISOSpeedRatings] = 800
        camera[ExifTags.Base.FNumber] = 5.6
    image = Image.fromarray(view.pixels)
    if path.suffix == ".jpg":
        image.save(path, exif=exif, quality=95, subsampling=0)
    else:
        image.save(path, exif=exif)


def make(name: str, folder: Path, seed: int) -> None:
    """Write the scene `name` into a folder."""
    generator = np.random.default_rng([seed, list(MAKERS).index(name)])
    take, change = MAKERS[name]
    views, truth = change(take(), generator) if change is not None else (take(), {})
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    for view in views:
        write_photo(view, images / view.name)
    frames = tuple(Frame(view.name, view.camera, view.world_from_cam, images / view.name) for view in views)
    model = folder / scene_folder.MODEL_FOLDER
    model.mkdir(parents=True, exist_ok=True)
    write_colmap_binary(Capture(frames, np.zeros((0, 3)), (), None, "colmap"), model)
    scene_folder.save(
        folder,
        image_folder=images,
        provenance={"made_by": "benchmarks/component_scenes.py", "seed": seed},
        split={view.name: "test" if view.test else "train" for view in views},
    )
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")


def main(
    out: Annotated[Path, typer.Argument(help="Where to write; a folder per scene.")],
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(MAKERS)}; may be given again.")] = None,
    seed: Annotated[int, typer.Option(help="Of everything random.")] = 0,
) -> None:
    """Make the scenes."""
    unknown = sorted(set(only or ()) - set(MAKERS))
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r}; choose from {', '.join(MAKERS)}", param_hint="--only")
    for name in only or MAKERS:
        make(name, out / name, seed)
        typer.echo(out / name)


if __name__ == "__main__":
    typer.run(main)
