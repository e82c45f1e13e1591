"""Which photos see a surface: against closed forms, and as renders and exports write it."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from commands import completed, error_of, nerfcli
from fog import CUBE, fog
from present import present

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.captures.formats.run_cameras import RunCameras
from nerfcli.notices import Reporter
from nerfcli.photos.images import write_png
from nerfcli.ply import read_ply_header
from nerfcli.render.coverage import DepthMap, coverage_and_parallax, depth_maps, largest_angle_deg, sees, without_steep
from nerfcli.render.files.file_facts import depth_meta_of
from nerfcli.training.runs.files import PHOTO_DEPTHS, left_out_mask
from nerfcli.training.runs.run import Run
from nerfcli.workflows.photo_depths import photo_depths

# Two balls beside each other: each hides a part of the other from most sides.
CENTRES, RADII = np.array([[0.0, 0.0, 0.0], [0.9, 0.2, 0.1]]), np.array([0.5, 0.3])
LENS = Camera("OPENCV", 160, 120, (150.0, 148.0, 83.0, 58.0, -0.1, 0.02, 0.001, -0.002))


def distance_to_balls(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the distance to the first hit of unit rays (N, 3), NaN where there is none."""
    nearest = np.full(len(directions), np.inf)
    for centre, radius in zip(CENTRES, RADII, strict=True):
        off = origins - centre
        b = (directions * off).sum(1)
        inside = b * b - (off * off).sum(1) + radius**2
        hit = -b - np.sqrt(np.maximum(inside, 0))
        nearest = np.where((inside > 0) & (hit > 0), np.minimum(nearest, hit), nearest)
    return np.where(np.isfinite(nearest), nearest, np.nan)


def ball_map(place: np.ndarray, target: np.ndarray) -> DepthMap:
    """Return the depth map of the balls seen by a camera with a distorting lens."""
    frame = Frame("a", LENS, look_at(place, target, np.array([0.1, 0.2, 1.0])))
    rays, _ = LENS.pixel_bearings()
    distances = distance_to_balls(np.broadcast_to(place, rays.shape), rays @ frame.world_from_cam[:3, :3].T)
    return without_steep(DepthMap(frame, distances.reshape(120, 160).astype(np.float32)))


@pytest.fixture(scope="module")
def ball_maps() -> list[DepthMap]:
    """Nine cameras on one side of the balls; two of them look past one of them."""
    angles = np.radians(np.linspace(-70, 70, 9))
    places = 2.2 * np.stack([np.cos(angles), np.sin(angles), 0.2 + 0.3 * np.cos(3 * angles)], axis=-1)
    targets = np.array([[0.3, 0.0, 0.0]] * 7 + [[0.3, 1.2, 0.0], [-0.2, -1.0, 0.3]])
    return [ball_map(place, target) for place, target in zip(places, targets, strict=True)]


def surface_points(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on both balls and their normals."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ball = rng.integers(0, 2, count)
    return CENTRES[ball] + RADII[ball, None] * normals, normals


def truly_seen(view: DepthMap, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which points are seen in closed form, and for which of them this is clear.

    Seen: in the picture, nothing in front, incidence below 80 degrees. Not clear: within three pixels of a border
    between seen and unseen, or on the rim of a ball, at an incidence from 68 to 96 degrees.
    """
    place = view.frame.centre
    reach = 3 * np.linalg.norm(points - place, axis=1, keepdims=True) / LENS.focal_px
    aside = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    other = np.cross(normals, aside)
    answers = []
    for a, b in [(0, 0), *((np.cos(t), np.sin(t)) for t in np.linspace(0, 2 * np.pi, 8, endpoint=False))]:
        moved = points + reach * (a * aside + b * other)
        rays = moved - place
        distance = np.linalg.norm(rays, axis=1)
        first = distance_to_balls(np.broadcast_to(place, rays.shape), rays / distance[:, None])
        pixels, valid = LENS.project((moved - place) @ view.frame.world_from_cam[:3, :3])
        inside = valid & (pixels >= 0).all(1) & (pixels <= (LENS.width, LENS.height)).all(1)
        facing = -(rays * normals).sum(1) / distance
        hidden = first < distance - 0.2  # by the other ball, not by the bulge of its own
        answers.append(inside & ~hidden & (facing > np.cos(np.radians(80))))
    clear = np.all(np.array(answers) == answers[0], axis=0)
    steepness = np.degrees(np.arccos(-((points - place) * normals).sum(1) / np.linalg.norm(points - place, axis=1)))
    return answers[0], clear & (np.abs(steepness - 82) > 14)


def test_points_of_two_balls_are_seen_as_closed_forms_say(ball_maps):
    points, normals = surface_points(4000)
    for view in ball_maps:
        expected, clear = truly_seen(view, points, normals)
        found = sees(view, points)
        assert clear.mean() > 0.6
        assert 0.02 < expected[clear].mean() < 0.6
        np.testing.assert_array_equal(found[clear], expected[clear])


def test_coverage_and_parallax_are_those_of_the_cameras_that_see(ball_maps):
    points, normals = surface_points(1500)
    truth = [truly_seen(view, points, normals) for view in ball_maps]
    seen, clear = np.stack([a for a, _ in truth], 1), np.all([b for _, b in truth], axis=0)
    coverage, parallax = coverage_and_parallax(ball_maps, points)
    assert {0, 1, 2, 3, 6} <= set(coverage[clear].tolist())
    np.testing.assert_array_equal(coverage[clear], seen.sum(1)[clear])
    for index in np.flatnonzero(clear):
        rays = [view.frame.centre - points[index] for view, there in zip(ball_maps, seen[index], strict=True) if there]
        rays = [ray / np.linalg.norm(ray) for ray in rays]
        angles = [np.degrees(np.arccos(np.clip(a @ b, -1, 1))) for a in rays for b in rays]
        assert parallax[index] == pytest.approx(max(angles, default=0.0), abs=0.05)


def test_a_point_that_is_undefined_has_no_coverage(ball_maps):
    points, _ = surface_points(3)
    points[1, 2] = np.nan
    for values in coverage_and_parallax(ball_maps, points):
        assert values.dtype == np.float32
        assert np.isnan(values).tolist() == [False, True, False]


@pytest.mark.parametrize("angle", [0.5, 2.0, 60.0, 179.0])
def test_small_and_large_angles_keep_their_digits(angle):
    turned = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
    centres = np.stack([[1.0, 0, 0], 3 * turned, [0, 0, 5.0]]) + 100.0
    seen = np.array([[True, True, False], [True, False, False], [False, False, False]])
    found = largest_angle_deg(seen, np.full((3, 3), 100.0), centres)
    np.testing.assert_allclose(found, [angle, 0, 0], atol=0.03)


def test_the_largest_angle_is_between_any_two_cameras():
    """At -30, 0 and 50 degrees around the point, in every order."""
    angles = np.radians([-30.0, 0.0, 50.0])
    centres = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=-1)
    for order in ([0, 1, 2], [1, 0, 2], [1, 2, 0], [2, 1, 0]):
        found = largest_angle_deg(np.ones((1, 3), dtype=bool), np.zeros((1, 3)), centres[order])
        np.testing.assert_allclose(found, [80.0], atol=1e-3)


def test_angles_between_many_cameras_take_little_memory(monkeypatch):
    """All pairs of 300 photos at 4,096 points were 1.5 GB; the answer is that of a loop over the points."""
    product, largest, rng = torch.bmm, [], np.random.default_rng(0)

    def measured(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        found = product(one, other)
        largest.append(found.nbytes)
        return found

    monkeypatch.setattr(torch, "bmm", measured)
    centres, points = 3 * rng.normal(size=(300, 3)), rng.normal(size=(600, 3))
    found = largest_angle_deg(np.ones((600, 300), bool), points, centres)
    assert max(largest) <= 2**27
    rays = centres - points[:3, None]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    np.testing.assert_allclose(found[:3], [np.degrees(np.arccos((r @ r.T).min())) for r in rays], atol=0.05)


def plane_map(incidence_deg: float) -> DepthMap:
    """Return the depth map of a pinhole camera that sees only a plane, at distance 2 in the middle."""
    camera = Camera.pinhole(80, 60, 400.0)
    rays, _ = camera.pixel_bearings()
    tilt = np.radians(incidence_deg)
    normal = np.array([0.0, np.sin(tilt), -np.cos(tilt)])
    distances = 2 * normal[2] / (rays @ normal)
    return DepthMap(Frame("a", camera, np.eye(4)), distances.reshape(60, 80).astype(np.float32))


def test_surfaces_are_seen_up_to_an_incidence_of_80_degrees():
    for incidence, seen in ((0.0, True), (70.0, True), (75.0, True), (85.0, False)):
        assert np.isfinite(without_steep(plane_map(incidence)).distances[20:40]).all() == seen


def test_nothing_is_seen_beyond_the_edges_of_the_picture():
    """Points on a plane that fills the picture, half a pixel inside and outside of each edge."""
    view = plane_map(0.0)
    for pixel, seen in (
        *(((0.5, 30), True), ((-0.5, 30), False), ((79.5, 30), True), ((80.5, 30), False)),
        *(((40, 0.5), True), ((40, -0.5), False), ((40, 59.5), True), ((40, 60.5), False)),
    ):
        point = 2 * np.array([(pixel[0] - 40) / 400, (pixel[1] - 30) / 400, 1.0])
        assert sees(view, point[None]).tolist() == [seen], pixel


def test_depths_of_a_field_are_those_of_its_surface():
    """A cube of fog: half of the light ends ln 2 / density behind its face."""
    model = fog(CUBE, Similarity(0.5, np.eye(3), np.zeros(3)))
    pose = look_at(np.array([0.0, 0.0, -4.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    frame = Frame("a", Camera("SIMPLE_RADIAL", 400, 300, (300.0, 200.0, 150.0, -0.05)), pose)
    (view,) = depth_maps(model, [frame], max_size=40)
    assert view.distances.shape == (30, 40)
    assert view.frame.camera == frame.camera.resized(40, 30)
    assert view.distances[15, 20] == pytest.approx(3.0 + np.log(2) / 0.5, abs=0.02)
    assert np.isnan(view.distances[0, 0])


@pytest.fixture
def run(spheres_run, tmp_path, small_photo_depths) -> Path:
    """A copy of the run, to write into."""
    return shutil.copytree(spheres_run, tmp_path / "spheres-run")


def test_render_writes_coverage_and_parallax_and_removes_depth(run, tmp_path):
    common = ("render", run, "--max-size", "48", "--depth-axis", "ray", "--threads", "2")
    plain = nerfcli(*common, "--outputs", "depth", "-o", tmp_path / "plain")
    limited = nerfcli(
        *common, "--outputs", "depth,coverage,parallax", "--min-views", "4", "--min-parallax", "50",
        "--depth-format", "tiff,exr", "-o", tmp_path / "views",
    )  # fmt: skip
    assert (plain.exit_code, limited.exit_code) == (0, 0), limited.stderr
    before, after, coverage, parallax = (
        np.stack([tifffile.imread(path) for path in sorted((tmp_path / folder).rglob("*.tiff"))])
        for folder in ("plain/depth", "views/depth", "views/coverage", "views/parallax")
    )
    assert (coverage == np.round(coverage))[np.isfinite(coverage)].all()
    assert np.nanmax(coverage) > 8
    kept = (coverage >= 4) & (parallax >= 50)
    assert ((coverage >= 4) & ~kept).any()
    np.testing.assert_array_equal(after, np.where(kept, before, np.nan))
    removed = 100 * (np.isfinite(before) & ~kept).sum() / np.isfinite(before).sum()
    words = "a coverage below 4 photos or a parallax below 50 degrees"
    assert f"depth removed at {removed:.1f} % of the pixels that had one: {words}" in limited.stderr
    facts = json.loads((tmp_path / "views/render.json").read_text())["facts"]
    assert sum(of_view["pixels_with_depth"] for of_view in facts.values()) == np.isfinite(before).sum()
    # What the files say of themselves.
    files = [next((tmp_path / "views" / name).rglob("*.tiff")) for name in ("depth", "coverage", "parallax")]
    of_depth, of_coverage, of_parallax = (present(depth_meta_of(file)) for file in files)
    assert (of_depth.min_views, of_depth.min_parallax_deg) == (4, 50.0)
    assert (of_coverage.unit, of_parallax.unit, of_coverage.min_views) == ("photos", "degrees", 0)
    assert of_coverage.provenance["training_photos"] == 21
    text = nerfcli("info", files[2]).stdout
    assert "parallax, in degrees: the largest angle between the rays of two training photos" in text
    assert "min views: 4" in nerfcli("info", next((tmp_path / "views").rglob("*.exr"))).stdout
    again = nerfcli(*common, "--outputs", "depth,coverage,parallax", "-o", tmp_path / "views")
    assert "min_views 4, not 0" in error_of(again)[0]


def test_limits_need_depth(run):
    result = nerfcli("render", run, "--outputs", "coverage", "--min-parallax", "2")
    assert result.exit_code == 2
    assert re.search(r"add\s+depth\s+to\s+--outputs", result.stderr.replace("│", " "))


def test_depths_of_photos_are_kept_for_the_field_they_belong_to(run, monkeypatch):
    trained = Run(run)
    fractions: list[float] = []
    counting = Reporter(pytest.fail, progress=lambda fraction, detail: fractions.append(fraction))
    maps = photo_depths(trained, trained.model(), counting)
    assert fractions[-1] == 1.0
    kept = Reporter(pytest.fail, progress=lambda fraction, detail: pytest.fail("rendered"))
    again = photo_depths(trained, trained.model(), kept)
    for one, other in zip(maps, again, strict=True):
        np.testing.assert_array_equal(one.distances, other.distances)
        assert one.frame.camera == other.frame.camera
    # Another field, or a damaged file: rendered again.
    fractions.clear()
    photo_depths(trained, replace(trained.model(), sha256="ab"), counting)
    assert len(fractions) == 21
    content = (run / PHOTO_DEPTHS).read_bytes()
    (run / PHOTO_DEPTHS).write_bytes(content[: len(content) // 2])
    photo_depths(trained, trained.model(), counting)
    assert len(fractions) == 42


@pytest.mark.parametrize("by_training", [False, True], ids=["mask", "left out by the training"])
def test_a_photo_sees_nothing_where_its_mask_covers_it(run, tmp_path, by_training):
    """A photo with a masked left half sees no points there; the other photos see as many as before."""
    trained, masked = Run(run), Run(run)
    train = list(trained.cameras.train)
    first = train[0]
    mask = np.full((first.camera.height, first.camera.width), 255, np.uint8)
    mask[:, : first.camera.width // 2] = 0
    whole, *others = photo_depths(trained, trained.model(), Reporter(pytest.fail))
    if by_training:
        write_png(left_out_mask(run, first.name), mask)
    else:
        for name in ("photo.png", "mask.png"):
            write_png(tmp_path / name, mask)
        train[0] = replace(first, image=tmp_path / "photo.png", mask=tmp_path / "mask.png")
    masked.__dict__["cameras"] = RunCameras(tuple(train), trained.cameras.test)
    (run / PHOTO_DEPTHS).unlink()  # cached for the photos of the run, whose masks do not change
    part, *same = photo_depths(masked, masked.model(), Reporter(pytest.fail))
    half = whole.distances.shape[1] // 2
    assert np.isfinite(whole.distances[:, :half]).any()
    assert np.isnan(part.distances[:, :half]).all()
    np.testing.assert_array_equal(part.distances[:, half:], whole.distances[:, half:])
    for one, other in zip(others, same, strict=True):
        np.testing.assert_array_equal(one.distances, other.distances)
    points = whole.points()
    columns = np.argwhere(np.isfinite(whole.distances))[:, 1]
    before, after = (coverage_and_parallax(maps, points)[0] for maps in ((whole, *others), (part, *same)))
    # A pixel beside the border is seen by its neighbour across it.
    np.testing.assert_array_equal((before - after)[columns < half - 1], 1.0)
    np.testing.assert_array_equal((before - after)[columns > half], 0.0)


def test_a_mesh_says_how_many_photos_see_its_points(run, tmp_path):
    path = tmp_path / "a.ply"
    completed("export", run, "--to", "mesh", "--voxel-size", "0.1", "-o", path)
    header = read_ply_header(path)
    assert {"photos", "parallax_deg"} <= header.vertex_properties.keys()
    assert any("largest angle between the rays of two photos" in comment for comment in header.comments)
