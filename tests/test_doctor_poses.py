"""Poses against matches: a wrong pose is named and no other photo, on cameras, points and photos with known truth.

The matches are projections of random points with half a pixel of noise, so any error beyond that is of the poses.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from present import present
from test_photos import NO_EXIF
from walks import FOCAL_PX, HEIGHT, WIDTH, walk, write

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.doctor import examination
from nerfcli.doctor.compared_pairs import Pair
from nerfcli.doctor.examination import ExaminedCapture, examine
from nerfcli.doctor.photo_facts import Brightness, PhotoFacts, PhotoFeatures, Sharpness, Source
from nerfcli.doctor.pose_agreement import (
    NEAREST,
    PairError,
    contradicting,
    misplaced_groups,
    nearest_pairs,
    pair_errors,
    poses_by_matches,
)
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding

CAMERA = Camera.pinhole(1600, 1200, 1400.0)
SIZE = (800, 600)  # features are at half the size of the photos
UP = np.array([0.0, 0.0, 1.0])
EXIF = replace(NO_EXIF, width=1600, height=1200)


def ring(count: int = 24, *, camera: Camera = CAMERA) -> list[Frame]:
    """Return cameras around the origin, at a distance of 4 and at different heights.

    At equal heights, neighbours that are swapped move all points along their epipolar lines.
    """
    heights = np.random.default_rng(0).uniform(0.2, 1.8, count)
    frames = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        centre = np.array([4 * np.cos(angle), 4 * np.sin(angle), heights[index]])
        frames.append(Frame(f"{index:02d}.jpg", camera, rigid.look_at(centre, np.zeros(3), UP)))
    return frames


@cache
def facts(count: int) -> tuple[PhotoFacts, ...]:
    nothing = np.zeros((0, 2), dtype=np.float32)
    features = PhotoFeatures(SIZE, nothing, nothing[:, 0], np.zeros((0, 128), np.uint8), nothing[:, 0], nothing)
    plain = (EXIF, "", b"", np.zeros((32, 32), np.float32), Sharpness(0.0, 1.0, 1.0), Brightness(0.5, 0.0, 0.0))
    return tuple(PhotoFacts(f"{index:02d}.jpg", *plain, features) for index in range(count))


def matched(frames: Sequence[Frame], first: int, second: int, *, matches: int) -> Pair:
    """Return the matches of two photos by their true cameras, with noise of half a pixel."""
    rng = np.random.default_rng([first, second])
    points = rng.uniform(-1, 1, (matches, 3))
    pixels = []
    for frame in (frames[first], frames[second]):
        local = rigid.apply(rigid.inverse(frame.world_from_cam), points)
        whole = frame.camera.project(local)[0] * SIZE[0] / frame.camera.width
        pixels.append(whole + rng.normal(0, 0.5, whole.shape))
    none = float("nan")
    return Pair(first, second, matches, 0.1, none, none, none, none, None, (), None, (pixels[0], pixels[1]))


def pairs_of(frames: Sequence[Frame]) -> list[Pair]:
    """Return the matches of each photo with its three neighbours on either side: the farther, the fewer."""
    count = len(frames)
    places = [(i, (i + step) % count, step) for i in range(count) for step in (1, 2, 3)]
    return [matched(frames, min(i, j), max(i, j), matches=160 - 40 * step) for i, j, step in places]


def checked(given: Sequence[Frame], pairs: Sequence[Pair]) -> Finding:
    photos = facts(len(given))
    return present(poses_by_matches(photos, pair_errors(given, photos, pairs)))


def posed(frames: Sequence[Frame], poses: dict[int, np.ndarray]) -> list[Frame]:
    return [replace(frame, world_from_cam=poses.get(index, frame.world_from_cam)) for index, frame in enumerate(frames)]


def turned(pose: np.ndarray, degrees: float) -> np.ndarray:
    twist = np.concatenate([np.zeros(3), np.radians(degrees) * np.array([0.8, 0.0, 0.6])])
    return pose @ rigid.transform_from_twist(twist)


def moved(pose: np.ndarray, by: Sequence[float]) -> np.ndarray:
    result = pose.copy()
    result[:3, 3] += by
    return result


# Single photos


def test_true_poses_are_good_and_their_error_is_that_of_the_noise():
    found = checked(ring(), pairs_of(ring()))
    assert (found.verdict, found.photos, found.advice) == (GOOD, (), "")
    # Noise of 0.5 px in both photos: a Sampson distance has the standard deviation 0.5, its median size is 0.34.
    np.testing.assert_allclose(found.number or 0, 0.34, atol=0.05)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda poses: {5: turned(poses[5], 2.0)},
        lambda poses: {5: turned(poses[5], 20.0)},
        lambda poses: {5: moved(poses[5], (0.0, 0.0, 0.4))},  # 5 % of the size of the ring
        lambda poses: {5: poses[6], 6: poses[5]},
        lambda poses: {5: poses[17], 17: poses[5]},
        lambda poses: {5: poses[4]},
        lambda poses: {5: turned(poses[5], 5.0), 6: turned(poses[6], -5.0), 7: turned(poses[7], 3.0)},
    ],
    ids=["by 2", "by 20", "moved", "neighbours swapped", "far ones swapped", "repeated", "three in a row"],
)
def test_wrong_poses_are_named_and_no_others(wrong: Callable[[list[np.ndarray]], dict[int, np.ndarray]]):
    frames = ring()
    poses = wrong([frame.world_from_cam for frame in frames])
    found = checked(posed(frames, poses), pairs_of(frames))
    assert found.verdict == BAD
    assert sorted(found.names) == [f"{index:02d}.jpg" for index in sorted(poses)]
    assert "as a whole" not in found.summary
    assert "nerfcli poses" in found.advice


def test_photos_that_look_alike_accuse_nobody():
    """The many pairs of a photo with other places have fewer matches than those with its neighbours."""
    frames = ring()
    other = [*frames]
    other[5] = replace(frames[5], world_from_cam=frames[17].world_from_cam)
    wrong = [matched(other, *sorted((5, index)), matches=35) for index in (12, 13, 14, 15, 16, 18, 19, 20, 21)]
    found = checked(frames, [*pairs_of(frames), *wrong])
    assert (found.verdict, found.photos) == (GOOD, ())


def test_two_pairs_and_pairs_of_few_matches_are_too_little_to_accuse():
    frames = ring()
    given = posed(frames, {5: turned(frames[5].world_from_cam, 10.0)})
    pairs = pairs_of(frames)
    two = [p for p in pairs if 5 not in (p.first, p.second) or (p.first, p.second) in ((4, 5), (5, 6))]
    assert checked(given, two).photos == ()
    few = [replace(pair, inliers=25) if 5 in (pair.first, pair.second) else pair for pair in pairs]
    assert checked(given, few).photos == ()


def test_a_photo_between_two_wrong_ones_is_not_accused_by_them():
    """Photos 0 and 5 are wrong. Two of the three pairs of photo 1 are with them."""
    wrong = [(0, other) for other in (1, 2, 3, 4)] + [(5, other) for other in (1, 3, 4, 6)]
    right = [(1, 2), (2, 3), (3, 4), (4, 6), (2, 4), (3, 6)]
    errors = [PairError(*pair, 100, 50.0, False) for pair in wrong]
    errors += [PairError(*pair, 90, 0.2, False) for pair in right]
    assert sorted(contradicting(errors, 7, limit_px=4.0)) == [(0, 50.0), (5, 50.0)]


def test_one_place_for_two_photos_that_saw_no_parallax_is_right():
    """Without a baseline there is no epipolar plane: the rays themselves are compared."""
    frames = ring()
    frames[5] = replace(frames[5], world_from_cam=turned(frames[4].world_from_cam, 8.0))
    assert checked(frames, pairs_of(frames)).verdict == GOOD
    errors = pair_errors(frames, facts(24), [matched(frames, 4, 5, matches=200)])
    assert errors[0].error_px < 1.0
    given = posed(frames, {5: turned(frames[5].world_from_cam, 5.0)})
    assert checked(given, pairs_of(frames)).names == ("05.jpg",)


# All photos


def test_poses_that_drift_are_looked_at_and_a_wrong_one_must_stand_out():
    frames = ring()
    rng = np.random.default_rng(0)
    drifted = [turned(frame.world_from_cam, rng.normal(0, 0.4)) for frame in frames]
    pairs = pairs_of(frames)
    found = checked(posed(frames, dict(enumerate(drifted))), pairs)
    assert (found.verdict, found.photos) == (LOOK, ())
    drifted[9] = turned(drifted[9], 15.0)
    found = checked(posed(frames, dict(enumerate(drifted))), pairs)
    assert found.names == ("09.jpg",)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda pose: pose @ np.diag([1.0, -1.0, -1.0, 1.0]),
        rigid.inverse,
        # The epipolar geometry stays the same, but all points are behind the cameras.
        lambda pose: moved(pose, -2 * pose[:3, 3]),
    ],
    ids=["other axes", "inverted", "centres negated"],
)
def test_wrong_conventions_are_wrong_cameras_as_a_whole_and_name_no_photo(wrong: Callable[[np.ndarray], np.ndarray]):
    frames = ring()
    given = [replace(frame, world_from_cam=wrong(frame.world_from_cam)) for frame in frames]
    found = checked(given, pairs_of(frames))
    assert (found.verdict, found.photos) == (BAD, ())
    assert "as a whole" in found.summary
    assert "--detect" in found.advice
    assert "nerfcli poses" in found.advice


def test_without_matches_nothing_is_said():
    frames, photos = ring(), facts(24)
    assert poses_by_matches(photos, pair_errors(frames, photos, [])) is None
    assert misplaced_groups(frames, photos, [], []) is None


# Groups


def compared_pairs(frames: Sequence[Frame], matching: Callable[[int, int], bool]) -> list[Pair]:
    """Return all pairs, of which only those match whose cameras are truly within 30 degrees and `matching` allows."""
    found = []
    for i, j in combinations(range(len(frames)), 2):
        near = frames[i].world_from_cam[:3, 2] @ frames[j].world_from_cam[:3, 2] > np.cos(np.radians(30))
        if near and matching(i, j):
            found.append(matched(frames, i, j, matches=60))
        else:
            none = float("nan")
            found.append(Pair(i, j, 0, none, none, none, none, none, None, ()))
    return found


def groups(given: Sequence[Frame], pairs: Sequence[Pair]) -> Finding | None:
    photos = facts(len(given))
    return misplaced_groups(given, photos, pair_errors(given, photos, pairs), pairs)


def test_a_group_of_photos_on_the_wrong_side_is_named_though_its_photos_agree_with_each_other():
    frames, group = ring(36), range(10, 15)
    pairs = compared_pairs(frames, lambda i, j: (i in group) == (j in group))
    opposite = np.diag([-1.0, -1.0, 1.0, 1.0])
    given = posed(frames, {index: opposite @ frames[index].world_from_cam for index in group})
    assert checked(given, pairs).photos == ()  # each pair agrees
    found = present(groups(given, pairs))
    assert (found.verdict, found.number) == (BAD, 5)
    assert sorted(found.names) == [f"{index}.jpg" for index in group]


def test_sound_captures_have_no_misplaced_group():
    frames = ring(36)
    found = present(groups(frames, compared_pairs(frames, lambda i, j: True)))
    assert (found.verdict, found.photos) == (GOOD, ())
    # Nor has one in two parts far from each other, such as two sides of a wall.
    halves = [
        replace(frame, world_from_cam=moved(frame.world_from_cam, (0.0, 0.0, 0.0 if index < 24 else 40.0)))
        for index, frame in enumerate(frames)
    ]
    found = groups(halves, compared_pairs(frames, lambda i, j: (i < 24) == (j < 24)))
    assert present(found).photos == ()


def test_a_group_without_matches_means_nothing_where_neighbours_often_do_not_match():
    frames, group = ring(36), range(10, 15)
    pairs = compared_pairs(frames, lambda i, j: (i in group) == (j in group) and (i + j) % 4 > 0)
    assert groups(frames, pairs) is None


def test_a_single_photo_without_matches_is_no_group():
    frames = ring(36)
    found = present(groups(frames, compared_pairs(frames, lambda i, j: 10 not in (i, j))))
    assert (found.verdict, found.photos) == (GOOD, ())


def test_nearest_pairs_by_a_double_loop():
    frames = [*ring(10), *ring(7)[1:]]
    expected = set()
    for i, frame in enumerate(frames):
        others = [
            (float(np.linalg.norm(frame.centre - other.centre)), j)
            for j, other in enumerate(frames)
            if j != i and frame.world_from_cam[:3, 2] @ other.world_from_cam[:3, 2] >= np.cos(np.radians(20))
        ]
        expected |= {(min(i, j), max(i, j)) for _, j in sorted(others)[:NEAREST]}
    assert nearest_pairs(frames) == expected


# Photos


def test_the_doctor_of_a_scene_names_the_wrong_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """On photos: all but the pose is as a user has it. The check of groups gets nearest pairs, and is reported."""
    seen: list[set[tuple[int, int]]] = []
    of_groups = Finding("places", LOOK, "as if", 0, "", "")

    def reported(frames: Sequence[Frame], *rest: Sequence[object]) -> Finding:
        pairs = rest[-1]
        seen.append(nearest_pairs(frames) - {(pair.first, pair.second) for pair in pairs if isinstance(pair, Pair)})
        return of_groups

    monkeypatch.setattr(examination, "misplaced_groups", reported)
    monkeypatch.setattr(examination, "choose_pairs", lambda facts: [(i, i + 2) for i in range(len(facts) - 2)])
    steps = np.linspace(-1, 1, 7)
    folder = write(tmp_path / "photos", walk())
    camera = Camera.pinhole(WIDTH, HEIGHT, FOCAL_PX)
    frames = []
    for step, path in zip(steps, sorted(folder.iterdir()), strict=True):
        pan = np.radians(-6 * step)
        cam_from_world = np.array([[np.cos(pan), 0, -np.sin(pan)], [0, 1, 0], [np.sin(pan), 0, np.cos(pan)]])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cam_from_world.T, (0.9 * step, 0.1 * step**2, 0.0)
        frames.append(Frame(path.name, camera, pose, path))
    sources = tuple(Source(path.name, path) for path in sorted(folder.iterdir()))
    verdicts = []
    for given in (frames, posed(frames, {3: turned(frames[3].world_from_cam, 3.0)})):
        scene = Capture(tuple(given), np.zeros((0, 3)), kind="transforms", root=tmp_path)
        subject = ExaminedCapture(tmp_path, sources, scene)
        diagnosis = examine(subject, threads=2, progress=lambda done, text: None)
        found = next(finding for finding in diagnosis.findings if finding.check == "poses")
        verdicts.append((found.verdict, found.names))
        assert of_groups in diagnosis.findings
    assert verdicts == [(GOOD, ()), (BAD, ("03.jpg",))]
    assert seen == [set(), set()]
