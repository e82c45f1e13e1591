"""Structure from motion, end to end, on the room corner of `corner`, whose poses are known."""

import json
import signal
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest
from corner import CENTRES, FOCAL_PX, NAMES, cam_from_world, wall, write_capture
from in_this_process import worker_in_this_process
from PIL import Image

from nerfcli.cameras.alignment import align
from nerfcli.errors import OUT_OF_MEMORY, TOO_FEW_PHOTOS, UserError
from nerfcli.photos.images import read_image
from nerfcli.poses.engine import supervise
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.report import PosesReport
from nerfcli.poses.structure_from_motion import estimate_poses
from nerfcli.poses.workspace import hash_inputs, is_same_scene

FAST = PoseSettings(max_features=1000, max_image_size=384, threads=2)


@dataclass(frozen=True)
class Solved:
    """The capture after structure from motion."""

    photos: Path
    scene: Path
    report: PosesReport
    notes: list[str]
    stages: list[tuple[str, int, int]]

    @property
    def model(self) -> pycolmap.Reconstruction:
        return pycolmap.Reconstruction(str(self.scene / "sparse" / "0"))


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Solved:
    folder = tmp_path_factory.mktemp("capture")
    photos, scene_dir = write_capture(folder / "my photos"), folder / "corner"
    (photos / "notes.jpg").write_text("this is text")
    (photos / "view 7.cr3").write_bytes(b"raw")
    notes: list[str] = []
    stages: list[tuple[str, int, int]] = []
    report = estimate_poses(
        photos,
        scene_dir,
        settings=FAST,
        notify=notes.append,
        progress=lambda stage, done, total: stages.append((stage, done, total)),
    )
    return Solved(photos, scene_dir, report, notes, stages)


def test_poses_agree_with_the_truth(solved: Solved):
    """Synthetic truth. The cameras are 4 units from the corner; the observed errors are 0.0005 and 0.04 degrees."""
    model = solved.model
    estimated = [model.find_image_with_name(name) for name in NAMES]
    centres = np.array([image.projection_center() for image in estimated])
    truth_from_found = align(centres, CENTRES)
    assert np.linalg.norm(truth_from_found.apply(centres) - CENTRES, axis=1).max() < 0.002
    for image, centre in zip(estimated, CENTRES, strict=True):
        found = image.cam_from_world().rotation.matrix() @ truth_from_found.rotation.T
        cosine = (np.trace(found @ cam_from_world(centre)[:, :3].T) - 1) / 2
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.15


def test_intrinsics_agree_with_the_truth_and_are_shared_by_size(solved: Solved):
    cameras = {(camera["width"], camera["height"]): camera for camera in solved.report.cameras}
    assert {size: camera["images"] for size, camera in cameras.items()} == {(480, 360): 5, (384, 288): 2}
    assert all(camera["model"] == "SIMPLE_RADIAL" for camera in cameras.values())
    assert cameras[480, 360]["params"][:3] == pytest.approx([FOCAL_PX, 240, 180], rel=0.005)
    assert cameras[384, 288]["params"][0] == pytest.approx(0.8 * FOCAL_PX, rel=0.005)


@pytest.mark.parametrize("index", range(len(NAMES)))
def test_points_project_onto_the_upright_picture_where_their_colour_is(solved: Solved, index: int):
    """The model's points, seen by each camera, have the colour of our own reader's pixels there."""
    model = solved.model
    picture = read_image(solved.photos / NAMES[index])
    image = model.find_image_with_name(NAMES[index])
    camera = model.camera(image.camera_id)
    assert picture.shape == (camera.height, camera.width, 3)
    seen = [model.point3D(point.point3D_id) for point in image.points2D if point.has_point3D()]
    pixels = np.array([image.project_point(point.xyz) for point in seen])
    column, row = np.floor(pixels).astype(int).clip(0, np.array([camera.width, camera.height]) - 1).T
    difference = picture[row, column].astype(float) - np.array([point.color for point in seen])
    assert len(seen) > 50
    assert np.median(np.abs(difference)) < 12


def test_every_file_is_registered_or_has_its_reason(solved: Solved):
    images = {image.name: image for image in solved.report.images}
    assert sorted(images) == sorted([*NAMES, "notes.jpg", "view 7.cr3", "wall.png"])
    assert all(images[name].registered and images[name].reason is None for name in NAMES)
    assert images["notes.jpg"].reason == "unreadable: not a readable picture"
    assert images["wall.png"].reason == "too few features (0 in 480x360 pixels)"
    # It matches nothing, so no other start of the mapper could place it.
    assert [attempt["models"] for attempt in solved.report.attempts] == [[7]]
    assert (solved.report.registered, solved.report.total) == (7, 10)
    assert "notes.jpg is skipped: not a readable picture" in solved.notes
    assert is_same_scene(solved.scene, solved.photos, FAST)


def test_the_scene_folder_holds_the_model_and_of_the_work_what_helps_the_next(solved: Solved):
    results = {"sparse", "scene.json", "poses_report.json", "database.db"}
    assert {path.name for path in solved.scene.iterdir()} == {*results, "work"}
    assert {path.suffix for path in (solved.scene / "work").iterdir()} == {".json", ".lock"}
    assert {path.name for path in solved.scene.parent.iterdir()} == {"my photos", "corner"}
    written = {path.name for path in (solved.scene / "sparse/0").iterdir()}
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= written
    assert solved.model.num_points3D() == solved.report.points > 200
    assert 0 < solved.report.mean_reprojection_error_px < 1


def test_the_report_file_has_the_promised_keys(solved: Solved):
    report = json.loads((solved.scene / "poses_report.json").read_text())
    assert set(report["seconds"]) == {"extract", "motions", "match", "map", "check", "stabilisation", "total"}
    assert report["seconds"]["total"] >= sum(report["seconds"][stage] for stage in ("extract", "match", "map"))
    notes = {"name": "notes.jpg", "registered": False, "reason": solved.report.images[0].reason}
    assert report["images"][0] == notes | {"orientation": None, "pose_blur_px": None}
    assert [image["orientation"] for image in report["images"] if image["registered"]] == [1, 6, 1, 1, 6, 1, 1]
    assert all(image["pose_blur_px"] > 0 for image in report["images"] if image["registered"])
    assert report["verdict"]["accepted"]
    assert report["parts"] == [7]
    assert report["models"][0] == report["registered"] == 7
    assert report["settings"]["max_features"] == 1000
    assert report["search"] == {"max_image_size": 384, "max_features": 1000}
    assert report["versions"]["pycolmap"] == pycolmap.__version__
    assert report["matching"] == {"rule": "retrieval", "pairs": 25, **hash_inputs(solved.photos, FAST)}


def test_progress_goes_through_all_stages(solved: Solved):
    stages = list(dict.fromkeys(stage for stage, _, _ in solved.stages))
    assert stages == ["read", "extract", "features", "pair", "match", "matches", "map", "check", "stabilise"]
    last = {stage: (done, total) for stage, done, total in solved.stages}
    assert last["extract"] == (8, 8)
    assert last["match"] == (25, 25)  # the blank photo is matched with four others


def write_noise(folder: Path) -> None:
    """Five photos that have nothing in common."""
    folder.mkdir()
    for seed in range(5):
        Image.fromarray(wall(100 + seed)[:160, :160]).save(folder / f"{seed}.png")


def test_photos_without_overlap_are_too_few_and_leave_no_scene(tmp_path: Path):
    write_noise(tmp_path / "photos")
    reported: list[str] = []
    said = r"^none of 5 photos registered.*matches no other photo well"
    with worker_in_this_process(), pytest.raises(UserError, match=said) as caught:
        estimate_poses(
            tmp_path / "photos",
            tmp_path / "scene",
            settings=replace(FAST, max_features=130),
            notify=reported.append,
            progress=lambda stage, done, total: reported.append(stage),
        )
    # Attempts are reported while the work goes on, not after it.
    announced = next(number for number, note in enumerate(reported) if note.startswith("next: more features from"))
    assert reported.index("default thresholds: none of 5 photos registered") < announced
    assert "match" in reported[announced:]
    assert caught.value.exit_code == TOO_FEW_PHOTOS
    assert "overlap" in caught.value.hint
    assert not (tmp_path / "scene" / "scene.json").exists()


def test_an_interrupt_ends_the_worker_and_leaves_no_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    workers: list[subprocess.Popen[bytes]] = []

    class Recorded(subprocess.Popen[bytes]):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            workers.append(self)

    def interrupt(stage: str, done: int, total: int) -> None:
        if stage == "extract":
            raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", Recorded)
    write_noise(tmp_path / "photos")
    with pytest.raises(KeyboardInterrupt):
        estimate_poses(tmp_path / "photos", tmp_path / "scene", settings=FAST, progress=interrupt)
    assert [worker.returncode for worker in workers] == [-9]
    assert not (tmp_path / "scene" / "scene.json").exists()


def test_the_last_output_of_a_dying_worker_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The message is the worker's own: it imports no library from the current directory."""
    (tmp_path / "pycolmap.py").write_text("raise RuntimeError('another library of this name')")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"crashed \(exit status 1\) while starting: .*FileNotFoundError.*job\.json"):
        supervise.run_worker(tmp_path / "job.json", threads=1, progress=lambda *reported: None)


def test_deaths_are_explained(monkeypatch: pytest.MonkeyPatch):
    log = "*** Aborted at 1 ***\nF1120 bundle.cc:9] Check failed: x > 0\n    @ 0x7f (libc.so)\n"
    aborted = supervise.explain_death(-6, "matching photos (3 of 10 done)", log, 10**9)
    assert aborted.message == (
        "structure from motion crashed (SIGABRT) while matching photos (3 of 10 done): "
        "F1120 bundle.cc:9] Check failed: x > 0"
    )
    assert supervise.explain_death(-9, "finding features", "", 10**9).exit_code == OUT_OF_MEMORY
    monkeypatch.delattr(signal, "SIGKILL")  # as on Windows
    assert "crashed (exit status 3)" in supervise.explain_death(3, "finding features", "", 10**9).message


@pytest.mark.parametrize(
    ("log", "free_bytes"),
    [("", 40_960), ("RuntimeError: SQL error: database or disk is full\n", 10**9), ("No space left on device", 10**9)],
)
def test_a_full_disk_is_reported_even_where_no_log_could_be_written(log: str, free_bytes: int):
    reported = supervise.explain_death(1, "finding features (3 of 10 done)", log, free_bytes)
    assert "stopped while finding features (3 of 10 done): the disk is full" in reported.message
    assert "run the same command again to continue" in reported.hint


def test_a_scene_never_takes_the_place_of_photos_or_of_something_else(tmp_path: Path):
    write_noise(tmp_path / "photos")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years of work")
    for destination, said in (
        (tmp_path / "photos", "would overwrite the photos"),
        (tmp_path, "would overwrite the photos"),
        (tmp_path / "thesis", "the folder contains other files"),
    ):
        with pytest.raises(UserError, match=said):
            estimate_poses(tmp_path / "photos", destination, settings=FAST)
    assert len(list((tmp_path / "photos").iterdir())) == 5
    assert (tmp_path / "thesis" / "chapter.tex").is_file()


def test_a_folder_that_is_read_only_is_refused_before_photos_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_noise(tmp_path / "photos")
    monkeypatch.setattr("nerfcli.atomic.os.access", lambda path, mode: False)
    unread = Mock(side_effect=AssertionError)
    with pytest.raises(UserError, match="no write permission"):
        estimate_poses(tmp_path / "photos", tmp_path / "scene", settings=FAST, progress=unread)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (PoseSettings(max_features=0), "must be positive, got 1600 and 0"),
        (PoseSettings(camera_model="BROWN"), "camera_model must be one of auto, .*, got BROWN"),
        (PoseSettings(min_registered=1.5), r"within 0\.\.\.1, got 1\.5"),
    ],
)
def test_settings_out_of_range_are_refused(tmp_path: Path, settings: PoseSettings, words: str):
    with pytest.raises(ValueError, match=words):
        estimate_poses(tmp_path, tmp_path / "scene", settings=settings)
