"""The lens that photos can hold, and the uncertainty of their poses, against models with known truth."""

from typing import Any

import numpy as np
import pycolmap
import pytest
import synthetic_captures as synthetic
from synthetic_captures import LONG, WIDE, Lens

from nerfcli.cameras.alignment import align
from nerfcli.poses.input.job import Solver
from nerfcli.poses.judge.examine import pose_blur_px
from nerfcli.poses.model import held_out, intrinsics
from nerfcli.poses.model.intrinsics import choose_lenses, convert_camera
from nerfcli.poses.model.lens_observability import DeterminedLens, determine_lens


def ring_model(
    name: str, params: tuple[float, ...], *, points: tuple[int, int] = (100, 240), seed: int = 0
) -> pycolmap.Reconstruction:
    """Twelve photos around a boulder in a room, so that pictures are full to the corners; half a pixel of noise.

    `points` are those of the boulder and of the room.
    """
    views = synthetic.ring(12, [Lens(name, 1024, 768, params)], seed=1, radius=2.5)
    scene = synthetic.together(synthetic.boulder(points[0], seed=2), synthetic.room(points[1], seed=3))
    return synthetic.observed_model(views, scene, noise_px=0.5, seed=seed)


def synthetic_model(
    name: str, params: list[float], *, photos: int = 12, points: int = 250, noise_px: float = 0.5, seed: int = 0
) -> tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]:
    """The truth, and the same with noise in the observations."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_frames_per_rig = photos
    options.num_points3D = points
    options.num_points2D_without_point3D = 0
    options.camera_model_id = getattr(pycolmap.CameraModelId, name)
    options.camera_params = params
    pycolmap.set_random_seed(3)
    truth = pycolmap.synthesize_dataset(options)
    noisy = pycolmap.Reconstruction(truth)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = noise_px
    pycolmap.set_random_seed(seed + 1)
    pycolmap.synthesize_noise(noise, noisy)
    noisy.update_point_3d_errors()
    return truth, noisy


def started_from(model: pycolmap.Reconstruction, name: str) -> pycolmap.Reconstruction:
    """Return the model adjusted with a simpler lens and a central principal point, as a mapper leaves it."""
    started = pycolmap.Reconstruction(model)
    for camera in started.cameras.values():
        camera.principal_point_x, camera.principal_point_y = camera.width / 2, camera.height / 2
        simple = convert_camera(camera, name)
        camera.model = simple.model
        camera.params = simple.params.tolist()
    held_out.adjust(started)
    return started


def camera_of(model: pycolmap.Reconstruction) -> pycolmap.Camera:
    return next(iter(model.cameras.values()))


@pytest.mark.parametrize(
    ("name", "params"),
    [
        ("SIMPLE_RADIAL", (800.0, 512.0, 384.0, 0.05)),
        ("RADIAL", (800.0, 512.0, 384.0, 0.08, -0.12)),
        ("OPENCV_FISHEYE", (380.0, 380.0, 512.0, 384.0, 0.1, -0.05, 0.03, -0.02)),
    ],
)
def test_the_lens_model_is_the_one_that_took_the_pictures(name: str, params: tuple[float, ...]):
    """Synthetic truth; no richer lens than the true one is kept, and the principal point stays at the centre."""
    lenses = choose_lenses(started_from(ring_model(name, params), "SIMPLE_RADIAL"))
    camera = camera_of(lenses.model)
    assert camera.model.name == name
    assert (camera.principal_point_x, camera.principal_point_y) == (512.0, 384.0)
    assert camera.mean_focal_length() == pytest.approx(params[0], rel=0.005)


def test_a_principal_point_off_the_centre_is_found():
    """Synthetic truth: 1.5 % of the width off, recovered to two pixels."""
    noisy = ring_model("SIMPLE_RADIAL", (800.0, 527.0, 380.0, 0.05))
    lenses = choose_lenses(started_from(noisy, "SIMPLE_RADIAL"))
    assert camera_of(lenses.model).params[1:3] == pytest.approx((527.0, 380.0), abs=2.0)
    assert lenses.uncertainty[1]["principal_point_free"]


def test_a_fisheye_off_the_axis_is_found_from_a_fisheye():
    """Synthetic truth: simpler and richer fisheyes are compared first with the principal point at the centre."""
    noisy = ring_model("OPENCV_FISHEYE", (380.0, 380.0, 524.0, 380.0, 0.1, -0.05, 0.03, -0.02), points=(100, 400))
    lenses = choose_lenses(started_from(noisy, "OPENCV_FISHEYE"))
    assert camera_of(lenses.model).model.name == "OPENCV_FISHEYE"
    assert camera_of(lenses.model).params[:4] == pytest.approx((380.0, 380.0, 524.0, 380.0), abs=1.0)


@pytest.mark.parametrize(("exif", "seed"), [(800.0, 0), (790.0, 1), (None, 2), (None, 3)])
def test_a_focal_length_that_flat_ground_from_above_leaves_open_stays_at_exif(exif: float | None, seed: int):
    """Height and focal length trade off. With EXIF's, distortion is right too; without it, the lens stays plausible."""
    views = synthetic.above(16, WIDE, seed=seed)
    points, noise_px = (300, 0.7) if exif is None else (600, 0.5)
    ground = synthetic.wall(points, seed=seed, size=9.0)
    noisy = synthetic.observed_model(views, ground, noise_px=noise_px, seed=seed)
    focal_px = {} if exif is None else {1: exif}
    lenses = choose_lenses(started_from(noisy, "SIMPLE_RADIAL"), exif_focal_px=focal_px)
    camera, certain = camera_of(lenses.model), lenses.uncertainty[1]
    assert certain["weak"]
    assert certain["focal_percent"] > 3
    if exif is None:
        assert camera.mean_focal_length() == pytest.approx(WIDE.params[0], rel=0.4)
    else:
        assert camera.mean_focal_length() == exif
        assert camera.params[3] == pytest.approx(WIDE.params[3], abs=0.006)


def test_intrinsics_that_are_given_stay():
    _, noisy = synthetic_model("SIMPLE_RADIAL", [1280.0, 527.0, 380.0, 0.05])
    camera_of(noisy).params = [1300.0, 512.0, 384.0, 0.04]
    lenses = choose_lenses(noisy, solver=Solver(fixed=(1,)))
    assert camera_of(lenses.model).params.tolist() == [1300.0, 512.0, 384.0, 0.04]


def test_the_lenses_with_the_most_photos_are_examined_and_reported(monkeypatch: pytest.MonkeyPatch):
    examined: list[int] = []

    def noted(model: pycolmap.Reconstruction, camera_id: int, *others: Any, **options: Any) -> DeterminedLens:
        examined.append(camera_id)
        return determine_lens(model, camera_id, *others, **options)

    monkeypatch.setattr(intrinsics, "MOST_CAMERAS", 1)
    monkeypatch.setattr(intrinsics, "determine_lens", noted)
    views = synthetic.ring(9, [WIDE, LONG, LONG], seed=1)
    lenses = choose_lenses(synthetic.observed_model(views, synthetic.boulder(300, seed=2), noise_px=0.5, seed=0))
    assert examined == list(lenses.uncertainty) == [2]


def test_a_named_model_stays():
    noisy = ring_model("RADIAL", (1000.0, 512.0, 384.0, 0.1, -0.2))
    lenses = choose_lenses(started_from(noisy, "SIMPLE_RADIAL"), named=[1])
    assert camera_of(lenses.model).model.name == "SIMPLE_RADIAL"


@pytest.mark.parametrize("name", ["RADIAL", "OPENCV", "SIMPLE_RADIAL_FISHEYE", "OPENCV_FISHEYE"])
def test_a_converted_lens_sees_the_same(name: str):
    """Within a pixel, also in the corners, for a normal lens."""
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 900.0, 1024, 768)
    camera.params = [900.0, 512.0, 384.0, -0.05]
    pixels = np.random.default_rng(0).uniform(0, [1024, 768], size=(50, 2))
    rays = np.asarray(camera.cam_ray_from_img(pixels), dtype=np.float64)
    assert convert_camera(camera, name).img_from_cam(rays) == pytest.approx(pixels, abs=1.0)


def test_held_out_observations_are_a_tenth_and_off_by_the_noise():
    """Without adjustment, their errors have a Rayleigh distribution, whose median is 1.177 sigma."""
    truth, noisy = synthetic_model("SIMPLE_RADIAL", [1280.0, 512.0, 384.0, 0.05], points=600)
    _, held = held_out.split(noisy, seed=0)
    errors = held_out.errors_px(truth, held)
    assert len(errors) == pytest.approx(0.1 * noisy.compute_num_observations(), rel=0.25)
    assert np.median(errors) == pytest.approx(0.5 * 1.177, rel=0.1)
    training, _ = held_out.split(noisy, seed=0)
    assert training.compute_num_observations() == noisy.compute_num_observations() - len(errors)


def test_residuals_measure_the_noise():
    _, noisy = synthetic_model("SIMPLE_RADIAL", [1280.0, 512.0, 384.0, 0.05], noise_px=0.8)
    held_out.adjust(noisy)
    assert held_out.residual_deviation_px(noisy) == pytest.approx(0.8, rel=0.05)


def test_pose_blur_is_how_far_pictures_really_move():
    """Monte Carlo: 24 captures with the same truth and other noise; every photo's predicted motion within a third."""
    predicted, moved = [], []
    for seed in range(24):
        truth, noisy = synthetic_model("SIMPLE_RADIAL", [1280.0, 512.0, 384.0, 0.05], photos=8, points=120, seed=seed)
        held_out.adjust(noisy)
        if seed < 3:
            blur = pose_blur_px(noisy)
            predicted.append([blur[image_id] for image_id in sorted(blur)])
        moved.append(_picture_motion(truth, noisy))
    ratio = np.mean(predicted, axis=0) / np.sqrt(np.mean(moved, axis=0))
    assert ratio == pytest.approx(1.0, abs=0.33)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.15)


def _picture_motion(truth: pycolmap.Reconstruction, found: pycolmap.Reconstruction) -> list[float]:
    """Mean squared motion of the true points in each photo, after the similarity that fits all points best."""
    source = np.array([found.point3D(i).xyz for i in sorted(found.point3D_ids())])
    target = np.array([truth.point3D(i).xyz for i in sorted(truth.point3D_ids())])
    fit = align(source, target)
    moved = pycolmap.Reconstruction(found)
    moved.transform(pycolmap.Sim3d(fit.scale, pycolmap.Rotation3d(fit.rotation), fit.translation))
    motions = []
    for image_id in sorted(truth.reg_image_ids()):
        pixels = [
            np.asarray(camera_of(model).img_from_cam(_local(model.image(image_id), target))) for model in (truth, moved)
        ]
        motions.append(float(((pixels[0] - pixels[1]) ** 2).sum(axis=1).mean()))
    return motions


def _local(image: pycolmap.Image, points: np.ndarray) -> np.ndarray:
    pose = image.cam_from_world()
    return points @ pose.rotation.matrix().T + pose.translation


def test_the_blur_grows_with_the_noise_and_does_not_depend_on_the_frame():
    """Law: proportional to the noise's standard deviation; unchanged by a similarity of the world."""
    blurs = []
    for noise_px in (0.5, 1.0):
        _, noisy = synthetic_model("SIMPLE_RADIAL", [1280.0, 512.0, 384.0, 0.05], noise_px=noise_px)
        blurs.append(pose_blur_px(noisy))
    assert [blurs[1][i] / blurs[0][i] for i in sorted(blurs[0])] == pytest.approx([2.0] * 12, rel=0.1)
    turned = pycolmap.Reconstruction(noisy)
    turned.transform(pycolmap.Sim3d(7.0, pycolmap.Rotation3d(np.array([0.1, 2.0, -0.4])), np.array([3.0, 1.0, -8.0])))
    again = pose_blur_px(turned)
    assert [again[i] for i in sorted(again)] == pytest.approx([blurs[1][i] for i in sorted(again)], rel=1e-3)
