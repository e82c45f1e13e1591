"""Poses against synthetic truth: right ones are accepted with the right accuracy, wrong ones refused with the reason.

Features and matches are drawn for known cameras (benchmarks/synthetic_captures.py); from the verification of matches on
everything is real.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import synthetic_captures as synthetic
from synthetic_captures import LONG, UNKNOWN_FISHEYE, WIDE, Noise, Scene, View

from nerfcli.multiview.graph import connected_groups
from nerfcli.poses.engine import ladder
from nerfcli.poses.engine import second_chance as chances
from nerfcli.poses.engine.database import register_photos
from nerfcli.poses.engine.features import match
from nerfcli.poses.engine.ladder import climb
from nerfcli.poses.engine.mapped import Mapped
from nerfcli.poses.engine.second_chance import is_contradicted, second_chance
from nerfcli.poses.input.job import Job
from nerfcli.poses.judge.acceptance import judge
from nerfcli.poses.judge.checks import Checks
from nerfcli.poses.judge.contradictions import leave_out_contradicting
from nerfcli.poses.judge.examine import Examined, examine
from nerfcli.poses.judge.parallax import best_turn
from nerfcli.poses.model import merging
from nerfcli.poses.model.lens_family import as_fisheye
from nerfcli.poses.model.two_views import read_verified_pairs, rotation_errors
from nerfcli.poses.model.view_graph import Bottlenecks, consistent_groups

pytestmark = pytest.mark.usefixtures("_quiet")


@pytest.fixture(scope="module")
def _quiet() -> None:
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value


@dataclass(frozen=True)
class Solved:
    views: Sequence[View]
    job: Job
    climbed: Mapped
    examined: Examined

    @property
    def model(self) -> pycolmap.Reconstruction:
        assert self.examined.model is not None
        return self.examined.model

    @property
    def kinds(self) -> list[str]:
        return [failure.kind for failure in self.examined.verdict.failures]


def solve(folder: Path, views: Sequence[View], scene: Scene, noise: Noise = Noise(), **options) -> Solved:
    synthetic.write_database(folder / "database.db", views, scene, noise=noise, seed=0, **options)
    job = synthetic.synthetic_job(folder, views, seed=0)
    climbed = climb(job, lambda *progress: None)
    examined = examine(climbed.models, climbed.job, lambda *progress: None, localised=climbed.localised)
    return Solved(views, job, climbed, examined)


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Solved:
    """Two cameras, a fifth of the matches wrong, three photos in ten unmatched."""
    views = synthetic.ring(10, [WIDE, LONG], seed=0, turn_deg=200)
    return solve(tmp_path_factory.mktemp("right"), views, synthetic.boulder(900, seed=0), Noise(outliers=0.2))


def test_a_right_result_is_accepted_and_right(solved: Solved):
    """Synthetic truth: relative rotations within 0.4 degrees, focal lengths within 1 %."""
    assert solved.examined.verdict.accepted
    assert solved.examined.left_out == {}
    assert solved.model.num_reg_images() == 10
    truth = synthetic.true_model(solved.views)
    first, true_first = solved.model.image(1).cam_from_world(), truth.image(1).cam_from_world()
    for image_id in range(2, 11):
        found = solved.model.image(image_id).cam_from_world() * first.inverse()
        true = truth.image(image_id).cam_from_world() * true_first.inverse()
        assert np.degrees((found.rotation * true.rotation.inverse()).angle()) < 0.4
    for camera_id, camera in solved.model.cameras.items():
        assert camera.mean_focal_length() == pytest.approx(truth.camera(camera_id).mean_focal_length(), rel=0.01)


def test_what_was_measured_on_a_right_result_is_as_it_must_be(solved: Solved):
    measures = solved.examined.verdict.measures
    assert measures["pairs"]["contradicting"] == 0
    assert measures["strong_contradictions"] == []
    assert measures["strong_contradictions_share"] == 0
    assert measures["share_in_front"] == 1
    # Half a pixel of noise in each coordinate, and the point's own error: a Rayleigh median of 0.6 px and more.
    assert 0.5 < measures["held_out"]["median_px"] < 1.2
    assert measures["parallax_px"] > 10
    # A ring of radius 3.5 around a ball of radius 1, seen from 2.5 at the nearest.
    assert 0.7 < measures["camera_spread_over_distance"] < 1.5


def test_every_rotation_of_a_pair_agrees_with_a_right_result(solved: Solved):
    with pycolmap.Database.open(str(solved.job.database)) as database:
        pairs = read_verified_pairs(database, min_matches=30)
    errors = rotation_errors(solved.model, pairs, seed=0)
    assert len(errors) > 15
    assert np.median([error.degrees for error in errors]) < 1
    assert max(error.degrees for error in errors) < 6


def test_a_wrong_result_with_low_residuals_is_refused(solved: Solved):
    """Two halves, each right in itself: what the reprojection error praises, the matches between them refuse."""
    wrong = synthetic.bent(solved.model, 6)
    assert wrong.compute_mean_reprojection_error() < 1.05 * solved.model.compute_mean_reprojection_error()
    with pycolmap.Database.open(str(solved.job.database)) as database:
        pairs = read_verified_pairs(database, min_matches=15)
    same, left_out = leave_out_contradicting(wrong, pairs)
    assert same is wrong
    assert left_out == {}
    verdict = judge(wrong, pairs, turn=None, names={"00005.jpg": "kitchen 5.jpg"}, seed=0, threads=1)
    assert verdict.failures[0].kind == "the poses contradict the strongest matches"
    assert "verified matches between" in verdict.failures[0].evidence


def wrongly_mapped(solved: Solved, folder: Path) -> Mapped:
    """The whole capture with photos 8, 9 and 10 in a wrong place, as a mapper leaves it that was misled."""
    shutil.copytree(solved.job.database.parent, folder)
    job = replace(solved.job, folder=str(folder / "work"))
    return Mapped(
        [synthetic.bent(solved.model, 8)], job, [{"what": "default thresholds", "models": [10]}], seconds=1000.0
    )


def test_a_contradicted_model_is_mapped_again_from_its_sound_part(solved: Solved, tmp_path: Path):
    """Synthetic truth: the three photos that were off by 40 degrees come out within 0.4 degrees."""
    wrong = wrongly_mapped(solved, tmp_path / "again")
    first = examine(wrong.models, wrong.job, lambda *progress: None)
    assert is_contradicted(first.verdict)
    notes: list[str] = []
    chance = second_chance(wrong, first, lambda *progress: None, notes.append, checks=Checks)
    assert chance.examined.verdict.accepted
    assert chance.examined.model is not None
    assert [attempt["models"] for attempt in chance.mapped.attempts] == [[10], [10]]
    assert notes[0].endswith("mapping again, for at most 33 min")
    assert notes[-1] == "from the largest consistent part: 10 of 10 photos registered, accepted"
    truth = synthetic.true_model(solved.views)
    for image_id in range(2, 11):
        relative = [
            model.image(image_id).cam_from_world() * model.image(1).cam_from_world().inverse()
            for model in (chance.examined.model, truth)
        ]
        assert np.degrees((relative[0].rotation * relative[1].rotation.inverse()).angle()) < 0.4


@pytest.mark.parametrize(("failing", "attempts"), [(1, [[10], [10]]), (2, [[10], [10]]), (3, [[10], [7]])])
def test_each_hypothesis_stands_in_for_the_one_before(
    solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int, attempts: list[list[int]]
):
    """The first, the first two, or all that map again give nothing; the last one keeps what agrees with itself."""
    wrong = wrongly_mapped(solved, tmp_path / "again")
    first = examine(wrong.models, wrong.job, lambda *progress: None)
    for name in ("_regrown", "_all_at_once", "_from_nothing")[:failing]:
        monkeypatch.setattr(chances, name, lambda *arguments: None)
    chance = second_chance(wrong, first, lambda *progress: None, lambda note: None, checks=Checks)
    assert chance.examined.verdict.accepted
    assert [attempt["models"] for attempt in chance.mapped.attempts] == attempts


def test_a_second_chance_is_bounded_in_time(solved: Solved, tmp_path: Path):
    """Nothing is mapped again where the first mapping took no time; the sound part alone costs only its checks."""
    wrong = replace(wrongly_mapped(solved, tmp_path / "again"), seconds=0.0)
    first = examine(wrong.models, wrong.job, lambda *progress: None)
    notes: list[str] = []
    chance = second_chance(wrong, first, lambda *progress: None, notes.append, checks=Checks)
    assert sum(note.endswith(": skipped, since no time is left") for note in notes) == 4
    assert "from scratch, with other initial pairs: skipped, since no time is left" in notes
    assert chance.examined.model is not None
    assert chance.examined.model.num_reg_images() == 7


def test_a_hypothesis_is_skipped_that_takes_longer_than_what_is_left(
    solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Of 200 s, the first two take 130: mapping from scratch, 100 s as the first time, does not fit; its part does."""
    wrong = replace(wrongly_mapped(solved, tmp_path / "again"), seconds=100.0)
    first = examine(wrong.models, wrong.job, lambda *progress: None)
    now = [0.0]

    def late(*arguments) -> None:
        now[0] += 65.0

    monkeypatch.setattr(chances.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(chances, "_regrown", late)
    monkeypatch.setattr(chances, "_all_at_once", late)
    notes: list[str] = []
    chance = second_chance(wrong, first, lambda *progress: None, notes.append, checks=Checks)
    assert "next: from the largest consistent part (about 30 s)" in notes
    assert "from scratch, with other initial pairs: skipped, since it takes about 2 min, and 70 s are left" in notes
    assert chance.mapped.attempts[-1]["what"] == "only the largest consistent part of the first model"


def test_of_many_photos_a_few_are_not_worth_another_mapping_from_scratch(
    solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Eight of ten are placed; what goes on from them is tried, what begins again is not."""
    shutil.copytree(solved.job.database.parent, tmp_path / "again")
    job = replace(solved.job, folder=str(tmp_path / "again" / "work"))
    real = ladder.map_photos

    def without_two(*arguments, **options) -> list[pycolmap.Reconstruction]:
        models = real(*arguments, **options)
        for photo in {9, 10} & set(models[0].reg_image_ids()):
            models[0].deregister_frame(models[0].image(photo).frame_id)
        return models

    monkeypatch.setattr(ladder, "map_photos", without_two)
    monkeypatch.setattr(ladder, "_MANY_PHOTOS", 10)
    notes: list[str] = []
    climbed = climb(job, lambda *progress: None, notes.append)
    assert [attempt["what"] for attempt in climbed.attempts][:2] == ["default thresholds", "lower angles"]
    assert not any("start from" in attempt["what"] for attempt in climbed.attempts)
    # By the plan, 10 photos take 0.38 + 10 * 0.0025 s each.
    assert "not trying other starts, which take about 4 s each: most photos are registered" in notes


def test_groups_hold_together_against_what_speaks_against_them():
    """By hand: two strong pairs, held apart although one join between them is positive."""
    joins = [(1, 2, 9.0), (3, 4, 9.0), (2, 3, 5.0), (1, 4, -6.0), (5, 1, -1.0)]
    assert consistent_groups([1, 2, 3, 4, 5], joins) == [[1, 2], [3, 4], [5]]
    assert consistent_groups([4, 3, 2, 1], [(1, 2, 9.0), (3, 4, 9.0), (2, 3, 7.0), (1, 4, -6.0)]) == [[4, 3, 2, 1]]
    many_weak = [(1, 2, 9.0), (3, 4, 9.0), (1, 4, -6.0), *((one, other, 5.0) for one in (1, 2) for other in (3, 4))]
    assert consistent_groups([1, 2, 3, 4], many_weak) == [[1, 2], [3, 4]]
    assert consistent_groups([], []) == []


def test_one_photo_that_contradicts_is_left_out(solved: Solved):
    """A tenth of the photos; the others are accepted."""
    wrong = synthetic.bent(solved.model, 10)
    with pycolmap.Database.open(str(solved.job.database)) as database:
        pairs = read_verified_pairs(database, min_matches=15)
    rest, left_out = leave_out_contradicting(wrong, pairs)
    assert set(left_out) == {10}
    assert left_out[10].startswith("contradicts the rest: its ")
    assert rest.num_reg_images() == 9
    assert judge(rest, pairs, turn=None, names={}, seed=0, threads=1).accepted


def test_a_photo_far_from_all_others_is_left_out(solved: Solved):
    wrong = pycolmap.Reconstruction(solved.model)
    frame = wrong.frame(wrong.image(10).frame_id)
    pose = wrong.image(10).cam_from_world()
    frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0.0, 0.0, 300.0]))
    with pycolmap.Database.open(str(solved.job.database)) as database:
        pairs = read_verified_pairs(database, min_matches=15)
    rest, left_out = leave_out_contradicting(wrong, pairs)
    assert rest.num_reg_images() == 9
    assert "times as far away as the other cameras" in left_out[10]


def test_a_scene_that_repeats_itself_is_recognised(tmp_path: Path):
    """A body whose back looks like its front. The mapper places every photo at half a pixel, half of them wrong."""
    folded = solve(tmp_path, synthetic.ring(14, [WIDE], seed=0), synthetic.twofold(800, seed=0))
    assert folded.model.num_reg_images() == 14
    assert folded.model.compute_mean_reprojection_error() < 0.8
    assert folded.kinds == ["parts of the scene look alike (repeated structure)"]


def test_a_camera_that_only_turns_is_recognised(tmp_path: Path):
    """What fits all matches is a turn, with the true focal length."""
    views = synthetic.panorama(6, WIDE, turn_deg=120)
    still = solve(tmp_path, views, synthetic.room(900, seed=0))
    assert still.kinds[0] == "no baseline (pure rotation)"
    assert [rung["what"] for rung in still.climbed.attempts] == ["default thresholds"]  # no other attempt can help
    with pycolmap.Database.open(str(still.job.database)) as database:
        pairs = read_verified_pairs(database, min_matches=30)
    turn = best_turn(pairs, dict.fromkeys(still.job.image_ids, (WIDE.width, WIDE.height)))
    assert turn is not None
    assert turn.parallax_px < 1.5
    assert turn.focal_px == pytest.approx(WIDE.params[0], rel=0.03)


def test_parts_that_share_nothing_are_told_apart(tmp_path: Path):
    far = (40.0, 0.0, 0.0)
    scene = synthetic.together(synthetic.boulder(600, seed=0), synthetic.boulder(300, seed=1, centre=far))
    views = [*synthetic.ring(6, [WIDE], seed=0, turn_deg=150), *synthetic.ring(4, [WIDE], seed=1, at=far, turn_deg=100)]
    apart = solve(tmp_path, views, scene)
    assert apart.examined.details["parts"] == [6, 4]
    assert apart.examined.verdict.accepted
    assert sorted(apart.model.reg_image_ids()) == [1, 2, 3, 4, 5, 6]


def test_every_rung_is_written_down_with_its_result(tmp_path: Path):
    """A boulder with too few features for any start: all cheap rungs are tried, and none places a photo."""
    views = synthetic.ring(5, [WIDE], seed=0, turn_deg=60)
    weak = solve(tmp_path, views, synthetic.boulder(70, seed=0), Noise(missed=0.1))
    assert [rung["what"] for rung in weak.climbed.attempts] == [
        "default thresholds",
        "start from a smaller baseline",
        "start from low angles",
    ]
    assert all(rung["models"] == [] for rung in weak.climbed.attempts)
    assert weak.examined.model is None


def test_a_photo_that_no_pair_holds_is_placed_by_what_the_model_knows(tmp_path: Path):
    """It has no match with any photo; its place is right, and the rungs list it."""
    views = synthetic.ring(7, [WIDE], seed=0, turn_deg=140)
    weak = solve(tmp_path, views, synthetic.boulder(500, seed=0), pairs=lambda i, j: 3 not in (i, j))
    assert [(rung["what"], rung["models"]) for rung in weak.climbed.attempts] == [
        ("default thresholds", [6]),
        ("remaining photos one by one, from the 3D points they see", [7]),
    ]
    assert [(one["name"], one["refused"]) for one in weak.climbed.attempts[1]["photos"]] == [("00003.jpg", "")]
    assert (weak.examined.verdict.accepted, weak.examined.left_out) == (True, {})
    turned = weak.model.image(4).cam_from_world().rotation * weak.model.image(1).cam_from_world().rotation.inverse()
    truth = synthetic.true_model(views)
    true = truth.image(4).cam_from_world().rotation * truth.image(1).cam_from_world().rotation.inverse()
    assert np.degrees((turned * true.inverse()).angle()) < 0.8


def test_a_fisheye_of_which_nothing_is_known_is_recognised(tmp_path: Path):
    """180 degrees wide, and the mapper starts from a perspective lens; a perspective capture has no such rung."""
    scene = synthetic.together(synthetic.boulder(250, seed=0), synthetic.room(300, seed=1))
    views = synthetic.ring(6, [UNKNOWN_FISHEYE], seed=0, radius=2.0, turn_deg=100)
    synthetic.write_database(tmp_path / "database.db", views, scene, noise=Noise(), seed=0)
    climbed = climb(synthetic.synthetic_job(tmp_path, views, seed=0), lambda *progress: None)
    assert [rung["what"] for rung in climbed.attempts] == ["default thresholds", "start from a fisheye lens"]
    assert climbed.models[0].num_reg_images() == 6
    (camera,) = climbed.models[0].cameras.values()
    assert camera.is_perspective_fisheye()
    assert camera.mean_focal_length() == pytest.approx(UNKNOWN_FISHEYE.params[0], rel=0.02)


def test_a_focal_length_that_exif_tells_wrong_is_left_out(tmp_path: Path):
    """Six times too long, as a stale resolution of the sensor makes it: without it all photos are placed, and right."""
    views = synthetic.ring(8, [WIDE], seed=0, turn_deg=120)
    synthetic.write_database(tmp_path / "database.db", views, synthetic.boulder(700, seed=0), noise=Noise(), seed=0)
    job = synthetic.synthetic_job(tmp_path, views, seed=0)
    groups = tuple(replace(group, focal_px=6 * WIDE.params[0], focal_is_prior=True) for group in job.groups)
    notes: list[str] = []
    job = replace(job, groups=groups)
    register_photos(job)
    match(job, job.pairs, lambda *progress: None)
    climbed = climb(job, lambda *progress: None, notes.append)
    assert [rung["what"] for rung in climbed.attempts] == ["default thresholds", "without EXIF's focal length"]
    assert climbed.attempts[0]["models"] == [] or max(climbed.attempts[0]["models"]) < 4
    assert "next: without EXIF's focal length" in notes
    assert climbed.models[0].num_reg_images() == 8
    (camera,) = climbed.models[0].cameras.values()
    assert camera.mean_focal_length() == pytest.approx(WIDE.params[0], rel=0.02)
    assert not camera.has_prior_focal_length


@pytest.mark.parametrize(
    ("placed", "size", "words"),
    [
        # A missing share of 0.9 is worth 4.5 times the first search, of which the matches take a part.
        (1, 3634, "next: more features from photos of 3634 pixels (takes about 4.5 times as long"),
        (7, 1871, "next: more features from photos of 1871 pixels (takes about 1.5 times as long"),
        (8, None, "default thresholds"),
    ],
)
def test_the_search_of_larger_pictures_is_worth_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, placed: int, size: int | None, words: str
):
    """Ten photos of 20 megapixels: by hand, the full size takes 8.7 times the first search."""
    views = synthetic.ring(10, [WIDE], seed=0, turn_deg=200)
    synthetic.write_database(tmp_path / "database.db", views, synthetic.boulder(600, seed=0), noise=Noise(), seed=0)
    job = synthetic.synthetic_job(tmp_path, views, seed=0)
    groups = tuple(replace(group, width=5184, height=3888) for group in job.groups)
    job = replace(job, groups=groups, max_image_size=1600, max_features=4096)
    model = synthetic.true_model(views)
    for image_id in range(placed + 1, 11):
        model.deregister_frame(model.image(image_id).frame_id)
    searched: list[Job] = []
    notes: list[str] = []
    monkeypatch.setattr(ladder, "extract", lambda job, report: searched.append(job))
    for name in ("match", "start_matching"):
        monkeypatch.setattr(ladder, name, lambda *arguments: None)
    monkeypatch.setattr(ladder, "map_photos", lambda *arguments, **options: [model])
    monkeypatch.setattr(ladder, "localise", lambda model, job, **options: (model, []))
    climb(job, lambda *progress: None, notes.append)
    assert [job.max_image_size for job in searched] == ([] if size is None else [size])
    assert any(note.startswith(words) for note in notes)


def test_pairs_of_perspective_photos_ask_for_no_fisheye(solved: Solved):
    assert as_fisheye(solved.job) is None


def test_sub_models_are_merged_where_they_overlap(solved: Solved, tmp_path: Path):
    """Two models of photos 1...6 and 6...10, the second turned, moved and three times as large, become the whole."""
    first, second = (pycolmap.Reconstruction(solved.model) for _ in range(2))
    for image_id in range(1, 11):
        if image_id > 6:
            first.deregister_frame(first.image(image_id).frame_id)
        if image_id < 6:
            second.deregister_frame(second.image(image_id).frame_id)
    turn = pycolmap.Rotation3d(np.array([0.3, -0.4, 1.2]))
    second.transform(pycolmap.Sim3d(3.0, turn, np.array([5.0, -2.0, 1.0])))
    reports: list[tuple[str, int, int]] = []
    merged = merging.merge_models(
        [first, second],
        solved.job.database,
        output=tmp_path / "merged",
        seed=0,
        threads=1,
        report=lambda *progress: reports.append(progress),
    )
    assert reports == [("merge", 0, 2), ("merge", 1, 2), ("merge", 2, 2)]
    assert [model.num_reg_images() for model in merged] == [10]
    for image_id in range(2, 11):
        poses = [model.image(image_id).cam_from_world() for model in (merged[0], solved.model)]
        relative = [
            pose * model.image(1).cam_from_world().inverse()
            for pose, model in zip(poses, (merged[0], solved.model), strict=True)
        ]
        assert np.degrees((relative[0].rotation * relative[1].rotation.inverse()).angle()) < 0.3


def test_models_with_nothing_in_common_stay_apart(solved: Solved, tmp_path: Path):
    first = pycolmap.Reconstruction(solved.model)
    second = pycolmap.Reconstruction(solved.model)
    for image_id in range(1, 11):
        model = first if image_id > 3 else second
        model.deregister_frame(model.image(image_id).frame_id)
    for point_id in sorted(second.point3D_ids()):
        second.delete_point3D(point_id)
    merged = merging.merge_models([second, first], solved.job.database, output=tmp_path / "m", seed=0, threads=1)
    assert sorted(model.num_reg_images() for model in merged) == [3, 7]


def test_the_bottleneck_is_the_weakest_join_of_the_strongest_chain():
    """By hand: 1-2-3 holds with 5, the direct join with 2; 4 is alone with 5."""
    chains = Bottlenecks([1, 2, 3, 4, 5], [(1, 2, 9.0), (2, 3, 5.0), (1, 3, 2.0), (4, 5, 1.0)])
    assert chains.between(1, 3) == chains.between(3, 1) == 5
    assert chains.between(1, 2) == 9
    assert chains.between(1, 4) == 0
    assert connected_groups([1, 2, 3, 4, 5], [(1, 2), (2, 3), (1, 3), (4, 5)]) == [[1, 2, 3], [4, 5]]
