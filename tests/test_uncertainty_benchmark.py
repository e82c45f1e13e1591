"""benchmarks/uncertainty.py: visibility on spheres in closed form, and statistics against closed forms and loops."""

import csv
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import uncertainty
import uncertainty_kitchen as kitchen
import uncertainty_laplace as laplace
import uncertainty_statistics as statistics
import uncertainty_tomography as tomography
from depth import COLOUR_FOCAL_PX, DEPTH_FROM_COLOUR
from make_spheres import Ball, Box
from PIL import Image
from scipy import stats
from uncertainty_scenes import STRATA, Solids, looks, sees, stratum_of, true_pixels, withheld

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.render.model import Marching, Model


def ball(x: float, y: float, z: float, radius: float) -> Ball:
    return Ball((x, y, z), radius, (0.5, 0.5, 0.5), 1.0)


def camera_at(azimuth_deg: float, *, reach: float = 5.0, name: str = "") -> Frame:
    """A camera on the circle z = 0 about the origin that looks at it, 40 degrees wide."""
    a = math.radians(azimuth_deg)
    outward = np.array([math.cos(a), math.sin(a), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(-outward, (0, 0, 1)), (0, 0, -1), -outward], axis=1)
    pose[:3, 3] = reach * outward
    return Frame(name or f"{azimuth_deg:g}", Camera.pinhole(80, 80, 110.0), pose)


def test_a_camera_sees_the_cap_of_a_ball_that_closed_form_gives():
    """At an incidence i a point of the unit ball lies at angle a from the camera: sin(i - a) = sin(i) / reach."""
    truth, camera = Solids((ball(0, 0, 0, 1.0),)), camera_at(0.0)
    angles = np.radians(np.linspace(0, 180, 3601))
    points = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    seen = sees(truth, camera, points, points)
    steepest = math.radians(80.0)
    expected = steepest - math.asin(math.sin(steepest) / 5.0)
    assert np.degrees(angles[seen].max()) == pytest.approx(np.degrees(expected), abs=0.05)
    np.testing.assert_array_equal(seen, angles <= angles[seen].max())


def test_a_ball_in_front_hides_what_lies_in_its_shadow():
    """A ball of radius r at distance d hides the plane behind it, at D, in a disc of radius r D / sqrt(d^2 - r^2)."""
    wall = Box((-1.0, 0.0, 0.0), (0.5, 3.0, 3.0), (0.5, 0.5, 0.5), 1.0)
    truth = Solids((ball(2.0, 0, 0, 0.3), wall))
    y = np.linspace(-1.5, 1.5, 3001)
    points = np.stack([np.full_like(y, -0.5), y, 0 * y], axis=1)
    seen = sees(truth, camera_at(0.0), points, np.tile([1.0, 0, 0], (len(y), 1)))
    shadow = 0.3 * 5.5 / math.sqrt(3.0**2 - 0.3**2)
    np.testing.assert_array_equal(seen, np.abs(y) > shadow)


def test_strata_of_a_ball_are_those_of_the_angles_between_cameras():
    """Cameras at 0, 1, 40 and 80 degrees; the caps that they see reach 68.6 degrees to each side of them."""
    cap = 80.0 - math.degrees(math.asin(math.sin(math.radians(80.0)) / 5.0))
    cameras = [camera_at(azimuth) for azimuth in (0.0, 1.0, 40.0, 80.0)]
    truth = Solids((ball(0, 0, 0, 1.0),))
    at = np.array([20.0, 60.0, 68.9, 69.3, 100.0, 130.0, -60.0, -40.0, 180.0])
    points = np.stack([np.cos(np.radians(at)), np.sin(np.radians(at)), 0 * at], axis=1)
    seen = np.stack([sees(truth, camera, points, points) for camera in cameras], axis=1)
    np.testing.assert_array_equal(seen, np.abs(at[:, None] - [0.0, 1.0, 40.0, 80.0]) < cap)


def test_pixels_of_a_view_have_the_truth_along_their_rays():
    """A view from 20 degrees of the ball that cameras at 0 and 40 see: distance, number and angle in closed form."""
    truth, cameras = Solids((ball(0, 0, 0, 1.0),)), [camera_at(0.0), camera_at(40.0)]
    view = camera_at(20.0)
    found = true_pixels(truth, looks([view]), cameras)
    assert len(found.distance) == 64 * 64
    bearings, _ = looks([view])[0].camera.pixel_bearings()
    cosine = bearings[:, 2]
    inside = 25.0 * (1 - cosine**2) < 1.0
    np.testing.assert_array_equal(np.isfinite(found.distance), inside)
    expected = 5.0 * cosine[inside] - np.sqrt(1.0 - 25.0 * (1 - cosine[inside] ** 2))
    np.testing.assert_allclose(found.distance[inside], expected, atol=1e-9)
    nearest = np.nanargmin(np.where(inside, found.distance, np.nan))
    centres = np.array([camera.centre for camera in cameras])
    point = np.array([math.cos(math.radians(20)), math.sin(math.radians(20)), 0.0])
    one, other = (centres - point) / np.linalg.norm(centres - point, axis=1)[:, None]
    assert found.photos[nearest] == 2
    # The pixel next to the axis is half a pixel off it.
    assert found.parallax_deg[nearest] == pytest.approx(np.degrees(np.arccos(one @ other)), abs=0.05)
    assert (found.stratum[~inside] == -1).all()


def test_every_point_is_in_the_stratum_that_the_protocol_gives():
    cases = {
        (0, 0.0): "U0",
        (1, 0.0): "U1",
        (4, 1.9): "U1",
        (2, 2.0): "W",
        (5, 9.9): "W",
        (2, 50.0): "W",
        (3, 10.0): "D",
    }
    photos, angles = np.array(list(cases)).T
    found = stratum_of(photos.astype(int), angles, hit=np.ones(len(cases), bool))
    assert [STRATA[index] for index in found] == list(cases.values())
    assert (stratum_of(photos.astype(int), angles, hit=np.zeros(len(cases), bool)) == -1).all()


def test_a_third_of_an_even_ring_is_withheld_and_every_eighth_of_the_rest():
    frames = [camera_at(azimuth, name=f"{azimuth:03d}") for azimuth in range(0, 360, 10)]
    inside, controls = withheld(frames, sector=1)
    assert inside == [f"{azimuth:03d}" for azimuth in range(90, 210, 10)]
    assert controls == ["000", "080", "280"]


def test_sparsification_is_the_mean_of_what_is_left():
    error = np.random.default_rng(0).exponential(size=200)
    uncertainty = np.random.default_rng(1).random(200)
    curve = statistics.sparsification(error, uncertainty)
    kept = [error[np.argsort(uncertainty)[: max(1, int((1 - removed / 100) * 200 + 1e-9))]] for removed in range(100)]
    np.testing.assert_allclose(curve, [part.mean() for part in kept])


def test_areas_have_their_closed_forms():
    """The oracle has an AUSE of 0, a random order an AURG of 0; a constant uncertainty counts as a random order."""
    error = np.linspace(0, 1, 20_000) ** 2
    rng = np.random.default_rng(0)
    assert statistics.ause(error, error) == 0
    assert statistics.ause(error, np.exp(error)) == 0
    # For errors x^2, the smallest fraction f has the mean f^2 / 3; up to 99 % removed, a random order keeps 1 / 3.
    random = np.trapezoid(1 / 3 - (1 - statistics.RATIOS) ** 2 / 3, statistics.RATIOS)
    for values in (rng.random(len(error)), np.zeros(len(error))):
        assert statistics.ause(error, values) == pytest.approx(random, abs=0.01)
        assert statistics.aurg(error, values) == pytest.approx(0.0, abs=0.01)
    assert statistics.aurg(error, error) == pytest.approx(random, abs=1e-3)


def test_ause_of_views_is_the_mean_over_views_of_normalised_areas():
    """Two views with errors of different size and the uncertainty in the opposite order have the same area."""
    error = np.concatenate([np.linspace(0, 1, 5000), 100 * np.linspace(0, 1, 5000)])
    views = np.repeat([0, 1], 5000)
    # For errors from 0 to 1, the smallest fraction f has the mean f / 2, the largest 1 - f / 2.
    left = 1 - statistics.RATIOS
    expected = np.trapezoid((1 - left / 2) - left / 2, statistics.RATIOS) / (1 - left.min() / 2)
    assert statistics.ause_of_views(error, -error, views) == pytest.approx(expected, rel=1e-3)
    assert statistics.ause_of_views(error, error, views) == 0.0
    assert math.isnan(statistics.ause_of_views(error[:9], error[:9], views[:9]))


def test_intervals_widened_by_their_quantile_hold_their_level():
    rng = np.random.default_rng(0)
    members, true = rng.normal(size=(5, 5000)), 3 * rng.normal(size=5000)
    factor = np.quantile(statistics.in_reaches(members, true, level=0.9), 0.9)
    assert statistics.held_by_interval(members, true, level=0.9) < 0.7
    assert statistics.held_by_interval(members, true, level=0.9, widened=factor) == pytest.approx(0.9, abs=1e-3)


@pytest.mark.parametrize("members", [2, 5, 8])
def test_members_of_the_distribution_of_the_truth_hold_it_as_stated(members):
    """The positive control: truth and members are drawn from the same Gaussian, a different one per pixel."""
    rng, pixels = np.random.default_rng(members), 40_000
    middle, deviation = rng.normal(size=pixels), rng.exponential(size=pixels)
    drawn = middle + deviation * rng.normal(size=(members + 1, pixels))
    for level in statistics.LEVELS:
        assert statistics.held_by_interval(drawn[1:], drawn[0], level=level) == pytest.approx(level, abs=0.01)
    expected = members / (2 * members + 1)
    assert statistics.variance_fraction(drawn[1:], drawn[0]) == pytest.approx(expected, abs=0.02)
    # The truth is off by ten times the deviation of the members.
    assert statistics.held_by_interval(drawn[1:], drawn[0] + 10 * deviation, level=0.5) < 0.1
    assert statistics.variance_fraction(drawn[1:], drawn[0] + 10 * deviation) < 0.02


def test_the_loss_of_a_normal_is_its_log_likelihood():
    members, true = np.array([[1.0, 2.0], [3.0, 2.0]]), np.array([2.5, 2.0])
    spread = np.array([math.sqrt(2.0), statistics.NLL_FLOOR])
    expected = 0.5 * math.log(2 * math.pi) + np.log(spread) + 0.5 * ((true - 2.0) / spread) ** 2
    assert statistics.log_likelihood_loss(members, true) == pytest.approx(expected.mean())


def test_the_area_under_the_roc_counts_pairs():
    rng = np.random.default_rng(0)
    values, positive = rng.integers(0, 9, 160).astype(float), rng.random(160) < 0.5
    pairs = [(a > b) + 0.5 * (a == b) for a in values[positive] for b in values[~positive]]
    assert statistics.area_under_roc(values, positive) == pytest.approx(np.mean(pairs))
    assert math.isnan(statistics.area_under_roc(values, np.zeros(160, bool)))


def test_the_sign_flip_test_counts_all_flips():
    differences = np.array([-0.5, -0.2, 0.1, -0.4, -0.3])
    flips = [np.mean(differences * signs) for signs in itertools.product((1, -1), repeat=5)]
    expected = np.mean(np.array(flips) <= differences.mean() + 1e-12)
    assert statistics.sign_flip(differences) == pytest.approx(expected)
    assert statistics.sign_flip(-np.ones(12)) == pytest.approx(2.0**-12)


def test_p_values_are_adjusted_as_in_the_paper():
    """Holm 1979: the k-th smallest of n times n - k + 1, never falling, at most 1."""
    adjusted = statistics.holm({"a": 0.01, "b": 0.04, "c": 0.03, "d": 0.6})
    assert adjusted == pytest.approx({"a": 0.04, "c": 0.09, "b": 0.09, "d": 0.6})


def test_the_interval_of_a_mean_is_that_of_its_standard_error():
    values = np.random.default_rng(0).normal(3.0, 1.0, 400)
    mean, low, high = statistics.mean_with_interval(np.append(values, np.nan))
    assert mean == pytest.approx(values.mean())
    assert (high - low) / 2 == pytest.approx(stats.norm.ppf(0.975) * values.std() / 20, rel=0.05)


GOOD = statistics.Summary(
    held=0.9,
    v_unseen=0.4,
    v_seen=0.45,
    correlation=(0.5, 0.3, 0.6),
    marks=0.95,
    p_of_ause=0.01,
    ause_difference=-0.1,
)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "YES"),
        ({"held": 0.75, "v_unseen": 0.25}, "LABEL ONLY"),
        ({"correlation": (0.05, -0.1, 0.2)}, "LABEL ONLY"),
        ({"correlation": (0.05, -0.1, 0.2), "held": 0.3, "v_unseen": 0.05}, "LABEL ONLY"),
        ({"marks": 0.7, "v_unseen": 0.05}, "NO"),
        ({"marks": 0.7, "held": 0.4}, "NO"),
        ({"marks": 0.7, "ause_difference": 0.1}, "NO"),
        ({"marks": 0.7, "held": 0.7}, "undecided"),
        ({"p_of_ause": 0.2}, "undecided"),
    ],
)
def test_verdicts_follow_the_rules_of_the_protocol(changes, expected):
    assert statistics.verdict(statistics.Summary(**{**vars(GOOD), **changes})) == expected


def test_uncertainty_of_another_replicate_predicts_nothing():
    """The negative control: AUSE of a random order."""
    rng = np.random.default_rng(0)
    errors = [rng.exponential(size=20_000), rng.exponential(size=15_000)]
    other = statistics.permuted(errors, 0)
    assert len(other) == 20_000
    assert abs(statistics.aurg(errors[0], other)) < 0.03


def test_lines_of_the_tomography_have_the_integrals_of_a_gaussian():
    """Of exp(-r^2 / (2 l^2)) at a distance t from its centre: sqrt(2 pi) l exp(-t^2 / (2 l^2))."""
    angles, side = np.array([0.0, 30.0, 90.0, 135.0]), tomography.SIDE
    matrix = tomography.Geometry("", angles, 0.6).matrix()
    at = (np.arange(side) + 0.5) / side * 2 - 1
    length, x0, y0 = 0.2, 0.1, -0.15
    image = np.exp(-((at - x0) ** 2 + (at[:, None] - y0) ** 2) / (2 * length**2)).ravel()
    lines = at[np.abs(at) < 0.6]
    turned = np.radians(angles)[:, None]
    t = lines - (x0 * np.cos(turned) + y0 * np.sin(turned))
    expected = math.sqrt(2 * math.pi) * length * np.exp(-(t**2) / (2 * length**2))
    np.testing.assert_allclose(matrix @ image, expected.ravel(), atol=0.01)


def test_least_squares_keep_the_start_where_the_matrix_sees_nothing():
    """A matrix that sees the first two of three unknowns: the null space is the third one."""
    inverse = tomography.Inverse.of(np.array([[2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 1.0, 0.0]]))
    np.testing.assert_allclose(inverse.null, [0, 0, 1], atol=1e-12)
    start, data = np.array([5.0, 6.0, 7.0]), np.array([2.0, 3.0, 5.0])
    matrix = np.array([[2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 1.0, 0.0]])
    np.testing.assert_allclose(start + inverse.back @ (data - matrix @ start), [1, 3, 7])


def test_a_point_is_seen_up_to_two_millimetres_behind_the_surface():
    truth, camera = Solids((Box((-1.0, 0.0, 0.0), (1.0, 3.0, 3.0), (0.5, 0.5, 0.5), 1.0),)), camera_at(0.0)
    depths = np.array([-0.003, -0.001, 0.0, 0.001, 0.0019, 0.0021, 0.003])
    points = np.stack([-depths, 0 * depths, 0 * depths], axis=1)
    seen = sees(truth, camera, points, np.tile([1.0, 0, 0], (len(depths), 1)))
    np.testing.assert_array_equal(seen, np.abs(depths) < 0.002)


def write_replicate(folder: Path, *, seed: int, bias: float) -> None:
    """Write the files of `train` for four views: members and truth are draws of one Gaussian, offset by `bias`.

    U0, where the Gaussian is ten times as wide, has as many pixels as D; a fifth of all pixels has no surface.
    """
    rng, pixels = np.random.default_rng(seed), 4 * uncertainty.PIXELS_PER_VIEW
    unseen = rng.random(pixels) < 0.5
    deviation = np.where(unseen, 0.1, 0.01) * 4.0 ** rng.uniform(-1.0, 1.0, pixels)
    middle = 5.0 + rng.random(pixels)
    true = middle + deviation * rng.normal(size=pixels)
    true[rng.random(pixels) < 0.2] = np.inf
    fields = middle + bias + deviation * rng.normal(size=(1 + uncertainty.MEMBERS, pixels))
    folder.mkdir(parents=True)
    photos = np.where(unseen, 0, 5)
    np.savez(folder / "truth.npz", distance=true, photos=photos, parallax_deg=np.where(unseen, 0.0, 40.0))
    maps = {name: rng.random(pixels) for name in ("coverage", "parallax", "gradient", "opacity")}
    np.savez(folder / "maps.npz", allow_pickle=False, **maps)
    np.savez(folder / "deployed.npz", distances=fields[:1])
    np.savez(folder / "seeds.npz", distances=fields[1:])


@pytest.mark.parametrize(("bias", "verdict"), [(0.0, "YES"), (1.0, "LABEL ONLY")])
def test_ensembles_of_known_quality_get_their_verdicts(tmp_path, monkeypatch, bias, verdict):
    """The positive control through all files: YES for draws of the truth's Gaussian, but not if they share an error."""
    monkeypatch.setattr(uncertainty, "PIXELS_PER_VIEW", 1024)
    for seed, one in enumerate(uncertainty.replicates()):
        write_replicate(tmp_path / one.name, seed=seed, bias=bias)
    uncertainty.judge(tmp_path)
    found = json.loads((tmp_path / "summary.json").read_text())["seeds"]
    assert found["verdict"] == verdict
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["replicate"] for row in rows] == [one.name for one in uncertainty.replicates()]
    assert len(rows) == 12
    if not bias:
        assert found["held"] == pytest.approx(0.9, abs=0.01)
        assert found["v_unseen"] == pytest.approx(5 / 11, abs=0.03)
        assert found["p_of_ause"] == pytest.approx(2.0**-12)
    # Random maps know nothing of the errors, nor does another replicate.
    for row in rows:
        for name in ("random", "coverage", "another replicate"):
            assert abs(float(row[f"AURG {name}"])) < 0.1 * float(row["mean error"])
    assert (tmp_path / "uncertainty.png").stat().st_size > 10_000


def small_model() -> Model:
    """A hash field with random rows, which is opaque in places."""
    torch.manual_seed(0)
    field = HashField(HashFieldSettings(contraction="l2", levels=2, log2_rows=8, coarsest=3, finest=6, width=8))
    with torch.no_grad():
        field.table.normal_(std=0.5)
    march = Marching(near=0.1, far=6.0, shortest_step=0.1, growth=0.0)
    return Model(
        field, torch.ones(4, 4, 4, dtype=torch.bool), march, (0.2, 0.4, 0.6), Similarity.identity(), "arbitrary"
    )


def test_squared_jacobians_are_those_of_a_grid_of_offsets():
    """Against autograd with respect to all vertices of a grid of 3^3 cells that is interpolated by SciPy's weights."""
    side, model = 3, small_model()
    origins = torch.tensor([[-1.5, 0.1, 0.2], [0.3, -1.4, 0.0], [0.2, 0.1, 1.6]])
    directions = torch.nn.functional.normalize(-origins + 0.1, dim=1)
    grid, samples = laplace.marched(model, origins, directions)
    vertices = np.indices((side + 1,) * 3).reshape(3, -1).T / side  # z, y, x
    places = samples.coordinates.flip(1).double().numpy()
    weights = np.maximum(0, 1 - side * np.abs(places[:, None] - vertices)).prod(axis=2)  # (N, vertices)

    def colours(theta: torch.Tensor) -> torch.Tensor:
        offsets = (torch.from_numpy(weights) @ theta).float()
        return laplace.colours(model, origins, directions, samples, grid, offsets).double()

    jacobian = torch.autograd.functional.jacobian(colours, torch.zeros((len(vertices), 3), dtype=torch.float64))
    expected = jacobian.square().sum(dim=(0, 1, 3))
    found = laplace.squared_jacobians(model, origins, directions, side)
    assert float(expected.max()) > 1e-4
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-6 * float(expected.max()))


def test_what_no_ray_meets_has_the_deviation_of_the_prior():
    """The variance is the inverse of lambda, and less where the colour of rays depends on the grid."""
    side, model = 3, small_model()
    prior = laplace.PRIOR / side**3
    variance = torch.full(((side + 1) ** 3,), 1.0 / prior, dtype=torch.float64)
    origins, directions = torch.tensor([[-1.5, 0.1, 0.2]]), torch.tensor([[1.0, 0.0, 0.0]])
    _, samples = laplace.marched(model, origins, directions)
    opacity = 1 - float(torch.exp(-(samples.density * (samples.ends - samples.starts)).sum()))
    expected = opacity * -0.5 * math.log10(prior) + (1 - opacity) * laplace.LEAST
    assert float(laplace.logarithms(model, origins, directions, variance, side)) == pytest.approx(expected, rel=1e-4)
    seen = laplace.squared_jacobians(model, origins, directions, side)
    expected_deviations = 1.0 / (seen + prior)
    assert float(laplace.logarithms(model, origins, directions, expected_deviations, side)) < expected


def test_predictors_are_combined_as_in_the_other_scenes():
    """Errors that fall with a sum of two predictors' ranks are ranked by a combination learned on another scene."""
    rng, scenes = np.random.default_rng(0), [uncertainty.Replicate(name, 0) for name in ("spheres", "desk")]
    every = []
    for _ in scenes:
        one, other, count = rng.random(4000), rng.random(4000), 4000
        pixels = uncertainty.Pixels(
            members=np.zeros((2, count)),
            true=np.ones(count),
            error=np.exp(3 * one + other),
            stratum=np.zeros(count, int),
            views=np.zeros(count, int),
            uncertainty={"one": one, "other": other**3},
            abstained={},
        )
        every.append(pixels)
    found = uncertainty.combined(scenes[0], every[0], scenes, every, ("one", "other"))
    worst = statistics.ause(every[0].error, every[0].uncertainty["one"])
    assert statistics.ause(every[0].error, found) < 0.05 * worst


def test_a_depth_camera_sees_the_points_at_its_depth(tmp_path):
    """A wall 2 m in front of the depth camera, with a hole; the colour camera is beside it."""
    (tmp_path / "depth").mkdir()
    depth = np.full((480, 640), 2000, np.uint16)
    depth[:, 320:] = 0
    Image.fromarray(depth).save(tmp_path / "depth" / "frame.png")
    np.savetxt(tmp_path / "camera-intrinsics.txt", np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]]))
    photo = Frame("frame.jpg", Camera.pinhole(640, 480, COLOUR_FOCAL_PX), DEPTH_FROM_COLOUR)
    points = np.array([[-0.1, 0, 2.0], [-0.1, 0, 2.04], [-0.1, 0, 2.06], [0.1, 0, 2.0], [-0.1, 0, -2.0], [-5, 0, 2.0]])
    seen = kitchen.sensor_sees(photo, points, tmp_path)
    assert seen.tolist() == [True, True, False, False, False, False]
