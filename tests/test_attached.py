"""What is attached to the camera: painted into photos of textured walls, at the same place in each of them."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from test_stereo import TEXTURE, truth, written
from trainings import FEW, fit

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import rotation_from_vector
from nerfcli.captures.capture import Capture
from nerfcli.evaluate.photos import held_out_photos
from nerfcli.matching.attached import FEWEST_PHOTOS, attached_masks, masks_of
from nerfcli.photos.images import read_image
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.poses.engine import turntable
from nerfcli.poses.engine.turntable import mask_turning_object, recall_masks
from nerfcli.poses.input.job import CameraGroup, Job
from nerfcli.training import preparation
from nerfcli.training.preparation import prepare
from nerfcli.training.runs.run import Run
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.storage import MemoryNeeds, PhotoStorage, storage_for

CAMERA = Camera.pinhole(320, 240, 300.0)
STEPS = np.linspace(-1.0, 1.0, 9)


def outline(*corners: tuple[int, int]) -> np.ndarray:
    return cv2.fillPoly(np.zeros((240, 320), np.uint8), [np.array(corners)], 1) > 0


GRIPPER = outline((250, 240), (262, 150), (285, 140), (300, 200), (300, 240))
WATERMARK = outline((14, 200), (50, 196), (46, 226), (20, 230))
BONNET = outline((0, 215), (160, 190), (320, 215), (320, 240), (0, 240))
BARS = outline((0, 0), (320, 0), (320, 24), (0, 24)) | outline((0, 216), (320, 216), (320, 240), (0, 240))
FRAME = ~outline((20, 20), (300, 20), (300, 220), (20, 220))
ROUND = np.hypot(*np.mgrid[-119.5:120, -159.5:160]) > 115
POLE = outline((296, 0), (304, 0), (304, 240), (296, 240))


def walls(where: np.ndarray | None = None, *, colour: float = 30.0, count: int = len(STEPS)) -> list[LoadedPhoto]:
    """Return photos of walls by a camera that moves irregularly, with a thing of one colour painted into each."""
    shown = []
    for step in STEPS[:count]:
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_vector(np.array([0.1 * np.cos(5.0 * step), 0.2 * np.sin(7.0 * step), 0.05 * step]))
        pose[0, 3] = 0.6 * step
        x, y = (truth(CAMERA, pose)[1][..., axis].astype(np.float32) * 130 + 450 for axis in (0, 1))
        grey = np.clip(128 + 1.5 * (cv2.remap(TEXTURE, x, y, cv2.INTER_CUBIC) - 128), 0, 255).astype(np.uint8)
        shown.append(LoadedPhoto(Frame(f"{step}.png", CAMERA, pose), np.repeat(grey[..., None], 3, axis=2), None))
    return shown if where is None else [painted(one, where, colour) for one in shown]


def painted(one: LoadedPhoto, where: np.ndarray, colour: float) -> LoadedPhoto:
    return replace(one, pixels=np.where(where[..., None], colour, one.pixels).astype(np.uint8))


def mask_of(photos: list[LoadedPhoto]) -> np.ndarray | None:
    (mask,) = attached_masks(photos, threads=2).values() or (None,)
    return mask


def grown(mask: np.ndarray, by_px: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)) > 0


@pytest.mark.parametrize(
    "where",
    [GRIPPER, WATERMARK, BONNET, BARS, FRAME, ROUND],
    ids=["gripper", "watermark", "bonnet", "bars", "frame", "round"],
)
def test_what_stays_in_place_is_found_with_its_edge(where):
    mask = mask_of(walls(where))
    assert mask is not None
    assert mask[where].all()
    assert not mask[~grown(where, 8)].any()


def test_it_may_shake_and_be_lit_differently():
    shaken = []
    for number, one in enumerate(walls()):
        moved = np.roll(GRIPPER, (number % 2, number // 3 - 1), axis=(0, 1))
        shaken.append(painted(one, moved, 20.0 + 5.0 * (number % 3)))
    mask = mask_of(shaken)
    assert mask is not None
    assert mask[GRIPPER].mean() > 0.95
    assert not mask[~grown(GRIPPER, 10)].any()


@pytest.mark.parametrize(
    "photos",
    [
        walls(),
        walls(GRIPPER, count=FEWEST_PHOTOS - 1),
        walls(outline((130, 100), (190, 100), (190, 140), (130, 140))),
        [painted(one, GRIPPER, 30.0) if number < 6 else one for number, one in enumerate(walls())],
        [replace(one, pixels=np.dstack([one.pixels, GRIPPER * np.uint8(255)])) for one in walls(GRIPPER)],
        [replace(one, frame=replace(one.frame, name=f"{n}/a.png")) for n, one in enumerate(walls(GRIPPER))],
    ],
    ids=["nothing", "few photos", "in the middle", "in some photos", "alpha", "a camera for each photo"],
)
def test_nothing_else_is_taken_for_attached(photos):
    assert attached_masks(photos, threads=2) == {}


@pytest.mark.parametrize("motion", ["around", "along", "past"])
def test_an_edge_that_the_scene_may_have_there_is_none(motion):
    """A pole around which the camera turns, or along which it moves, has its place in all photos; not one it passes."""
    photos = []
    for number, step in enumerate(STEPS):
        pose = np.eye(4)
        if motion == "along":
            pose[1, 3] = step
        else:  # it turns, around the pole at column 300, which is 4 before it, or while it moves past
            pose[:3, :3] = rotation_from_vector(np.array([0.0, 0.4 * step, 0.0]))
            pose[:3, 3] = -pose[:3, :3] @ (4.0 * 140.0 / 300.0, 0.0, 4.0) if motion == "around" else (step, 0.0, 0.0)
        noise = np.random.default_rng(number).uniform(90, 250, (240, 320)).astype(np.float32)
        pixels = np.repeat(cv2.GaussianBlur(noise, (0, 0), 2)[..., None], 3, axis=2).astype(np.uint8)
        photos.append(painted(LoadedPhoto(Frame(f"{number}.png", CAMERA, pose), pixels, None), POLE, 20.0))
    mask = mask_of(photos)
    assert (mask is not None) == (motion == "past")
    assert mask is None or mask[POLE].all()


def test_cameras_have_masks_of_their_own():
    left, right = (
        [replace(one, frame=replace(one.frame, name=f"{side}/{one.frame.name}")) for one in walls(where)]
        for side, where in (("left", GRIPPER), ("right", WATERMARK))
    )
    masks = {folder.name: mask for (folder, _), mask in attached_masks([*left, *right], threads=2).items()}
    assert masks["left"][GRIPPER].all()
    assert masks["right"][WATERMARK].all()
    assert not (masks["left"] & masks["right"]).any()


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Photos with a gripper, of which the last one is held out."""
    frames = written(tmp_path / "walls", walls(GRIPPER))
    return Capture(frames, np.zeros((0, 3)), root=tmp_path / "walls", test_names=frozenset({frames[-1].name}))


@pytest.mark.parametrize("fixed", [(), ("occluders",)], ids=["by default", "without occluders"])
def test_training_and_evaluation_leave_it_out(capture, tmp_path, fixed):
    fit(capture, tmp_path / "run", replace(FEW, steps=20, model="auto", fixed=fixed), notes=(notes := []))
    written = {path.name for path in (tmp_path / "run" / "occluders").rglob("*.png")}
    messages = [note for note in notes if note.startswith("attached to the camera: ") and "of 9 photos" in note]
    run = Run(tmp_path / "run")
    (held_out,) = held_out_photos(run, run.cameras.test)
    if fixed:
        assert (written, messages, held_out.used) == (set(), [], None)
        return
    assert written == {f"{number}.png.png" for number in range(9)}
    assert len(messages) == 1
    assert held_out.used is not None
    assert not held_out.used[GRIPPER].any()
    assert held_out.used[~grown(GRIPPER, 8)].all()


def test_the_memory_of_its_masks_is_counted_where_it_is_found(capture, tmp_path, monkeypatch):
    needs: list[MemoryNeeds] = []

    def recorded(needed: MemoryNeeds, *limits: int | None, folder: Path) -> tuple[PhotoStorage, str]:
        needs.append(needed)
        return storage_for(needed, *limits, folder=folder)

    monkeypatch.setattr(preparation, "storage_for", recorded)
    prepare(capture, TrainSettings(budget_seconds=None, steps=20, model="auto"), run=tmp_path, notify=lambda note: None)
    assert [entry.photos - needs[0].photos for entry in needs] == [0, 9 * 9 * 320 * 240]


def job_of(work: Path, names: tuple[str, ...]) -> Job:
    return Job(
        folder=str(work), files=names, originals=str(work / "photos"), names=names, keys=names,
        groups=(CameraGroup(tuple(range(len(names))), "PINHOLE", 320, 240),), pairs=(), neighbours=0,
        max_image_size=320, max_features=500, seed=0, threads=1,
    )  # fmt: skip


def test_no_features_are_searched_for_on_it(tmp_path):
    """The masks of pycolmap are those of the next call, too; if one is lost, all are made again."""
    work, names = tmp_path / "scene" / "work", tuple(f"{number}.png" for number in range(len(STEPS)))
    (work / "photos").mkdir(parents=True)
    for name, one in zip(names, walls(GRIPPER), strict=True):
        Image.fromarray(one.pixels).save(work / "photos" / name)
    job = job_of(work, names)
    notes: list[str] = []
    masked, facts = mask_turning_object(job, notes.append)
    assert facts is None
    assert [note for note in notes if note.startswith("attached to the camera: ")] == notes != []
    for name in names:
        used = read_image(work / "masks" / f"{name}.png")[..., 0] > 0
        assert not used[GRIPPER].any()
        assert used[~grown(GRIPPER, 8)].all()
    assert not turntable.scene_masks(job).exists()
    assert recall_masks(job) == (masked, None)
    (work / "masks" / f"{names[3]}.png").unlink()
    assert recall_masks(job) is None


def test_an_object_with_a_still_outline_is_not_taken_for_attached(tmp_path):
    """Regression: a can on a turntable before a plain background, whose outline is the same in all photos."""
    work, names = tmp_path / "scene" / "work", tuple(f"{number}.png" for number in range(12))
    (work / "photos").mkdir(parents=True)
    random = np.random.default_rng(0)
    label = cv2.GaussianBlur(random.uniform(0, 255, (190, 1200)).astype(np.float32), (0, 0), 1.5)
    angles = np.arcsin(np.linspace(-1.0, 1.0, 100))
    for number, name in enumerate(names):
        columns = ((angles / (2 * np.pi) + 0.02 * number) * 1200 % 1200).astype(int)
        grey = random.normal(200, 2, (240, 320))
        grey[25:215, 110:210] = np.clip(1.5 * (label[:, columns] - 128) + 90, 30, 150)
        Image.fromarray(np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)).save(work / "photos" / name)
    job = job_of(work, names)
    assert mask_turning_object(job, lambda note: None) == (job, None)


def test_held_out_photos_in_a_folder_of_their_own_have_the_masks_of_their_size():
    photos = [replace(one, frame=replace(one.frame, name=f"train/{one.frame.name}")) for one in walls(GRIPPER)]
    frames = [one.frame for one in photos]
    other = replace(frames[0], name="test/0.png")
    smaller = replace(other, name="test/1.png", camera=Camera.pinhole(300, 240, 300.0))
    masks = masks_of([*frames, other, smaller], attached_masks(photos, threads=1), seen=frames)
    assert set(masks) == {frame.name for frame in (*frames, other)}
