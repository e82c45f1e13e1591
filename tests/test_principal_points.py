"""Principal points of single photos, against models and pictures whose true ones are known."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import synthetic_captures as synthetic
from corner import NAMES, write_capture
from in_this_process import poses_in_this_process
from synthetic_captures import Lens
from test_pose_strict import assert_added, training_model_kept

from nerfcli.captures.loading import load_scene
from nerfcli.poses.input.job import Solver
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.model import held_out
from nerfcli.poses.model.lens_evidence import OwnCameras
from nerfcli.poses.model.lens_observability import uncertainty
from nerfcli.poses.model.principal_points import (
    LEAST_OBSERVATIONS,
    PrincipalPoints,
    StabilisedModel,
    camera_of_lens,
    choose_principal_points,
    give_own_cameras,
    refine_with_principal_point,
)
from nerfcli.poses.report import PosesReport, closing_notes

PHOTOS = 12


def capture(shifts: np.ndarray, *, seed: int = 0, points: int = 500, wrong: float = 0.0) -> pycolmap.Reconstruction:
    """Twelve photos of one lens in a room, shifted by (12, 2) pixels, as a mapper leaves them; noise of 0.5 px.

    A fraction `wrong` of the observations is 100 px off.
    """
    lens = Lens("SIMPLE_RADIAL", 1024, 768, (820.0, 512.0, 384.0, 0.02))
    views = synthetic.ring(PHOTOS, [lens], seed=1, radius=2.5)
    around = synthetic.together(synthetic.boulder(points * 3 // 10, seed=2), synthetic.room(points * 7 // 10, seed=3))
    model = synthetic.observed_model(views, around, noise_px=0.5, seed=seed)
    rng = np.random.default_rng(seed)
    for number, shift in enumerate(shifts, start=1):
        for point in model.image(number).points2D:
            point.xy = np.asarray(point.xy) + shift
            if rng.uniform() < wrong:
                angle = rng.uniform(0, 2 * np.pi)
                point.xy = np.asarray(point.xy) + 100 * np.array([np.cos(angle), np.sin(angle)])
    held_out.adjust(model, robust_px=2.0 if wrong else None)
    return model


def stabiliser(seed: int, *, px: float = 12.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=px, size=(PHOTOS, 2))


def chosen(
    model: pycolmap.Reconstruction,
) -> tuple[pycolmap.Reconstruction, PrincipalPoints, dict[int, dict[str, Any]]]:
    reports: list[tuple[str, int, int]] = []

    def report(stage: str, done: int, total: int) -> None:
        reports.append((stage, done, total))

    found = choose_principal_points(model, report=report)
    assert found.evidence is not None
    settling = [("settle", done, 4) for done in range(5)]
    assert reports == [
        ("stabilise", 0, 2),
        ("stabilise", 1, 2),
        *(settling if found.evidence.kept else [("stabilise", 2, 2)]),
    ]
    return found.model, found.evidence, found.uncertainty


def found_mean(model: pycolmap.Reconstruction) -> np.ndarray:
    return np.mean([(c.principal_point_x, c.principal_point_y) for c in model.cameras.values()], axis=0)


def own_points(model: pycolmap.Reconstruction) -> np.ndarray:
    """The principal points of the photos, (12, 2), less their mean, which poses can absorb."""
    cameras = [model.camera(model.image(number).camera_id) for number in range(1, PHOTOS + 1)]
    found = np.array([(camera.principal_point_x, camera.principal_point_y) for camera in cameras])
    return found - found.mean(axis=0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_shifts_of_a_stabiliser_are_found(seed):
    """Synthetic truth: shifts of 12 px, 1.2 % of the width, uncertain by 2 px. The residuals fall to the noise."""
    shifts = stabiliser(seed)
    model = capture(shifts, seed=seed)
    found, evidence, certain = chosen(model)
    assert evidence.kept
    assert evidence.own_px < 0.8 * evidence.shared_px
    misses = own_points(found) - (shifts - shifts.mean(axis=0))
    assert np.sqrt((misses**2).mean()) < 2.5
    assert np.abs(found_mean(found) - [512.0, 384.0]).max() < 12.0
    assert held_out.residual_deviation_px(model) > 0.7
    assert held_out.residual_deviation_px(found) == pytest.approx(0.5, abs=0.04)
    assert len({image.camera_id for image in found.images.values()}) == PHOTOS
    lenses = {(camera.mean_focal_length(), camera.params[3]) for camera in found.cameras.values()}
    assert len(lenses) == 1
    focal, distortion = lenses.pop()
    assert focal == pytest.approx(820.0, rel=0.005)
    assert distortion == pytest.approx(0.02, abs=0.006)
    assert certain[1]["focal_percent"] < 0.5


def test_free_principal_points_leave_the_focal_length_less_certain():
    """A law: each principal point that is free takes evidence away; the report's uncertainty has all but one free."""
    found, _, certain = chosen(capture(stabiliser(0)))
    photos = sorted(found.reg_image_ids())

    def percent(shifting: list[int]) -> float:
        lens_of = dict.fromkeys(photos, 1)
        return uncertainty(found, 1, principal_point=False, own=OwnCameras(lens_of, shifting))["focal_percent"]

    assert percent([]) < 0.98 * certain[1]["focal_percent"]
    assert certain[1]["focal_percent"] < 0.999 * percent(photos)


def test_a_gain_that_changes_no_picture_is_not_kept():
    """Shifts of 2.5 px are found beyond doubt, and change the errors by a few percent."""
    model = capture(stabiliser(0, px=2.5), points=2500)
    found, evidence, _ = chosen(model)
    assert found is model
    assert evidence.gain > 3
    assert evidence.own_px < 0.99 * evidence.shared_px


def test_a_gain_within_its_noise_is_not_kept(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(held_out, "gain", lambda before, after: 2.9)
    model = capture(stabiliser(0))
    assert chosen(model)[0] is model


def test_wrong_matches_do_not_hide_the_shifts():
    """One observation in 25 is 100 px off; unclipped, these would be most of the mean error, before and after."""
    model = capture(stabiliser(0), wrong=0.04)
    assert chosen(model)[1].kept


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_photos_with_one_principal_point_share_it(seed):
    """A law: noise alone must not free two parameters per photo."""
    model = capture(np.zeros((PHOTOS, 2)), seed=seed)
    found, evidence, _ = chosen(model)
    assert found is model
    assert not evidence.kept
    assert evidence.own_px > 0.97 * evidence.shared_px


def test_fixed_intrinsics_stay_as_they_are():
    model = capture(stabiliser(0))
    assert choose_principal_points(model, solver=Solver(fixed=(1,))) == StabilisedModel(model, None, {})


def test_a_photo_with_few_observations_keeps_the_shared_principal_point():
    model = capture(stabiliser(0))
    few = model.image(3)
    for index in few.get_observation_point2D_idxs()[LEAST_OBSERVATIONS - 1 :]:
        model.delete_observation(3, index)
    found, evidence, _ = chosen(model)
    assert (evidence.kept, evidence.photos) == (True, PHOTOS - 1)
    shared = model.camera(few.camera_id)
    kept, moved = (found.camera(found.image(number).camera_id) for number in (3, 4))
    assert (kept.principal_point_x, kept.principal_point_y) == (shared.principal_point_x, shared.principal_point_y)
    assert moved.principal_point_x != shared.principal_point_x


def test_a_principal_point_far_from_the_others_is_put_back():
    """No stabiliser shifts a picture by a tenth of its width; a crop does, or nothing determines it."""
    shifts = stabiliser(0, px=8.0)
    shifts[5] = (110.0, 0.0)
    model = capture(shifts)
    found, evidence, _ = chosen(model)
    assert evidence.kept
    far, shared = found.camera(found.image(6).camera_id), model.camera(1)
    assert (far.principal_point_x, far.principal_point_y) == (shared.principal_point_x, shared.principal_point_y)


def test_too_few_photos_are_no_evidence():
    model = capture(stabiliser(0), points=60)
    assert choose_principal_points(model) == StabilisedModel(model, None, {})


def test_points_in_two_photos_alone_are_no_evidence():
    """Nothing can be held out where each point has two observations."""
    model = capture(stabiliser(0))
    surplus = [
        (element.image_id, element.point2D_idx)
        for point in model.points3D.values()
        for element in list(point.track.elements)[2:]
    ]
    for observation in surplus:
        model.delete_observation(*observation)
    assert choose_principal_points(model) == StabilisedModel(model, None, {})


def test_a_model_with_own_cameras_projects_as_before():
    model = capture(stabiliser(0))
    own = give_own_cameras(model)
    assert own.compute_num_observations() == model.compute_num_observations()
    assert sorted(own.point3D_ids()) == sorted(model.point3D_ids())
    for point_id in sorted(model.point3D_ids())[::50]:
        one, other = model.point3D(point_id), own.point3D(point_id)
        assert {(e.image_id, e.point2D_idx) for e in one.track.elements} == {
            (e.image_id, e.point2D_idx) for e in other.track.elements
        }
        for element in one.track.elements:
            before, after = (m.image(element.image_id).project_point(one.xyz) for m in (model, own))
            assert before is not None
            assert after is not None
            assert np.array_equal(before, after)


def test_the_camera_of_a_lens_has_the_median_principal_point():
    model = give_own_cameras(capture(np.zeros((PHOTOS, 2))))
    for number, x in ((1, 500.0), (2, 510.0), (3, 532.0)):
        model.camera(model.image(number).camera_id).principal_point_x = x
    assert camera_of_lens(model, [1, 2, 3]).principal_point_x == 510.0


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_and_a_shift_are_found_on_fixed_points(seed):
    """Exact observations but for a tenth of wrong ones; the start is a degree and 2 % of the distance off."""
    rng = np.random.default_rng(seed)
    params = [800.0, 500.0, 375.0, 0.02]
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=1000, height=750, params=params)
    points = rng.uniform([-3, -2, 4], [3, 2, 9], size=(200, 3))
    shift = rng.normal(scale=10, size=2)
    pixels = np.asarray(camera.img_from_cam(points), dtype=np.float64) + shift
    pixels[::10] += rng.uniform(-60, 60, size=pixels[::10].shape)
    near = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.radians(rng.normal(scale=0.6, size=3))), rng.normal(scale=0.1, size=3)
    ).matrix()
    pose, found = refine_with_principal_point(camera, near, pixels, points)
    assert found == pytest.approx(shift, abs=0.05)
    assert pose == pytest.approx(np.eye(4)[:3], abs=1e-3)


@pytest.fixture(scope="module")
def stabilised(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, PosesReport]:
    """The room corner with principal points shifted by 1.2 % of the width; one photo is held out."""
    folder = tmp_path_factory.mktemp("stabilised")
    shifts = np.random.default_rng(2).normal(scale=6, size=(len(NAMES), 2))
    write_capture(folder / "photos", shifts)
    (folder / "test.txt").write_text(f"{NAMES[2]}\n")
    settings = PoseSettings(max_features=600, threads=1, strict=True, holdout=str(folder / "test.txt"))
    with training_model_kept(folder):
        report = poses_in_this_process(folder / "photos", folder / "scene", settings)
    return folder / "scene", shifts, report


def test_a_scene_of_stabilised_photos_has_their_principal_points(stabilised):
    """Synthetic truth, from pictures to the scene; the held-out photo is placed with a principal point of its own."""
    scene_dir, shifts, report = stabilised
    assert report.principal_points is not None
    assert report.principal_points["kept"]
    assert any("its own principal point" in note for note in closing_notes(report))
    model = pycolmap.Reconstruction(str(scene_dir / "sparse" / "0"))
    assert report.strict is not None
    assert assert_added(scene_dir.parent, NAMES[2]) == {"pose", "camera"}
    large = [0, 1, 2, 3, 4]  # the others are smaller, of another lens
    cameras = [model.camera(model.find_image_with_name(NAMES[number]).camera_id) for number in large]
    assert len({camera.camera_id for camera in cameras}) == len(large)
    found = np.array([(camera.principal_point_x, camera.principal_point_y) for camera in cameras])
    misses = (found - found.mean(axis=0)) - (shifts[large] - shifts[large].mean(axis=0))
    assert np.sqrt((misses**2).mean()) < 3.0  # mostly a drift along the row of five photos
    assert report.strict["placed"][NAMES[2]]["error_px"] < 0.8
    assert [camera["images"] for camera in report.cameras] == [4, 2]  # by lens; the held-out photo is not counted
    # Shared principal points look like a distortion of k1 = -0.13, which moves what is 27 degrees off by 7 px.
    seen = np.asarray(cameras[0].img_from_cam(np.array([[0.5, 0.0, 1.0]])), dtype=np.float64).ravel()
    straight = cameras[0].principal_point_x + 0.5 * cameras[0].mean_focal_length()
    assert abs(seen[0] - straight) < 5.0
    assert len({frame.camera for frame in load_scene(scene_dir).frames}) == len(NAMES)
