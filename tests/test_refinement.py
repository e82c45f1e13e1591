"""Camera refinement: derivatives against differences, what the gauge must not change, and removal of a known noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from lenses import HEIGHT, MODELS, WIDTH, random_camera
from pools import pool_of_photos
from present import present
from trainings import FEW, fit, resumed_bit_for_bit

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.lens_change import bearings_by_change, changeable, changed
from nerfcli.cameras.rigid import (
    Similarity,
    apply,
    from_parts,
    inverse,
    look_at,
    rotation_from_vector,
    transform_from_twist,
    vector_from_rotation,
)
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.run_cameras import find_run, parse_run, read_cameras, read_given_cameras
from nerfcli.field.checkpoint import load_tensors
from nerfcli.photos.loading import load_photos
from nerfcli.training.extent import Extent
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.optimiser import BETAS, EPS, NewtonSteps, WhitenedAdam, mean_similarity, whitening, without_mean
from nerfcli.training.pool import PixelPool
from nerfcli.training.refinement import LENS_RATE, PoseRefinement, Refinement
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.files import STATE
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.schedule import CAMERAS_END, camera_plan
from nerfcli.workflows.describe import camera_moves

seeds = st.integers(0, 2**32 - 1)


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    centres, targets = (size * rng.normal(size=(count, 3)) for size in (3.0, 0.2))
    return np.array([look_at(*pair, np.array([0, 0, 1])) for pair in zip(centres, targets, strict=True)])


def turned(scene: Capture, degrees: float) -> Capture:
    """The scene with its training photos turned about random axes."""
    rng = np.random.default_rng(7)

    def turn(pose: np.ndarray) -> np.ndarray:
        axis = rng.normal(size=3)
        pose = pose.copy()
        pose[:3, :3] = pose[:3, :3] @ rotation_from_vector(np.radians(degrees) * axis / np.linalg.norm(axis))
        return pose

    frames = [
        f if f.name in scene.test_names else replace(f, world_from_cam=turn(f.world_from_cam)) for f in scene.frames
    ]
    return replace(scene, frames=tuple(frames))


@pytest.fixture(scope="module")
def small(spheres: Capture) -> Capture:
    """Four photos, the last one held out."""
    frames = spheres.frames[:4]
    return replace(spheres, frames=frames, test_names=frozenset({frames[3].name}))


def pool_of(scene: Capture) -> PixelPool:
    photos = load_photos(scene.train_frames, factor=1, threads=1)
    return pool_of_photos(photos)


@pytest.fixture
def pool(small: Capture) -> PixelPool:
    return pool_of(small)


def linear_loss(pool: PixelPool, refinement: Refinement, numbers: torch.Tensor, slopes: torch.Tensor) -> float:
    """Return a loss that is linear in the rays, so that `slopes` are exactly its gradients by them."""
    drawn = refinement.refine_cameras(pool.rays_of(numbers))
    return float((torch.stack([drawn.origins, drawn.directions]).double() * slopes).sum())


def rays_and_slopes(pool: PixelPool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the numbers of 300 pixels, and gradients (2, 300, 3) by the origins and directions of their rays."""
    generator = torch.Generator().manual_seed(3)
    numbers = pool.draw(300, generator).numbers
    return numbers, torch.randn(2, 300, 3, generator=generator, dtype=torch.float64)


def test_pose_gradient_is_the_difference_of_a_loss(pool, generator):
    """Central differences of a loss that is linear in the rays, from poses that have moved already."""
    numbers, slopes = rays_and_slopes(pool)
    refinement = Refinement("poses", pool)
    poses = present(refinement.poses)
    twists = 0.1 * torch.randn(3, 6, generator=generator, dtype=torch.float64)
    start = torch.from_numpy(transform_from_twist(twists.numpy()))
    poses.motions.copy_(start)
    drawn = refinement.refine_cameras(pool.rays_of(numbers))
    by_rays = {"by_origin": slopes[0], "by_direction": slopes[1]}
    of_rays = poses.gradients(drawn.directions.double(), pool.photo_of(numbers), **by_rays)
    found = torch.zeros(3, 6, dtype=torch.float64).index_add_(0, pool.photo_of(numbers), of_rays)
    step = 1e-2  # float32 rays; the third derivative of a turn is about the first
    for photo in range(3):
        for axis in range(6):
            losses = []
            for sign in (1, -1):
                twist = np.zeros((3, 6))
                twist[photo, axis] = sign * step
                poses.motions.copy_(start @ torch.from_numpy(transform_from_twist(twist)))
                losses.append(linear_loss(pool, refinement, numbers, slopes))
            wanted = (losses[0] - losses[1]) / (2 * step)
            assert found[photo, axis].item() == pytest.approx(wanted, abs=1e-4 * found.abs().max().item() + 1e-3)


def with_lens(small: Capture, shifts: tuple[float, ...]) -> Capture:
    """Return the scene with photos of one lens, whose principal points a stabiliser has moved by `shifts`."""
    lens = Camera("RADIAL", 96, 72, (100.0, 48.0, 36.0, 0.05, -0.02))
    cameras = [lens.with_principal_point(48.0 + shift, 36.0 - shift) for shift in shifts]
    frames = tuple(replace(frame, camera=camera) for frame, camera in zip(small.frames, cameras, strict=True))
    return replace(small, frames=frames)


@pytest.mark.parametrize("shifts", [(0.0, 0.0, 0.0, 0.0), (0.0, 3.2, -1.7, 2.0)])
def test_lens_gradient_is_the_difference_of_a_loss(small, shifts):
    pool = pool_of(with_lens(small, shifts))
    numbers, slopes = rays_and_slopes(pool)
    refinement = Refinement("all", pool)
    lenses = present(refinement.lenses)
    start = torch.tensor([[0.02, 0.01, -0.01]], dtype=torch.float64)
    lenses.values.copy_(start)
    turns = pool.poses[:, :3, :3].double()
    found = lenses.gradient(numbers, pool.photo_of(numbers), turns=turns, by_direction=slopes[1])
    for index in range(3):
        losses = []
        for sign in (1, -1):
            lenses.values.copy_(start)
            lenses.values[0, index] += sign * 1e-2
            losses.append(linear_loss(pool, refinement, numbers, slopes))
        wanted = (losses[0] - losses[1]) / 2e-2
        assert found[0, index].item() == pytest.approx(wanted, abs=2e-3 * found.abs().max().item())


def test_photos_of_a_stabilised_lens_change_together(small):
    """Whatever a lens learns holds for all its photos, the held-out one too; principal points stay where they are."""
    scene = with_lens(small, (0.0, 3.2, -1.7, 2.0))
    refinement = Refinement("all", pool_of(scene))
    present(refinement.lenses).values.copy_(torch.tensor([[0.02, 0.01, -0.01]], dtype=torch.float64))
    training, held_out = refinement.frames(scene.train_frames, scene.test_frames)
    before = {frame.name: frame.camera for frame in scene.frames}
    for frame in (*training, *held_out):
        assert frame.camera == changed(before[frame.name], ("focal", "k1", "k2"), np.array([0.02, 0.01, -0.01]))
        assert frame.camera.principal_point == before[frame.name].principal_point


def test_only_a_sphere_has_nothing_to_change():
    rng = np.random.default_rng(0)
    assert {m for m in MODELS if not changeable(random_camera(m, rng))} == {"EQUIRECTANGULAR"}


@given(model=st.sampled_from([m for m in MODELS if m != "EQUIRECTANGULAR"]), seed=seeds)
@examples(15)
def test_bearings_of_a_changed_lens_move_as_the_derivative_says(model, seed):
    rng = np.random.default_rng(seed)
    camera = random_camera(model, rng)
    names = changeable(camera)
    pixels = rng.uniform(0.3, 0.7, (50, 2)) * (WIDTH, HEIGHT)
    found = bearings_by_change(camera, names, pixels)
    step = 1e-5
    for index in range(len(names)):
        change = np.zeros(len(names))
        change[index] = step
        (ahead, valid), (behind, also) = (changed(camera, names, sign * change).bearings(pixels) for sign in (1, -1))
        _, inside = camera.bearings(pixels)
        smooth = valid & also & inside
        difference = (ahead - behind) / (2 * step)
        # Where a lens is about to turn back, its derivative is large and changes within the step.
        away = np.linalg.norm(found[..., index], axis=-1)
        smooth &= away < 3.0
        np.testing.assert_allclose(found[smooth, :, index], difference[smooth], rtol=1e-5, atol=1e-6)


@given(seed=seeds)
@examples(40)
def test_taking_out_the_mean_leaves_cameras_as_they_stand_to_each_other(seed):
    """Relative rotations do not change, and distances between cameras change by one common factor."""
    rng = np.random.default_rng(seed)
    before = random_poses(rng, 5)
    after = before @ transform_from_twist(rng.normal(size=(5, 6)) * 0.05)
    kept = without_mean(before, after)
    found, expected = (inverse(poses[0])[:3, :3] @ poses[1:, :3, :3] for poses in (kept, after))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    apart = [np.linalg.norm(poses[1:, :3, 3] - poses[0, :3, 3], axis=1) for poses in (kept, after)]
    np.testing.assert_allclose(apart[0] / apart[1], (apart[0] / apart[1])[0], rtol=1e-12)


@given(seed=seeds)
@examples(40)
def test_a_similarity_of_all_cameras_is_taken_out_whole(seed):
    """One removal is exact to first order, so repeated removals are complete."""
    rng = np.random.default_rng(seed)
    before = random_poses(rng, 6)
    moved = Similarity(np.exp(0.1 * rng.normal()), rotation_from_vector(0.1 * rng.normal(size=3)), rng.normal(size=3))
    kept = moved.apply_pose(before)
    for _ in range(6):
        kept = without_mean(before, kept)
    np.testing.assert_allclose(kept, before, atol=1e-9)
    rest = mean_similarity(before, kept)
    assert rest.scale == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("radius", [0.01, 1.0, 30.0])
def test_a_turn_of_each_camera_on_its_spot_counts_as_the_move_that_it_would_be(radius):
    """Closed form for a tetrahedron, whose arms are alike in all directions: if all turn by w on
    their spots, w / (1 + 2/3) counts as a turn of the whole, whatever the size of the capture."""
    centres = radius * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    before = from_parts(np.broadcast_to(np.eye(3), (4, 3, 3)), centres)
    turn = np.array([1e-3, -2e-3, 5e-4])
    after = from_parts(np.broadcast_to(rotation_from_vector(turn), (4, 3, 3)), centres)
    found = mean_similarity(before, after)
    np.testing.assert_allclose(vector_from_rotation(found.rotation), 0.6 * turn, rtol=1e-6)


def test_a_step_of_poses_leaves_no_mean_and_far_cameras_see_moves_less(pool, generator):
    """A step leaves no mean motion; the effect of a move on the picture is inverse to the distance."""
    poses = present(Refinement("poses", pool).poses)
    given = poses.poses()
    gradients = torch.randn(90, 6, generator=generator, dtype=torch.float64) + 1.0
    poses.step(gradients, torch.full((90,), 0.5, dtype=torch.float64), torch.arange(90) % 3, camera_plan(0.3), rate=1.0)
    assert np.abs(poses.poses() - given).max() > 1e-4
    rest = mean_similarity(given, poses.poses())
    assert np.linalg.norm(vector_from_rotation(rest.rotation)) < 1e-5  # to first order
    away = np.linalg.norm(given[:, :3, 3], axis=1).max()
    given[:, :3, 3] *= np.array([[1.0], [10.0], [10.0]]) * away / np.linalg.norm(given[:, :3, 3], axis=1, keepdims=True)
    near, far, _ = torch.diagonal(PoseRefinement(given, pool.cameras).picture, dim1=1, dim2=2)
    torch.testing.assert_close(near[:3] / far[:3], torch.full((3,), 100.0, dtype=torch.float64))
    torch.testing.assert_close(near[3:], far[3:])


def test_how_the_picture_moves_with_a_pose(small):
    """Against differences by twists: points on 6 x 6 pixels of a camera, at 2/3, 1 and 2 times its distance of 3."""
    camera, step = small.frames[0].camera, 1e-6
    pose = look_at(np.array([3.0, 0.0, 0.0]), np.zeros(3), np.array([0, 0, 1]))
    x, y = ((np.arange(6) + 0.5) / 6 * side for side in (camera.width, camera.height))
    bearings, _ = camera.bearings(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    points = np.concatenate([3 * fraction * bearings for fraction in (2 / 3, 1.0, 2.0)])
    columns = []
    for twist in np.eye(6):
        moved = [apply(inverse(transform_from_twist(sign * step * twist)), points) for sign in (1, -1)]
        ahead, behind = (camera.project(places)[0] for places in moved)
        columns.append((ahead - behind).ravel() / (2 * step * camera.focal_px * np.sqrt(len(points))))
    jacobian = np.stack(columns, axis=-1)
    refinement = PoseRefinement(pose[None], [camera])
    np.testing.assert_allclose(refinement.picture[0], jacobian.T @ jacobian, rtol=1e-5, atol=1e-7)
    in_pixels = (camera.focal_px**2 * jacobian**2).sum(0)
    np.testing.assert_allclose(refinement.newton._picture_px[0], in_pixels, rtol=1e-5)


@given(seed=seeds, turned_only=st.booleans())
@examples(10)
def test_what_was_right_says_where_the_cameras_are(seed, turned_only):
    """Wrong rotations do not enter the similarity, nor do wrong centres: the part that was right is restored."""
    rng = np.random.default_rng(seed)
    before = random_poses(rng, 12)
    noisy = before.copy()
    if turned_only:
        noisy[:, :3, :3] = noisy[:, :3, :3] @ rotation_from_vector(rng.normal(scale=1e-2, size=(12, 3)))
    else:
        noisy[:, :3, 3] += rng.normal(scale=1e-2, size=(12, 3))
    small = Similarity(1.002, rotation_from_vector(rng.normal(scale=1e-3, size=3)), rng.normal(scale=1e-3, size=3))
    found = without_mean(before, small.apply_pose(noisy))
    kept = (slice(None), slice(3), 3 if turned_only else slice(3))
    assert np.abs(found[kept] - before[kept]).max() < 1e-4


@pytest.mark.parametrize("count", [1, 3])
def test_cameras_in_one_place_have_no_scale(count):
    before = np.repeat(random_poses(np.random.default_rng(0), 1), count, axis=0)
    after = before @ transform_from_twist(np.full(6, 0.01))
    assert mean_similarity(before, after).scale == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(without_mean(before, after), before, atol=1e-3)


def test_cameras_that_stay_where_they_are_have_moved_by_nothing():
    poses = random_poses(np.random.default_rng(0), 8)
    found = mean_similarity(poses, poses)
    np.testing.assert_array_equal(without_mean(poses, poses), poses)
    assert (found.scale, found.rotation.tolist()) == (1.0, np.eye(3).tolist())


def test_whitened_steps_move_what_is_seen_alike():
    """The closed form for independent parameters: one over their sizes, less the damping."""
    sizes = np.array([1e-3, 1.0, 50.0])
    jacobian = np.linalg.qr(np.random.default_rng(0).normal(size=(20, 3)))[0] * sizes
    np.testing.assert_allclose(jacobian @ whitening(jacobian) @ (np.eye(3)), jacobian / sizes / np.sqrt(1.1), rtol=6e-3)


def test_whitened_steps_are_those_of_adam_in_whitened_coordinates():
    """Against torch's own: parameters x = W y, whose gradient by y is W g; the steps of y are Adam's."""
    rng, rate = np.random.default_rng(0), 0.01
    squares = rng.normal(size=(2, 3, 3))
    matrices = squares @ np.swapaxes(squares, -1, -2)
    white = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    theirs, ours = torch.optim.Adam([white], lr=rate, betas=BETAS, eps=EPS), WhitenedAdam(matrices)
    moved = torch.zeros(2, 3, dtype=torch.float64)
    for _ in range(5):
        gradient = torch.from_numpy(rng.normal(size=(2, 3)))
        moved += ours.change(gradient, rate)
        white.grad = (torch.from_numpy(matrices) @ gradient[..., None])[..., 0]
        theirs.step()
    torch.testing.assert_close(moved, (torch.from_numpy(matrices) @ white.detach()[..., None])[..., 0])


def newton(rng: np.random.Generator, strengths: np.ndarray) -> tuple[NewtonSteps, torch.Tensor, torch.Tensor]:
    """Return steps that learned from scalar residuals J (x - wanted), loss r^2 / 2, at x = 0; `wanted`; the slope."""
    wanted = torch.from_numpy(rng.normal(scale=0.1, size=(3, 6)))
    rows = torch.from_numpy(rng.normal(size=(600, 6)) * np.sqrt(strengths))
    photos = torch.arange(600) % 3
    residuals = -(rows * wanted[photos]).sum(-1)
    steps = NewtonSteps(3, torch.full((3, 6), 1e3, dtype=torch.float64))
    # Far above the least loss that counts.
    slope = steps.learn(1e6 * residuals[:, None] * rows, 1e6 * residuals**2 / 2, photos)
    return steps, wanted, slope


def test_an_undamped_step_solves_least_squares():
    """If residuals are linear in the parameters, the step ends at their zero, however unequal their effects."""
    steps, wanted, slope = newton(np.random.default_rng(0), np.array([1, 1e-3, 1e-2, 1, 10, 100]))
    found = steps.change(slope, torch.zeros(3, 6, dtype=torch.float64), damping=0.0, holding=0.0)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)


def test_what_hardly_moved_is_held_and_what_moved_far_is_not():
    """Turns of 10 pixels and moves of a thousandth of a pixel: holding pulls the moves back, and the turns stay."""
    steps, _, _ = newton(np.random.default_rng(0), np.ones(6))
    so_far = torch.tensor([[1e-5] * 3 + [0.2] * 3] * 3, dtype=torch.float64)
    found = steps.change(torch.zeros_like(so_far), so_far, damping=0.0, holding=1.0)
    assert (found[:, :3] / so_far[:, :3] < -0.8).all()
    assert (found[:, 3:] / so_far[:, 3:]).abs().max() < 0.05


@pytest.mark.parametrize(("damping", "holding", "scale"), [(1.0, 0.0, 1.0), (0.1, 0.05, 0.3), (0.3, 1e-3, 1e-3)])
def test_a_step_is_the_one_that_the_formula_says(damping, holding, scale):
    """(H + damping diag(H) + L)^-1 (slope + L so_far) in NumPy, for moves and turns of every size."""
    steps, _, slope = newton(np.random.default_rng(0), np.array([1, 1e-1, 1e-2, 1, 10, 100]))
    so_far = torch.from_numpy(np.random.default_rng(1).normal(scale=scale, size=(3, 6)))
    found = steps.change(slope, so_far, damping=damping, holding=holding)
    curvature = (steps.curvature / steps.weight).numpy()
    diagonal = np.diagonal(curvature, axis1=1, axis2=2)
    squares = 1e3 * so_far.numpy() ** 2  # pixels
    spread = np.array([squares[:, :3].sum(1).mean()] * 3 + [squares[:, 3:].sum(1).mean()] * 3)
    held = holding * diagonal.mean(0) / np.maximum(spread, 0.05) ** 2
    for photo in range(3):
        matrix = curvature[photo] + np.diag(damping * diagonal[photo] + held)
        wanted = -np.linalg.solve(matrix, slope[photo].numpy() + held * so_far[photo].numpy())
        np.testing.assert_allclose(found[photo].numpy(), wanted, rtol=1e-6, atol=1e-12)


# One ray without a slope or a loss, of the first photo.
NO_RAYS = torch.zeros(1, 6).double(), torch.zeros(1).double(), torch.zeros(1).long()


def steps_of(monkeypatch: pytest.MonkeyPatch, twist: float) -> list[dict[str, float]]:
    """Replace Newton steps by a constant twist of the poses, and return the list that records their settings."""
    calls: list[dict[str, float]] = []

    def change(self: NewtonSteps, slope: torch.Tensor, so_far: torch.Tensor, **settings: float) -> torch.Tensor:
        calls.append(settings)
        return torch.tensor([[twist, 0, 0, 0, -twist, 0], [0, twist, 0, 0, 0, twist]], dtype=torch.float64).repeat(2, 1)

    monkeypatch.setattr(NewtonSteps, "change", change)
    return calls


def test_poses_are_damped_less_and_less_and_fixed_once_the_fault_is_found(monkeypatch):
    calls = steps_of(monkeypatch, 1e-9)
    refinement = PoseRefinement(random_poses(np.random.default_rng(0), 4), [Camera.pinhole(40, 30, 40.0)] * 4)
    fractions = (0.11, 0.2, 0.21, 0.35, 0.5, 0.8, 0.97)
    for fraction in fractions:
        refinement.step(*NO_RAYS, camera_plan(fraction), rate=1.0)
    damping, holding = ([one[name] for one in calls] for name in ("damping", "holding"))
    assert damping[:2] == pytest.approx([1.0, 1.0])
    assert damping[-2:] == pytest.approx([0.1, 0.1])
    assert damping == sorted(damping, reverse=True)
    assert holding[:2] == [0.0, 0.0]
    assert holding[3:] == pytest.approx([np.sqrt(1e-3 * 0.05), 0.05, 0.05, 0.05])
    assert holding[2] == pytest.approx(1e-3, rel=0.2)


def test_poses_that_float32_has_rounded_stay_rigid(small, monkeypatch):
    """A rotation in float32 is orthonormal to 6e-8, which 100 steps without motion would raise to 1e-5."""
    steps_of(monkeypatch, 0.0)
    frames = small.train_frames
    pool = pool_of(replace(small, frames=(*frames, frames[0]), test_names=frozenset()))
    poses = present(Refinement("poses", pool).poses)
    for _ in range(100):
        poses.step(*NO_RAYS, camera_plan(0.5), rate=1.0)
    rotations = poses.poses()[:, :3, :3]
    assert np.abs(np.swapaxes(rotations, -1, -2) @ rotations - np.eye(3)).max() < 1e-9


def test_poses_go_by_the_rate_of_the_whole_way(monkeypatch):
    """To first order a tenth of the rate is a tenth of the way."""
    steps_of(monkeypatch, 1e-7)
    ways = []
    for rate in (1.0, 0.1):
        refinement = PoseRefinement(random_poses(np.random.default_rng(0), 4), [Camera.pinhole(40, 30, 40.0)] * 4)
        refinement.step(*NO_RAYS, camera_plan(0.5), rate=rate)
        ways.append(refinement.motions.numpy() - np.eye(4))
    assert np.abs(ways[0]).max() > 1e-8
    np.testing.assert_allclose(ways[1], 0.1 * ways[0], atol=1e-13)


def test_a_step_of_all_hands_each_part_what_it_needs(pool, monkeypatch):
    """Poses: the gradient of every ray's own loss, not of their mean. Lenses: the turns of the poses as they are now,
    and their own rate."""
    refinement = Refinement("all", pool)
    poses, lenses = present(refinement.poses), present(refinement.lenses)
    turns = np.stack([transform_from_twist(np.array([0, 0, 0, 0.1 * i, 0, 0])) for i in range(1, 4)])
    poses.motions.copy_(torch.from_numpy(turns))
    given: dict[str, torch.Tensor | float] = {}

    def lens_gradient(numbers: torch.Tensor, photos: torch.Tensor, **rays: torch.Tensor) -> torch.Tensor:
        given["turns"] = rays["turns"]
        return torch.ones_like(lenses.values)

    monkeypatch.setattr(lenses, "gradient", lens_gradient)
    monkeypatch.setattr(lenses, "step", lambda gradient, rate: given.update(lens_rate=rate))
    monkeypatch.setattr(poses, "gradients", lambda *rays, **slopes: slopes["by_origin"].repeat(1, 2))
    monkeypatch.setattr(poses, "step", lambda slopes, *others, rate: given.update(slopes=slopes, rate=rate))
    numbers = torch.arange(50)
    drawn = refinement.refine_cameras(pool.rays_of(numbers))
    drawn = drawn._replace(origins=drawn.origins.requires_grad_(), directions=drawn.directions.requires_grad_())
    losses = (drawn.origins + drawn.directions).square().sum(-1)
    losses.mean().backward()
    refinement.step(drawn, losses.detach(), camera_plan(0.3), factor=0.5)
    np.testing.assert_allclose(given["turns"], poses.poses()[:, :3, :3])
    assert (given["rate"], given["lens_rate"]) == (0.5, pytest.approx(0.5 * LENS_RATE))
    own = 2.0 * (drawn.origins + drawn.directions).detach().double()
    torch.testing.assert_close(given["slopes"], own.repeat(1, 2), rtol=1e-5, atol=1e-6)


def test_rates_rise_from_nothing_and_end_at_nothing():
    fractions = np.linspace(0, 1, 201)
    rates = np.array([camera_plan(fraction).rate for fraction in fractions])
    assert rates.max() == 1.0
    assert (rates[[0, -1]] == 0).all()
    assert (rates[fractions >= CAMERAS_END] == 0).all()
    assert np.abs(np.diff(rates)).max() < 0.11


@pytest.mark.parametrize("refined", ["poses", "focal"])
def test_cameras_that_have_not_changed_give_the_same_rays(refined, pool):
    drawn = pool.draw(100, torch.Generator().manual_seed(0))
    again = Refinement(refined, pool).refine_cameras(drawn)
    assert torch.equal(again.origins, drawn.origins)
    torch.testing.assert_close(again.directions, drawn.directions, atol=2e-7, rtol=0)


def test_moves_are_reported_in_degrees_and_percent(small):
    """By hand: one photo turned by 2 degrees, another moved by 0.3 in a scene of radius 6, both 1 % longer."""
    first, second, third = small.train_frames
    turn = transform_from_twist(np.array([0, 0, 0, 0, 0, np.radians(2.0)]))
    move = transform_from_twist(np.array([0, 0.3, 0, 0, 0, 0]))
    longer = changed(first.camera, ("focal",), np.log([1.01]))
    first_after = replace(first, world_from_cam=first.world_from_cam @ turn, camera=longer)
    second_after = replace(second, world_from_cam=second.world_from_cam @ move, camera=longer)
    after = [first_after, second_after, third]
    moves = camera_moves([first, second, third], after, radius=6.0)
    assert moves["rotation_deg"] == {"median": 0.0, "max": 2.0}
    assert moves["translation_percent"] == {"median": 0.0, "max": 5.0}
    assert moves["focal_percent"] == {"median": 1.0, "max": 1.0}


def test_frames_are_where_the_cameras_of_the_training_frame_are(small):
    """Exported poses, mapped to the training frame, are those from which rays were cast."""
    similarity = Similarity(2.5, rotation_from_vector(np.array([0.3, -0.2, 0.9])), np.array([1.0, 2.0, 3.0]))
    pool = pool_of_photos(load_photos(small.train_frames, factor=1, threads=1), similarity)
    refinement = Refinement("poses", pool)
    poses = present(refinement.poses)
    twists = np.random.default_rng(0).normal(size=(3, 6)) * 0.1
    poses.motions.copy_(torch.from_numpy(transform_from_twist(twists)))
    refined, held_out = refinement.frames(small.train_frames, small.test_frames)
    exported = similarity.apply_pose(np.array([frame.world_from_cam for frame in refined]))
    np.testing.assert_allclose(exported, poses.poses(), atol=1e-5)  # those of the pool are float32
    assert np.array_equal(held_out[0].world_from_cam, small.test_frames[0].world_from_cam)


def test_displaced_cameras_return_to_their_places_in_a_trained_field(spheres, spheres_run):
    """With a trained field frozen and photos turned by half a degree, 20 steps bring points at the centre of the scene
    twice as near to their places in the pictures."""
    noisy = turned(spheres, 0.5)
    tensors, description = load_tensors(spheres_run / STATE, "cpu")
    extent = Extent.from_json(description["extent"])
    photos = load_photos(noisy.train_frames, factor=1, threads=1)
    pool = pool_of_photos(photos, extent.training_from_scene)
    settings = TrainSettings(
        budget_seconds=None, steps=20, samples_per_step=2**13, threads=2, log2_rows=14,
        components=Components(cameras="poses"), learning_rate=1e-30, final_learning_rate=1e-30,
    )  # fmt: skip
    fitting = Fitting(TrainingInputs(settings, extent, pool))
    cameras = present(fitting.appearance.cameras)
    tensors |= {f"parts.{name}": value.clone() for name, value in fitting.appearance.state_dict().items()}
    fitting.restore(tensors, description)
    truth = extent.training_from_scene.apply_pose(np.array([f.world_from_cam for f in spheres.train_frames]))
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.2

    def error_px() -> float:
        now = without_mean(truth, present(cameras.poses).poses())
        squares = [
            ((camera.project(apply(inverse(a), points))[0] - camera.project(apply(inverse(b), points))[0]) ** 2).sum(1)
            for camera, a, b in zip(pool.cameras, truth, now, strict=True)
        ]
        return float(np.sqrt(np.mean(squares)))

    before = error_px()
    for step in range(20):
        fitting.advance(0.15 + 0.3 * step / 20)
    assert before > 0.5
    assert error_px() < before / 2


def test_resuming_goes_on_with_the_cameras_bit_for_bit(small, tmp_path):
    state = resumed_bit_for_bit(small, tmp_path, replace(FEW, components=Components(cameras="all")), stop_at=7)
    assert (state["parts.cameras.poses.motions"] != torch.eye(4)).any()


def test_a_run_has_the_cameras_of_its_field_and_those_of_the_scene(small, tmp_path):
    run = tmp_path / "run"
    fit(small, run, replace(FEW, components=Components(cameras="all")))
    refined, before = read_cameras(run), read_given_cameras(run)
    for frame, old in zip(before.train, small.train_frames, strict=True):
        assert frame.camera == old.camera
        assert np.array_equal(frame.world_from_cam, old.world_from_cam)
    moves = camera_moves(before.train, refined.train, radius=1.0)
    assert all(moves[name]["max"] > 0 for name in ("rotation_deg", "translation_percent", "focal_percent"))
    # A held-out photo gets the lens learned from training photos, and keeps its pose.
    (held_out,) = refined.test
    assert held_out.camera == refined.train[0].camera != small.test_frames[0].camera
    assert np.array_equal(held_out.world_from_cam, small.test_frames[0].world_from_cam)
    # And `convert` reads them.
    found = present(find_run(run))
    capture = parse_run(found)
    assert [frame.split for frame in capture.frames] == ["train"] * 3 + ["test"]
    assert capture.frames[0].camera == refined.train[0].camera
    assert np.array_equal(capture.frames[0].world_from_cam, refined.train[0].world_from_cam)
