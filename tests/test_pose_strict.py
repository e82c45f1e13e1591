"""poses --strict on the room corner, whose poses are known: held-out photos change nothing, and are placed rightly."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from corner import CENTRES, NAMES, cam_from_world, write_capture
from in_this_process import poses_in_this_process
from PIL import Image
from synthetic_captures import job_of
from test_poses import FAST

from nerfcli.cameras.alignment import align
from nerfcli.captures.loading import load_scene
from nerfcli.evaluate.ledger import leak_ledger
from nerfcli.poses.engine import worker
from nerfcli.poses.engine.database import register_photos
from nerfcli.poses.engine.held_out_photos import move_held_out_last, place_held_out, training_part
from nerfcli.poses.engine.mapping import MappedModels
from nerfcli.poses.input.job import CameraGroup, Job
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.model.reasons import NO_MODEL, dominant
from nerfcli.poses.report import PosesReport
from nerfcli.poses.workspace import is_same_scene
from nerfcli.training.runs.run import RunConfig

HELD_OUT = 2  # in the middle, and stored upright


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, PoseSettings, PosesReport]:
    folder = tmp_path_factory.mktemp("strict")
    write_capture(folder / "photos")
    for number in range(2):
        Image.new("RGB", (300, 200), (200, 200, 200)).save(folder / "photos" / f"other camera {number}.png")
    (folder / "test.txt").write_text(f"{NAMES[HELD_OUT]}\nwall.png\nother camera 1.png\n")
    settings = replace(FAST, max_features=300, max_image_size=320, strict=True, holdout=str(folder / "test.txt"))
    with training_model_kept(folder):
        report = poses_in_this_process(folder / "photos", folder / "scene", settings)
    return folder / "photos", folder / "scene", settings, report


@contextmanager
def training_model_kept(folder: Path) -> Iterator[None]:
    """Copy the model of the training photos to a folder before held-out ones are placed."""

    def place_after_copying(job: Job, *others: Any) -> dict[str, Any]:
        shutil.copytree(Path(job.folder) / "sparse" / "0", folder / "training model")
        return place_held_out(job, *others)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(worker, "place_held_out", place_after_copying)
        yield


def assert_added(folder: Path, name: str) -> set[str]:
    """Assert that a scene has nothing but a photo more than its training model; return what that has brought."""
    model = pycolmap.Reconstruction(str(folder / "scene" / "sparse" / "0"))
    before, after = bits(pycolmap.Reconstruction(str(folder / "training model"))), bits(model)
    assert before.items() <= after.items()
    photo = model.find_image_with_name(name)
    numbers = {"pose": photo.image_id, "camera": photo.camera_id}
    added = after.keys() - before.keys()
    assert all(number == numbers[kind] for kind, number in added)
    return {kind for kind, _ in added}


def bits(model: pycolmap.Reconstruction) -> dict[tuple[str, int], Any]:
    """Return every bit of the points with their tracks, of the cameras, and of the poses."""
    points = {
        ("point", number): (point.xyz.tobytes(), sorted((e.image_id, e.point2D_idx) for e in point.track.elements))
        for number, point in model.points3D.items()
    }
    cameras = {
        ("camera", number): (camera.model.name, camera.width, camera.height, camera.params.tobytes())
        for number, camera in model.cameras.items()
    }
    poses = {
        ("pose", i): (image.name, image.camera_id, image.cam_from_world().matrix().tobytes())
        for i, image in ((i, model.image(i)) for i in model.reg_image_ids())
    }
    return points | cameras | poses


def test_a_held_out_photo_is_placed_and_moves_nothing_by_a_bit(solved):
    """Synthetic truth for the pose; all else is as it was before, to the last bit."""
    photos, scene_dir, _, report = solved
    model = pycolmap.Reconstruction(str(scene_dir / "sparse" / "0"))
    name = NAMES[HELD_OUT]
    assert assert_added(photos.parent, name) == {"pose"}
    held_out = model.find_image_with_name(name)
    tracks = [element.image_id for point in model.points3D.values() for element in point.track.elements]
    assert held_out.image_id not in tracks
    others = [index for index in range(len(NAMES)) if index != HELD_OUT]
    centres = np.array([model.find_image_with_name(NAMES[index]).projection_center() for index in others])
    truth_from_found = align(centres, CENTRES[others])
    assert np.linalg.norm(truth_from_found.apply(held_out.projection_center()) - CENTRES[HELD_OUT]) < 0.01
    turned = held_out.cam_from_world().rotation.matrix() @ truth_from_found.rotation.T
    turn = turned @ cam_from_world(CENTRES[HELD_OUT])[:, :3].T
    assert np.degrees(np.arccos(min((np.trace(turn) - 1) / 2, 1.0))) < 0.3
    assert report.strict["placed"][name]["inliers"] > 50
    assert report.strict["placed"][name]["error_px"] < 1.5


def test_the_scene_records_what_was_held_out_and_how(solved):
    photos, scene_dir, settings, report = solved
    images = {image.name: image for image in report.images}
    assert images["wall.png"].reason == "matches too few points of the training photos (0 inliers of 0)"
    assert images["other camera 1.png"].reason == "held out, and no training photo of its camera registered"
    assert (report.registered, report.total) == (7, 10)
    loaded = load_scene(scene_dir)
    assert loaded.test_names == {NAMES[HELD_OUT]}
    assert (loaded.provenance["registered"], loaded.provenance["total"]) == (7, 10)
    ledger = {entry.stage: entry.saw_held_out for entry in leak_ledger(RunConfig(history=loaded.provenance))}
    assert (ledger["poses"], ledger["intrinsics"], ledger["points"]) == (False, False, False)
    assert is_same_scene(scene_dir, photos, settings)
    assert not is_same_scene(scene_dir, photos, replace(settings, strict=False))
    Path(settings.holdout).write_text(NAMES[0])
    assert not is_same_scene(scene_dir, photos, settings)


def test_a_held_out_photo_is_placed_with_the_features_of_the_model(solved, tmp_path, monkeypatch):
    """Regression: the features of a model that took an attempt with larger pictures were taken for the first ones."""
    map_photos = worker._map

    def map_with_larger_pictures(job: Job, *others: Any, **more: Any) -> MappedModels:
        register_photos(job)  # as the first attempts do
        return map_photos(replace(job, variant="full-size", max_image_size=480), *others, **more)

    monkeypatch.setattr(worker, "_map", map_with_larger_pictures)
    (tmp_path / "test.txt").write_text(NAMES[HELD_OUT])
    with training_model_kept(tmp_path):
        poses_in_this_process(solved[0], tmp_path / "scene", replace(solved[2], holdout=str(tmp_path / "test.txt")))
    assert assert_added(tmp_path, NAMES[HELD_OUT]) == {"pose"}


def job_of_five() -> Job:
    """The second and third photos are held out."""
    files = ("00000.jpg", "00003.jpg", "00004.jpg", "00007.jpg", "00008.jpg")
    groups = (
        CameraGroup((1,), "OPENCV", 4, 3),
        CameraGroup((0, 2), "PINHOLE", 4, 3),
        CameraGroup((3, 4), "RADIAL", 8, 6),
    )
    named: dict[str, Any] = {"names": ("a", "b", "c", "d", "e"), "keys": ("ka", "kb", "kc", "kd", "ke")}
    pairs = ((0, 1), (0, 2), (1, 3), (2, 4), (3, 4))
    return job_of(Path("work"), files, groups, pairs=pairs, held_out=(1, 2), **named)


def test_a_held_out_photo_is_not_said_to_lack_features_where_no_training_photo_is_placed():
    seen = {"features": 60, "best_matches": 8, "best_partner": "a"}
    result = {"models": [], "evidence": dict.fromkeys("ade", seen)}
    whole = place_held_out(job := job_of_five(), training_part(job), result, lambda *progress: None)
    assert whole["left_out"] == dict.fromkeys(("b", "c"), NO_MODEL)
    unseen = {"features": 0, "best_matches": 0, "best_partner": None}
    assert whole["evidence"] == dict.fromkeys("ade", seen) | dict.fromkeys("bc", unseen)
    assert dominant([NO_MODEL, "too few features (9 in 40x30 pixels)"])[0] == "too few features"


def test_the_training_part_keeps_files_cameras_and_pairs_together():
    ordered = move_held_out_last(job_of_five())
    assert [group.model for group in ordered.groups] == ["PINHOLE", "RADIAL", "OPENCV"]
    part = training_part(ordered)
    assert (part.files, part.names, part.keys) == (
        ("00000.jpg", "00007.jpg", "00008.jpg"),
        ("a", "d", "e"),
        ("ka", "kd", "ke"),
    )
    assert [(group.model, group.photos) for group in part.groups] == [("PINHOLE", (0,)), ("RADIAL", (1, 2))]
    assert part.pairs == ((1, 2),)
    assert part.image_ids == (1, 8, 9)
    assert part.held_out == ()
