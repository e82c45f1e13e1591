"""Matches against poses, in closed form and on known cameras: distances from epipolar lines, parallax, sides."""

import numpy as np
import pytest

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.matching.agreement import Agreement, agreement, rays_of

RIGHT = rigid.from_parts(np.eye(3), np.array([-1.0, 0.0, 0.0]))  # the second camera is to the right of the first
LENSES = {
    "pinhole": Camera.pinhole(600, 450, 550.0),
    "distorted": Camera("OPENCV", 600, 450, (550.0, 545.0, 290.0, 230.0, -0.12, 0.03, 1e-3, -1e-3)),
    "fisheye": Camera("OPENCV_FISHEYE", 600, 450, (300.0, 300.0, 300.0, 225.0, 0.02, -0.01, 0.0, 0.0)),
    "panorama": Camera("EQUIRECTANGULAR", 600, 300, (600.0, 300.0)),
}


def unit(*rays: tuple[float, float, float]) -> np.ndarray:
    return np.array(rays) / np.linalg.norm(rays, axis=1, keepdims=True)


def relative_pose(seed: int) -> np.ndarray:
    twist = np.random.default_rng(seed).normal(size=6) * (0.5, 0.5, 0.5, 0.2, 0.2, 0.2)
    return rigid.transform_from_twist(twist)


def seen_by_both(camera: Camera, cam1_from_cam0: np.ndarray) -> list[np.ndarray]:
    """Return the pixels (N, 2) in two photos of points in front of both."""
    points = np.random.default_rng(1).uniform((-2, -2, 3), (2, 2, 8), (200, 3))
    found = [camera.project(local) for local in (points, rigid.apply(cam1_from_cam0, points))]
    both = found[0][1] & found[1][1] & camera.contains(found[0][0]) & camera.contains(found[1][0])
    assert both.sum() > 50
    return [pixels[both] for pixels, _ in found]


def compared(camera: Camera, pixels: list[np.ndarray], pose: np.ndarray) -> Agreement:
    first, second = (rays_of([camera], np.zeros(len(places), dtype=np.int64), places) for places in pixels)
    return agreement(first, second, pose, focal_px=camera.focal_px)


def test_a_ray_lifted_off_the_epipolar_plane_in_closed_form():
    """The second ray is lifted by the angle a: sin a from the line in its photo, more in the first, where the other ray
    has a shorter product with the baseline, and by Pythagoras in both together."""
    a, x = 1e-3, 0.2
    second = np.array([[-x, -np.sin(a), np.sqrt(1 - x**2 - np.sin(a) ** 2)]])
    found = agreement(unit((0, 0, 1)), second, RIGHT, focal_px=500.0)
    lift = 500.0 * np.sin(a)
    np.testing.assert_allclose(np.abs(found.sampson_px), lift / np.sqrt(2 - x**2), rtol=1e-12)
    np.testing.assert_allclose(np.abs(found.line_px), lift / np.sqrt(1 - x**2), rtol=1e-12)
    lowered = agreement(unit((0, 0, 1)), second * (1, -1, 1), RIGHT, focal_px=500.0)
    np.testing.assert_array_equal(lowered.sampson_px, -found.sampson_px)
    np.testing.assert_array_equal(lowered.line_px, -found.line_px)


@pytest.mark.parametrize("lens", LENSES)
def test_a_point_moved_by_d_pixels_across_its_line_is_off_by_d(lens: str):
    """Exact matches fit to the rounding. The line's direction in the photo: by moving the other point's depth.

    The first point may be off by more, as many times as its ray is farther from the epipole.
    """
    camera, pose = LENSES[lens], relative_pose(0)
    pixels = seen_by_both(camera, pose)
    found = compared(camera, pixels, pose)
    np.testing.assert_allclose(found.line_px, 0, atol=1e-9)
    assert not found.behind.any()
    assert found.count == len(pixels[0])
    rays = rays_of([camera], np.zeros(len(pixels[0]), dtype=np.int64), pixels[0])
    ahead = [camera.project(rigid.apply(pose, rays * depth))[0] for depth in (5.0, 5.001)]
    along = ahead[1] - ahead[0]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    # In the middle of the picture, where a radian has `focal_px` pixels for every lens.
    near = np.linalg.norm(ahead[0] - np.array(camera.size) / 2, axis=1) < 0.12 * camera.focal_px
    assert near.sum() > 3
    moved = compared(camera, [pixels[0], ahead[0] + 2.0 * across], pose)
    towards = pose[:3, 3] / np.linalg.norm(pose[:3, 3])
    other = rays_of([camera], np.zeros(len(pixels[0]), dtype=np.int64), ahead[0])
    cosines = rays @ pose[:3, :3].T @ towards, other @ towards
    times = np.sqrt((1 - cosines[0] ** 2) / (1 - cosines[1] ** 2))
    np.testing.assert_allclose(np.abs(moved.line_px[near]), 2.0 * np.maximum(times, 1.0)[near], rtol=0.03)
    np.testing.assert_allclose(np.abs(moved.sampson_px[near]), 2.0 / np.hypot(1.0, 1.0 / times)[near], rtol=0.03)


@pytest.mark.parametrize("t", [(1.0, 0.0, 0.0), (0.1, 0.0, 1.0)], ids=["sideways", "forward"])
def test_noise_has_its_standard_deviation_in_sampsons_distance(t: tuple[float, float, float]):
    """Of all four coordinates, also where the two points are at different distances from the epipole."""
    camera, pose = Camera.pinhole(600, 450, 2000.0), rigid.from_parts(np.eye(3), np.array(t))
    rng = np.random.default_rng(2)
    points = rng.uniform((-0.4, -0.3, 3), (0.4, 0.3, 8), (20_000, 3))
    seen = [camera.project(rigid.apply(one, points))[0] for one in (np.eye(4), pose)]
    pixels = [places + rng.normal(0, 0.7, (20_000, 2)) for places in seen]
    assert compared(camera, pixels, pose).sampson_px.std() == pytest.approx(0.7, rel=0.03)


def test_the_parallax_of_known_triangles():
    """Isosceles right, equilateral, and rays of a point 10^8 baselines away, of which no digit is lost."""
    root = np.sqrt(3.0)
    first, second = unit((0, 0, 1), (0.5, 0, root / 2), (0, 0, 1)), unit((-1, 0, 1), (-0.5, 0, root / 2), (-1e-8, 0, 1))
    found = agreement(first, second, RIGHT, focal_px=100.0)
    np.testing.assert_allclose(found.parallax, [np.pi / 4, np.pi / 3, 1e-8], rtol=1e-14)
    np.testing.assert_allclose(found.parallax_px, 100.0 * found.parallax)


@pytest.mark.parametrize(("first_ahead", "second_ahead"), [(True, True), (True, False), (False, True), (False, False)])
def test_points_behind_either_camera_are_behind(first_ahead: bool, second_ahead: bool):
    """The point at the given signed distances along the two rays, from a camera at t in the second one's axes."""
    t = np.array([0.4, -0.1, 0.2])
    first = unit((0.1, 0.2, 0.97))
    point = (3.0 if first_ahead else -3.0) * first + t
    second = point / np.linalg.norm(point) * (1 if second_ahead else -1)
    found = agreement(first, second, rigid.from_parts(np.eye(3), t), focal_px=1.0)
    np.testing.assert_allclose(found.sampson_px, 0, atol=1e-15)
    assert found.behind.tolist() == [not (first_ahead and second_ahead)]


def test_the_order_of_the_photos_and_the_unit_of_length_do_not_matter():
    rng = np.random.default_rng(3)
    first, second = (unit(*rng.normal(size=(50, 3))) for _ in range(2))
    pose = relative_pose(4)
    found = agreement(first, second, pose, focal_px=300.0)
    swapped = agreement(second, first, rigid.inverse(pose), focal_px=300.0)
    np.testing.assert_allclose(np.abs(swapped.line_px), np.abs(found.line_px), rtol=1e-9)
    np.testing.assert_allclose(np.abs(swapped.sampson_px), np.abs(found.sampson_px), rtol=1e-9)
    np.testing.assert_array_equal(swapped.behind, found.behind)
    for unit_of_length in (1e-8, 1e8):
        scaled = pose.copy()
        scaled[:3, 3] *= unit_of_length
        other = agreement(first, second, scaled, focal_px=300.0)
        np.testing.assert_allclose(other.line_px, found.line_px, rtol=1e-9)
        np.testing.assert_array_equal(other.behind, found.behind)


def test_a_pose_and_a_focal_length_for_each_match_are_those_of_a_loop():
    rng = np.random.default_rng(5)
    first, second = (unit(*rng.normal(size=(4, 3))) for _ in range(2))
    poses, focals_px = np.stack([relative_pose(seed) for seed in range(4)]), rng.uniform(100, 900, 4)
    found = agreement(first, second, poses, focal_px=focals_px)
    for i in range(4):
        alone = agreement(first[i : i + 1], second[i : i + 1], poses[i], focal_px=focals_px[i])
        np.testing.assert_allclose(found.line_px[i], alone.line_px[0], rtol=1e-12)
        np.testing.assert_allclose(found.sampson_px[i], alone.sampson_px[0], rtol=1e-12)
        assert found.behind[i] == alone.behind[0]


def test_degenerate_matches():
    """Without a baseline the rays themselves are compared; a ray along it fits; without a ray nothing is known."""
    first, second = unit((0, 0, 1), (0, 0, 1)), unit((0, 0, 1), (0, np.tan(0.01), 1))
    still = agreement(first, second, np.eye(4), focal_px=100.0)
    for distances in (still.sampson_px, still.line_px):
        np.testing.assert_allclose(distances, [0.0, 1.0], atol=1e-12)
    ahead = rigid.from_parts(np.eye(3), np.array([0.0, 0.0, -1.0]))
    along = agreement(first, unit((0, 0, 1), (0, 0, -1)), ahead, focal_px=100.0)
    np.testing.assert_array_equal(along.line_px, 0)
    np.testing.assert_array_equal(along.sampson_px, 0)
    unknown = agreement(np.array([[np.nan] * 3, [0, 0, 1]]), second, RIGHT, focal_px=100.0)
    assert unknown.count == 1
    assert not unknown.behind[0]
    for values in (unknown.sampson_px, unknown.line_px, unknown.parallax, unknown.parallax_px):
        assert np.isnan(values).tolist() == [True, False]
    nothing = agreement(np.zeros((0, 3)), np.zeros((0, 3)), RIGHT, focal_px=100.0)
    assert (nothing.count, nothing.line_px.shape, nothing.behind.shape) == (0, (0,), (0,))


def test_rays_of_several_cameras_are_those_of_each_and_nan_beyond_the_lens():
    cameras = [LENSES["pinhole"], LENSES["fisheye"], LENSES["pinhole"]]
    photos = np.array([2, 1, 0, 1])
    pixels = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0], [1e6, 0.0]])
    found = rays_of(cameras, photos, pixels)
    for i in range(3):
        np.testing.assert_array_equal(found[i], cameras[photos[i]].bearings(pixels[i : i + 1])[0][0])
    assert np.isnan(found[3]).all()
    assert rays_of([], np.zeros(0, dtype=np.int64), np.zeros((0, 2))).shape == (0, 3)
