"""Focal lengths from pairs of photos, before any is placed, against synthetic truth."""

import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import synthetic_captures as synthetic
from numpy.typing import NDArray
from synthetic_captures import FISHEYE, WIDE, Noise, View

from nerfcli.poses.engine.attempts import map_with_fallbacks
from nerfcli.poses.engine.database import register_photos
from nerfcli.poses.engine.initial_lens import estimate_focal_lengths, focal_length
from nerfcli.poses.input.job import Job
from nerfcli.poses.model.two_views import VerifiedPair, read_verified_pairs

SIZE, FOCAL_PX = (1000, 750), 800.0
POINTS = 200


def pairs_of(
    cameras: list[NDArray[np.float64]], points: NDArray[np.float64], *, wrong: float = 0.0, focal_px: float = FOCAL_PX
) -> list[VerifiedPair]:
    """Return pairs of successive cameras (3, 4) that see points (pairs, n, 3) with 0.5 px noise and wrong matches."""
    rng = np.random.default_rng(1)
    pairs = []
    for number, (one, other, seen) in enumerate(zip(cameras[::2], cameras[1::2], points, strict=True)):
        pixels = []
        for camera in (one, other):
            local = seen @ camera[:, :3].T + camera[:, 3]
            exact = focal_px * local[:, :2] / local[:, 2:] + np.array(SIZE) / 2
            pixels.append(exact + rng.normal(scale=0.5, size=exact.shape))
        mistaken = rng.random(len(seen)) < wrong
        pixels[1][mistaken] = rng.uniform(0, SIZE, (mistaken.sum(), 2))
        pairs.append(VerifiedPair(2 * number, 2 * number + 1, *pixels))
    return pairs


def freely(count: int) -> list[NDArray[np.float64]]:
    """Return pairs of cameras, about 1 apart, that look around the origin from about 5 away, not at one point."""
    rng = np.random.default_rng(0)
    cameras = []
    for _ in range(count):
        centre = np.array([0.0, -5.0, 0.0])
        for _ in range(2):
            cameras.append(synthetic.looking_at(centre, rng.normal(scale=0.8, size=3)))
            centre = centre + rng.normal(scale=0.7, size=3)
    return cameras


def cloud(count: int) -> NDArray[np.float64]:
    return np.random.default_rng(2).uniform(-1.2, 1.2, (count, POINTS, 3))


def test_the_focal_length_is_found_within_a_percent_where_pairs_determine_it():
    """Synthetic truth, with a fifth of the matches wrong; 1.2 times the longer side would be half too long."""
    for focal_px in (500.0, FOCAL_PX, 2000.0):
        found = focal_length(pairs_of(freely(40), cloud(40), wrong=0.2, focal_px=focal_px), SIZE, seed=0)
        assert found is not None
        assert found.px == pytest.approx(focal_px, rel=0.01)
        assert found.spread < 0.01
        assert found.rise > 1
        assert found.pairs == 40


def test_spread_and_rise_say_where_pairs_leave_it_open():
    """Degenerate in theory: a plane, and cameras that look at one point from the same distance.

    A camera that turns on the spot does determine the focal length.
    """
    rng = np.random.default_rng(3)
    flat = cloud(40)
    flat[..., 1] = 0.0
    turning = [synthetic.looking_at(np.array([0.0, -5.0, 0.0]), rng.normal(scale=0.8, size=3)) for _ in range(80)]
    around = []
    for angle in rng.uniform(0, 2 * np.pi, 40):
        for turned in (angle, angle + 0.3):
            centre = 5 * np.array([np.cos(turned), np.sin(turned), 0.2])
            around.append(synthetic.looking_at(centre, np.zeros(3)))
    plane, turned, fixed = (
        focal_length(pairs_of(cameras, points), SIZE, seed=0)
        for cameras, points in ((freely(40), flat), (turning, cloud(40)), (around, cloud(40)))
    )
    assert plane is not None
    assert fixed is not None
    assert turned is not None
    assert plane.spread > 0.05
    assert fixed.spread > 0.05
    assert fixed.rise < 0.1
    assert turned.px == pytest.approx(FOCAL_PX, rel=0.01)
    assert turned.spread < 0.01


def test_few_pairs_give_no_estimate():
    pairs = pairs_of(freely(19), cloud(19))
    assert focal_length(pairs, SIZE, seed=0) is None
    weak = [
        VerifiedPair(p.one, p.other, p.pixels_one[:49], p.pixels_other[:49]) for p in pairs_of(freely(40), cloud(40))
    ]
    assert focal_length(weak, SIZE, seed=0) is None


@pytest.fixture(scope="module")
def matched(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[View], Path]:
    """Fourteen photos around an object, from uneven distances, and their database; the distortion is -0.05."""
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    path = tmp_path_factory.mktemp("matched") / "database.db"
    views = synthetic.ring(14, [WIDE], seed=0)
    synthetic.write_database(path, views, synthetic.boulder(1000, seed=0), noise=Noise(), seed=0)
    return views, path


@pytest.fixture
def job(matched: tuple[list[View], Path], tmp_path: Path) -> Job:
    views, database = matched
    shutil.copy(database, tmp_path)
    return synthetic.synthetic_job(tmp_path, views, seed=0)


def verified(job: Job) -> dict[tuple[int, int], int]:
    return {(pair.one, pair.other): pair.matches for pair in read_verified_pairs(job.database, min_matches=1)}


def focal_px_of(job: Job) -> list[float]:
    with closing(pycolmap.Database.open(str(job.database))) as database:
        return [camera.mean_focal_length() for camera in database.read_all_cameras()]


def test_mapping_starts_from_the_estimate_and_no_match_is_lost(job: Job):
    """Synthetic truth, within 5 % because of the distortion; 1.2 times the longer side is 50 % too long."""
    before, notes = verified(job), []
    started = estimate_focal_lengths(job, notes.append)
    (px,) = focal_px_of(job)
    assert px == started.groups[0].estimated_focal_px == pytest.approx(WIDE.params[0], rel=0.05)
    assert notes == [notes[0]]
    assert notes[0].startswith(f"starting from a focal length of {px:.0f} px, estimated from ")
    assert verified(started) == before
    register_photos(job)  # as the next call does when it resumes
    assert focal_px_of(job) == [1200.0]
    assert verified(job) == before


def test_given_lens_parameters_are_left_alone(job: Job):
    """By definition: intrinsics from a file, reliable EXIF, a fisheye."""
    (group,) = job.groups
    for camera_group in (
        replace(group, params=WIDE.params),
        replace(group, focal_px=1000.0, focal_is_prior=True),
        replace(group, model=FISHEYE.model),
    ):
        alone = replace(job, groups=(camera_group,))
        assert estimate_focal_lengths(alone, lambda note: None) is alone
    doubted = replace(job, groups=(replace(group, focal_px=2000.0),))
    assert estimate_focal_lengths(doubted, lambda note: None).groups[0].estimated_focal_px is not None


def test_a_changed_prior_focal_length_is_verified_anew(job: Job):
    (group,) = job.groups
    register_photos(replace(job, groups=(replace(group, focal_px=1000.0, focal_is_prior=True),)))
    assert not verified(job)


def test_a_first_mapping_starts_from_it(job: Job):
    """All photos placed, focal length within half a per cent of the truth."""
    notes: list[str] = []
    mapped = map_with_fallbacks(job, lambda *progress: None, notes.append)
    assert [attempt["models"] for attempt in mapped.attempts] == [[14]]
    assert mapped.job.groups[0].estimated_focal_px is not None
    assert mapped.models[0].cameras[1].mean_focal_length() == pytest.approx(WIDE.params[0], rel=0.005)
