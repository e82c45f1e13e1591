"""The page that renders a field by itself: its numbers with NumPy, and all of it in a browser if there is one."""

import base64
import json
import os
import re
import shlex
import shutil
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import Browser, find_browser, needs_browser
from fog import SIDE
from page_arithmetic import PageField, array, element
from present import present

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts, look_at, rotation_from_vector
from nerfcli.captures.formats.camera_path import read_path
from nerfcli.errors import UserError
from nerfcli.field.background import SphereBackground
from nerfcli.field.fourier_field import FourierField, FourierFieldSettings
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.field.interface import Field
from nerfcli.field.voxel_field import VoxelField, VoxelFieldSettings
from nerfcli.kernels import grid_coordinates
from nerfcli.kernels.reference.encoding import hash_encode
from nerfcli.machine import Resources
from nerfcli.output import Output
from nerfcli.render.coverage import DepthMap, depth_maps, with_coverage
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.render.trained_field import Marching
from nerfcli.training.runs.run import Run
from nerfcli.viewer.packing import FINEST_LEVEL, pack_model, quantised, reached_rows, seen_cells
from nerfcli.viewer.page import numbers_of, page_html, scene_of
from nerfcli.viewer.pictures import HEIGHT, WIDTH, Proof, make_proof, page_photos
from nerfcli.workflows import photo_depths
from nerfcli.workflows.export import export_run

# The change of a colour in [0, 1] by 16-bit rows, single precision and the colours that neither side evaluates.
COLOUR_BOUND = 2e-3
# `nerfcli render` leaves out cells with less than this of a ray's light, see `training.picture_cells`; a page does not.
FINE_BOUND = 2e-3
# Longer side of the maps of photos' depths: a quarter of the usual rays.
PHOTO_SIZE = 48
COMPRESSED_NOTHING = base64.b64encode(zlib.compress(b"")).decode()
# The fraction of pixels within the bound of depths: at edges a median jumps from one surface to another.
AGREEING = 0.98
UNSEEN = np.zeros((2, 2, 2), "<u2")
NO_PROOF = Proof({}, np.zeros(0, "<f4"))
SIMILARITY = Similarity(0.7, rotation_from_vector(np.array([0.2, -0.4, 0.9])), np.array([0.1, -0.2, 0.3]))


def at(place: tuple[float, float, float]) -> Frame:
    """Return a small camera of the scene that looks at the centre of the training frame."""
    world = SIMILARITY.inverse()
    pose = look_at(world.apply(np.array(place)), world.apply(np.zeros(3)), np.array([0.1, 0.2, 1.0]))
    return Frame("a.png", Camera("PINHOLE", 16, 12, (11.0, 12.0, 8.5, 5.75)), pose)


def rough(field: Field, *, sky: bool = False) -> Model:
    """Return a model of random parameters, dense and thin throughout, with 40 % of the cells occupied."""
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * (0.5 if parameter.dim() > 2 else 0.6))
    background: SphereBackground | tuple[float, float, float] = (0.2, 0.4, 0.6)
    if sky:
        background = SphereBackground(8)
        background.logits.data = torch.randn(background.logits.shape, generator=generator)
    occupied = torch.rand(SIDE, SIDE, SIDE, generator=generator) < 0.4
    return Model(field, occupied, Marching(0.05, 40.0, 0.05, 0.05), background, SIMILARITY, "metre")


def page_of(model: Model, frames: list[Frame], proof: Proof) -> str:
    box = (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
    scene = scene_of(model, run=Path("a run"), frames=frames, photos=[], box=box)
    description, numbers = numbers_of(pack_model(model), proof, UNSEEN)
    return page_html(scene | description, numbers)


def hash_settings(contraction: str, *, antialias: bool = False, view_degree: int = 3) -> HashFieldSettings:
    small = HashFieldSettings(contraction=contraction, levels=3, log2_rows=10, coarsest=4, finest=40, width=16)
    return replace(small, antialias=antialias, view_degree=view_degree)


@pytest.mark.parametrize(
    ("field", "sky"),
    [
        (HashField(hash_settings("none")), False),
        (HashField(hash_settings("l2")), True),
        (HashField(hash_settings("l2", antialias=True, view_degree=1)), False),
        (VoxelField(VoxelFieldSettings(contraction="l2", view_degree=2, log2_vertices=11)), True),
    ],
    ids=["none", "l2 with a sky", "l2, antialiased, degree 1", "voxels"],
)
def test_the_numbers_in_the_page_render_what_the_kernels_render(field, sky):
    """Against an independent implementation of the shader, applied to the page's own text."""
    model, frame = rough(field, sky=sky), at((1.6, -0.4, 0.8))
    page = page_of(model, [frame], NO_PROOF)
    traced = PageField(page).trace(json.loads(element(page, "scene"))["home"])
    request = DepthRequest("median", "ray", min_opacity=0.0)
    picture = render_picture(model, frame, background=model.background, depth=request)
    assert picture.rgb.std() > 0.02
    np.testing.assert_allclose(traced.rgb.reshape(picture.rgb.shape), picture.rgb, atol=COLOUR_BOUND)
    np.testing.assert_allclose(traced.opacity.reshape(picture.opacity.shape), picture.opacity, atol=COLOUR_BOUND)
    for ours, kernels in ((traced.median, present(picture.depth)), (traced.spread, present(picture.spread))):
        mine = ours.reshape(kernels.shape) / SIMILARITY.scale
        alike = np.isclose(mine, kernels, rtol=2e-3, atol=2e-3, equal_nan=True)
        assert alike.mean() > AGREEING


@pytest.mark.parametrize(("largest", "worth"), [(1e-3, FINEST_LEVEL), (5.0, FINEST_LEVEL), (100.0, 100.0 / 32767)])
def test_levels_are_off_by_half_a_level_and_zero_stays_zero(largest, worth):
    values = np.random.default_rng(0).uniform(-largest, largest, (50, 4)).astype(np.float32)
    values[0] = (largest, -largest, 0.0, 0.0)
    levels, scale = quantised(values)
    assert scale == pytest.approx(worth)
    assert np.abs(levels * scale - values).max() <= scale / 2 * (1 + 1e-6)
    assert np.abs(levels.astype(int)).max() == round(largest / worth)
    assert not quantised(np.zeros(3))[0].any()


@pytest.mark.parametrize("side", [4, 7, 13, 40, 101])
def test_interpolation_in_occupied_cells_reads_only_reached_rows(side):
    """Unreached rows hold 1e6, which must not affect random points or corners of occupied cells."""
    rng, rows = torch.Generator().manual_seed(side), 2**12
    occupied = torch.rand(8, 8, 8, generator=rng) < 0.02
    cells = occupied.nonzero().flip(-1)
    inside = torch.rand(200, 1, 3, generator=rng)
    inside[0], inside[1] = 0.0, 1.0 - 2**-20
    points = ((cells + inside) / 8).reshape(-1, 3)
    reached = reached_rows(occupied, side, rows)
    table = torch.where(reached, 0.0, 1e6)[None, :, None]
    assert hash_encode(points, table, (side,)).abs().max() < 1e-3
    assert reached.sum() <= len(cells) * (side // 8 + 3) ** 3
    assert not reached_rows(torch.zeros_like(occupied), side, rows).any()


def test_rows_that_no_vertex_has_are_left_out():
    settings = hash_settings("none")
    packed = pack_model(rough(HashField(settings)))
    sides = [side + 1 for side in settings.resolutions]
    assert packed.field["rows"] == sum(min(side**3, 2**10) for side in sides)
    assert len(packed.arrays["table"]) == packed.field["rows"]


def test_the_proof_holds_the_pictures_of_nerfcli_render():
    model, frame = rough(HashField(hash_settings("l2"))), at((1.6, -0.4, 0.8))
    frames = [frame, at((0.2, 1.5, 0.1))]
    page = page_of(model, frames, make_proof(model, frames))
    described = json.loads(element(page, "scene"))["proof"]
    expected = array(page, "expected", "<f4")
    count = WIDTH * HEIGHT
    assert len(expected) == 2 * count * (3 + len(described["maps"]))
    lens = described["cameras"][0]["lens"]
    small = replace(frame, camera=Camera("PINHOLE", WIDTH, HEIGHT, tuple(lens)))
    picture = render_picture(model, small, background=model.background, depth=DepthRequest("median", "z"))
    np.testing.assert_array_equal(expected[: 3 * count].reshape(HEIGHT, WIDTH, 3), picture.rgb)
    first = 3 + described["maps"].index("median")
    np.testing.assert_array_equal(expected[first * count : (first + 1) * count].reshape(HEIGHT, WIDTH), picture.depth)


def plane_from(x: float) -> DepthMap:
    """Return the depths of the scene's plane z = 0 from a camera 1.2 above it, with a field of view of 40 degrees."""
    pose = look_at(np.array([x, 0.0, 1.2]), np.array([x, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    frame = Frame("a.png", Camera.pinhole(240, 240, 120 / np.tan(np.radians(20))), pose)
    rays, _ = frame.camera.pixel_bearings()
    return DepthMap(frame, (1.2 / rays[:, 2]).reshape(240, 240).astype(np.float32))


def cell_values(model: Model, cells: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the values of the cells that contain points (N, 3) of the scene."""
    places = grid_coordinates(torch.from_numpy(model.training_from_scene.apply(points)), model.contraction).numpy()
    x, y, z = np.floor(places * len(cells)).astype(int).T
    return cells[z, y, x]


def test_cells_hold_the_coverage_and_parallax_of_the_surface_in_them():
    """Closed form for a plane below three cameras: how many see a point, and the angle between their rays."""
    model = rough(VoxelField(VoxelFieldSettings(contraction="none", view_degree=1, log2_vertices=11)))
    places = (-0.3, 0.0, 0.35)
    cells = seen_cells(model, [plane_from(x) for x in places])
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (5000, 3)) * (1, 0.44, 0)
    from_middle = np.abs(points[:, :1] - places)
    reach, width = 1.2 * np.tan(np.radians(20)), 2 * np.sqrt(3) / len(cells) / SIMILARITY.scale
    clear = (np.abs(from_middle - reach) > width).all(axis=1)
    seen = from_middle < reach
    angles = np.degrees(np.arctan2(points[:, :1] - places, np.hypot(1.2, points[:, 1:2])))
    lowest, highest = np.where(seen, angles, 90).min(axis=1), np.where(seen, angles, -90).max(axis=1)
    found = cell_values(model, cells, points)
    assert set(seen[clear].sum(axis=1)) == {0, 1, 2, 3}
    alike = found % 256 == seen.sum(axis=1)
    assert alike[clear].mean() > 0.99
    expected = np.where(seen.sum(axis=1) > 1, highest - lowest, 0)
    np.testing.assert_allclose((found // 256)[clear & alike], expected[clear & alike], atol=1.5)
    assert not cell_values(model, cells, points + np.array([0, 0, 3 * width])).any()


def test_a_network_without_a_table_is_refused_with_a_way_out():
    field = FourierField(FourierFieldSettings(contraction="l2", width=16, octaves=4))
    with pytest.raises(UserError, match="cannot render a field of type") as caught:
        pack_model(rough(field))
    assert "nerfcli render" in caught.value.hint


def test_networks_beyond_a_block_of_uniforms_are_refused():
    with pytest.raises(UserError, match="its networks have"):
        pack_model(rough(HashField(replace(hash_settings("l2"), width=64, levels=16))))


def test_the_page_loads_nothing(spheres_page):
    text = spheres_page.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert not re.search(r"""(src|href)\s*=\s*["']?https?:""", text)
    assert len(text) < 10_000_000


def test_photos_are_shown_though_their_masks_are_gone(spheres_run, tmp_path):
    """Regression: masks, which are not shown, were read, and the page failed without them."""
    cameras = Run(spheres_run).cameras
    masked = replace(cameras.train[0], mask=tmp_path / "gone.png")
    photos = [page_photos(cameras.exposures, [frame], [], room_bytes=10**6) for frame in (masked, cameras.train[0])]
    assert photos[0] == photos[1]
    assert photos[0][0][0]["picture"].startswith("data:image/jpeg")


# In a browser


@pytest.fixture(scope="module")
def spheres_page(spheres_run, tmp_path_factory) -> Path:
    run = shutil.copytree(spheres_run, spheres_run.with_name(f"page-run-{os.getpid()}"))  # it keeps depths of photos
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(photo_depths, "MAX_SIZE", PHOTO_SIZE)
        output = Output(tmp_path_factory.mktemp("page") / "spheres.html")
        return export_run(run, output, to="page", resources=Resources(2))


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Browser]:
    if find_browser() is None:
        pytest.skip("there is no Chromium on this machine to open the page with")
    with Browser(tmp_path_factory.mktemp("profile"), width=420, height=200) as opened:
        yield opened


@pytest.fixture
def opened(browser, spheres_page) -> Browser:
    """The page of the spheres, drawn."""
    browser.errors.clear()
    browser.open(spheres_page)
    browser.wait("document.body.dataset.rested > 0")
    assert browser.run("document.getElementById('trouble').textContent") == ""
    assert not browser.errors
    return browser


def test_the_browser_draws_what_nerfcli_renders(opened):
    found = json.loads(opened.run("(nerfcliPage.check(), document.getElementById('checked').dataset.found)"))
    assert found["colour"]["largest"] <= COLOUR_BOUND
    assert found["opacity"]["largest"] <= COLOUR_BOUND + FINE_BOUND
    assert found["colour"]["rms"] <= 2e-4
    for name, differences in found.items():
        assert differences["numbers"] > 1000, name
        assert differences["percentile_99"] <= 2e-3, name
        assert differences["undefined_here"] + differences["undefined_there"] <= 3, name


def test_the_browser_shows_how_many_photos_see_the_surface(opened, spheres_run):
    """The value of the cell at the kernels' median depth; nearly everywhere in the same stratum as `render`."""
    run = Run(spheres_run)
    model, photos = run.model(), depth_maps(run.model(), run.cameras.train, max_size=PHOTO_SIZE)
    cells = seen_cells(model, photos)
    camera = opened.run("nerfcliPage.scene.proof.cameras[0]")
    drawn = opened.run(
        "(() => { const { proof } = nerfcliPage.scene, { width, height, share } = proof;"
        " const picture = nerfcliPage.renderer.picture({ ...proof.cameras[0], width, height, share });"
        " const value = (map, i) => valueOf(map, picture, i, { factor: 7, farthest: 1, minOpacity: 0.5 });"
        " const pixels = [...Array(width * height).keys()];"
        " return ['coverage', 'parallax'].map(map => pixels.map(i => value(map, i))); })()"
    )
    coverage, parallax = np.array(drawn, dtype=float)
    pose = from_parts(camera["turn"], camera["place"])
    frame = Frame("a.png", Camera("PINHOLE", WIDTH, HEIGHT, tuple(camera["lens"])), pose)
    request = DepthRequest("median", "ray")
    picture = render_picture(model, frame, background=model.background, depth=request)
    exact = present(with_coverage(picture, frame, axis="ray", photo_depths=photos).coverage).ravel()
    depth = present(picture.depth).ravel()
    there = np.isfinite(coverage) & np.isfinite(depth)
    assert there.sum() > 300
    assert (np.isfinite(coverage) == np.isfinite(depth)).mean() > AGREEING
    rays, _ = frame.camera.pixel_bearings()
    points = (rays * depth[:, None])[there] @ pose[:3, :3].T + pose[:3, 3]
    found = cell_values(model, cells, points)
    assert (coverage[there] == found % 256).mean() > AGREEING
    assert (parallax[there] == found // 256).mean() > AGREEING
    strata = [np.searchsorted((1, 2, 4), values[there], side="right") for values in (coverage, exact)]
    assert (strata[0] == strata[1]).mean() > 0.9
    opened.run("nerfcliPage.choose(MAPS.indexOf('coverage'))")
    opened.wait("nerfcliPage.done")
    assert opened.run("document.getElementById('meaning').textContent").startswith("coverage: training photos that see")
    assert opened.run("document.getElementById('ticks').textContent") == "02468 or more photos"
    assert opened.run("state.range") == [0, 8]


@pytest.mark.parametrize(
    ("field", "sky"),
    [
        (HashField(hash_settings("l2", antialias=True, view_degree=1)), True),
        (VoxelField(VoxelFieldSettings(contraction="none", view_degree=2, log2_vertices=11)), False),
    ],
    ids=["l2, antialiased, a sky", "voxels, no contraction"],
)
def test_the_browser_draws_other_fields(field, sky, browser, tmp_path):
    page = tmp_path / "other.html"
    model, frames = rough(field, sky=sky), [at((1.6, -0.4, 0.8)), at((0.2, 1.5, 0.1))]
    page.write_text(page_of(model, frames, make_proof(model, frames)), encoding="utf-8")
    browser.open(page, "#check")
    assert browser.run("document.getElementById('trouble').textContent") == ""
    found = json.loads(browser.wait("document.getElementById('checked').dataset.found"))
    assert found["colour"]["percentile_99"] <= COLOUR_BOUND
    assert found["median"]["median"] <= 1e-3
    assert found["colour"]["numbers"] == 2 * 3 * WIDTH * HEIGHT
    browser.run("(nerfcliPage.boxChanged(), nerfcliPage.listKeys())")
    for name in ("command", "render"):  # as a shell reads them
        assert shlex.split(browser.run(f"document.getElementById('{name}').textContent"))[2] == "a run"


def test_keys_move_turn_and_choose_what_is_shown(opened):
    place = opened.run("nerfcliPage.walk.place")
    ahead = opened.run("nerfcliPage.walk.ahead()")
    opened.run("document.getElementById('field').focus()")
    opened.key("w", seconds=0.3)
    moved = np.array(opened.run("nerfcliPage.walk.place")) - place
    assert moved @ ahead > 0.9 * np.linalg.norm(moved) > 0
    opened.key("ArrowRight", seconds=0.2)
    assert np.dot(opened.run("nerfcliPage.walk.ahead()"), ahead) < 1 - 1e-4
    opened.key("3")
    assert opened.run("document.getElementById('map').value") == "conditional"
    opened.wait("nerfcliPage.done")
    assert "in units of the scene" in opened.run("document.getElementById('meaning').textContent")
    low, high = (float(opened.run(f"document.getElementById('{name}').value")) for name in ("low", "high"))
    assert 0 < low < high < 20


def test_the_address_holds_the_view(opened, spheres_page):
    opened.key("8")
    opened.run("$('share').value = 0.7, $('share').dispatchEvent(new Event('change'))")
    opened.drag((60, 60), (80, 70))
    opened.wait("nerfcliPage.done")
    fragment = opened.run("location.hash")
    place, turn = opened.run("nerfcliPage.walk.place"), opened.run("nerfcliPage.walk.turn")
    opened.open(spheres_page, fragment)
    np.testing.assert_allclose(opened.run("nerfcliPage.walk.place"), place, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(opened.run("nerfcliPage.walk.turn"), turn, atol=1e-5)
    assert opened.run("[$('map').value, $('share').value, state.share]") == ["quantile", "0.7", 0.7]


def test_a_photo_is_stood_at_wiped_over_and_subtracted(opened):
    opened.key("]")
    opened.wait("nerfcliPage.done")
    photo = opened.run("nerfcliPage.scene.photos[0]")
    assert opened.run("nerfcliPage.walk.place") == photo["place"]
    assert not opened.run("document.getElementById('wipe').hidden")
    box = opened.run("document.getElementById('photo').getBoundingClientRect().toJSON()")
    assert box["width"] / box["height"] == pytest.approx(photo["width"] / photo["height"], rel=1e-3)
    middle = (box["left"] + box["width"] / 2, box["top"] + box["height"] / 2)
    opened.drag(middle, (middle[0] - box["width"] / 4, middle[1]))
    assert opened.run("document.getElementById('wipe').getAttribute('aria-valuenow')") == "25"
    assert "0px 75." in opened.run("document.getElementById('photo').style.clipPath")
    opened.run("$('compare').value = 'error', $('compare').dispatchEvent(new Event('change'))")
    opened.wait("/ dB at/.test(document.getElementById('status').textContent)")
    decibels = float(re.findall(r"([\d.]+) dB", opened.run("document.getElementById('status').textContent"))[0])
    assert decibels > 15  # the training of the fixture is short; a misplaced picture has about 8
    opened.key("w", seconds=0.1)
    assert opened.run("document.getElementById('photo-name').textContent") == "none"


def test_measuring_gives_the_distance_between_depths(opened):
    opened.key("m")
    width, height = opened.run("(s => [s.clientWidth, s.clientHeight])(document.getElementById('stage'))")
    points = []
    for x in (0.5 * width, 0.5 * width + 3):
        opened.click(x, 0.5 * height)
        points = opened.run("state.points.map(p => p.middle)")
    assert len(points) == 2, opened.run("document.getElementById('distance').textContent")
    words = opened.run("document.getElementById('distance').textContent")
    apart, low, high = (float(number) for number in re.findall(r"[\d.]+(?:e-?\d+)?", words)[:3])
    assert apart == pytest.approx(np.linalg.norm(np.subtract(*points)), rel=1e-3)
    assert low <= apart <= high
    opened.key("m")


def test_the_crop_box_gives_the_command_and_crops_the_view(opened):
    opened.key("b")
    command = opened.run("document.getElementById('command').textContent")
    assert re.fullmatch(r"nerfcli export page-run-\d+ --to mesh --box=(-?[\d.e-]+,){5}-?[\d.e-]+", command)
    before = opened.run("nerfcliPage.probe.colour.filter((_, i) => i % 4 === 3).reduce((a, b) => a + b)")
    opened.run(
        "(() => { const i = document.getElementById('numbers').children[3], b = state.box; i.value = b[0] + 1e-3;"
        " i.dispatchEvent(new Event('change')); document.getElementById('clip').click(); })()"
    )
    opened.wait("nerfcliPage.done")
    after = opened.run("nerfcliPage.probe.colour.filter((_, i) => i % 4 === 3).reduce((a, b) => a + b)")
    assert after < 0.2 * before
    opened.run("document.getElementById('clip').click()")


def test_the_path_is_a_camera_path_that_render_reads(opened, tmp_path):
    opened.key("p")
    first = opened.run("[nerfcliPage.walk.place, nerfcliPage.walk.turn, nerfcliPage.walk.fov]")
    opened.key("]")
    opened.key("p")
    text = opened.run("JSON.stringify(cameraPath(state.keyframes, {seconds: 1, fps: 10, width: 64, height: 48}))")
    (tmp_path / "camera_path.json").write_text(text)
    path = read_path(tmp_path / "camera_path.json")
    assert path.fps == 10
    assert len(path.frames) == 11
    np.testing.assert_allclose(path.frames[0].world_from_cam[:3, 3], first[0], atol=1e-9)
    np.testing.assert_allclose(path.frames[0].world_from_cam[:3, :3], first[1], atol=1e-6)
    assert path.frames[0].camera.focal_px == pytest.approx(24 / np.tan(first[2] / 2))
    again = opened.run(f"keyframesOf({json.dumps(text)}).map(k => k.place)")
    np.testing.assert_allclose(again, opened.run("state.keyframes.map(k => k.place)"), atol=1e-9)
    opened.key(" ")
    assert opened.run("state.playing")
    opened.key(" ")


def test_a_lost_context_is_reported_and_restored(opened):
    count = int(opened.run("document.body.dataset.rested"))
    opened.run("(globalThis.lose = nerfcliPage.renderer.gl.getExtension('WEBGL_lose_context')).loseContext()")
    opened.wait("!document.getElementById('trouble').hidden")
    assert "graphics context" in opened.run("document.getElementById('trouble').textContent")
    opened.run("globalThis.lose.restoreContext()")
    opened.wait("document.getElementById('trouble').hidden")
    opened.wait(f"document.body.dataset.rested > {count}")
    alpha = opened.run("nerfcliPage.probe.colour.filter((_, i) => i % 4 === 3).reduce((a, b) => Math.max(a, b))")
    assert alpha > 0.5


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: re.sub(r'(id="table"[^>]*>.{100})....', r"\1", text), "cannot be decompressed"),
        (lambda text: re.sub(r'(id="table"[^>]*>.{100})....', r"\1!!!!", text), "not base64"),
        (
            lambda text: re.sub(r'id="table"([^>]*>).*?<', rf'id="table"\1{COMPRESSED_NOTHING}<', text),
            "0 bytes, expected",
        ),
        (lambda text: text.replace('id="cuts"', 'id="cut"'), 'lacks "cuts"'),
        (lambda text: text.replace("globalThis.DecompressionStream", "globalThis.Absent"), "lacks DecompressionStream"),
        (lambda text: re.sub(r'(id="scene">)', r"\1{", text), "not JSON"),
    ],
    ids=["short", "letters", "empty", "missing", "old browser", "json"],
)
def test_a_damaged_page_says_so(damage, message, browser, spheres_page, tmp_path):
    page = tmp_path / "damaged.html"
    page.write_text(damage(spheres_page.read_text(encoding="utf-8")), encoding="utf-8")
    browser.open(page)
    browser.wait("document.body.dataset.state === 'trouble'")
    assert message in browser.run("document.getElementById('trouble').textContent")


@needs_browser
def test_a_browser_without_webgl2_is_reported(spheres_page, tmp_path):
    with Browser(tmp_path, flags=("--disable-3d-apis",)) as browser:
        browser.open(spheres_page)
        browser.wait("document.body.dataset.state === 'trouble'")
        assert "no WebGL2" in browser.run("document.getElementById('trouble').textContent")
