"""Maps of a field from above: heights and colours in closed form, and their place in the tags of GeoTIFF."""

import math
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from commands import error_of, listing, nerfcli
from fog import fog, foggy_cells
from make_spheres import BALLS

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.run_cameras import write_cameras
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.cameras.world import Origin
from nerfcli.errors import UserError
from nerfcli.media.geodesy import degrees_per_metre, east_north_up
from nerfcli.media.geotiff import MapPlace, write_geotiff
from nerfcli.media.mesh_files import read_glb_json
from nerfcli.render.visibility import DepthMap
from nerfcli.runs.config import write_config
from nerfcli.runs.run import Run
from nerfcli.surface.ortho import Ortho, automatic_pixel, check_upright, ortho_of
from nerfcli.workflows.describe import describe
from nerfcli.workflows.views import Views, chosen_frames

# The scene is twice as large as the training frame, turned about z and moved.
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SIMILARITY = Similarity(0.5, TURN, np.array([0.1, -0.2, 0.05]))
DOWN = np.diag([1.0, -1.0, -1.0])
# Fog between these corners of the training frame, and half of the light from above ends ln 2 below its top.
LOW, HIGH = np.array([-0.5, -0.75, -1.0]), np.array([0.25, 0.5, 0.75])


def in_scene(corner: np.ndarray) -> np.ndarray:
    return SIMILARITY.inverse().apply(corner[None])[0]


SURFACE = float(in_scene(HIGH)[2]) - math.log(2) / SIMILARITY.scale
BOX = (*(np.minimum(in_scene(LOW), in_scene(HIGH)) - 0.4), *(np.maximum(in_scene(LOW), in_scene(HIGH)) + 0.4))
BOX = tuple(float(value) for value in BOX)


def photo(x: float, y: float) -> DepthMap:
    """Return the distances to a plane at the height of the surface, from a camera above that looks down."""
    camera = Camera.pinhole(80, 60, 40.0)
    frame = Frame(f"{x}.png", camera, rigid.from_parts(DOWN, np.array([x, y, SURFACE + 3.0])))
    rays, _ = camera.pixel_bearings()
    return DepthMap(frame, (3.0 / rays[:, 2]).reshape(60, 80).astype(np.float32))


def map_of(views: list[DepthMap], pixel_size: float = 0.09, bottom: float = BOX[2]) -> Ortho:
    model = fog(foggy_cells(tuple(LOW), tuple(HIGH)), SIMILARITY)
    return ortho_of(model, views, (*BOX[:2], bottom, *BOX[3:]), pixel_size, height_above=3.0)


def test_a_map_of_fog_has_its_height_outline_and_colour():
    """The density is 1 per length of the training frame: half of the light is left ln 2 below the top."""
    found = map_of([photo(0.0, 0.0)] * 3)
    height, width = found.heights.shape
    x = BOX[0] + 0.09 * (np.arange(width) + 0.5)
    y = BOX[4] - 0.09 * (np.arange(height) + 0.5)
    a, b = (np.sort([in_scene(LOW)[i], in_scene(HIGH)[i]]) for i in (0, 1))
    inside = ((y > b[0]) & (y < b[1]))[:, None] & ((x > a[0]) & (x < a[1]))
    np.testing.assert_array_equal(np.isfinite(found.heights), inside)
    np.testing.assert_allclose(found.heights[inside], SURFACE, rtol=0, atol=1 / 256)
    np.testing.assert_array_equal(found.rgba[inside][:, :3], 128)
    np.testing.assert_array_equal(found.rgba[..., 3], 255 * inside)
    assert not found.rgba[~inside].any()
    assert found.corner == (BOX[0], BOX[4])
    shallow = map_of([photo(0.0, 0.0)] * 3, bottom=SURFACE + 0.1)
    assert not np.isfinite(shallow.heights).any()


def test_a_map_shows_what_three_photos_see():
    aside = photo(2.0, 0.0)
    two, three = map_of([photo(0.0, 0.0)] * 2 + [aside]), map_of([photo(0.0, 0.0)] * 3 + [aside])
    assert 0 < np.isfinite(two.heights).sum() < np.isfinite(three.heights).sum()
    columns = np.flatnonzero(np.isfinite(two.heights).any(axis=0)) * 0.09 + BOX[0]
    assert columns.min() == pytest.approx(2.0 - 3.0, abs=0.1)  # the left edge of that photo, 45 degrees off its axis
    elsewhere = photo(0.0, 0.0)
    wrong = DepthMap(elsewhere.frame, elsewhere.distances * np.float32(0.9))
    with_wrong = map_of([photo(0.0, 0.0)] * 2 + [wrong])
    assert not np.isfinite(with_wrong.heights).any()


def test_a_map_of_too_many_pixels_is_refused():
    with pytest.raises(UserError, match="at most 67108864 pixels are supported") as raised:
        map_of([photo(0.0, 0.0)], pixel_size=1e-4)
    least = float(raised.value.hint.rsplit(" ", 1)[1])
    assert (BOX[3] - BOX[0]) * (BOX[4] - BOX[1]) / least**2 < 2**26


def test_pixels_are_those_of_the_photos_as_they_were_trained_on():
    frames = [Frame("a.jpg", Camera.pinhole(400, 300, 500.0), np.eye(4))]
    assert automatic_pixel(frames, 4, 25.0, (0, 0, 0, 10, 10, 1)) == pytest.approx(0.2)
    assert automatic_pixel(frames, 4, 25.0, (0, 0, 0, 10, 81920, 1)) == pytest.approx(10.0)


def test_scenes_that_do_not_stand_upright_are_refused():
    camera = Camera.pinhole(40, 30, 40.0)
    above = [Frame(f"{x}", camera, rigid.from_parts(DOWN, np.array([x, 0.0, 5.0]))) for x in range(4)]
    check_upright(above)
    level = rigid.look_at(np.array([3.0, 0, 1]), np.zeros(3), np.array([0.0, 0, 1]))
    check_upright([Frame("a", camera, level)])
    for pose in (np.eye(4), rigid.look_at(np.array([3.0, 0, 1]), np.zeros(3), np.array([0.0, 1, 0]))):
        with pytest.raises(UserError, match="z axis of the scene does not point up"):
            check_upright([Frame("a", camera, pose)])


@pytest.mark.parametrize(
    ("system", "code"),
    [
        ("EPSG:2154", 2154),
        ("epsg: 25832", 25832),
        ("WGS84 UTM 11N", 32611),
        ("WGS84 UTM 56S", 32756),
        ("+proj=utm +zone=11 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", 32611),
        ("+proj=utm +zone=56 +south +datum=WGS84", 32756),
        ("+proj=utm +zone=32 +ellps=GRS80", None),
        ("+proj=tmerc +lat_0=0 +lon_0=9", None),
    ],
)
def test_codes_of_coordinate_systems(system, code):
    assert Origin(system, (0.0, 0.0, 0.0), in_degrees=False).epsg == code
    for name, degrees in (("WGS 84", 4326), ("EPSG:4979", 4326), ("EPSG:4269", 4269), ("+proj=longlat", 4326)):
        assert Origin(name, (1.0, 2.0, 3.0), in_degrees=True).epsg == degrees


@pytest.mark.parametrize("latitude", [0.0, 34.4, -61.0])
def test_degrees_per_metre_are_those_of_small_steps(latitude):
    north, east = degrees_per_metre(latitude, 200.0)
    steps, _ = east_north_up([(latitude, 7.0, 200.0), (latitude + north, 7.0, 200.0), (latitude, 7.0 + east, 200.0)])
    np.testing.assert_allclose(steps[1:, :2], [[0, 1], [1, 0]], rtol=0, atol=1e-6)


def tags_of(path: Path) -> dict[str, Any]:
    with tifffile.TiffFile(path) as tiff:
        found = tiff.geotiff_metadata
    assert found is not None
    return found


def test_tags_of_a_map_with_and_without_a_system(tmp_path):
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    values[0, 0] = np.nan
    place = MapPlace((235234.5, 3811234.25), (0.03, 0.03), 32611, False, "EPSG:32611")
    write_geotiff(tmp_path / "a.tif", values, place, description={"unit": "metre"})
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        np.testing.assert_array_equal(tiff.asarray(), values)
        assert tiff.pages[0].aspage().tags[42113].value == "nan"
    found = tags_of(tmp_path / "a.tif")
    assert found["ModelTiepoint"] == [0, 0, 0, 235234.5, 3811234.25, 0]
    assert found["ModelPixelScale"] == [0.03, 0.03, 0]
    assert (found["GTModelTypeGeoKey"], found["GTRasterTypeGeoKey"]) == (1, 1)
    assert found["ProjectedCSTypeGeoKey"] == 32611
    assert found["GTCitationGeoKey"] == "EPSG:32611"
    assert describe(tmp_path / "a.tif") == {
        "kind": "map",
        "format": "GeoTIFF",
        "width": 4,
        "height": 3,
        "system": "EPSG:32611",
        "epsg": 32611,
        "corner": [235234.5, 3811234.25],
        "pixel": [0.03, 0.03],
        "unit": "metre",
    }
    rgba = np.zeros((3, 4, 4), np.uint8)
    write_geotiff(tmp_path / "b.tif", rgba, MapPlace((7.0, 48.0), (1e-7, 2e-7), 4326, True, "WGS 84"), description={})
    with tifffile.TiffFile(tmp_path / "b.tif") as tiff:
        assert tiff.pages[0].aspage().extrasamples == (2,)
    found = tags_of(tmp_path / "b.tif")
    assert (found["GTModelTypeGeoKey"], found["GeographicTypeGeoKey"]) == (2, 4326)
    write_geotiff(
        tmp_path / "c.tif", values, MapPlace((0.0, 0.0), (1.0, 1.0), None, False, "Gauß-Krüger"), description={}
    )
    found = tags_of(tmp_path / "c.tif")
    assert found["GTModelTypeGeoKey"] == 32767
    assert found["GTCitationGeoKey"] == "Gau?-Kr?ger"
    (tmp_path / "cut.tif").write_bytes((tmp_path / "a.tif").read_bytes()[:20])
    with pytest.raises(UserError, match="damaged or truncated"):
        describe(tmp_path / "cut.tif")


@pytest.fixture
def run(spheres_run: Path, tmp_path: Path) -> Path:
    shutil.copytree(spheres_run, tmp_path / "survey-run")
    return tmp_path / "survey-run"


@pytest.fixture
def few(run: Path) -> Path:
    """The run with a third of its photos, which are enough where results are compared and not measured."""
    cameras = Run(run).cameras
    write_cameras(run, cameras.train[::3], list(cameras.test))
    return run


def put(run: Path, origin: Origin | None) -> None:
    """Say where the origin of a run's scene is, as `nerfcli convert` does."""
    config = Run(run).config
    history = {**(config.history or {}), "origin": None if origin is None else asdict(origin)}
    write_config(run, replace(config, history=history))


def test_the_command_maps_balls_where_they_are(run, tmp_path):
    """Balls of known place and radius: their tops, in coordinates of the system."""
    put(run, Origin("EPSG:32611", (235000.0, 3811000.0, 100.0), in_degrees=False))
    out = tmp_path / "map"
    options = ("--to", "ortho", "--voxel-size", "0.04", "--max-size", "96", "--threads", "2")
    done = nerfcli("export", run, "-o", out, *options)
    assert done.exit_code == 0, done.stderr
    assert "coordinates in EPSG:32611" in done.stderr
    assert sorted(listing(out)) == ["heights.tif", "orthophoto.tif"]
    heights, tags = tifffile.imread(out / "heights.tif"), tags_of(out / "heights.tif")
    (left, top), (size, _, _) = tags["ModelTiepoint"][3:5], tags["ModelPixelScale"]
    errors = []
    for ball in BALLS:
        x, y, z = ball.centre
        row, column = int((top - (3811000.0 + y)) / size), int((235000.0 + x - left) / size)
        errors.append(heights[row, column] - (100.0 + z + ball.radius))
    # Two pixels of the map; 200 steps leave 0.056 with two threads, 0.060 with one.
    assert np.nanmedian(np.abs(errors)) < 2 * size
    colours = tifffile.imread(out / "orthophoto.tif")
    np.testing.assert_array_equal(colours[..., 3] > 0, np.isfinite(heights))
    printed = nerfcli("info", out / "heights.tif").stdout
    assert "holds: heights" in printed
    assert f"corner: {left:.10g} {top:.10g}" in printed
    again = nerfcli("export", run, "-o", out, *options)
    assert "exists" in error_of(again)[0]


def test_georeferenced_scenes_stand_on_z(few, tmp_path):
    """The cameras are turned on their sides: without an origin their own up is x, with one it is z."""
    cameras = Run(few).cameras
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = [
        replace(f, world_from_cam=rigid.from_parts(f.world_from_cam[:3, :3] @ quarter, f.centre)) for f in cameras.train
    ]
    write_cameras(few, turned, list(cameras.test))
    for origin in (None, Origin("EPSG:32611", (0.0, 0.0, 0.0), in_degrees=False)):
        put(few, origin)
        centres = np.stack([f.centre for f in chosen_frames(Run(few), Views("ellipse", 8), depth_hint=1.0)])
        assert (np.ptp(centres[:, 2]) < 1e-9) == (origin is not None)
        done = nerfcli("export", few, "--to", "mesh", "-o", tmp_path / "a.glb", "--max-size", "48", "--overwrite")
        assert done.exit_code == 0, done.stderr
        matrix = np.array(read_glb_json(tmp_path / "a.glb")["nodes"][0]["matrix"]).reshape(4, 4).T
        assert (abs(matrix[1, 2] - 1) < 1e-9) == (origin is not None)


def test_las_files_of_surveys_are_in_their_system(few, tmp_path):
    laspy = pytest.importorskip("laspy", reason="an extra")
    options = ("--to", "points", "--max-size", "48", "--threads", "2")
    put(few, None)
    assert nerfcli("export", few, "-o", tmp_path / "a.las", *options).exit_code == 0
    put(few, Origin("EPSG:32611", (235000.0, 3811000.0, 100.0), in_degrees=False))
    assert nerfcli("export", few, "-o", tmp_path / "b.las", *options).exit_code == 0
    plain, surveyed = (laspy.read(tmp_path / name) for name in ("a.las", "b.las"))
    np.testing.assert_allclose(
        surveyed.xyz - plain.xyz, np.tile([235000.0, 3811000.0, 100.0], (len(plain), 1)), atol=1e-5
    )
    records = {vlr.record_id: vlr for vlr in surveyed.header.vlrs if vlr.user_id == "LASF_Projection"}
    keys = {key.id: key.value_offset for key in records[34735].geo_keys}
    assert (keys[1024], keys[3072]) == (1, 32611)
    printed = nerfcli("info", tmp_path / "b.las").stdout
    assert "frame: EPSG:32611" in printed
    assert f"{surveyed.header.mins[1]:.2f}" in printed
    low, high = describe(tmp_path / "b.las")["box"][:3], describe(tmp_path / "b.las")["box"][3:]
    assert (surveyed.xyz >= low).all()
    assert (surveyed.xyz <= high).all()
    assert not [vlr for vlr in plain.header.vlrs if vlr.user_id == "LASF_Projection"]


def test_degrees_and_scenes_without_a_place(few, tmp_path):
    options = ("--to", "ortho", "--voxel-size", "0.2", "--max-size", "32", "--threads", "2")
    origins = (Origin("WGS 84", (48.0, 11.0, 500.0), in_degrees=True), None)
    for origin, words in zip(origins, ("coordinates in WGS 84", "is not georeferenced"), strict=True):
        put(few, origin)
        done = nerfcli("export", few, "-o", tmp_path / words.replace(" ", "-"), *options)
        assert done.exit_code == 0, done.stderr
        assert words in done.stderr
    tags, own = (
        tags_of(tmp_path / name / "orthophoto.tif") for name in ("coordinates-in-WGS-84", "is-not-georeferenced")
    )
    north, east = degrees_per_metre(48.0, 500.0)
    np.testing.assert_allclose(tags["ModelPixelScale"][:2], [0.2 * east, 0.2 * north], rtol=1e-12)
    np.testing.assert_allclose(
        tags["ModelTiepoint"][3:5],
        [11 + east * own["ModelTiepoint"][3], 48 + north * own["ModelTiepoint"][4]],
        rtol=1e-12,
    )
    assert own["GTModelTypeGeoKey"] == 32767
