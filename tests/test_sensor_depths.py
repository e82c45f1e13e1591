"""Depth maps of sensors: a wall and a panel before it, whose depth is known in closed form, measured in other units."""

import json
import sys
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
import torch
from every_format import Views, write_polycam, write_record3d
from PIL import Image
from pools import pool_of_photos
from present import present
from test_stereo import OFFSETS, photo, truth
from trainings import prepared

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame, SensorDepth
from nerfcli.cameras.rigid import Similarity, from_parts
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.polycam import parse_polycam
from nerfcli.captures.formats.pose_files import parse_pose_files
from nerfcli.captures.formats.record3d import parse_record3d
from nerfcli.captures.formats.registry import depths_beside
from nerfcli.captures.formats.scene_folder import parse_scene, write_scene
from nerfcli.captures.formats.transforms import losses_transforms, parse_transforms, write_transforms
from nerfcli.cli.options import Training
from nerfcli.cli.train import Fit
from nerfcli.errors import UserError
from nerfcli.matching.stereo import DenseDepth
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.photos.sensor_depth import read_sensor_depth
from nerfcli.training import sensor_depths as module
from nerfcli.training.evidence import dense_points
from nerfcli.training.pool import PixelPool, PointDepths
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.sensor_depths import Registration, fitted, seen_points, sensor_depths

PHOTO, MAP = Camera.pinhole(160, 120, 120.0), Camera.pinhole(80, 60, 60.0)
# Metres in a scene unit, and the similarity of the training frame.
METRES, TRAINING = 0.4, Similarity(0.5, np.eye(3), np.array([1.0, 2.0, 3.0]))


def z_of(camera: Camera, x: float = 0.0) -> np.ndarray:
    """Depth (H, W) in metres seen from (x, 0, 0): a panel at z = 1.2, |x| < 0.35, |y| < 0.3, before a slanted wall."""
    rays = camera.pixel_bearings()[0]
    rays = (rays / rays[:, 2:]).reshape(camera.height, camera.width, 3)
    wall = (2.4 - 0.2 * x) / (1.0 + 0.2 * rays[..., 0])  # z + 0.2 x = 2.4
    on_panel = (np.abs(x + 1.2 * rays[..., 0]) < 0.35) & (np.abs(1.2 * rays[..., 1]) < 0.3)
    return np.where(on_panel, 1.2, wall)


def place(folder: Path, maps: Sequence[np.ndarray], *, unit: float = 1e-3) -> PixelPool:
    """Write photos and levels of their maps, and return the pool of the photos, one at x = 0, 0.1 m, ..."""
    photos = []
    for index, levels in enumerate(maps):
        image, depth = folder / f"{index}.png", folder / f"{index}.depth.png"
        cv2.imwrite(str(image), np.full((120, 160, 3), 128, np.uint8))
        cv2.imwrite(str(depth), levels)
        pose = from_parts(np.eye(3), np.array([0.1 * index / METRES, 0.0, 0.0]))
        frame = Frame(image.name, PHOTO, pose, image=image, depth=SensorDepth(depth, unit))
        photos.append(LoadedPhoto(frame, np.full((120, 160, 3), 128, np.uint8), None))
    return pool_of_photos(photos, TRAINING)


def levels_of(z: np.ndarray, unit: float = 1e-3) -> np.ndarray:
    return np.rint(z / unit).astype(np.uint16)


def place_panel(folder: Path, count: int = 4, *, unit: float = 1e-3) -> PixelPool:
    """Place photos of the panel, with maps of half their size in levels of `unit`, which is stated as 1e-3."""
    return place(folder, [levels_of(z_of(MAP, 0.1 * index), unit) for index in range(count)])


def known_points(pool: PixelPool, *, seed: int = 0, count: int = 400) -> PointDepths:
    """Return true distances at random pixels."""
    rng, dense = np.random.default_rng(seed), []
    for index in range(len(pool.frames)):
        places = np.unique(rng.integers(0, (160, 120), (count, 2)), axis=0)
        dense.append(DenseDepth(places, true_distances(places, index), np.full(len(places), 0.01)))
    return dense_points(dense, pool)


def true_distances(places: np.ndarray, index: int) -> np.ndarray:
    cosines = PHOTO.bearings(places + 0.5)[0][:, 2]
    return z_of(PHOTO, 0.1 * index)[places[:, 1], places[:, 0]] / METRES / cosines


def measured(pool: PixelPool, said: list[str] | None = None, *, count: int = 400) -> list[DenseDepth]:
    notes: list[str] = [] if said is None else said
    return sensor_depths(known_points(pool, count=count), pool, notify=notes.append)


def errors(depths: Sequence[DenseDepth]) -> np.ndarray:
    """Return relative errors against the truth."""
    numbered = enumerate(depths)
    return np.concatenate([depth.distances / true_distances(depth.pixels, index) - 1.0 for index, depth in numbered])


@pytest.mark.parametrize("unit", [1e-3, 2e-4])
def test_depths_in_another_unit_and_size_are_distances_along_the_rays(tmp_path, unit):
    """Maps have half the photos' size. The unit is a millimetre, as stated, or a fifth of what is stated."""
    said: list[str] = []
    pool = place_panel(tmp_path, unit=unit)
    found = measured(pool, said)
    # Half a pixel of the map, on a wall whose depth changes by 0.35 % from pixel to pixel, and half a level.
    assert np.abs(errors(found)).max() < 5e-3
    assert all(len(depth.pixels) > 0.8 * 80 * 60 for depth in found)
    assert f"{unit / 1e-3 / METRES:.4g} scene units per metre" in said[0]
    assert "another" not in said[0]
    expected = np.concatenate([depth.distances for depth in found]) * TRAINING.scale
    assert dense_points(found, pool).distances.numpy() == pytest.approx(expected, rel=1e-5)


def test_pixels_at_edges_of_depth_are_left_out(tmp_path):
    """A sensor mixes both sides of an edge: flying pixels at a depth between them."""
    maps = []
    for i in range(4):
        z = z_of(MAP, 0.1 * i)
        edge = cv2.dilate(z, np.ones((3, 3))) > 1.06 * cv2.erode(z, np.ones((3, 3)))
        maps.append(levels_of(np.where(edge, cv2.blur(z, (3, 3)), z)))
    assert np.abs(errors(measured(place(tmp_path, maps)))).max() < 5e-3


def test_what_photos_contradict_is_left_out_and_counted(tmp_path):
    """A mirror in one corner is measured at twice its depth; all of another map is wrong."""
    said: list[str] = []
    maps = [levels_of(z_of(MAP, 0.1 * i)) for i in range(6)]
    maps[1][:15, :20] *= 2
    maps[4] = levels_of(1.7 * z_of(MAP, 0.4))
    found = measured(place(tmp_path, maps), said, count=6000)
    assert len(found[4].pixels) == 0
    assert "all of 1 photo: 4.png" in said[0]
    assert (np.abs(errors(found)) > 5e-3).sum() < 0.1 * 15 * 20  # in squares that are partly beside the mirror
    share = float(said[0].split("disagree: ")[1].split(" %")[0]) / 100
    lost = 15 * 20 / (5 * 80 * 60)
    assert 0.9 * lost < share < 1.6 * lost  # squares reach over the mirror's edge


def test_the_view_of_a_depth_camera_beside_the_photos_is_found(tmp_path):
    """A Kinect: q = f_depth (X + 0.025) / Z, for f_depth = 1.1 f and a camera 2.5 cm to the left of the photo's."""
    said: list[str] = []
    camera = Camera.pinhole(160, 120, 1.1 * 120.0)
    pool = place(tmp_path, [levels_of(z_of(camera, 0.1 * i - 0.025)) for i in range(6)])
    points = seen_points(known_points(pool, count=2000), pool)
    maps = [read_sensor_depth(frame.depth, frame.image).z for frame in pool.frames]  # type: ignore[arg-type]
    fit = present(fitted(list(zip(points, maps, strict=True))))
    assert fit.registration.zoom == pytest.approx(1.1, abs=0.01)
    for z in (1.2, 2.4):  # at each depth, shift and parallax are the disparity, to two pixels: few points are at edges
        moved = fit.registration.in_map(np.array([[0.5, 0.5]]), np.array([z]))[0]
        assert moved == pytest.approx([0.5 + 1.1 * 120.0 * 0.025 / z / 160, 0.5], abs=2 / 120)
    assert np.percentile(np.abs(errors(measured(pool, said))), 98) < 0.01
    assert "its view differs from the photos': it is 0.91 times as wide" in said[0]


def test_a_registration_and_its_inverse_undo_each_other():
    registration = Registration(1.1, (0.01, -0.02), (0.03, 0.001))
    positions, z = np.random.default_rng(0).uniform(0, 1, (50, 2)), np.linspace(0.5, 9, 50)
    assert registration.in_photo(registration.in_map(positions, z), z) == pytest.approx(positions, abs=1e-12)


def test_little_confidence_doubles_the_error_and_none_leaves_out(tmp_path):
    """ARKit's levels: 0, 1 and 2. Rows of the map have one each."""
    pool = place_panel(tmp_path)
    confidence = np.repeat(np.array([0, 1, 2], np.uint8), 20)[:, None].repeat(80, 1)
    cv2.imwrite(str(tmp_path / "confidence.png"), confidence)
    plain = measured(pool)[0]
    pool.frames = tuple(
        replace(frame, depth=replace(frame.depth, confidence=tmp_path / "confidence.png"))  # type: ignore[type-var]
        for frame in pool.frames
    )
    found = measured(pool)[0]
    assert found.pixels[:, 1].min() >= 40
    before = {tuple(pixel): error for pixel, error in zip(plain.pixels.tolist(), plain.errors, strict=True)}
    rows, ratios = found.pixels[:, 1] // 40, np.array([before[tuple(pixel)] for pixel in found.pixels.tolist()])
    ratios = found.errors / ratios
    assert np.median(ratios[rows == 1]) == pytest.approx(2 * np.median(ratios[rows == 2]), rel=1e-4)


def test_depths_that_nothing_confirms_are_not_used(tmp_path):
    said: list[str] = []
    noise = np.random.default_rng(0).uniform(300, 6000, (4, 60, 80))
    pool = place(tmp_path, [cv2.resize(cv2.resize(one, (8, 6)), (80, 60)).astype(np.uint16) for one in noise])
    assert all(len(depth.pixels) == 0 for depth in measured(pool, said))
    assert "the depths of the sensor are not used: only" in said[0]
    nothing = PointDepths(torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0))
    sensor_depths(nothing, pool, notify=said.append)
    assert said[1] == "the depths of the sensor are not used: too few points that photos see have one"


def test_a_map_that_cannot_be_read_is_left_out_and_named(tmp_path):
    said: list[str] = []
    pool = place_panel(tmp_path)
    (tmp_path / "2.depth.png").write_bytes(b"no picture")
    found = measured(pool, said)
    assert [len(depth.pixels) > 0 for depth in found] == [True, True, False, True]
    assert f"1 map left out: {tmp_path / '2.depth.png'}" in said[0]


def walls(folder: Path) -> Capture:
    """Two textured walls in six photos, two of them held out, all with maps of their depth in millimetres."""
    frames = []
    for index, x in enumerate((*OFFSETS, 0.75, -0.5)):
        one = photo(x)
        cosines = one.frame.camera.pixel_bearings()[0][:, 2].reshape(150, 200)
        z = truth(one.frame.camera, one.frame.world_from_cam)[0] * cosines
        image, depth = folder / f"{index}.png", folder / f"{index}.tif"
        cv2.imwrite(str(image), one.pixels)
        tifffile.imwrite(depth, (z[::2, ::2] * METRES * 1000).astype(np.uint16))
        frames.append(replace(one.frame, name=image.name, image=image, depth=SensorDepth(depth, 1e-3)))
    return Capture(tuple(frames), np.zeros((0, 3)), root=folder, test_names=frozenset({"1.png", "4.png"}))


@pytest.mark.parametrize("fixed", [(), ("sensor",)])
def test_training_selects_the_depths_of_its_photos_and_reads_no_other(tmp_path, monkeypatch, fixed):
    opened, read = list[str](), module.read_sensor_depth
    monkeypatch.setattr(module, "read_sensor_depth", lambda *given: opened.append(given[1].name) or read(*given))
    settings = TrainSettings(budget_seconds=None, steps=50, model="auto", fixed=fixed)
    inputs, said = prepared(walls(tmp_path), tmp_path, settings)
    assert inputs.settings.components.sensor == (not fixed)
    assert set(opened) == (set() if fixed else {"0.png", "2.png", "3.png", "5.png"})
    if not fixed:
        known = present(inputs.points).sets[-1]
        rays = inputs.pool.rays_of(known.numbers)
        scene = inputs.extent.training_from_scene.inverse()
        points = scene.apply((rays.origins + rays.directions * known.distances[:, None]).double().numpy())
        walls_apart = np.abs(np.cos(0.7) * points[:, 2] + np.sin(0.7) * np.abs(points[:, 0]) - 3.0)
        assert np.median(walls_apart) < 0.02
        assert any(f"{1 / METRES:.1f}" in line and "scene units per metre" in line for line in said)


def test_a_model_with_sensor_needs_maps(tmp_path):
    capture = walls(tmp_path)
    capture = replace(capture, frames=tuple(replace(frame, depth=None) for frame in capture.frames))
    settings = TrainSettings(budget_seconds=None, steps=50, components=Components(sensor=True))
    with pytest.raises(UserError, match="no depth maps of a sensor that its photos confirm"):
        prepared(capture, tmp_path, settings)


def test_known_distances_of_a_sensor_count_as_much_as_points():
    weights = [Components(points=p, sensor=s).distance_weight for p, s in ((0, False), (0, True), (0.3, True))]
    assert weights == [0, 0.1, 0.3]


Z = np.linspace(4.0, 5.0, 20 * 30, dtype=np.float32).reshape(20, 30)
LEVELS = np.rint(Z * 1000).astype(np.uint16)


def write_exr(path: Path) -> None:
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": Z}).write(str(path))


@pytest.fixture
def landscape(tmp_path: Path) -> Path:
    """A photo whose shape is that of `Z`."""
    Image.new("RGB", (300, 200)).save(tmp_path / "photo.jpg")
    return tmp_path / "photo.jpg"


WRITERS: dict[str, tuple[Callable[[Path], object], float]] = {
    "a.png": (lambda path: cv2.imwrite(str(path), LEVELS), 1e-3),
    "a.tif": (lambda path: tifffile.imwrite(path, Z), 1.0),
    "big-endian.tif": (lambda path: tifffile.imwrite(path, Z, byteorder=">"), 1.0),
    "lzw.tif": (lambda path: cv2.imwrite(str(path), Z), 1.0),
    "a.pgm": (lambda path: cv2.imwrite(str(path), LEVELS), 1e-3),
    "up to 9999.pgm": (lambda path: path.write_bytes(b"P5 30 20 9999\n" + LEVELS.astype(">u2").tobytes()), 1e-3),
    "a.npy": (lambda path: np.save(path, Z), 1.0),
    "a.exr": (write_exr, 1.0),
}


@pytest.mark.parametrize("name", WRITERS)
def test_maps_of_other_libraries_are_read(tmp_path, landscape, name):
    write, unit = WRITERS[name]
    write(tmp_path / name)
    z = read_sensor_depth(SensorDepth(tmp_path / name, unit), landscape).z
    assert z == pytest.approx(Z, abs=0.5e-3 if unit == 1e-3 else 0.0)


@pytest.mark.parametrize("name", ["a.png", "a.pgm", "a.npy"])
def test_what_was_not_measured_has_no_depth(tmp_path, landscape, name):
    path, levels = tmp_path / name, np.full((20, 30), 2000, np.uint16)
    levels[5, 5], levels[10, 10] = 0, 65535
    cv2.imwrite(str(path), levels) if path.suffix != ".npy" else np.save(path, levels.astype(">u2"))
    z = read_sensor_depth(SensorDepth(path, 1e-3), landscape).z
    assert np.argwhere(np.isnan(z)).tolist() == [[5, 5], [10, 10]]


@pytest.mark.parametrize(
    ("orientation", "turned"), [(5, Z.T), (6, np.rot90(Z, -1)), (7, Z[::-1, ::-1].T), (8, np.rot90(Z))]
)
def test_a_map_turns_like_its_photo_unless_it_is_upright(tmp_path, orientation, turned):
    """EXIF 6 turns the stored picture a quarter clockwise, 5 mirrors it; a map of the stored shape goes with it."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.new("RGB", (300, 200)).save(tmp_path / "photo.jpg", exif=exif)
    np.save(tmp_path / "stored.npy", Z)
    np.save(tmp_path / "upright.npy", turned)
    maps = (SensorDepth(tmp_path / f"{name}.npy") for name in ("stored", "upright"))
    stored, upright = (read_sensor_depth(one, tmp_path / "photo.jpg").z for one in maps)
    assert stored.shape == (30, 20)
    assert np.array_equal(stored, upright, equal_nan=True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.ones((20, 20)), "is 20x20, which is not the shape of its 300x200 photo"),
        (np.ones((2, 20, 30)), "is not a depth map: numbers of type float64 in shape"),
        (None, "does not exist"),
        (np.ones((0, 0)), "is not a depth map: numbers of type float64 in shape"),
        (b"nothing", "is not a depth map: ValueError"),
        (b"PK\x03\x04, as of an .npz file", "is not a depth map: ValueError"),
    ],
)
def test_what_is_no_map_of_the_photo_is_an_error(tmp_path, landscape, content, message):
    path = tmp_path / "a.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.save(path, content)
    with pytest.raises(UserError, match=message):
        read_sensor_depth(SensorDepth(path), landscape)


def test_maps_of_record3d_are_unpacked_with_lzfse(tmp_path, landscape, monkeypatch):
    """The file does not tell its shape: it is that of the photo."""
    path = tmp_path / "0.depth"
    path.write_bytes(zlib.compress(Z.tobytes()))
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    with pytest.raises(UserError, match="compressed with LZFSE"):
        read_sensor_depth(SensorDepth(path), landscape)
    (tmp_path / "0.conf").write_bytes(zlib.compress(np.full((20, 30), 1, np.uint8).tobytes()))
    monkeypatch.setitem(sys.modules, "liblzfse", SimpleNamespace(decompress=zlib.decompress, error=zlib.error))
    readings = read_sensor_depth(SensorDepth(path, confidence=tmp_path / "0.conf"), landscape)
    assert np.array_equal(readings.z, Z)
    assert (readings.confidence == 0.5).all()


VIEWS = Views(Camera.pinhole(30, 20, 30.0), np.eye(4)[None].repeat(2, 0))


def put_map(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"")
    return path


def test_formats_name_the_maps_of_their_photos(tmp_path):
    """The layouts of polyform's README, Record3D's two exports, ScanNet and 7-Scenes."""
    home = write_polycam(VIEWS, tmp_path / "polycam").parent.parent
    depth, sure = put_map(home / "depth/1000.png"), put_map(home / "confidence/1000.png")
    frames = parse_polycam(tmp_path / "polycam").frames
    assert [frame.depth for frame in frames] == [SensorDepth(depth, 1e-3, sure), None]

    file = write_record3d(VIEWS, tmp_path / "record3d")
    depth = put_map(file.parent / "depth/1.exr")
    assert [frame.depth for frame in parse_record3d(file).frames] == [None, SensorDepth(depth)]
    raw, sure = put_map(file.parent / "rgb/0.depth"), put_map(file.parent / "rgb/0.conf")
    assert parse_record3d(file).frames[0].depth == SensorDepth(raw, 1.0, sure)

    for stem, pose, image, where in (
        ("0", "pose/0.txt", "color/0.png", "depth/0.png"),
        ("frame-000000", "frame-000000.pose.txt", "frame-000000.color.png", "frame-000000.depth.png"),
    ):
        folder = tmp_path / stem
        VIEWS.put(0, folder / image)
        depth = put_map(folder / where)
        (folder / pose).parent.mkdir(exist_ok=True)
        np.savetxt(folder / pose, np.eye(4))
        np.savetxt(folder / "intrinsics.txt", VIEWS.matrix)
        capture = parse_pose_files(folder)
        assert [frame.depth for frame in capture.frames] == [SensorDepth(depth, 1e-3)]
        if "color/" in image:
            assert depths_beside(folder / "color") == {"0.png": SensorDepth(depth, 1e-3)}


def test_scenes_and_transforms_keep_maps(tmp_path):
    maps = [SensorDepth(put_map(tmp_path / "depth/0.png"), 1e-3), SensorDepth(put_map(tmp_path / "depth/1.exr"))]
    maps[1] = replace(maps[1], confidence=put_map(tmp_path / "depth/1.conf"))
    frames = [replace(one, depth=depth) for one, depth in zip(VIEWS.frames(tmp_path), maps, strict=True)]
    capture = Capture(tuple(frames), np.zeros((0, 3)))
    write_scene(capture, tmp_path / "scene")
    assert [frame.depth for frame in parse_scene(tmp_path / "scene").frames] == maps

    write_transforms(capture, tmp_path / "transforms.json")
    kept = parse_transforms(tmp_path / "transforms.json").frames
    assert [frame.depth for frame in kept] == [maps[0], None]
    assert "1 depth map in another unit than millimetres" in losses_transforms(capture)

    content = json.loads((tmp_path / "scene/scene.json").read_text())
    content["depths"]["0.jpg"] = "depth/0.png"
    (tmp_path / "scene/scene.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="depths are not the depth maps of photos"):
        parse_scene(tmp_path / "scene")


def test_no_sensor_depth_is_a_component_that_the_user_leaves_out():
    settings = Fit(steps=10, sensor_depth=False).settings(Training())
    assert (settings.fixed, settings.components.sensor) == (("sensor",), False)
