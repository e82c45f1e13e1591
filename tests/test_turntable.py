"""An object turning before a still background: recognised, masked, solved; and captures not to be mistaken for it."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import synthetic_captures as synthetic
from in_this_process import worker_in_this_process
from PIL import Image
from scipy.spatial.transform import Rotation
from synthetic_captures import WIDE, Scene, View
from turntable_capture import Turntable, turntable, write

from nerfcli.cameras.alignment import align
from nerfcli.captures.loading import load_scene
from nerfcli.doctor.examination import Diagnosis, examine, find_subject
from nerfcli.errors import UserError
from nerfcli.matching.stationary import Motions, motions, still_px, together
from nerfcli.pages.findings import LOOK
from nerfcli.photos.images import reduced
from nerfcli.poses.engine import turntable as module
from nerfcli.poses.engine.turntable import add_advice, describe_motions, mask_turning_object, recall_masks, scene_masks
from nerfcli.poses.input import still_background as still
from nerfcli.poses.input.job import CameraGroup, Job
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.structure_from_motion import estimate_poses

SIZE = (WIDE.width, WIDE.height)


def matched(one: View, other: View, scene: Scene, *, seed: int, noise_px: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """Return where two views see their common points, with noise and a tenth of wrong matches."""
    rng = np.random.default_rng(seed)
    (first, x), (second, y) = synthetic.seen(one, scene), synthetic.seen(other, scene)
    _, a, b = np.intersect1d(first, second, return_indices=True)
    x, y = (pixels + rng.normal(scale=noise_px, size=pixels.shape) for pixels in (x[a], y[b]))
    wrong = rng.choice(len(y), len(y) // 10, replace=False)
    y[wrong] = rng.permutation(y[wrong])
    return x, y


def staying(
    count: int, *, seed: int, box: tuple[float, float, float, float] = (0, 0, 1, 1)
) -> tuple[np.ndarray, np.ndarray]:
    """Return matches that stay in place within a box: left, top, right, bottom as fractions of the picture."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(np.array(box[:2]) * SIZE, np.array(box[2:]) * SIZE, size=(count, 2))
    return x + rng.normal(scale=0.3, size=x.shape), x + rng.normal(scale=0.3, size=x.shape)


def both(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> Motions:
    return motions(np.vstack([one[0], other[0]]), np.vstack([one[1], other[1]]), SIZE)


def ring_pairs(count: int = 24) -> list[tuple[int, int, tuple[np.ndarray, np.ndarray]]]:
    """Return (i, j, matches) of a boulder photographed from all around."""
    scene = synthetic.boulder(1500, seed=3)
    views = synthetic.ring(count, [WIDE], seed=4)
    return [
        (i, i + step, matched(views[i], views[i + step], scene, seed=100 * i + step))
        for step in (1, 2)
        for i in range(0, count - step, 3)
    ]


class TestMotions:
    @pytest.mark.parametrize("still_count", [40, 150, 600])
    def test_background_that_stays_and_object_that_turns_are_two_motions(self, still_count: int) -> None:
        for i, j, moving in ring_pairs():
            found = both(moving, staying(still_count, seed=i + j))
            assert (found.two, found.only_still, found.one) == (True, False, False)
            assert abs(found.still - still_count) <= 0.05 * still_count + 6  # some points of the object are on its axis
            assert found.moving > 0.6 * len(moving[0])
            assert found.agreeing < 0.6

    def test_object_alone_is_one_motion(self) -> None:
        for _, _, moving in ring_pairs():
            found = motions(*moving, SIZE)
            assert found.one
            assert found.still == 0  # the few matches near the axis are no peak

    def test_copies_of_a_photo_are_no_two_motions(self) -> None:
        found = motions(*staying(400, seed=0), SIZE)
        assert (found.only_still, found.two) == (True, False)

    def test_what_is_far_away_agrees_with_a_camera_that_moves_sideways(self) -> None:
        """The horizon stays while the camera slides past what is near: one motion."""
        near = synthetic.room(1500, seed=1)
        middle = np.array([0.0, 0.0, 0.0])
        one, other = (
            View(WIDE, synthetic.looking_at(middle + offset, middle + offset + np.array([1.0, 0.0, 0.0])))
            for offset in (np.zeros(3), np.array([0.0, 0.4, 0.0]))
        )
        found = both(matched(one, other, near, seed=5), staying(200, seed=6))
        assert found.still >= 190
        assert found.agreeing > 0.9
        assert found.one

    def test_towards_the_middle_of_a_zoom_there_is_no_peak(self) -> None:
        """With a forward-moving camera, the point it heads for stays in place, but motion grows smoothly around it."""
        rng = np.random.default_rng(2)
        x = rng.uniform(0, SIZE, size=(20_000, 2))
        y = (x - np.array(SIZE) / 2) * 1.02 + np.array(SIZE) / 2
        within = still_px(SIZE)
        assert (np.linalg.norm(y - x, axis=1) < within).sum() > 100  # enough to count as a still background
        assert motions(x, y, SIZE).still == 0

    @pytest.mark.parametrize(
        ("shift", "turned_deg"), [((0.002, -0.002), 0.0), ((-0.1, 0.05), 0.0), ((0.1, 0.0), -1.5), ((0.0, -0.05), 2.5)]
    )
    def test_background_that_is_displaced_as_a_whole_stays(self, shift: tuple[float, float], turned_deg: float) -> None:
        """The tripod gives way, or photos are cropped around the object: a similarity that the object does not follow.

        The shift is in diagonals of the picture.
        """
        angle = np.radians(turned_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        two = 0
        for i, j, moving in ring_pairs():
            x, y = staying(150, seed=i + j)
            centre = np.array(SIZE) / 2
            found = both(moving, (x, (y - centre) @ turn.T + centre + np.hypot(*SIZE) * np.array(shift)))
            assert found.still >= 140
            two += found.two
        assert two == len(ring_pairs())

    def test_background_that_moves_far_is_no_still_one(self) -> None:
        for i, j, moving in ring_pairs():
            x, y = staying(150, seed=i + j)
            assert not both(moving, (x, y + 0.2 * np.hypot(*SIZE))).two

    def test_wide_background_is_preferred_to_the_front_of_the_object(self) -> None:
        """More matches on a flat front follow a similarity of their own, but in a small part of the picture."""
        front = staying(300, seed=1, box=(0.4, 0.4, 0.6, 0.6))
        x, y = staying(100, seed=2)
        found = both((front[0], front[1] + 20), (x, y))
        assert found.stays[300:].sum() >= 95
        assert not found.stays[:300].any()

    def test_nothing_says_nothing(self) -> None:
        found = motions(np.zeros((0, 2)), np.zeros((0, 2)), SIZE)
        assert (found.still, found.moving, found.two, found.one, found.only_still) == (0, 0, False, False, False)

    def test_same_matches_say_the_same(self) -> None:
        _, _, moving = ring_pairs()[0]
        one, other = (both(moving, staying(100, seed=1)) for _ in range(2))
        np.testing.assert_array_equal(one.moves, other.moves)
        assert one.agreeing == other.agreeing


class TestTogether:
    @staticmethod
    def of(box: tuple[float, float, float, float]) -> list[Motions]:
        return [both(moving, staying(60, seed=i + j, box=box)) for i, j, moving in ring_pairs()]

    @pytest.mark.parametrize("box", [(0.75, 0.93, 0.99, 0.99), (0.0, 0.94, 1.0, 1.0), (0.85, 0.02, 0.98, 0.15)])
    def test_time_stamp_or_mark_is_no_background(self, box: tuple[float, float, float, float]) -> None:
        said = together(self.of(box))
        assert (said.two_motions, said.wide, said.found) == (True, False, False)

    def test_background_around_an_object_is_found_and_copies_neither_make_nor_hide_it(self) -> None:
        around, copies = self.of((0, 0, 1, 1)), [motions(*staying(200, seed=i), SIZE) for i in range(40)]
        for pairs, found, fraction in ((around, True, 1), (around + copies, True, 1), (copies, False, 0)):
            said = together(pairs)
            assert (said.found, said.fraction) == (found, fraction)

    def test_few_such_pairs_among_others_are_not_enough(self) -> None:
        pairs = [motions(*moving, SIZE) for _, _, moving in ring_pairs()]
        several = [both(moving, staying(60, seed=i)) for i, _, moving in ring_pairs()[:5]]
        assert together(several).found
        assert not together(several + pairs).found


@pytest.fixture(scope="module")
def capture() -> Turntable:
    return turntable(8, size=(480, 360), turn_deg=90, supersampled=1, seed=1)


class TestMasks:
    @staticmethod
    def around(capture: Turntable) -> np.ndarray:
        """Return positions of the background, as fractions of the picture."""
        height, width = capture.masks.shape[1:]
        rows, columns = np.nonzero(~capture.masks.any(axis=0))
        return np.column_stack([columns / width, rows / height])

    def check(
        self,
        capture: Turntable,
        pictures: list[np.ndarray],
        *,
        cut: float,
        extra: float,
        placed: Sequence[np.ndarray] = (),
    ) -> None:
        """Check masks of pictures that are placed in the capture's by similarities."""
        placed = placed or [np.eye(2, 3)] * len(pictures)
        behind = still.background(pictures, placed, self.around(capture))
        for picture, similarity, mask in zip(pictures, placed, capture.masks, strict=True):
            truth = cv2.warpAffine(mask.astype(np.uint8), similarity, mask.shape[::-1]) > 0
            size = (truth.shape[1], truth.shape[0])
            found = still.enlarged(still.differs(picture, behind.seen_with(similarity, size)), size)
            assert (truth & ~found).sum() < cut * truth.sum()
            assert (found & ~truth).sum() < extra * truth.size

    def test_photos_may_be_displaced(self, capture: Turntable) -> None:
        """Each photo is moved and turned by known amounts; what comes in from outside the picture is grey noise."""
        rng = np.random.default_rng(3)
        placed, pictures = [], []
        for photo in capture.photos:
            similarity = cv2.getRotationMatrix2D((240, 180), rng.uniform(-1.5, 1.5), 1.0)
            similarity[:, 2] += rng.uniform(-25, 25, size=2)
            placed.append(similarity)
            pictures.append(cv2.warpAffine(photo, similarity, (480, 360), borderMode=cv2.BORDER_REFLECT))
        self.check(capture, pictures, cut=0.05, extra=0.05, placed=placed)

    def test_masks_hold_the_object_and_little_else_whatever_the_light_of_each_photo(self, capture: Turntable) -> None:
        self.check(capture, [reduced(photo, still.SIDE_PX) for photo in capture.photos], cut=0.03, extra=0.03)
        gains = np.random.default_rng(0).uniform(0.8, 1.1, size=(len(capture.photos), 1, 1, 1))
        brighter = np.clip(capture.photos * gains, 0, 255).astype(np.uint8)
        self.check(capture, [reduced(photo, still.SIDE_PX) for photo in brighter], cut=0.05, extra=0.06)


SETTINGS = PoseSettings(max_image_size=480, max_features=500, threads=1)


def solved(photos: Path, scene_dir: Path, **options: Any) -> tuple[dict, list[str]]:
    notes: list[str] = []
    settings = replace(SETTINGS, **options)
    with worker_in_this_process():
        estimate_poses(photos, scene_dir, settings=settings, notify=notes.append)
    return json.loads((scene_dir / "poses_report.json").read_text(encoding="utf-8")), notes


def errors(capture: Turntable, scene_dir: Path) -> tuple[float, float]:
    """Return the largest position error (fraction of the radius) and rotation error (degrees) after alignment."""
    frames = load_scene(scene_dir).frames
    truth = np.array([capture.object_from_cam[int(Path(frame.name).name[5:8])] for frame in frames])
    found = np.array([frame.world_from_cam for frame in frames])
    moved = align(found[:, :3, 3], truth[:, :3, 3])
    aligned = np.array([moved.apply_pose(pose) for pose in found])
    radius = np.linalg.norm(truth[:, :3, 3], axis=1).mean()
    off = np.swapaxes(truth[:, :3, :3], 1, 2) @ aligned[:, :3, :3]
    distances = np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1)
    return float(distances.max() / radius), float(np.degrees(Rotation.from_matrix(off).magnitude()).max())


@pytest.fixture(scope="module")
def made(capture: Turntable, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict, list[str]]:
    folder = tmp_path_factory.mktemp("turntable")
    write(capture, folder)
    return folder, *solved(folder / "images", folder / "scene")


@pytest.fixture(scope="module")
def once() -> dict[str, Callable[..., list]]:
    """The slow steps of making masks, which compute at their first call: the photos of `job` are always the same."""
    found: dict[str, list] = {}

    def remembering(name: str, step: Callable[..., list]) -> Callable[..., list]:
        def recall(*given: Any, **more: Any) -> list:
            if name not in found:
                found[name] = step(*given, **more)
            return list(found[name])

        return recall

    return {name: remembering(name, getattr(module, name)) for name in ("_compare_photos", "_make_masks")}


@pytest.fixture
def job(
    capture: Turntable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, once: dict[str, Callable[..., list]]
) -> Job:
    """Return the worker's job for a turntable whose masks have been made."""
    for name, step in once.items():
        monkeypatch.setattr(module, name, step)
    work = tmp_path / "scene" / "work"
    (work / "photos").mkdir(parents=True)
    names = tuple(f"{number}.png" for number in range(len(capture.photos)))
    for name, photo in zip(names, capture.photos, strict=True):
        Image.fromarray(photo).save(work / "photos" / name, compress_level=1)
    made = synthetic.job_of(work, names, (CameraGroup(tuple(range(len(names))), "PINHOLE", 480, 360),))
    mask_turning_object(made, lambda note: None)
    return made


def interrupted_masking(job: Job) -> None:
    """Make masks that are all white, and be interrupted where the first one is written for pycolmap."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(still, "enlarged", lambda mask, size: np.ones(size[::-1], bool))
        patched.setattr(module, "write_mask", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            mask_turning_object(job, lambda note: None)


class TestPoses:
    def test_object_is_solved_as_if_the_camera_went_around_it(
        self, capture: Turntable, made: tuple[Path, dict, list[str]]
    ) -> None:
        folder, report, notes = made
        assert report["registered"] == len(capture.photos)
        position, rotation_deg = errors(capture, folder / "scene")
        assert position < 0.02
        assert rotation_deg < 0.5
        assert sum("the object turns in front of a background that does not (" in note for note in notes) == 1

    def test_report_has_the_numbers(self, capture: Turntable, made: tuple[Path, dict, list[str]]) -> None:
        found = made[1]["moving_foreground"]
        assert found["masked"]
        assert found["unmasked"] == []
        # No pair shows the object alone; in pairs 45 degrees apart and more, too little of it matches to be a motion.
        assert found["pairs_one_motion"] == 0
        assert found["pairs_two_motions"] > 0.7 * found["pairs"]
        assert abs(found["white_share"][1] - capture.masks.mean()) < 0.03
        assert found["object_matches_in_white"] > 0.95
        assert found["background_matches_in_black"] > 0.95

    def test_scene_has_masks_for_training(self, capture: Turntable, made: tuple[Path, dict, list[str]]) -> None:
        for frame in load_scene(made[0] / "scene").frames:
            assert frame.mask is not None
            mask = np.asarray(Image.open(frame.mask).convert("L")) > 127
            truth = capture.masks[int(frame.name[5:8])]
            assert (truth & ~mask).sum() < 0.03 * truth.sum()
            assert (mask & ~truth).sum() < 0.03 * truth.size

    def test_masks_that_were_edited_by_hand_are_used(self, made: tuple[Path, dict, list[str]]) -> None:
        """Existing masks are kept when poses are estimated again, also when features change."""
        folder = made[0]
        mask = sorted((folder / "scene" / "masks").iterdir())[0]
        narrower = np.asarray(Image.open(mask)).copy()
        narrower[:200] = False
        Image.fromarray(narrower).save(mask)
        for again in ({"seed": 1}, {"max_features": 450}):
            report, notes = solved(folder / "images", folder / "scene", **again)
            assert sum("the object turns in front of a background that does not (" in note for note in notes) == 1
            assert (np.asarray(Image.open(mask)) == narrower).all()
            assert report["moving_foreground"]["masked"]
            assert report["images"][0]["registered"]

    @pytest.mark.parametrize(
        ("found", "first"), [(None, 0), (np.ones((36, 48), bool), 0), (np.ones((36, 48), bool), 1)]
    )
    def test_masks_that_were_edited_are_used_whatever_is_found(
        self, job: Job, monkeypatch: pytest.MonkeyPatch, found: np.ndarray | None, first: int
    ) -> None:
        """Also where the background of a photo matches no other any more, and where the masks made now are refused.

        Photos before the first edited mask get none then.
        """
        edited = []
        for name in job.names[first:]:
            path = scene_masks(job) / f"{name}.png"
            edited.append(np.asarray(Image.open(path)).copy())
            edited[-1][:150] = False  # most of the object
            Image.fromarray(edited[-1]).save(path)
        monkeypatch.setattr(module, "_make_masks", lambda *_, **__: [found] * len(job.files))
        used, facts = mask_turning_object(job, lambda note: None)
        assert facts is not None
        assert (facts["masked"], facts["unmasked"]) == (True, list(job.names[:first]))
        assert [mask.used_fraction for mask in used.masks] == [1.0] * first + [mask.mean() for mask in edited]
        said = "no masks of the rest could be created, because they would cover 100.0 % of a photo"
        assert (said in describe_motions(facts)) == (first > 0)

    @pytest.mark.parametrize("found", [True, False])
    def test_an_edited_mask_that_does_not_fit_is_neither_used_nor_lost(
        self, job: Job, monkeypatch: pytest.MonkeyPatch, found: bool
    ) -> None:
        """Regression: it was overwritten, or removed if no mask was found for its photo any more."""
        make, path = module._make_masks, scene_masks(job) / f"{job.names[0]}.png"
        Image.new("1", (240, 180), 1).save(path)
        edited, notes = path.read_bytes(), list[str]()
        if not found:
            monkeypatch.setattr(module, "_make_masks", lambda *some, **more: [None, *make(*some, **more)[1:]])
        masked, _ = mask_turning_object(job, notes.append)
        assert (masked.masks[0].used_fraction < 1) == found
        assert path.exists() == found
        assert (path.parent / f"unusable-{path.name}").read_bytes() == edited
        assert sum("240x180" in note and f"it is now unusable-{path.name}" in note for note in notes) == 1

    def test_a_mask_that_the_user_made_for_a_photo_that_got_none_is_used_and_kept(
        self, job: Job, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Regression: only training used it, and it was overwritten when a mask was found."""
        make, path = module._make_masks, scene_masks(job) / f"{job.names[0]}.png"
        with monkeypatch.context() as patched:
            patched.setattr(module, "_make_masks", lambda *some, **more: [None, *make(*some, **more)[1:]])
            mask_turning_object(job, lambda note: None)
        own = np.zeros((360, 480), bool)
        own[100:200] = True
        Image.fromarray(own).save(path)
        drawn = path.read_bytes()
        recalled = recall_masks(job)
        assert recalled is not None
        for used, facts in (recalled, mask_turning_object(job, lambda note: None)):
            assert facts is not None
            assert facts["unmasked"] == []
            assert used.masks[0].used_fraction == own.mean()
            assert path.read_bytes() == drawn

    def test_masks_of_a_run_that_was_interrupted_are_not_taken_for_edited_ones(self, job: Job) -> None:
        expected = mask_turning_object(job, lambda note: None)[0].masks
        interrupted_masking(job)
        assert np.asarray(Image.open(scene_masks(job) / f"{job.names[0]}.png")).all()
        assert mask_turning_object(job, lambda note: None)[0].masks == expected

    def test_a_photo_that_gets_no_mask_any_more_has_no_old_one(self, job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
        make = module._make_masks
        monkeypatch.setattr(module, "_make_masks", lambda *some, **more: [None, *make(*some, **more)[1:]])
        _, facts = mask_turning_object(job, lambda note: None)
        assert facts is not None
        assert (facts["masked"], facts["unmasked"]) == (True, [job.names[0]])
        there = [(scene_masks(job) / f"{name}.png").exists() for name in job.names]
        assert there == [False] + [True] * (len(job.names) - 1)

    def test_an_edited_mask_of_a_photo_saved_again_is_kept(self, job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
        make, path = module._make_masks, scene_masks(job) / f"{job.names[0]}.png"
        Image.fromarray(~np.asarray(Image.open(path))).save(path)
        edited = path.read_bytes()
        monkeypatch.setattr(module, "_make_masks", lambda *some, **more: [None, *make(*some, **more)[1:]])
        _, facts = mask_turning_object(replace(job, keys=("new", *job.keys[1:])), lambda note: None)
        assert facts is not None
        assert facts["unmasked"] == [job.names[0]]
        assert path.read_bytes() == edited

    def test_a_photo_that_gets_no_mask_has_none_of_a_run_that_was_interrupted(
        self, job: Job, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The first mask was written by that run, the last one before it."""
        interrupted_masking(job)
        make = module._make_masks
        monkeypatch.setattr(module, "_make_masks", lambda *some, **more: [None, *make(*some, **more)[1:-1], None])
        mask_turning_object(job, lambda note: None)
        there = [(scene_masks(job) / f"{name}.png").exists() for name in job.names]
        assert there == [False] + [True] * (len(job.names) - 2) + [False]

    def test_camera_at_two_heights_that_is_turned_a_little_between_photos(self, tmp_path: Path) -> None:
        """The background of either height moves by 10 px (standard deviation) from photo to photo, 1.7 % of 600 px.

        The photos are in a subfolder, and so are their masks.
        """
        capture = turntable(12, size=(480, 360), heights=2, turn_deg=90, shift_px=10, supersampled=1, seed=2)
        write(capture, tmp_path)
        (tmp_path / "images").rename(tmp_path / "one camera")
        (tmp_path / "photos").mkdir()
        (tmp_path / "one camera").rename(tmp_path / "photos" / "one camera")
        report, notes = solved(tmp_path / "photos", tmp_path / "scene", subfolders=True)
        assert report["moving_foreground"]["masked"]
        assert report["moving_foreground"]["unmasked"] == []
        assert report["registered"] == len(capture.photos)
        position, rotation_deg = errors(capture, tmp_path / "scene")
        assert position < 0.02
        assert rotation_deg < 0.5
        assert any("as on a turntable: making masks of it" in note for note in notes)

    def test_object_in_a_room_that_turns_with_it_needs_no_masks(self, capture: Turntable, tmp_path: Path) -> None:
        """Like a camera that moves around the object: the background outside the true masks is made grey."""
        photos = np.where(capture.masks[..., None], capture.photos, np.uint8(128))
        write(replace(capture, photos=photos), tmp_path)
        report, notes = solved(tmp_path / "images", tmp_path / "scene", max_features=400)
        assert report["moving_foreground"] is None
        assert not (tmp_path / "scene" / "masks").exists()
        assert not any("turns" in note for note in notes)
        assert all(frame.mask is None for frame in load_scene(tmp_path / "scene").frames)


class TestDoctor:
    @staticmethod
    def examined(folder: Path) -> Diagnosis:
        subject = find_subject(folder)
        return examine(subject, threads=1, progress=lambda done, what: None)

    def test_a_turntable_is_named_and_the_camera_is_not_blamed(self, capture: Turntable, tmp_path: Path) -> None:
        """The camera stood still, so "only turned, or hardly moved" would be the wrong advice."""
        write(capture, tmp_path)
        diagnosis = self.examined(tmp_path / "images")
        found = {finding.check: finding for finding in diagnosis.findings}
        assert found["turning object"].verdict == LOOK
        assert "turntable" in found["turning object"].summary
        assert "--masks" in found["turning object"].advice
        assert not {"movement", "moving content", "depth relief"} & found.keys()

    def test_camera_that_goes_around_is_examined_as_before(self, capture: Turntable, tmp_path: Path) -> None:
        photos = np.where(capture.masks[..., None], capture.photos, np.uint8(128))
        write(replace(capture, photos=photos), tmp_path)
        checks = {finding.check for finding in self.examined(tmp_path / "images").findings}
        assert "turning object" not in checks
        assert {"movement", "moving content"} <= checks


def test_refusal_says_what_to_do_about_it() -> None:
    error = UserError("only 3 of 66 photos registered", "take more", 4)
    facts = {"wide": True, "masked": False, "why_not": "x", "pairs": 9, "pairs_two_motions": 9, "unmasked": []}
    assert "--masks" in (add_advice(error, facts).hint or "")
    assert add_advice(error, facts).exit_code == 4
    assert add_advice(error, None) is error
    assert add_advice(error, facts | {"wide": False}) is error
    assert "--masks" in describe_motions(facts)
