"""Pairs of photos that mislead, on rings of cameras around points, where which pairs are wrong is known."""

import numpy as np
import pycolmap
import pytest

from nerfcli.poses.input.job import Solver
from nerfcli.poses.model.rotations import averaged_rotations, explains, misleading_pairs
from nerfcli.poses.model.two_views import VerifiedPair

PHOTOS, FOCAL_PX, SOLVER = 24, 800.0, Solver(seed=0, threads=1)
Pose = tuple[np.ndarray, np.ndarray]


def lens(focal_px: float = FOCAL_PX) -> pycolmap.Camera:
    return pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", focal_px, 800, 600)


def ring() -> list[Pose]:
    """Rotations and translations from the world of cameras around the origin, that look at it, 15 degrees apart."""
    poses = []
    for angle in 2 * np.pi * np.arange(PHOTOS) / PHOTOS:
        back = np.array([np.cos(angle), np.sin(angle), 0.3])
        z = -back / np.linalg.norm(back)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        poses.append((np.array([x, np.cross(z, x), z]), np.array([0.0, 0.0, 4.0])))
    return poses


def pixels(pose: Pose, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    local = points @ pose[0].T + pose[1]
    exact = FOCAL_PX * local[:, :2] / local[:, 2:] + [400.0, 300.0]
    return exact + 0.3 * rng.standard_normal(exact.shape)


def pair_of(one: int, other: int, rng: np.random.Generator, *, seen_from: int | None = None) -> VerifiedPair:
    """A pair of photos with 80 matches; those of a wrong pair are of what another photo sees from `seen_from`."""
    poses = ring()
    points = rng.uniform(-1.0, 1.0, (80, 3))
    seen = poses[other if seen_from is None else seen_from]
    return VerifiedPair(one + 1, other + 1, pixels(poses[one], points, rng), pixels(seen, points, rng))


def right_pairs(rng: np.random.Generator, *, up_to: int = 4) -> list[VerifiedPair]:
    """The pairs of photos up to so many places apart."""
    ends = {tuple(sorted((one, (one + step) % PHOTOS))) for one in range(PHOTOS) for step in range(1, up_to + 1)}
    return [pair_of(one, other, rng) for one, other in sorted(ends)]


def wrong_pairs(count: int, rng: np.random.Generator) -> list[VerifiedPair]:
    """Photos on opposite sides, whose matches say that they are 30 degrees apart: the object looks alike there."""
    return [pair_of(one, one + PHOTOS // 2, rng, seen_from=one + 2) for one in range(count)]


def found(pairs: list[VerifiedPair], focal_px: float = FOCAL_PX) -> set[tuple[int, int]]:
    cameras = dict.fromkeys(range(1, PHOTOS + 1), lens(focal_px))
    return {(min(pair), max(pair)) for pair in misleading_pairs(pairs, cameras, SOLVER)}


@pytest.mark.parametrize("seed", range(3))
def test_all_wrong_pairs_and_no_others_mislead(seed: int):
    rng = np.random.default_rng(seed)
    wrong = wrong_pairs(10, rng)
    assert found([*right_pairs(rng), *wrong]) == {(pair.one, pair.other) for pair in wrong}


def test_a_few_wrong_pairs_are_left_to_the_mapper():
    """One pair of 97 is more than 1 %, and one of 193 is less; pairs of 49 matches do not count."""
    rng = np.random.default_rng(0)
    (wrong,) = wrong_pairs(1, rng)
    assert found([*right_pairs(rng), wrong]) == {(wrong.one, wrong.other)}
    assert found([*right_pairs(rng, up_to=8), wrong]) == set()
    few = [VerifiedPair(p.one, p.other, p.pixels_one[:49], p.pixels_other[:49]) for p in wrong_pairs(10, rng)]
    assert found([*right_pairs(rng), *few]) == set()


def test_with_a_wrong_focal_length_no_pair_is_blamed():
    rng = np.random.default_rng(0)
    pairs = [*right_pairs(rng), *wrong_pairs(10, rng)]
    assert found(pairs, 2.5 * FOCAL_PX) == found(pairs, FOCAL_PX / 2.5) == set()


def test_averaged_rotations_outvote_wrong_pairs():
    """Twelve pairs off by 150 degrees, with fewer matches than the others, move no rotation; photos apart have none."""
    truth = [pycolmap.Rotation3d(rotation) for rotation, _ in ring()]

    def posed(one: int, other: int, seen_from: int, matches: int = 80) -> tuple[VerifiedPair, pycolmap.Rigid3d]:
        pose = pycolmap.Rigid3d(truth[seen_from] * truth[one].inverse(), np.array([1.0, 0.0, 0.0]))
        return VerifiedPair(one + 1, other + 1, np.zeros((matches, 2)), np.zeros((matches, 2))), pose

    near = [(one, (one + step) % PHOTOS) for one in range(PHOTOS) for step in (1, 2, 3)]
    pairs = [posed(min(pair), max(pair), max(pair)) for pair in near]
    wrong = [posed(one, one + PHOTOS // 2, one + 2, matches=40) for one in range(12)]
    apart = (VerifiedPair(101, 102, np.zeros((50, 2)), np.zeros((50, 2))), pycolmap.Rigid3d())
    rotations = averaged_rotations([*pairs, *wrong, apart], seed=0)
    assert sorted(rotations) == list(range(1, PHOTOS + 1))
    world = truth[0].inverse() * rotations[1]  # its axes are arbitrary
    off = [rotations[one + 1] * (truth[one] * world).inverse() for one in range(PHOTOS)]
    assert max(np.degrees(each.angle()) for each in off) < 1e-3


@pytest.mark.parametrize(
    ("off_deg", "seen_from", "fits"), [(0, 3, True), (3, 3, True), (-3, 3, True), (40, 3, False), (0, 5, False)]
)
def test_a_pair_is_explained_by_about_its_rotation_only(off_deg: float, seen_from: int, fits: bool):
    """The rotation is that from photo 0 to photo 3, or `off_deg` beside it; the matches are those of `seen_from`."""
    (first, _), *_, (last, _) = ring()[:4]
    beside = pycolmap.Rotation3d(np.radians(off_deg) * np.array([0.6, 0.8, 0.0]))
    turn = beside * pycolmap.Rotation3d(last @ first.T)
    pair = pair_of(0, 3, np.random.default_rng(0), seen_from=seen_from)
    assert explains(turn, pair, {1: lens(), 4: lens()}) == fits


def test_matches_without_rays_are_explained_by_no_rotation():
    """A lens with strong distortion has no rays for most pixels; pycolmap's refinement ends the process without any."""
    lens_without_rays = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 100.0, 800, 600)
    lens_without_rays.params = [100.0, 400.0, 300.0, -3.0]
    pair = pair_of(0, 3, np.random.default_rng(0))
    nowhere = VerifiedPair(1, 4, np.full((40, 2), np.nan), np.full((40, 2), np.nan))
    assert not explains(pycolmap.Rotation3d(), pair, {1: lens_without_rays, 4: lens_without_rays})
    assert not explains(pycolmap.Rotation3d(), nowhere, {1: lens(), 4: lens()})


def test_without_pairs_there_is_nothing_to_blame():
    assert found([]) == set()
