"""Photos placed by the points of a model, against known poses; and photos that must not be placed.

The model is the truth of `synthetic_captures`, with half a pixel of noise in what is seen; features look like their
points, as descriptors of real photos do.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import synthetic_captures as synthetic
from synthetic_captures import WIDE, View, looking_at

from nerfcli.poses.input.job import Job
from nerfcli.poses.judge.contradictions import leave_out_contradicting
from nerfcli.poses.model import locate
from nerfcli.poses.model.locate import LocationAttempt, left_out, locate_photos, shared_pairs
from nerfcli.poses.model.point_descriptors import KnownPoints, PhotoFeatures, known_points, photo_features, votes

POINTS = synthetic.boulder(700, seed=0)
VIEWS = synthetic.ring(7, [WIDE], seed=0, turn_deg=180)
LAST = 8  # the id of the photo that is left out
# What a photo shows: pixels (n, 2), and the points whose appearance they have.
Shown = tuple[np.ndarray, np.ndarray]


def shown(view: View, *, clutter: int = 150, seed: int = 5) -> Shown:
    rng = np.random.default_rng(seed)
    points, pixels = synthetic.seen(view, POINTS)
    clutter_px = rng.uniform(0, [WIDE.width, WIDE.height], size=(clutter, 2))
    noisy = np.vstack([pixels + rng.normal(scale=0.5, size=pixels.shape), clutter_px])
    return noisy, np.concatenate([points, np.full(clutter, -1)])


def capture(folder: Path, last: Shown, *, camera_id: int = 1) -> tuple[pycolmap.Reconstruction, Job]:
    """A model of seven photos, and the database in which an eighth shows `last`."""
    model = synthetic.observed_model(VIEWS, POINTS, noise_px=0.5, seed=1)
    with pycolmap.Database.open(str(folder / "database.db")) as database:
        synthetic.write_camera(database, model.camera(1))
        other = pycolmap.Camera.create_from_model_name(2, "SIMPLE_RADIAL", 1200, WIDE.width, WIDE.height)
        synthetic.write_camera(database, other)
        for number, view in enumerate(VIEWS):
            pixels = np.array([point.xy for point in model.image(number + 1).points2D])
            looks = synthetic.seen(view, POINTS)[0]
            synthetic.write_image(database, number, 1, keypoints=pixels, looks=looks)
        synthetic.write_image(database, LAST - 1, camera_id, keypoints=last[0], looks=last[1])
    return model, synthetic.synthetic_job(folder, [*VIEWS, VIEWS[0]], seed=0)


def refusal(folder: Path, last: Shown) -> str:
    model, job = capture(folder, last)
    reports: list[tuple[str, int, int]] = []
    grown, (attempt,) = locate_photos(
        model, job, image_ids=[LAST], report=lambda stage, done, total: reports.append((stage, done, total))
    )
    assert reports == [("locate", 0, 3), ("locate", 3, 3)]
    assert grown.num_reg_images() == len(VIEWS)
    return attempt.refused


@pytest.mark.parametrize("angle_deg", [77.0, 215.0])
def test_a_photo_without_any_pair_is_placed_where_it_was_taken(tmp_path: Path, angle_deg: float):
    """Between other photos, and beyond the last one; as accurate as noise permits for half a ring of photos."""
    angle = np.radians(angle_deg)
    view = View(WIDE, looking_at(np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.5]), np.array([0.1, 0.0, 0.1])))
    model, job = capture(tmp_path, shown(view))
    assert left_out(model, job) == [LAST]
    grown, (attempt,) = locate_photos(model, job, image_ids=[LAST])
    assert (attempt.refused, model.num_reg_images()) == ("", len(VIEWS))
    assert attempt.found > 10 * attempt.beside
    relative = grown.image(LAST).cam_from_world() * grown.image(1).cam_from_world().inverse()
    true = pycolmap.Rigid3d(view.cam_from_world) * pycolmap.Rigid3d(VIEWS[0].cam_from_world).inverse()
    assert np.degrees((relative.rotation * true.rotation.inverse()).angle()) < 0.8
    assert np.abs(relative.translation - true.translation).max() < 0.01 * np.linalg.norm(true.translation)
    # It now observes most of the points by which it was placed.
    assert grown.image(LAST).num_points3D > 0.8 * attempt.found
    assert grown.image(LAST).name == synthetic.photo_name(LAST - 1)
    # No verified pair holds it, yet the check for contradictions does not remove it.
    held = shared_pairs(grown, [LAST], min_matches=15)
    assert {pair.other for pair in held} == {LAST}
    assert leave_out_contradicting(grown, held, job.name_of)[1] == {}


def test_a_photo_of_something_else_is_not_placed(tmp_path: Path):
    pixels, looks = shown(VIEWS[2])
    assert refusal(tmp_path, (pixels, np.full(len(looks), -1))).startswith("only ")


def test_a_detail_that_looks_like_one_elsewhere_places_nothing(tmp_path: Path):
    """The boulder, seen from so far that it fills a fiftieth of the photo, with unknown features all around."""
    far = View(WIDE, looking_at(np.array([9.0, 6.0, 3.0]), np.zeros(3)))
    pixels, looks = shown(far, clutter=600)
    assert "of the picture agrees with the model" in refusal(tmp_path, (pixels, looks))


def test_a_photo_that_may_be_of_two_places_is_not_placed(tmp_path: Path):
    (one, one_looks), (other, other_looks) = shown(VIEWS[1]), shown(VIEWS[5])
    both = np.intersect1d(one_looks, other_looks)
    one_looks = np.where(np.isin(one_looks, both), -1, one_looks)
    last = np.vstack([one, other]), np.concatenate([one_looks, np.where(np.isin(other_looks, both), -1, other_looks)])
    assert "agree on a different pose" in refusal(tmp_path, last)


def test_a_place_that_the_photos_own_matches_contradict_is_not_kept(tmp_path: Path):
    model, job = capture(tmp_path, shown(VIEWS[3]))
    rng = np.random.default_rng(0)
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED.value
    geometry.inlier_matches = rng.permutation(120)[:80].reshape(40, 2).astype(np.uint32)
    with pycolmap.Database.open(str(job.database)) as database:
        database.write_two_view_geometry(4, LAST, geometry)
    grown, (attempt,) = locate_photos(model, job, image_ids=[LAST])
    assert attempt.refused == "40 verified matches contradict its pose"
    assert LAST not in grown.reg_image_ids()


def test_only_a_photo_that_resembles_a_placed_one_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Of three left photos, one is placed, one shows something else, and one shows 15 points of the first: too few."""
    model, job = capture(tmp_path, shown(VIEWS[3]))
    pixels, looks = shown(VIEWS[3])
    few = np.where(np.arange(len(looks)) < 15, looks, -1)
    with pycolmap.Database.open(str(job.database)) as database:
        synthetic.write_image(database, LAST, 1, keypoints=pixels, looks=np.full(len(looks), -1))
        synthetic.write_image(database, LAST + 1, 1, keypoints=pixels, looks=few)
    views = [*VIEWS, VIEWS[0], VIEWS[0], VIEWS[0]]
    job = synthetic.synthetic_job(tmp_path / "three", views, seed=0)
    shutil.copy(tmp_path / "database.db", job.database)
    tried: list[int] = []

    def counted(photo: PhotoFeatures, model_points: KnownPoints) -> tuple[np.ndarray, np.ndarray]:
        tried.append(photo.image_id)
        return votes(photo, model_points)

    monkeypatch.setattr(locate, "votes", counted)
    _, attempts = locate_photos(model, job, image_ids=[LAST, LAST + 1, LAST + 2])
    assert [attempt.refused == "" for attempt in attempts] == [True, False, False]
    assert tried == [LAST, LAST + 1, LAST + 2, LAST + 2]


def test_a_feature_votes_for_a_point_that_it_resembles_clearly_more_than_any_other(tmp_path: Path):
    """Independent: a loop over features, with the largest cosine of each point."""
    model, job = capture(tmp_path, shown(VIEWS[3]))
    with pycolmap.Database.open(str(job.database)) as database:
        known = known_points(model, database)
        photo = photo_features(model, database, LAST)
    assert photo is not None
    best: dict[int, tuple[float, int]] = {}
    for feature, descriptor in enumerate(photo.descriptors):
        cosines = np.full(len(known.ids), -1.0)
        np.maximum.at(cosines, known.of, known.descriptors @ descriptor)
        other, nearest = np.argsort(cosines)[-2:]
        ratio = np.sqrt(max(1 - cosines[nearest], 0) / (1 - cosines[other]))
        if ratio < min(0.9, best.get(nearest, (1.0, 0))[0]):
            best[nearest] = (ratio, feature)
    features, points = votes(photo, known)
    assert len(features) > 100
    assert dict(zip(points, features, strict=True)) == {point: feature for point, (_, feature) in best.items()}


def test_nothing_is_placed_without_a_known_lens(tmp_path: Path):
    """The photo has a camera of its own with unknown intrinsics."""
    model, job = capture(tmp_path, shown(VIEWS[3]), camera_id=2)
    _, attempts = locate_photos(model, job, image_ids=[LAST])
    assert attempts == [LocationAttempt(LAST, refused="its camera is unknown")]


def test_a_model_without_points_places_nothing(tmp_path: Path):
    _, job = capture(tmp_path, shown(VIEWS[3]))
    _, (attempt,) = locate_photos(synthetic.true_model(VIEWS), job, image_ids=[LAST])
    assert attempt.refused == "the model has too few points"


def test_what_is_drawn_at_random_depends_on_the_seed_alone(tmp_path: Path):
    model, job = capture(tmp_path, shown(VIEWS[3]))
    runs = [locate_photos(model, replace(job, threads=1), image_ids=[LAST]) for _ in range(2)]
    poses = [grown.image(LAST).cam_from_world().matrix() for grown, _ in runs]
    np.testing.assert_array_equal(poses[0], poses[1])
