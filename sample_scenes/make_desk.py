"""Makes sample_scenes/desk: 48 photos of a table in a room, with exact cameras and depth.

    python make_desk.py --out desk [--samples 8] [--threads 2] [--only INDEX ...]

Needs Blender as a module (`pip install bpy==5.0.1`, Python 3.11), NumPy and Pillow. Pictures that exist are kept,
so a stopped run goes on where it was. Each photo is rendered by Cycles through a wider pinhole camera of higher
resolution, in linear light, and then resampled through COLMAP's RADIAL lens; depth is cast, not rendered.
"""

import argparse
import json
import math
import os
import tempfile
import time
from pathlib import Path

import bpy
import desk_scene
import numpy as np
from mathutils import Matrix, Vector
from mathutils.bvhtree import BVHTree
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

SEED = 20260
NUM_RING, NUM_HALF_RING = 32, 16
TEST_EVERY = 8

# The lens: COLMAP's RADIAL model. 645.2 px on 800 px of a 17.3 mm wide sensor are 13.95 mm, sold as 14 mm.
WIDTH, HEIGHT = 800, 600
FOCAL, CENTRE_X, CENTRE_Y, K1, K2 = 645.2, 403.4, 297.9, -0.06, 0.01
# The pinhole picture that it is resampled from: 4 % more pixels per radian, and room beyond every edge.
WIDE_WIDTH, WIDE_HEIGHT, WIDE_FOCAL = 880, 664, 672.0
# Depth is rounded to 2**-13 m, an eighth of a millimetre, so that it packs well; the error is half of that.
DEPTH_STEP = 2.0**-13

EXPOSURE = 0.98
# Noise in linear light: variance = SHOT * signal + READ**2.
SHOT, READ = 1.2e-4, 1.5e-3


def camera_poses(seed: int) -> np.ndarray:
    """world_from_cam (48, 4, 4), OpenCV axes: a full ring, then half a ring lower down, both held by hand."""
    rng = np.random.default_rng(seed)
    poses = []
    for index in range(NUM_RING + NUM_HALF_RING):
        low = index >= NUM_RING
        azimuth = 2 * np.pi * (index % NUM_RING + rng.normal(0, 0.1)) / NUM_RING + (0.55 if low else -1.2)
        elevation = math.radians((19 if low else 34) + 2.5 * math.sin(3 * azimuth) + rng.normal(0, 1.0))
        reach = (1.16 if low else 1.1) + 0.05 * math.sin(2 * azimuth + 1) + rng.normal(0, 0.02)
        target = np.array((0, 0, desk_scene.TABLE_HEIGHT + 0.06)) + rng.normal(0, 0.03, 3)
        outward = (
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        )
        centre = np.array((0, 0, desk_scene.TABLE_HEIGHT + 0.06)) + reach * np.array(outward)
        poses.append(look_at(centre, target, roll=math.radians(rng.normal(0, 2.0))))
    return np.array(poses)


def look_at(centre: np.ndarray, target: np.ndarray, *, roll: float) -> np.ndarray:
    """world_from_cam (4, 4) with OpenCV axes, z up in the world, turned by `roll` about the optical axis."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    world_from_cam = np.eye(4)
    world_from_cam[:3, 0] = math.cos(roll) * right + math.sin(roll) * down
    world_from_cam[:3, 1] = math.cos(roll) * down - math.sin(roll) * right
    world_from_cam[:3, 2] = forward
    world_from_cam[:3, 3] = centre
    return world_from_cam


def pixel_rays() -> np.ndarray:
    """Directions (HEIGHT, WIDTH, 3) of the photo's pixel centres in camera axes, z = 1.

    Inverts r_distorted = r * (1 + K1 r^2 + K2 r^4) by Newton's method, to rounding.
    """
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    distorted = np.stack(((columns + 0.5 - CENTRE_X) / FOCAL, (rows + 0.5 - CENTRE_Y) / FOCAL), axis=-1)
    wanted = np.linalg.norm(distorted, axis=-1)
    radius = wanted.copy()
    for _ in range(12):
        residual = radius * (1 + K1 * radius**2 + K2 * radius**4) - wanted
        radius -= residual / (1 + 3 * K1 * radius**2 + 5 * K2 * radius**4)
    assert np.abs(radius * (1 + K1 * radius**2 + K2 * radius**4) - wanted).max() < 1e-14
    scale = radius / np.maximum(wanted, 1e-300)
    return np.concatenate((distorted * scale[..., None], np.ones((HEIGHT, WIDTH, 1))), axis=-1)


def build(parts: list[desk_scene.Part]) -> None:
    """Puts the parts, the lights and one camera into an empty Blender scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    collection = bpy.context.scene.collection
    shaders: dict[int, bpy.types.Material] = {}
    for part in parts:
        mesh = bpy.data.meshes.new(part.name)
        mesh.from_pydata(part.mesh.vertices.tolist(), [], part.mesh.triangles.tolist())
        mesh.uv_layers.new(name="uv").uv.foreach_set("vector", part.mesh.uv.astype(np.float32).ravel())
        if part.mesh.smooth:
            mesh.shade_smooth()
        if id(part.finish) not in shaders:
            shaders[id(part.finish)] = shader(part.finish)
        mesh.materials.append(shaders[id(part.finish)])
        collection.objects.link(bpy.data.objects.new(part.name, mesh))

    area_light("window", at=(0, -1.88, 1.6), aim=(0, 0.3, 0.6), size=(1.5, 1.2), watts=46, colour=(0.93, 0.97, 1.0))
    area_light("lamp", at=(0.5, 0.6, 2.5), aim=(0.2, 0.2, 0), size=(0.5, 0.5), watts=34, colour=(1.0, 0.89, 0.74))
    area_light("lamp", at=(-0.9, 0.2, 2.5), aim=(-0.5, 0.1, 0), size=(0.6, 0.6), watts=30, colour=(1.0, 0.92, 0.8))

    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit, camera.sensor_width = "HORIZONTAL", 36.0
    camera.lens = 36.0 * WIDE_FOCAL / WIDE_WIDTH
    camera.clip_start, camera.clip_end = 0.01, 50.0
    eye = bpy.data.objects.new("camera", camera)
    collection.objects.link(eye)
    bpy.context.scene.camera = eye


def shader(finish: desk_scene.Finish) -> bpy.types.Material:
    """Blender's principled shader for a finish."""
    material = bpy.data.materials.new("finish")
    # A lamp that is only seen, not sampled: the area lights do the lighting.
    material.cycles.emission_sampling = "NONE"
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = finish.roughness
    surface.inputs["Metallic"].default_value = finish.metallic
    surface.inputs["Coat Weight"].default_value = finish.coat
    surface.inputs["Coat Roughness"].default_value = 0.05
    surface.inputs["Emission Strength"].default_value = finish.emission
    if isinstance(finish.paint, np.ndarray):
        texture = nodes.new("ShaderNodeTexImage")
        texture.image = blender_image(finish.paint)
        texture.extension = "EXTEND"
        links.new(texture.outputs["Color"], surface.inputs["Base Color"])
        links.new(texture.outputs["Color"], surface.inputs["Emission Color"])
    else:
        linear = srgb_to_linear(np.array(finish.paint) / 255)
        surface.inputs["Base Color"].default_value = (*linear, 1.0)
    return material


def blender_image(picture: np.ndarray) -> bpy.types.Image:
    """A packed sRGB image of (h, w, 3) uint8; Blender's rows begin at the bottom."""
    height, width = picture.shape[:2]
    image = bpy.data.images.new("paint", width, height)
    pixels = np.ones((height, width, 4), dtype=np.float32)
    pixels[..., :3] = picture[::-1] / np.float32(255)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    return image


def area_light(
    name: str,
    *,
    at: tuple[float, float, float],
    aim: tuple[float, float, float],
    size: tuple[float, float],
    watts: float,
    colour: tuple[float, float, float],
) -> None:
    """A rectangular light that reflections show but the camera does not see, so it hides no depth."""
    lamp = bpy.data.lights.new(name, "AREA")
    lamp.shape, lamp.size, lamp.size_y = "RECTANGLE", *size
    lamp.energy, lamp.color = watts, colour
    holder = bpy.data.objects.new(name, lamp)
    holder.location = at
    holder.rotation_euler = (Vector(aim) - Vector(at)).to_track_quat("-Z", "Y").to_euler()
    holder.visible_camera = False
    bpy.context.scene.collection.objects.link(holder)


def render_settings(samples: int, threads: int) -> None:
    """Cycles on the CPU with Intel's denoiser, linear half-float output."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples, cycles.use_adaptive_sampling = samples, False
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    cycles.denoising_input_passes, cycles.denoising_prefilter = "RGB_ALBEDO_NORMAL", "FAST"
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 3, 2, 2
    # From the second bounce on, light of the room is taken as even and only shaded by what is near.
    cycles.use_fast_gi, cycles.fast_gi_method, cycles.ao_bounces_render = True, "REPLACE", 1
    cycles.use_light_tree = False
    scene.world = bpy.data.worlds.new("room light")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.42, 0.385, 0.34, 1.0)
    scene.world.light_settings.distance, scene.world.light_settings.ao_factor = 1.2, 1.0
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect = 4.0
    scene.render.use_persistent_data = True
    scene.render.threads_mode, scene.render.threads = "FIXED", threads
    scene.render.resolution_x, scene.render.resolution_y = WIDE_WIDTH, WIDE_HEIGHT
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode, scene.render.image_settings.color_depth = "RGB", "16"


def render_wide(world_from_cam: np.ndarray, *, seed: int, folder: Path) -> np.ndarray:
    """Linear pinhole picture (WIDE_HEIGHT, WIDE_WIDTH, 3) seen from a pose."""
    scene = bpy.context.scene
    # Blender's camera looks along -z with +y up.
    scene.camera.matrix_world = Matrix((world_from_cam @ np.diag((1.0, -1.0, -1.0, 1.0))).tolist())
    scene.cycles.seed = seed
    scene.render.filepath = str(folder / "wide.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(WIDE_WIDTH * WIDE_HEIGHT * 4, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(WIDE_HEIGHT, WIDE_WIDTH, 4)[::-1, :, :3].astype(float)


def resample(wide: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """The wide picture along rays (h, w, 3) with z = 1, by Catmull-Rom interpolation."""
    # Sample positions in units where an index is the centre of a pixel.
    x = rays[..., 0] * WIDE_FOCAL + WIDE_WIDTH / 2 - 0.5
    y = rays[..., 1] * WIDE_FOCAL + WIDE_HEIGHT / 2 - 0.5
    assert min(x.min(), y.min()) > 1
    assert max(x.max() - WIDE_WIDTH, y.max() - WIDE_HEIGHT) < -3
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    across, down = catmull_rom(x - column), catmull_rom(y - row)
    result = np.zeros((*rays.shape[:2], 3))
    for i in range(4):
        for j in range(4):
            weight = down[..., i] * across[..., j]
            result += weight[..., None] * wide[row + i - 1, column + j - 1]
    return result


def catmull_rom(t: np.ndarray) -> np.ndarray:
    """Weights (..., 4) of the samples at -1, 0, 1, 2 for a position t in [0, 1)."""
    return 0.5 * np.stack(
        (-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, -(t**2) + t**3), axis=-1
    )


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """The sRGB decoding, IEC 61966-2-1."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: np.ndarray) -> np.ndarray:
    """The sRGB encoding, IEC 61966-2-1, of values in [0, 1]."""
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-9) ** (1 / 2.4) - 0.055)


def develop(linear: np.ndarray, seed: int) -> np.ndarray:
    """Exposure, shot and read noise, clipping and sRGB: linear (h, w, 3) to uint8."""
    rng = np.random.default_rng(seed)
    exposed = np.maximum(linear * EXPOSURE, 0)
    noisy = exposed + rng.standard_normal(exposed.shape) * np.sqrt(SHOT * exposed + READ**2)
    return np.rint(255 * linear_to_srgb(np.clip(noisy, 0, 1))).astype(np.uint8)


def exif(index: int) -> Image.Exif:
    """What a camera would note; the focal length is the true one rounded to the label of the lens."""
    tags = Image.Exif()
    tags[0x010F], tags[0x0110], tags[0x0112] = "nerfcli", "Desk 4:3", 1
    tags[0x0131] = "sample_scenes/make_desk.py"
    stamp = f"2026:01:17 15:{4 + index // 12:02d}:{5 * (index % 12):02d}"
    details = tags.get_ifd(0x8769)
    details[0x829A] = IFDRational(1, 60)
    details[0x829D] = IFDRational(56, 10)
    details[0x8827] = 800
    details[0x9003] = details[0x9004] = stamp
    details[0x920A] = IFDRational(140, 10)
    details[0xA405] = 28
    details[0xA434] = "nerfcli 14mm F5.6"
    tags[0x8769] = details
    return tags


def ray_caster(parts: list[desk_scene.Part]) -> tuple[BVHTree, np.ndarray]:
    """A search tree over all triangles, and their corners (M, 3, 3) as Blender stores them (float32)."""
    corners = np.concatenate([part.mesh.vertices[part.mesh.triangles] for part in parts])
    corners = corners.astype(np.float32).astype(np.float64)
    index = np.arange(3 * len(corners)).reshape(-1, 3)
    return BVHTree.FromPolygons(corners.reshape(-1, 3).tolist(), index.tolist(), all_triangles=True), corners


def cast_depth(tree: BVHTree, corners: np.ndarray, *, world_from_cam: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Exact z-depth (h, w) of the first surface along each ray; NaN where there is none.

    The tree only says which triangle is hit; the distance to its plane is computed here in float64.
    """
    directions = (rays.reshape(-1, 3) @ world_from_cam[:3, :3].T).astype(float)
    origin = Vector(world_from_cam[:3, 3])
    hits = [tree.ray_cast(origin, Vector(d))[2] for d in directions]
    found = np.array([hit is not None for hit in hits])
    triangle = corners[[hit or 0 for hit in hits]]
    normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    height = ((triangle[:, 0] - world_from_cam[:3, 3]) * normal).sum(axis=1)
    # The camera's z axis has length 1 in `rays`, so the parameter along a ray is the z-depth itself.
    depth = height / (directions * normal).sum(axis=1)
    return np.where(found, depth, np.nan).reshape(rays.shape[:2])


def write_depth(path: Path, depth: np.ndarray) -> None:
    """float32 TIFF, deflated, rounded to DEPTH_STEP, with its meaning in ImageDescription."""
    meaning = {
        "convention": "first surface", "axis": "z", "unit": "metre", "opacity_floor": 0.0, "invalid": "nan",
        "background_distance": None, "rounded_to": DEPTH_STEP,
    }  # fmt: skip
    picture = Image.fromarray((np.rint(depth / DEPTH_STEP) * DEPTH_STEP).astype(np.float32))
    partial = path.with_name(f".{path.name}.partial")
    picture.save(partial, "TIFF", compression="tiff_adobe_deflate", tiffinfo={270: json.dumps(meaning)})
    os.replace(partial, path)


def write_cameras(path: Path, poses: np.ndarray) -> None:
    """Intrinsics and poses of all photos as JSON."""
    content = {
        "convention": "OpenCV axes (x right, y down, z forward); centre of the top left pixel at (0.5, 0.5)",
        "unit": "metre",
        "camera": {
            "model": "RADIAL", "width": WIDTH, "height": HEIGHT,
            "params": [FOCAL, CENTRE_X, CENTRE_Y, K1, K2], "param_names": ["f", "cx", "cy", "k1", "k2"],
        },
        "images": [
            {
                "name": f"desk_{i:03d}.jpg",
                "split": "train" if i % TEST_EVERY else "test",
                "world_from_cam": pose.tolist(),
            }
            for i, pose in enumerate(poses)
        ],
    }  # fmt: skip
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Writes the truth first, then photo after photo."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the capture")
    parser.add_argument("--samples", type=int, default=8, help="paths per pixel before denoising")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", type=int, nargs="+", metavar="INDEX", help="make these photos only")
    options = parser.parse_args()
    images, depths = options.out / "images", options.out / "truth" / "depth"
    images.mkdir(parents=True, exist_ok=True)
    depths.mkdir(parents=True, exist_ok=True)

    poses, rays = camera_poses(SEED), pixel_rays()
    write_cameras(options.out / "truth" / "cameras.json", poses)
    parts = desk_scene.furnish(SEED)
    build(parts)
    render_settings(options.samples, options.threads)
    tree, corners = ray_caster(parts)
    print(f"{len(parts)} parts, {len(corners)} triangles", flush=True)

    chosen = options.only if options.only is not None else range(len(poses))
    for index in chosen:
        depth_path = depths / f"desk_{index:03d}.tiff"
        if index % TEST_EVERY == 0 and not depth_path.exists():
            write_depth(depth_path, cast_depth(tree, corners, world_from_cam=poses[index], rays=rays))
            print(f"wrote {depth_path}", flush=True)
        path = images / f"desk_{index:03d}.jpg"
        if path.exists():
            print(f"kept {path}", flush=True)
            continue
        started = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            wide = render_wide(poses[index], seed=SEED + index, folder=Path(folder))
        photo = develop(resample(np.minimum(wide, 2 / EXPOSURE), rays), SEED + index)
        partial = path.with_name(f".{path.name}.partial")
        Image.fromarray(photo).save(partial, "JPEG", quality=90, exif=exif(index))
        os.replace(partial, path)
        print(f"wrote {path} in {time.monotonic() - started:.0f} s", flush=True)


if __name__ == "__main__":
    main()
