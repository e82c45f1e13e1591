"""Poses against synthetic truth: right ones are accepted with the right accuracy, wrong ones refused with the reason.

Features and matches are drawn for known cameras (benchmarks/synthetic_captures.py); from the verification of matches on
everything is real.
"""

import shutil
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import synthetic_captures as synthetic
from scipy.spatial.transform import Rotation
from synthetic_captures import LONG, UNKNOWN_FISHEYE, WIDE, Lens, Noise, Scene, View

from nerfcli.cameras.alignment import align
from nerfcli.matching.graph import bottlenecks, connected_groups, consistent_groups
from nerfcli.poses.engine import attempts, mapping, remap
from nerfcli.poses.engine.attempts import map_with_fallbacks
from nerfcli.poses.engine.database import copied, register_photos
from nerfcli.poses.engine.features import match
from nerfcli.poses.engine.initial_lens import detect_fisheyes
from nerfcli.poses.engine.mapping import MappedModels, MapperOptions, map_photos
from nerfcli.poses.engine.remap import ChosenModel, choose_model, extend_accepted, is_contradicted, remap_refused
from nerfcli.poses.input.job import Job
from nerfcli.poses.judge import acceptance
from nerfcli.poses.judge.acceptance import Failure, Verdict, judge
from nerfcli.poses.judge.contradictions import leave_out_contradicting
from nerfcli.poses.judge.examine import ExaminedModel, examine
from nerfcli.poses.judge.parallax import best_rotation_fit
from nerfcli.poses.model import merging
from nerfcli.poses.model.intrinsics import convert_camera
from nerfcli.poses.model.locate import LocationAttempt
from nerfcli.poses.model.two_views import VerifiedPair, agreements, read_verified_pairs, rotation_errors

pytestmark = pytest.mark.usefixtures("_quiet")
PLAUSIBLE = {
    "triangulation_angle_deg": 20.0,
    "share_in_front": 1.0,
    "held_out": {"median_px": 0.5},
    "observations_per_photo": {"median": 500.0},
}


@pytest.fixture(scope="module")
def _quiet() -> None:
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value


@dataclass(frozen=True)
class Solved:
    views: Sequence[View]
    job: Job
    mapped: MappedModels
    examined: ExaminedModel

    @property
    def model(self) -> pycolmap.Reconstruction:
        assert self.examined.model is not None
        return self.examined.model

    @property
    def kinds(self) -> list[str]:
        return [failure.kind for failure in self.examined.verdict.failures]

    @property
    def attempts(self) -> list[tuple[str, list[int]]]:
        return [(attempt["what"], attempt["models"]) for attempt in self.mapped.attempts]


def matched(folder: Path, views: Sequence[View], scene: Scene, noise: Noise = Noise(), **options) -> Job:
    synthetic.write_database(folder / "database.db", views, scene, noise=noise, seed=0, **options)
    return synthetic.synthetic_job(folder, views, seed=0)


def solve(folder: Path, views: Sequence[View], scene: Scene, noise: Noise = Noise(), **options) -> Solved:
    job = matched(folder, views, scene, noise, **options)
    mapped = map_with_fallbacks(job, lambda *progress: None)
    examined = examine(mapped.models, mapped.job, located=mapped.located)
    return Solved(views, job, mapped, examined)


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Solved:
    """Two cameras, a fifth of the matches wrong, three photos in ten unmatched."""
    views = synthetic.ring(10, [WIDE, LONG], seed=0, turn_deg=200)
    return solve(tmp_path_factory.mktemp("right"), views, synthetic.boulder(650, seed=0), Noise(outliers=0.2))


def rotations_off_deg(
    model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction, photos: Sequence[int] = range(2, 11)
) -> list[float]:
    """Return by how many degrees the rotations of photos relative to the first one differ from the truth."""
    return [
        float(np.degrees((found.rotation * true.rotation.inverse()).angle()))
        for found, true in (
            [one.image(photo).cam_from_world() * one.image(1).cam_from_world().inverse() for one in (model, truth)]
            for photo in photos
        )
    ]


def test_a_right_result_is_accepted_and_right(solved: Solved):
    """Synthetic truth: relative rotations within 0.4 degrees, focal lengths within 1 %."""
    assert (solved.examined.verdict.accepted, solved.examined.left_out) == (True, {})
    assert solved.model.num_reg_images() == 10
    truth = synthetic.true_model(solved.views)
    assert max(rotations_off_deg(solved.model, truth)) < 0.4
    for camera_id, camera in solved.model.cameras.items():
        assert camera.mean_focal_length() == pytest.approx(truth.camera(camera_id).mean_focal_length(), rel=0.01)


def test_what_was_measured_on_a_right_result_is_as_it_must_be(solved: Solved):
    measures = solved.examined.verdict.measures
    assert (measures["pairs"]["contradicting"], measures["share_in_front"]) == (0, 1)
    assert (measures["strong_contradictions"], measures["strong_contradictions_share"]) == ([], 0)
    # Half a pixel of noise in each coordinate, and the point's own error: a Rayleigh median of 0.6 px and more.
    assert 0.5 < measures["held_out"]["median_px"] < 1.2
    assert measures["parallax_px"] > 10
    # A ring of radius 3.5 around a ball of radius 1, seen from 2.5 at the nearest.
    assert 0.7 < measures["camera_spread_over_distance"] < 1.5


def test_the_triangulation_angle_is_the_median_of_the_widest_angles_at_points(solved: Solved):
    """Independent: a loop over points and pairs of the photos that see them."""
    model, widest = solved.model, []
    for point in model.points3D.values():
        photos = {element.image_id for element in point.track.elements}
        rays = [model.image(photo).projection_center() - point.xyz for photo in photos]
        cosines = [one @ other / np.linalg.norm(one) / np.linalg.norm(other) for one, other in combinations(rays, 2)]
        widest.append(np.degrees(np.arccos(min(cosines))))
    measures = solved.examined.verdict.measures
    assert measures["triangulation_angle_deg"] == pytest.approx(np.median(widest), rel=1e-9)


def test_every_rotation_of_a_pair_agrees_with_a_right_result(solved: Solved):
    pairs = read_verified_pairs(solved.job.database, min_matches=30)
    errors = rotation_errors(solved.model, pairs)
    assert len(errors) > 15
    assert np.median([error.degrees for error in errors]) < 1
    assert max(error.degrees for error in errors) < 6


def test_a_wrong_result_with_low_residuals_is_refused(solved: Solved):
    """Two parts, each right by itself: the reprojection error is low, but matches between them contradict the poses."""
    wrong = synthetic.bent(solved.model, 6)
    assert wrong.compute_mean_reprojection_error() < 1.05 * solved.model.compute_mean_reprojection_error()
    pairs = read_verified_pairs(solved.job.database, min_matches=15)
    job = replace(solved.job, names=tuple(f"kitchen {number}.jpg" for number in range(10)))
    assert leave_out_contradicting(wrong, pairs, job.name_of) == (wrong, {})
    verdict = judge(wrong, pairs, job)
    assert verdict.failures[0].kind == "the poses contradict the strongest matches"
    assert "verified matches between kitchen " in verdict.failures[0].evidence
    assert {verdict.measures["strong_contradictions"][0][end] for end in ("one", "other")} < set(job.names)


def job_again(solved: Solved, folder: Path) -> Job:
    """Return the job in a copy of its folder, without the models of its mapper."""
    shutil.copytree(solved.job.database.parent, folder)
    (folder / "work" / "models_0.json").unlink(missing_ok=True)
    return replace(solved.job, folder=str(folder / "work"))


def wrongly_mapped(solved: Solved, folder: Path) -> MappedModels:
    """The whole capture with photos 8, 9 and 10 in a wrong place, as a misled mapper leaves it."""
    attempts = [{"what": "default thresholds", "models": [10]}]
    return MappedModels([synthetic.bent(solved.model, 8)], job_again(solved, folder), attempts, seconds=1000.0)


def remapped(wrong: MappedModels, refused: ExaminedModel) -> tuple[ChosenModel, list[str]]:
    """Return what is accepted instead of a refused model, and the messages for the user."""
    notes: list[str] = []
    chosen = remap_refused(ChosenModel(wrong, refused), lambda *progress: None, notes.append)
    assert chosen.examined.verdict.accepted
    return chosen, notes


@pytest.fixture(scope="module")
def refused(solved: Solved, tmp_path_factory: pytest.TempPathFactory) -> ExaminedModel:
    """What the checks say of `wrongly_mapped`."""
    wrong = wrongly_mapped(solved, tmp_path_factory.mktemp("wrong") / "again")
    return examine(wrong.models, wrong.job)


def test_a_contradicted_model_is_mapped_from_its_sound_part(solved: Solved, refused: ExaminedModel, tmp_path: Path):
    """Synthetic truth: the three photos that were off by 40 degrees come out within 0.4 degrees."""
    assert is_contradicted(refused.verdict)
    chosen, notes = remapped(wrongly_mapped(solved, tmp_path / "again"), refused)
    assert chosen.examined.model is not None
    assert [attempt["models"] for attempt in chosen.mapped.attempts] == [[10], [10]]
    assert notes[0].endswith("mapping again, for at most 33 min")
    assert notes[-1] == "from the largest consistent part: 10 of 10 photos registered, accepted"
    assert max(rotations_off_deg(chosen.examined.model, synthetic.true_model(solved.views))) < 0.4


def without(model: pycolmap.Reconstruction, *photos: int, tear_down: bool = True) -> pycolmap.Reconstruction:
    """Return a copy of a model without some photos."""
    rest = pycolmap.Reconstruction(model)
    for image_id in photos:
        rest.deregister_frame(rest.image(image_id).frame_id)
    if tear_down:
        rest.tear_down()
    return rest


def in_two_parts(solved: Solved, tmp_path: Path) -> MappedModels:
    """Return a right model in two parts, of seven and four photos, in a folder of its own."""
    parts = [without(solved.model, 8, 9, 10), without(solved.model, *range(1, 7))]
    attempts = [{"what": "default thresholds", "models": [7, 4]}]
    return MappedModels(parts, job_again(solved, tmp_path / "again"), attempts, seconds=1000.0)


def sizes_of(chosen: ChosenModel) -> list[int]:
    """Return the numbers of photos of a chosen model, which is accepted, and of the others."""
    assert chosen.examined.verdict.accepted
    return [model.num_reg_images() for model in chosen.mapped.models]


def test_an_accepted_model_takes_in_the_photos_of_a_smaller_one(
    solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Synthetic truth: of a right model in two parts, the larger takes in the three photos of the smaller one.

    Photo 7 counts as located from points before and after.
    """
    mapped = replace(in_two_parts(solved, tmp_path), located=(7,))
    examined: list[Sequence[int]] = []

    def noted(*arguments, located: Sequence[int], **options) -> ExaminedModel:
        examined.append(located)
        return examine(*arguments, located=located, **options)

    monkeypatch.setattr(remap, "examine", noted)
    for _ in range(2):  # the second time, from what was kept
        notes: list[str] = []
        found = choose_model(mapped, lambda *progress: None, notes.append)
        assert sizes_of(found) == [10]
        assert found.examined.model is not None
        assert max(rotations_off_deg(found.examined.model, synthetic.true_model(solved.views))) < 0.4
        assert notes == [
            "3 photos in smaller models, next: from the accepted model (about 5 min)",
            "from the accepted model: 10 of 10 photos registered, accepted",
        ]
    assert examined == [(7,)] * 4


def test_an_accepted_model_grows_with_the_lens_that_was_chosen_for_it(solved: Solved, tmp_path: Path):
    """The mapper began with SIMPLE_RADIAL; the checks chose OPENCV."""
    mapped = in_two_parts(solved, tmp_path)
    first = examine(mapped.models[:1], mapped.job)
    assert first.model is not None
    camera = first.model.cameras[1]
    richer = convert_camera(camera, "OPENCV")
    camera.model, camera.params = richer.model, richer.params.tolist()
    notes: list[str] = []
    found = extend_accepted(ChosenModel(mapped, first), lambda *progress: None, notes.append)
    assert notes[-1] == "from the accepted model: 10 of 10 photos registered, accepted"
    assert sizes_of(found) == [10]


@pytest.mark.parametrize("grown", ["wrong", "same"])
def test_a_model_that_grows_into_a_wrong_one_or_not_at_all_stays_as_it_was(
    solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, grown: str
):
    """One that takes in no further photo is not checked again."""
    mapped = in_two_parts(solved, tmp_path)
    result = synthetic.bent(solved.model, 8) if grown == "wrong" else pycolmap.Reconstruction(mapped.models[0])
    monkeypatch.setattr(remap, "map_photos", lambda *_, **__: [result])
    examined = iter([examine] * (2 if grown == "wrong" else 1))
    monkeypatch.setattr(remap, "examine", lambda *arguments, **options: next(examined)(*arguments, **options))
    notes: list[str] = []
    found = choose_model(mapped, lambda *progress: None, notes.append)
    assert sizes_of(found) == [7, 4]
    if grown == "wrong":
        assert notes[-1].startswith("from the accepted model: 10 of 10 photos registered, the poses contradict")
        assert [attempt["models"] for attempt in found.mapped.attempts] == [[7, 4], [10]]
    else:
        assert notes[-1] == "from the accepted model: no further photo registered"


def test_nothing_is_mapped_again_where_the_camera_only_turned():
    """If rotations explain the matches to 2 px, the capture is at fault; at 20 px, the model is."""
    contradicted = Failure("the poses contradict pairs of photos", "40 % of the matches ...", "take more photos")
    for parallax_px, again in ((2.0, False), (20.0, True), (None, True)):
        assert is_contradicted(Verdict({"parallax_px": parallax_px}, (contradicted,))) == again


@pytest.mark.parametrize(("failing", "placed"), [(1, 10), (2, 10), (3, 7)])
def test_each_way_stands_in_for_the_one_before(
    solved: Solved, refused: ExaminedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int, placed: int
):
    """The first one, two or all three that map again give nothing; the last one keeps the consistent part."""
    for name in ("_extend_part", "_map_globally", "_map_from_scratch")[:failing]:
        monkeypatch.setattr(remap, name, lambda *arguments: [])
    chosen, _ = remapped(wrongly_mapped(solved, tmp_path / "again"), refused)
    assert [attempt["models"] for attempt in chosen.mapped.attempts] == [[10], [placed]]


def test_mapping_again_is_bounded_in_time_and_says_what_contradicts_where_no_pair_does(
    solved: Solved, refused: ExaminedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Nothing is mapped again where there is no time for it; the sound part alone costs only its checks."""
    monkeypatch.setattr(remap, "_LEAST_SECONDS", 0.0)
    wrong = replace(wrongly_mapped(solved, tmp_path / "again"), seconds=0.0)
    evidence = "40 % of the matches are in pairs whose relative rotation differs"
    verdict = Verdict({"pairs": {"judged": 15, "contradicting": 0}}, (Failure("contradict", evidence, "more photos"),))
    chosen, notes = remapped(wrong, replace(refused, verdict=verdict))
    assert notes[0] == f"{evidence}: mapping again, for at most 0 s"
    assert sum(note.endswith(": skipped, since no time is left") for note in notes) == 4
    assert "from scratch, with other initial pairs: skipped, since no time is left" in notes
    assert sizes_of(chosen) == [7]


def test_a_way_is_skipped_that_takes_longer_than_what_is_left(
    solved: Solved, refused: ExaminedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Of 200 s, the first two take 130: mapping from scratch (100 s as before) does not fit; the sound part does."""
    wrong = replace(wrongly_mapped(solved, tmp_path / "again"), seconds=100.0)
    now = [0.0]

    def late(*arguments) -> list[pycolmap.Reconstruction]:
        now[0] += 65.0
        return []

    monkeypatch.setattr(remap.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(remap, "_extend_part", late)
    monkeypatch.setattr(remap, "_map_globally", late)
    chosen, notes = remapped(wrong, refused)
    assert "next: from the largest consistent part (about 30 s)" in notes
    assert "from scratch, with other initial pairs: skipped, since it takes about 2 min, and 70 s are left" in notes
    assert chosen.mapped.attempts[-1]["what"] == "only the largest consistent part of the first model"
    assert chosen.mapped.attempts[-1]["doubt"].startswith("photos of sides that look alike")


def test_of_many_photos_a_few_are_not_worth_another_mapping_from_scratch(
    solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Eight of ten are placed: attempts that continue from them are made, attempts from scratch are not."""
    job = job_again(solved, tmp_path / "again")
    real = attempts.map_photos

    def without_two(*arguments, **options) -> list[pycolmap.Reconstruction]:
        models = real(*arguments, **options)
        for photo in {9, 10} & set(models[0].reg_image_ids()):
            models[0].deregister_frame(models[0].image(photo).frame_id)
        return models

    monkeypatch.setattr(attempts, "map_photos", without_two)
    monkeypatch.setattr(attempts, "locate_photos", lambda model, job, **options: (model, []))
    monkeypatch.setattr(attempts, "_MANY_PHOTOS", 10)
    notes: list[str] = []
    mapped = map_with_fallbacks(job, lambda *progress: None, notes.append)
    located = "remaining photos one by one, from the 3D points they see"
    assert [attempt["what"] for attempt in mapped.attempts][:3] == ["default thresholds", located, "lower angles"]
    assert not any("start from" in attempt["what"] for attempt in mapped.attempts)
    # By the plan, 10 photos take 0.09 + 10 * 0.0005 s each.
    assert "not trying other starts, which take about 1 s each: most photos are registered" in notes


def test_the_mapper_counts_the_photos_that_it_goes_on_from(solved: Solved, tmp_path: Path):
    job, base = job_again(solved, tmp_path / "again"), without(solved.model, 9, 10)
    reports: list[tuple[object, ...]] = []
    map_photos(job, lambda *report: reports.append(report), attempt=7, start=MapperOptions(), base=base)
    assert reports == [("map", 8, 10), ("map", 9, 10), ("map", 10, 10)]


def test_a_run_of_the_mapper_ends_if_no_photo_follows(solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The plan's time for all photos, two minutes at least; those in the last snapshot are kept."""
    assert [mapping.stall_seconds(photos) for photos in (10, 1000)] == [120, pytest.approx(590)]
    monkeypatch.setattr(mapping, "stall_seconds", lambda photos: 0.0)
    monkeypatch.setattr(attempts, "map_from_other_starts", lambda *arguments: None)
    hangs = threading.Event()

    def report(stage: str, done: int, total: int) -> None:
        if stage == "map" and done == 8 and not hangs.is_set():
            hangs.set()
            time.sleep(1.5)

    notes: list[str] = []
    mapped = map_with_fallbacks(job_again(solved, tmp_path / "again"), report, notes.append)
    stopped = "default thresholds: stopped after 0 s without another photo; only its largest snapshot is kept"
    assert (mapped.attempts[0]["models"], mapped.cut_short[0], notes[0]) == ([8], stopped, f"cut short: {stopped}")


def test_a_slow_run_of_the_mapper_is_not_ended_while_photos_follow(
    solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def slow(*arguments, cancellation_token, next_image_callback, **options) -> dict[int, pycolmap.Reconstruction]:
        for _ in range(5):
            time.sleep(0.5)
            next_image_callback()
        assert not cancellation_token.is_cancelled
        return {}

    monkeypatch.setattr(mapping.pycolmap, "incremental_mapping", slow)
    monkeypatch.setattr(mapping, "stall_seconds", lambda photos: 1.4)
    map_photos(job_again(solved, tmp_path / "again"), lambda *progress: None, attempt=0, start=MapperOptions())


def test_the_mapper_goes_on_from_its_last_snapshot(solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Interrupted at the eighth of ten photos; the last snapshot was not written to its end."""
    monkeypatch.setattr(mapping, "_MANY_PHOTOS", 10)
    job, counts = job_again(solved, tmp_path / "again"), list[int]()

    def report(stage: str, done: int, total: int) -> None:
        counts.append(done)
        if done == 8 and 7 in counts:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        map_photos(job, report, attempt=0, start=MapperOptions())
    assert counts == [2, 3, 4, 5, 6, 7, 8]
    snapshots = sorted(Path(job.folder).glob("models_0_snapshots/*/*"))
    (snapshots[-1].with_name("9" * 20)).mkdir()
    counts.clear()
    [model] = map_photos(job, report, attempt=0, start=MapperOptions())
    assert (counts, model.num_reg_images()) == ([8, 9, 10], 10)
    assert not list(Path(job.folder).glob("models_0_snapshots"))


def test_groups_hold_together_against_what_speaks_against_them():
    """By hand: two strong pairs stay apart, although one join between them is positive."""
    joins = [(1, 2, 9.0), (3, 4, 9.0), (2, 3, 5.0), (1, 4, -6.0), (5, 1, -1.0)]
    assert consistent_groups([1, 2, 3, 4, 5], joins) == [[1, 2], [3, 4], [5]]
    assert consistent_groups([4, 3, 2, 1], [(1, 2, 9.0), (3, 4, 9.0), (2, 3, 7.0), (1, 4, -6.0)]) == [[4, 3, 2, 1]]
    many_weak = [(1, 2, 9.0), (3, 4, 9.0), (1, 4, -6.0), *((one, other, 5.0) for one in (1, 2) for other in (3, 4))]
    assert consistent_groups([1, 2, 3, 4], many_weak) == [[1, 2], [3, 4]]
    assert consistent_groups([], []) == []


def test_one_photo_that_contradicts_is_left_out(solved: Solved):
    """A tenth of the photos; the others are accepted."""
    wrong = synthetic.bent(solved.model, 10)
    pairs = read_verified_pairs(solved.job.database, min_matches=15)
    names = {image_id: f"kitchen {image_id}.jpg" for image_id in range(11)}
    rest, left_out = leave_out_contradicting(wrong, pairs, names)
    assert set(left_out) == {10}
    assert left_out[10].startswith("contradicts the rest: its ")
    assert "matches with kitchen " in left_out[10]
    assert rest.num_reg_images() == 9
    assert judge(rest, pairs, solved.job).accepted


def test_a_photo_far_from_all_others_is_left_out(solved: Solved):
    wrong = pycolmap.Reconstruction(solved.model)
    frame = wrong.frame(wrong.image(10).frame_id)
    pose = wrong.image(10).cam_from_world()
    frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0.0, 0.0, 300.0]))
    pairs = read_verified_pairs(solved.job.database, min_matches=15)
    rest, left_out = leave_out_contradicting(wrong, pairs, solved.job.name_of)
    assert rest.num_reg_images() == 9
    assert "times as far away as the other cameras" in left_out[10]


def common_pixels(views: Sequence[View], points: np.ndarray, *, noise_px: float) -> list[VerifiedPair]:
    """Return all pairs of views, each matched at those of the points (n, 3) that both see."""
    rng = np.random.default_rng(0)
    found = []
    for number, view in enumerate(views):
        local = points @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
        camera = synthetic.true_model([view]).camera(1)
        pixels = np.asarray(camera.img_from_cam(local)) + rng.normal(scale=noise_px, size=(len(points), 2))
        inside = (local[:, 2] > 0) & ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        found.append((number + 1, pixels, inside))
    return [
        VerifiedPair(one, other, pixels[inside & also], others[inside & also])
        for index, (one, pixels, inside) in enumerate(found)
        for other, others, also in found[index + 1 :]
    ]


def side_by_side(count: int) -> list[View]:
    """Cameras at steps of 0.05 along x, looking along +y."""
    centres = [np.array([0.05 * number, 0.0, 0.0]) for number in range(count)]
    return [View(WIDE, synthetic.looking_at(centre, centre + np.array([0.0, 1.0, 0.0]))) for centre in centres]


def test_points_far_away_agree_whichever_side_noise_makes_their_rays_meet():
    """Synthetic truth: a parallax of 0.4 px and a noise of 0.5 px; a camera turned by 3 degrees is contradicted."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-40, 40, 400), rng.uniform(90, 110, 400), rng.uniform(-30, 30, 400)])
    views = side_by_side(2)
    (pair,) = common_pixels(views, points, noise_px=0.5)
    (agreement,) = agreements(synthetic.true_model(views), [pair])
    assert agreement.matches > 300
    assert agreement.fraction == 1
    turned = Rotation.from_euler("x", 3, degrees=True).as_matrix() @ views[1].cam_from_world
    (agreement,) = agreements(synthetic.true_model([views[0], View(WIDE, turned)]), [pair])
    assert agreement.contradicts


def test_a_photo_from_much_farther_away_stays_if_its_matches_determine_its_place():
    """Synthetic truth: seven photos within 0.3 of a rugged wall at a distance of 2, and one from a distance of 9."""
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-1, 1, 300), rng.uniform(1.5, 2.5, 300), rng.uniform(-0.7, 0.7, 300)])
    back = np.array([0.15, -7.0, 0.3])
    views = [*side_by_side(7), View(WIDE, synthetic.looking_at(back, back + np.array([0.0, 1.0, 0.0])))]
    pairs, names = common_pixels(views, points, noise_px=0.5), dict(enumerate("abcdefgh", start=1))
    assert leave_out_contradicting(synthetic.true_model(views), pairs, names)[1] == {}
    # A sky says nothing about where it is seen from.
    sky = points * 1e4
    held_by_sky = [*common_pixels(views[:-1], points, noise_px=0.5), *common_pixels(views, sky, noise_px=0.5)]
    assert list(leave_out_contradicting(synthetic.true_model(views), held_by_sky, names)[1]) == [8]


def test_a_scene_that_repeats_itself_is_recognised(tmp_path: Path):
    """A body whose back looks like its front. The mapper places every photo at half a pixel, half of them wrong."""
    folded = solve(tmp_path, synthetic.ring(12, [WIDE], seed=0), synthetic.twofold(600, seed=0))
    assert folded.model.num_reg_images() == 12
    assert folded.model.compute_mean_reprojection_error() < 0.8
    assert folded.kinds == ["parts of the scene look alike (repeated structure)"]


def test_a_photo_placed_by_points_is_judged_with_what_holds_it(solved: Solved):
    """Photo 10 has a mistaken pair of 20 matches, which refuses the model unless the pairs that hold it count."""
    pairs = read_verified_pairs(solved.job.database, min_matches=15)
    held = [pair for pair in pairs if pair.other == 10]
    rest = [pair for pair in pairs if pair.other != 10]
    strongest = max(held, key=lambda pair: pair.matches)
    shifted = np.roll(strongest.pixels_other, 7, axis=0)[:20]
    evidence = [*rest, VerifiedPair(strongest.one, 10, strongest.pixels_one[:20], shifted)]
    assert not judge(solved.model, evidence, solved.job).accepted
    assert judge(solved.model, evidence, solved.job, held=held).accepted


def test_a_camera_that_only_turns_is_recognised(tmp_path: Path):
    """A rotation with the true focal length fits all matches."""
    views = synthetic.panorama(6, WIDE, turn_deg=120)
    still = solve(tmp_path, views, synthetic.room(900, seed=0))
    assert still.kinds[0] == "no baseline (pure rotation)"
    assert len(still.attempts) == 1  # no other can help
    pairs = read_verified_pairs(still.job.database, min_matches=30)
    turn = best_rotation_fit(pairs, dict.fromkeys(still.job.image_ids, (WIDE.width, WIDE.height)))
    assert turn is not None
    assert turn.parallax_px < 1.5
    assert turn.focal_px == pytest.approx(WIDE.params[0], rel=0.03)
    assert not turn.stands_still


def test_a_camera_that_does_not_move_is_told_from_one_that_turns(solved: Solved):
    """As on a tripod before something that turns and has few features: only the background's matches are verified."""
    rng = np.random.default_rng(0)
    places, noise = rng.uniform(0, 700, (4, 200, 2)), rng.normal(0, 0.3, (4, 200, 2))
    pairs = [
        VerifiedPair(one, one + 1, place, place + off)
        for one, (place, off) in enumerate(zip(places, noise, strict=True), 1)
    ]
    turn = best_rotation_fit(pairs, dict.fromkeys(range(1, 6), (WIDE.width, WIDE.height)))
    assert turn is not None
    assert turn.stands_still
    assert turn.moved_px == pytest.approx(0.3 * np.sqrt(2 * np.log(2)), rel=0.1)  # median of a Rayleigh distribution
    verdict = judge(
        solved.model,
        read_verified_pairs(solved.job.database, min_matches=30),
        solved.job,
        turn=replace(turn, parallax_px=0),
    )
    failure = next(failure for failure in verdict.failures if failure.kind == "no baseline (pure rotation)")
    assert failure.evidence == "the camera stands still: matches are at the same place in all photos, to 0.4 px"
    assert "give --masks" in failure.advice


def test_turning_on_the_spot_with_an_off_centre_lens_is_recognised(tmp_path: Path):
    """The mapper's lens model is too simple, and made-up depth compensates for it: points fit to half a pixel, with a
    focal length 40 % too long. A rotation with two radial terms and a principal point fits as well.
    """
    lens = Lens("OPENCV", 1000, 750, (800.0, 805.0, 512.0, 370.0, -0.2, 0.08, 0.001, -0.002))
    views = synthetic.panorama(12, lens, turn_deg=120)
    still = solve(tmp_path, views, synthetic.room(2500, seed=0), Noise(features_px=0.25))
    measures = still.examined.verdict.measures
    assert still.model.num_reg_images() == 12
    assert measures["triangulation_angle_deg"] > 10
    assert still.model.camera(1).mean_focal_length() > 1.4 * 802.5
    assert measures["parallax_px"] < 1.5 * measures["held_out"]["median_px"]
    assert still.kinds == ["no baseline (pure rotation)"]


def test_parallax_of_a_few_pixels_is_accepted_if_points_explain_it(tmp_path: Path):
    """640 x 360 pixels, cameras 0.17 apart in a room of 8 x 8: rotations fit to 3 px, points to 0.4."""
    lens = Lens("SIMPLE_RADIAL", 640, 360, (556.0, 320.0, 180.0, -0.03))
    steps = np.random.default_rng(0).normal(scale=0.1, size=(12, 3))
    turned = synthetic.panorama(12, lens, turn_deg=120)
    views = [
        View(lens, view.cam_from_world + np.column_stack([np.zeros((3, 3)), step]))
        for view, step in zip(turned, steps, strict=True)
    ]
    moved = solve(tmp_path, views, synthetic.room(2500, seed=0), Noise(features_px=0.25))
    assert moved.kinds == []
    assert moved.examined.verdict.measures["parallax_px"] < 3
    found = np.array([moved.model.image(number).projection_center() for number in range(1, 13)])
    true = np.array([view.centre for view in views])
    missed = align(found, true).apply(found) - true
    assert np.sqrt(np.square(missed).sum(1).mean()) < 0.05 * np.sqrt(np.square(steps).sum(1).mean())


def test_parts_that_share_nothing_are_reported_separately(tmp_path: Path):
    far = (40.0, 0.0, 0.0)
    scene = synthetic.together(synthetic.boulder(600, seed=0), synthetic.boulder(300, seed=1, centre=far))
    views = [*synthetic.ring(6, [WIDE], seed=0, turn_deg=150), *synthetic.ring(4, [WIDE], seed=1, at=far, turn_deg=100)]
    apart = solve(tmp_path, views, scene)
    assert apart.examined.details["parts"] == [6, 4]
    assert apart.examined.verdict.accepted
    assert sorted(apart.model.reg_image_ids()) == [1, 2, 3, 4, 5, 6]


def test_every_attempt_is_written_down_with_its_result(tmp_path: Path):
    """A boulder with too few features for any start: all cheap attempts are tried, and none places a photo."""
    views = synthetic.ring(5, [WIDE], seed=0, turn_deg=60)
    weak = solve(tmp_path, views, synthetic.boulder(70, seed=0), Noise(missed=0.1))
    tried = ("default thresholds", "start from a smaller baseline", "start from low angles")
    assert weak.attempts == [(what, []) for what in tried]
    assert weak.examined.model is None


def test_a_photo_without_verified_pairs_is_placed_by_the_points_of_the_model(tmp_path: Path):
    """It has no match with any photo; its pose is right, and the list of attempts names it."""
    views = synthetic.ring(7, [WIDE], seed=0, turn_deg=140)
    weak = solve(tmp_path, views, synthetic.boulder(500, seed=0), pairs=lambda i, j: 3 not in (i, j))
    assert weak.attempts == [
        ("default thresholds", [6]),
        ("remaining photos one by one, from the 3D points they see", [7]),
    ]
    assert [(one["name"], one["refused"]) for one in weak.mapped.attempts[1]["photos"]] == [("00003.jpg", "")]
    assert (weak.examined.verdict.accepted, weak.examined.left_out) == (True, {})
    assert max(rotations_off_deg(weak.model, synthetic.true_model(views), photos=[4])) < 0.8


def test_a_fisheye_without_metadata_is_recognized(tmp_path: Path):
    """180 degrees wide, and the mapper starts from a perspective lens; a perspective capture has no such attempt."""
    scene = synthetic.together(synthetic.boulder(250, seed=0), synthetic.room(300, seed=1))
    views = synthetic.ring(6, [UNKNOWN_FISHEYE], seed=0, radius=2.0, turn_deg=100)
    mapped = map_with_fallbacks(matched(tmp_path, views, scene), lambda *progress: None)
    assert [attempt["what"] for attempt in mapped.attempts] == ["default thresholds", "start from a fisheye lens"]
    assert mapped.models[0].num_reg_images() == 6
    (camera,) = mapped.models[0].cameras.values()
    assert camera.is_perspective_fisheye()
    assert camera.mean_focal_length() == pytest.approx(UNKNOWN_FISHEYE.params[0], rel=0.02)


def with_exif(folder: Path, views: Sequence[View], *, focal_px: float) -> Job:
    """Return the job of photos of a boulder, verified with a focal length from EXIF."""
    job = matched(folder, views, synthetic.boulder(700, seed=0))
    job = replace(job, groups=tuple(replace(g, focal_px=focal_px, focal_is_prior=True) for g in job.groups))
    register_photos(job)
    match(job, job.pairs, lambda *progress: None)
    return job


def test_a_wrong_focal_length_in_exif_is_ignored(tmp_path: Path):
    """EXIF's is six times too long, as by a stale sensor resolution; without it, all photos are placed correctly."""
    notes: list[str] = []
    job = with_exif(tmp_path, synthetic.ring(8, [WIDE], seed=0, turn_deg=120), focal_px=6 * WIDE.params[0])
    mapped = map_with_fallbacks(job, lambda *progress: None, notes.append)
    assert [attempt["what"] for attempt in mapped.attempts] == ["default thresholds", "without EXIF's focal length"]
    assert mapped.attempts[0]["models"] == [] or max(mapped.attempts[0]["models"]) < 4
    assert "next: without EXIF's focal length" in notes
    assert notes[-1].startswith("EXIF's focal length (4800 px) was not used, since few photos registered with it; the ")
    assert notes[-1].endswith(" px: if EXIF is right, give --intrinsics")
    assert mapped.models[0].num_reg_images() == 8
    (camera,) = mapped.models[0].cameras.values()
    assert camera.mean_focal_length() == pytest.approx(WIDE.params[0], rel=0.02)
    assert not camera.has_prior_focal_length


def test_a_camera_whose_photos_are_not_registered_is_no_error(tmp_path: Path):
    """EXIF's focal lengths are 20 and 10 times too long, and all photos of the second camera show something else."""
    views = synthetic.ring(8, [WIDE], seed=0, turn_deg=120)
    views += synthetic.turned_away([View(LONG, view.cam_from_world) for view in views[:2]])
    job = with_exif(tmp_path, views, focal_px=20 * WIDE.params[0])
    notes: list[str] = []
    mapped = map_with_fallbacks(job, lambda *progress: None, notes.append)
    assert len(job.groups) == 2
    assert list(mapped.models[0].cameras) == [1]
    assert sum("was not used" in note for note in notes) == 1


@pytest.fixture
def used(monkeypatch: pytest.MonkeyPatch) -> list[pycolmap.IncrementalPipelineOptions]:
    """The options with which a mapper is run that gives no model."""
    found: list[pycolmap.IncrementalPipelineOptions] = []
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *_, options, **others: found.append(options) or {})
    return found


def test_a_given_initial_pair_is_tried_once(solved: Solved, tmp_path: Path, used):
    """pycolmap tries an unsuitable one again 200 times at each of five thresholds, with the same result."""
    job = job_again(solved, tmp_path / "again")
    for number, start in enumerate((MapperOptions(init_pair=(1, 2)), MapperOptions())):
        map_photos(job, lambda *progress: None, attempt=50 + number, start=start)
    assert [options.init_num_trials for options in used] == [1, 200]


@pytest.mark.parametrize(
    ("attempt", "many", "dense", "rough", "growth"),
    [(0, 100, 3000, True, 1.1), (1, 100, 3000, False, 1.1), (1, 10, 3000, True, 1.1), (0, 100, 0, True, 1.3)],
)
def test_first_attempts_and_those_of_many_photos_are_rough(
    solved: Solved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, used, attempt, many, dense, rough, growth
):
    """Ten photos; global adjustments are fewer where photos have more matches than `dense`."""
    monkeypatch.setattr(mapping, "_MANY_PHOTOS", many)
    monkeypatch.setattr(mapping, "_DENSE", dense)
    map_photos(job_again(solved, tmp_path / "again"), lambda *progress: None, attempt=attempt, start=MapperOptions())
    assert used[0].mapper.ba_global_ignore_redundant_points3D == rough
    assert used[0].ba_local_max_num_iterations == (10 if rough else -1)
    assert used[0].ba_global_frames_ratio == used[0].ba_global_points_ratio == growth


@pytest.mark.parametrize(
    ("placed", "features", "halved_from", "size", "words"),
    [
        # A missing fraction of 0.9 is worth 4.5 times the first search: more than the largest pictures take.
        (1, 4096, 0, 3200, "next: more features from pictures of 3200 pixels (takes about 3.8 times as long"),
        (7, 4096, 0, 1723, "next: more features from pictures of 1723 pixels (takes about 1.5 times as long"),
        (7, 2048, 4096, 1723, "next: more features from pictures of 1723 pixels (takes about 1.7 times as long"),
        (7, 2048, 0, 1600, "next: more features from pictures of 1600 pixels (takes about 1.5 times as long"),
        (8, 4096, 0, None, "default thresholds"),
    ],
)
def test_the_search_of_larger_pictures_is_worth_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, placed, features, halved_from, size, words
):
    """Ten photos of 20 megapixels: by hand, 3,200 pixels take 3.8 times the first search for 4,096 features."""
    views = synthetic.ring(10, [WIDE], seed=0, turn_deg=200)
    job = matched(tmp_path, views, synthetic.boulder(400, seed=0))
    groups = tuple(replace(group, width=5184, height=3888) for group in job.groups)
    job = replace(job, groups=groups, max_image_size=1600, max_features=features, halved_from=halved_from)
    model = without(synthetic.true_model(views), *range(placed + 1, 11), tear_down=False)
    searched: list[Job] = []
    notes: list[str] = []
    monkeypatch.setattr(attempts, "extract", lambda job, report: searched.append(job))
    for name in ("match", "start_matching"):
        monkeypatch.setattr(attempts, name, lambda *arguments: None)
    monkeypatch.setattr(attempts, "map_photos", lambda *arguments, **options: [model])
    monkeypatch.setattr(attempts, "locate_photos", lambda model, job, **options: (model, []))
    map_with_fallbacks(job, lambda *progress: None, notes.append)
    assert [job.max_image_size for job in searched] == ([] if size is None else [size])
    assert any(note.startswith(words) for note in notes)


def test_single_photos_are_located_before_costlier_attempts(solved: Solved, monkeypatch: pytest.MonkeyPatch):
    """Eight of ten photos are mapped. With the other two located, nothing else is tried; without, much is."""
    model = without(solved.model, 9, 10, tear_down=False)
    monkeypatch.setattr(attempts, "map_photos", lambda *arguments, **options: [model])
    tried = {}
    for grown in (solved.model, model):
        placed = [LocationAttempt(i, refused="" if grown is solved.model else "too few votes") for i in (9, 10)]
        monkeypatch.setattr(
            attempts, "locate_photos", lambda *arguments, grown=grown, placed=placed, **o: (grown, placed)
        )
        found = map_with_fallbacks(solved.job, lambda *progress: None)
        tried[found.models[0].num_reg_images()] = [attempt["what"] for attempt in found.attempts]
    one_by_one = "remaining photos one by one, from the 3D points they see"
    assert tried[10] == ["default thresholds", one_by_one]
    assert len(tried[8]) > 3
    assert tried[8][:2] == tried[10]
    assert tried[8].count(one_by_one) == 1  # not again from the same points


def test_a_model_that_grows_knows_the_photos_that_its_points_placed(solved: Solved, monkeypatch: pytest.MonkeyPatch):
    """Photo 8 was located before, photo 9 now; then the mapper adds photo 10, and loses photo 8."""
    tried = attempts.MappingAttempts(solved.job, lambda *progress: None, lambda note: None)
    tried.take("first", [without(solved.model, 9, 10, tear_down=False)], solved.job, located=(8,))
    found = without(solved.model, 10, tear_down=False), [LocationAttempt(9), LocationAttempt(10, refused="why")]
    monkeypatch.setattr(attempts, "locate_photos", lambda model, job, **options: found)
    attempts.locate_single_photos(tried)
    monkeypatch.setattr(attempts, "map_photos", lambda *arguments, **options: [solved.model])
    tried.extend("lower angles", attempts.LOW_ANGLES)
    assert (tried.best.models, tried.best.located) == ([solved.model], (8, 9))
    left = examine([without(solved.model, 8)], solved.job, located=tried.best.located)
    assert left.details["not_computed"] == {}


def test_a_copy_of_the_database_is_removed_whatever_happens(solved: Solved, tmp_path: Path):
    job = job_again(solved, tmp_path / "again")

    def interrupted() -> None:
        with copied(job, "remapped") as copy:
            copy.database.with_name("remapped.db-wal").write_bytes(b"a log")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not list(Path(job.folder).glob("remapped.db*"))


def test_pairs_of_perspective_photos_ask_for_no_fisheye(solved: Solved):
    assert detect_fisheyes(solved.job) is None


def test_sub_models_are_merged_where_they_overlap(solved: Solved):
    """Two models of photos 1...6 and 6...10, the second turned, moved and three times as large, become the whole."""
    first, second = (without(solved.model, *left, tear_down=False) for left in (range(7, 11), range(1, 6)))
    turn = pycolmap.Rotation3d(np.array([0.3, -0.4, 1.2]))
    second.transform(pycolmap.Sim3d(3.0, turn, np.array([5.0, -2.0, 1.0])))
    reports: list[tuple[object, ...]] = []
    merged = merging.merge_models([first, second], solved.job, report=lambda *report: reports.append(report))
    assert reports == [("merge", 0, 2), ("merge", 1, 2), ("merge", 2, 2)]
    assert [model.num_reg_images() for model in merged] == [10]
    assert max(rotations_off_deg(merged[0], solved.model)) < 0.3


def test_a_model_that_the_matches_contradict_is_left_out_when_several_are_joined(solved: Solved):
    """Photos 7 and 8 in the right place, 9 and 10 moved by the radius of the ring: only the former are added."""
    base, right, wrong = (
        without(solved.model, *{*range(1, 11)}.difference(kept), tear_down=False)
        for kept in (range(1, 7), (7, 8), (9, 10))
    )
    radius = np.linalg.norm(base.image(1).projection_center())
    shift = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([0.0, 0.0, radius]))
    given = [(wrong, shift), (right, pycolmap.Sim3d())]
    with pycolmap.Database.open(solved.job.database) as database:
        cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions(min_num_matches=15))
    pairs = read_verified_pairs(solved.job.database, min_matches=1)
    joined, taken = merging._join(base, given, job=solved.job, cache=cache, pairs=pairs)
    assert taken == given[1:]
    assert sorted(joined.reg_image_ids()) == list(range(1, 9))


def test_models_with_nothing_in_common_stay_apart(solved: Solved):
    first, second = (without(solved.model, *left, tear_down=False) for left in (range(4, 11), range(1, 4)))
    for point_id in sorted(second.point3D_ids()):
        second.delete_point3D(point_id)
    merged = merging.merge_models([second, first], solved.job)
    assert sorted(model.num_reg_images() for model in merged) == [3, 7]


def test_the_bottleneck_is_the_weakest_join_of_the_strongest_chain():
    """By hand: the chain 1-2-3 holds with 5, the direct join only with 2; photo 4 is joined to photo 5 alone."""
    chain = bottlenecks([1, 2, 3, 4, 5], [(1, 2, 9.0), (2, 3, 5.0), (1, 3, 2.0), (4, 5, 1.0)])
    assert [chain(1, 3), chain(3, 1), chain(1, 2), chain(1, 4)] == [5, 5, 9, 0]
    assert connected_groups([1, 2, 3, 4, 5], [(1, 2), (2, 3), (1, 3), (4, 5)]) == [[1, 2, 3], [4, 5]]


@pytest.mark.parametrize(
    ("photos", "focal", "refused"),
    [(1, 3.2, False), (1, 0.25, False), (1, 11.0, True), (1, 0.1, True), (2, 3.2, True), (2, 0.25, True)],
)
def test_a_few_photos_may_have_a_focal_length_that_others_may_not(photos, focal, refused):
    """Of 20 photos, one with a camera of its own, or two that share one; the cameras of the others are usual."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 20 // photos, 1, photos
    options.num_points3D = 50
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    for camera in model.cameras.values():
        camera.params = [1.2 * camera.width, *camera.params[1:]]
    assert acceptance._implausible(model, PLAUSIBLE, given=()) == []
    first = model.cameras[min(model.cameras)]
    first.params = [focal * first.width, *first.params[1:]]
    failures = acceptance._implausible(model, PLAUSIBLE, given=())
    assert [failure.kind for failure in failures] == ["the intrinsics are implausible"] * refused
    assert acceptance._implausible(model, PLAUSIBLE, given=[first.camera_id]) == []
    for camera in model.cameras.values():  # each has few photos, but all together have not
        camera.params = [3.2 * camera.width, *camera.params[1:]]
    assert len(acceptance._implausible(model, PLAUSIBLE, given=())) == len(model.cameras)
    assert acceptance._implausible(model, PLAUSIBLE, given=(), determined=list(model.cameras)) == []
    first.params = [11.0 * first.width, *first.params[1:]]
    assert len(acceptance._implausible(model, PLAUSIBLE, given=(), determined=list(model.cameras))) == 1


def test_a_long_focal_length_that_the_photos_determine_is_accepted(tmp_path: Path):
    """A macro lens and cropped photos: 3.6 times the longer side, known to better than 1 %."""
    lens = Lens("SIMPLE_RADIAL", 1000, 1000, (3600.0, 500.0, 500.0, 0.0))
    views = synthetic.ring(16, [lens], seed=0, radius=9.0)
    far = solve(tmp_path, views, synthetic.boulder(900, seed=0))
    assert far.kinds == []
    assert far.model.num_reg_images() == 16
    (camera,) = far.model.cameras.values()
    assert camera.mean_focal_length() == pytest.approx(3600.0, rel=0.02)


@pytest.mark.parametrize(("size", "features", "more"), [(3199, 8192, True), (3200, 8192, False), (6400, 16384, False)])
def test_the_largest_pictures_are_not_searched_again(solved: Solved, size: int, features: int, more: bool):
    """Photos of 7,680 pixels, as of panoramas: another search would be of the same pictures, or for fewer features."""
    groups = tuple(replace(group, width=7680, height=3840) for group in solved.job.groups)
    job = replace(solved.job, groups=groups, max_image_size=size, max_features=features)
    tried = attempts.MappingAttempts(job, lambda *progress: None, lambda note: None)
    assert tried.can_have_more_features() == more


@pytest.mark.parametrize(
    ("photos", "features", "halved_from", "again"),
    [
        (150, 2048, 4096, 8192),
        (151, 2048, 4096, 4096),
        (151, 2048, 0, None),  # as was asked for
        (151, 4096, 8192, 8192),  # panoramas
        (151, 6144, 12288, None),  # no photo has that many
    ],
)
def test_many_photos_are_searched_again_for_as_many_features_as_few(
    solved: Solved, monkeypatch: pytest.MonkeyPatch, photos, features, halved_from, again
):
    """Photos of 20 megapixels with 5,000 features: many are not searched in larger pictures, nor all pairs matched."""
    groups = tuple(replace(group, width=5184, height=3888) for group in solved.job.groups)
    pairs = solved.job.pairs[:9]
    job = replace(solved.job, groups=groups, pairs=pairs, max_image_size=1600)
    job = replace(job, max_features=features, halved_from=halved_from)
    notes: list[str] = []
    tried = attempts.MappingAttempts(job, lambda *progress: None, notes.append)
    tried.photos = photos
    monkeypatch.setattr(attempts, "feature_counts", lambda job: [5000] * 10)
    for name in ("extract", "start_matching", "map_from_other_starts"):
        monkeypatch.setattr(attempts, name, lambda *arguments: None)
    for name in ("match", "map"):
        monkeypatch.setattr(tried, name, lambda *arguments: None)
    assert tried.can_have_more_features() == (again is not None)
    if again is None:
        return
    attempts.map_with_more_features(tried)
    assert tried.job.max_features == again
    assert (tried.job.max_image_size == job.max_image_size) == (tried.job.pairs == pairs) == (photos == 151)
    if photos == 151:
        assert notes[0].startswith(f"next: {again:,} features from each photo (takes about ")
        assert not tried.can_have_more_features()
