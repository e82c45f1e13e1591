"""Resuming: what a killed or an earlier `poses` left is used, but only for the same input and as far as it is whole.

The evidence is that models agree to the last bit with one thread, and what pycolmap's database holds at which time.
"""

import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from errno import ENOSPC
from itertools import pairwise
from pathlib import Path
from typing import Any

import pycolmap
import pytest
from corner import NAMES, write_capture
from in_this_process import worker_in_this_process
from PIL import Image

import nerfcli
from nerfcli.errors import OUT_OF_MEMORY, UserError
from nerfcli.machine import default_memory_limit, resident_bytes, thread_count
from nerfcli.poses import structure_from_motion
from nerfcli.poses import workspace as workspace_module
from nerfcli.poses.engine.database import remove_database
from nerfcli.poses.input.job import read_job, read_stage, write_stage
from nerfcli.poses.input.settings import PoseSettings, Search
from nerfcli.poses.report import PosesReport
from nerfcli.poses.structure_from_motion import estimate_poses, plan_poses
from nerfcli.poses.workspace import database_bytes, hash_inputs, is_same_scene, workspace

# A fixed lens model: choosing one would only add adjustments.
ONE_THREAD = PoseSettings(max_features=200, max_image_size=192, threads=1, camera_model="SIMPLE_RADIAL")
Progress = Callable[[str, int, int], None]


class KilledError(Exception):
    """The worker was killed."""


def estimate(photos: Path, scene: Path, settings: PoseSettings = ONE_THREAD, **options: Any) -> PosesReport:
    return estimate_poses(photos, scene, settings=settings, **options)


def killed_at(stage: str, done: int) -> Progress:
    """Have the worker killed (SIGKILL) once it reports this much progress in a stage."""

    def progress(reported: str, told_done: int, total: int) -> None:
        if reported == stage and told_done >= done:
            raise KilledError

    return progress


def model(scene: Path) -> dict[str, bytes]:
    """The files of the model."""
    return {path.name: path.read_bytes() for path in sorted((scene / "sparse/0").iterdir())}


def rows(scene: Path, table: str, column: str = "image_id") -> dict[int, bytes]:
    """Return a table of the database as {key: data of the row}."""
    with closing(sqlite3.connect(scene / "database.db")) as database:
        return dict(database.execute(f"SELECT {column}, data FROM {table}"))


@pytest.fixture
def same_process() -> Iterator[None]:
    """For tests of what is done again: only the others need a worker that can be killed."""
    with worker_in_this_process():
        yield


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("capture") / "my photos")


@pytest.fixture(scope="module")
def unpublished(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene folder of a call that ended after the worker's last file and before the scene's."""
    scene = tmp_path_factory.mktemp("unpublished") / "scene"

    def interrupted(scene_dir: Path, describe: Callable[[], None]) -> None:
        raise KilledError

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(structure_from_motion, "publish", interrupted)
        with worker_in_this_process(), pytest.raises(KilledError):
            estimate(photos, scene)
    return scene


@pytest.fixture(scope="module")
def whole(photos: Path, unpublished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The complete scene, made from the unpublished model: only the last step is done."""
    scene = shutil.copytree(unpublished, tmp_path_factory.mktemp("whole") / "scene")
    stages: list[str] = []
    with worker_in_this_process():
        report = estimate(photos, scene, progress=lambda stage, done, total: stages.append(stage))
    assert report.registered == len(NAMES)
    assert "map" not in stages
    return scene


@pytest.fixture
def again(whole: Path, tmp_path: Path) -> Path:
    """A copy of that scene, to be changed."""
    return shutil.copytree(whole, tmp_path / "scene")


def test_after_kills_in_two_stages_the_result_is_the_same_to_the_last_bit(photos: Path, whole: Path, tmp_path: Path):
    scene = tmp_path / "scene"
    for stage, done in (("match", 0), ("map", 3)):
        with pytest.raises(KilledError):
            estimate(photos, scene, progress=killed_at(stage, done))
        assert not (scene / "scene.json").exists()
    with worker_in_this_process():
        assert estimate(photos, scene).registered == len(NAMES)
    assert model(scene) == model(whole)
    assert rows(scene, "two_view_geometries", "pair_id") == rows(whole, "two_view_geometries", "pair_id")


@pytest.mark.usefixtures("same_process")
@pytest.mark.parametrize(
    ("damaged", "repeated"),
    [
        (["sparse/0"], {"check"}),
        (["sparse/0", "mapped/0"], {"check"}),
        (["sparse/0", "mapped/0", "models_0/0"], {"map"}),
    ],
)
def test_a_damaged_model_is_made_again_from_what_is_whole(
    photos: Path, unpublished: Path, whole: Path, tmp_path: Path, damaged: list[str], repeated: set[str]
):
    scene = shutil.copytree(unpublished, tmp_path / "scene")
    for folder in damaged:
        images = scene / "work" / folder / "images.bin"
        images.write_bytes(images.read_bytes()[:-8])
    stages: set[str] = set()
    estimate(photos, scene, progress=lambda stage, done, total: stages.add(stage))
    assert repeated <= stages
    assert ("map" in stages) == ("map" in repeated)
    assert model(scene) == model(whole)


@pytest.mark.usefixtures("same_process")
def test_another_camera_model_extracts_and_matches_nothing_again(photos: Path, whole: Path, again: Path):
    stages: dict[str, int] = {}
    settings = replace(ONE_THREAD, camera_model="SIMPLE_PINHOLE")
    report = estimate(
        photos, again, settings, progress=lambda stage, done, total: stages.update({stage: stages.get(stage, done)})
    )
    assert stages["extract"] == len(NAMES) + 1  # all of them were there from the first
    assert rows(again, "descriptors") == rows(whole, "descriptors")
    assert rows(again, "matches", "pair_id") == rows(whole, "matches", "pair_id")
    assert {camera["model"] for camera in report.cameras} == {"SIMPLE_PINHOLE"}
    # Mapping had restarted from the same state: with the first camera model again, the result is the first one.
    assert estimate(photos, again).registered == len(NAMES)
    assert model(again) == model(whole)


@pytest.mark.usefixtures("same_process")
def test_another_photo_and_other_pairs_do_only_what_is_new(photos: Path, whole: Path, again: Path, tmp_path: Path):
    """A photo that is first by name shifts the others' positions, but not their ids in the database."""
    more = shutil.copytree(photos, tmp_path / "more")
    shutil.copy(photos / NAMES[2], more / "a first one.png")
    pairs = [f"a first one.png {NAMES[2]}", *(f"{one} {other}" for one, other in pairwise(NAMES))]
    (tmp_path / "pairs.txt").write_text("\n".join(pairs))
    settings = replace(ONE_THREAD, pairs_file=str(tmp_path / "pairs.txt"))
    with pytest.raises(KilledError):
        estimate(more, again, settings, progress=killed_at("map", 0))
    assert model(again) == model(whole)  # the scene stands until another takes its place
    before, after = rows(whole, "descriptors"), rows(again, "descriptors")
    assert {key: after[key] for key in before} == before
    assert len(after) == len(before) + 1
    old, new = rows(whole, "matches", "pair_id"), rows(again, "matches", "pair_id")
    assert {key: new[key] for key in old} == old
    assert len(new) == len(old) + 1
    # The mapper sees the listed pairs and no others.
    assert len(rows(again, "two_view_geometries", "pair_id")) == len(NAMES)


@pytest.mark.usefixtures("same_process")
def test_a_changed_photo_is_extracted_again_and_no_other(photos: Path, whole: Path, again: Path, tmp_path: Path):
    changed = shutil.copytree(photos, tmp_path / "changed")
    shutil.copy(changed / NAMES[3], changed / NAMES[2])
    with pytest.raises(KilledError):
        estimate(changed, again, progress=killed_at("match", 0))
    before, after = rows(whole, "descriptors"), rows(again, "descriptors")
    assert {key for key in before if before[key] != after[key]} == {3}  # ids count from 1
    assert after[3] == before[4]


def _holds_the_same_again(photos: Path, whole: Path, scene: Path) -> None:
    """Check that all that mapping starts from is restored; the tests above show that the result follows from it."""
    with pytest.raises(KilledError):
        estimate(photos, scene, progress=killed_at("map", 0))
    for table, key in (("descriptors", "image_id"), ("keypoints", "image_id"), ("two_view_geometries", "pair_id")):
        assert rows(scene, table, key) == rows(whole, table, key)


@pytest.mark.usefixtures("same_process")
def test_a_damaged_database_is_made_anew(photos: Path, whole: Path, again: Path):
    """As a machine that lost its power may leave it."""
    content = bytearray((again / "database.db").read_bytes())
    content[len(content) // 3 : len(content) // 2] = bytes(len(content) // 2 - len(content) // 3)
    (again / "database.db").write_bytes(content)
    _holds_the_same_again(photos, whole, again)


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", '{"key": "k", "content": {"1"', "[]", '"k"', '{"key": "k"}', '{"key": ["k"], "content": {}}'),
        *('{"key": "k", "content": [3]}', "[" * 100_000, "\udcff"),
    ],
)
def test_a_damaged_stage_is_none(tmp_path: Path, text: str):
    path = tmp_path / "stage.json"
    write_stage(path, "k", {"1": "a", "2": (3, 0.1)})
    assert read_stage(path, "k") == {"1": "a", "2": [3, 0.1]}
    assert read_stage(path, "other") is None
    whole = json.loads(path.read_text())
    path.write_bytes(text.encode(errors="surrogateescape"))
    assert read_stage(path, "k") is None
    path.write_text(json.dumps(whole | {"content": {"1": "b", "2": [3, 0.1]}}))
    assert read_stage(path, "k") is None


@pytest.mark.usefixtures("same_process")
def test_damaged_stages_are_done_again(photos: Path, whole: Path, again: Path):
    """Each is damaged in another way: cut off, of the wrong type, with other content, not text."""
    stages = sorted(path for path in (again / "work").glob("*.json"))
    assert {path.stem for path in stages} >= {"features", "geometries", "matches", "photos"}
    for number, path in enumerate(stages):
        content = json.loads(path.read_text())
        wrong = (path.read_text()[:20], "[1, 2]", json.dumps(content | {"content": 7}), "\udcff\udc80")[number % 4]
        path.write_bytes(wrong.encode(errors="surrogateescape"))
    (again / "poses_report.json").write_text("[]")
    assert not is_same_scene(again, photos, ONE_THREAD)
    _holds_the_same_again(photos, whole, again)


@pytest.mark.usefixtures("same_process")
def test_a_disk_that_is_full_when_a_scene_is_replaced_leaves_the_earlier_one(
    photos: Path, unpublished: Path, again: Path, monkeypatch: pytest.MonkeyPatch
):
    shutil.copytree(unpublished / "work", again / "work", dirs_exist_ok=True)

    def full(source: Path, target: Path) -> None:
        raise OSError(ENOSPC, "No space left on device", str(target))

    monkeypatch.setattr(workspace_module.shutil, "copytree", full)
    with pytest.raises(UserError, match="No space left"):
        estimate(photos, again)
    assert is_same_scene(again, photos, ONE_THREAD)


@pytest.mark.usefixtures("same_process")
@pytest.mark.parametrize(
    ("strict", "said"), [(False, "holds out 0 of 7 photos"), (True, "^0 of 1 held-out photo could be placed")]
)
def test_a_split_that_holds_out_no_placed_photo_leaves_an_earlier_scene(
    photos: Path, again: Path, tmp_path: Path, strict: bool, said: str
):
    (tmp_path / "test.txt").write_text("wall.png")
    with pytest.raises(UserError, match=said) as refused:
        estimate(photos, again, replace(ONE_THREAD, holdout=str(tmp_path / "test.txt"), strict=strict))
    assert f"details are in {again / 'work' / 'poses_report.json'}" in (refused.value.hint or "")
    images = json.loads((again / "work" / "poses_report.json").read_text())["images"]
    assert [image["name"] for image in images if image["reason"]] == ["wall.png"]
    assert is_same_scene(again, photos, ONE_THREAD)


@pytest.mark.usefixtures("same_process")
def test_held_out_photos_may_be_listed_in_the_scene_that_is_replaced(photos: Path, again: Path):
    listed = again / "sparse" / "0" / "test.txt"
    listed.write_text(NAMES[0])
    estimate(photos, again, replace(ONE_THREAD, holdout=str(listed)))
    assert json.loads((again / "scene.json").read_text())["split"]["test"] == [NAMES[0]]


def test_a_backup_of_a_database_is_not_removed_with_it(tmp_path: Path):
    kept = {"database.db.bak", "database.db-copy"}
    for name in (*kept, "database.db", "database.db-wal", "database.db-shm", "database.db-journal"):
        (tmp_path / name).touch()
    remove_database(tmp_path / "database.db")
    assert {path.name for path in tmp_path.iterdir()} == kept


def test_the_database_is_one_that_colmap_reads_with_the_users_photos(whole: Path, photos: Path):
    with closing(sqlite3.connect(whole / "database.db")) as database:
        names = [name for (name,) in database.execute("SELECT name FROM images ORDER BY image_id")]
    assert names == sorted(path.name for path in photos.iterdir())
    assert database_bytes(whole) > 100_000


def test_without_its_database_a_scene_is_still_a_scene(photos: Path, again: Path):
    (again / "database.db").unlink()
    shutil.rmtree(again / "work")
    assert {path.name for path in again.iterdir()} == {"sparse", "scene.json", "poses_report.json"}
    assert is_same_scene(again, photos, ONE_THREAD)
    assert not is_same_scene(again, photos, replace(ONE_THREAD, max_features=700))


def test_a_scene_is_the_same_as_long_as_its_photos_and_masks_are(photos: Path, again: Path, tmp_path: Path):
    """They keep their names; a report of an earlier version, without hashes, knows only these."""
    path, masks = again / "poses_report.json", tmp_path / "masks"
    masks.mkdir()
    (masks / f"{NAMES[0]}.png").write_bytes(b"white")
    settings = replace(ONE_THREAD, masks=str(masks))
    report = json.loads(path.read_text())
    report["settings"]["masks"] = str(masks)
    report["matching"] |= hash_inputs(photos, settings)
    path.write_text(json.dumps(report))
    for file in (photos / NAMES[0], masks / f"{NAMES[0]}.png"):
        assert is_same_scene(again, photos, settings)
        content = file.read_bytes()
        file.write_bytes(content + b"exported again")
        assert not is_same_scene(again, photos, settings)
        file.write_bytes(content)
    report["matching"] = {"rule": "retrieval", "pairs": 28}
    path.write_text(json.dumps(report))
    assert is_same_scene(again, photos, settings)


def test_a_scene_with_4096_features_by_default_in_an_earlier_version_is_the_same(photos: Path, again: Path):
    """In a report of this version, they were asked for."""
    path, by_default = again / "poses_report.json", replace(ONE_THREAD, max_features=None)
    report = json.loads(path.read_text())
    report["settings"]["max_features"] = 4096
    path.write_text(json.dumps(report))
    assert not is_same_scene(again, photos, by_default)
    del report["search"]
    path.write_text(json.dumps(report))
    assert is_same_scene(again, photos, by_default)


def test_the_worker_gets_numbers_that_libraries_take(photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A pool of threads takes no -1, which stands for all of them, and pycolmap no seed beyond 31 bits."""

    def run_worker(job_path: Path, **options: object) -> None:
        job = read_job(job_path)
        assert job.threads == options["threads"] == thread_count(0)
        pycolmap.RANSACOptions(random_seed=job.seed + 200)  # attempts to map have their numbers added
        raise KilledError

    monkeypatch.setattr(structure_from_motion, "run_worker", run_worker)
    with pytest.raises(KilledError):
        estimate(photos, tmp_path / "scene", replace(ONE_THREAD, threads=-1, seed=2**32 - 1))


def test_two_calls_on_one_scene_do_not_meet(photos: Path, tmp_path: Path):
    with workspace(tmp_path / "scene"), pytest.raises(UserError, match="another nerfcli poses is working on"):
        estimate(photos, tmp_path / "scene")


def test_the_worker_keeps_the_lock_as_long_as_it_lives(tmp_path: Path):
    with workspace(tmp_path / "scene") as lock:
        code = "import sys; sys.stdin.read()"
        child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, pass_fds=(lock,))
    with pytest.raises(UserError, match="another"), workspace(tmp_path / "scene"):
        pass
    child.communicate()
    with workspace(tmp_path / "scene"):
        pass


def test_too_much_memory_ends_the_worker(photos: Path, tmp_path: Path):
    with pytest.raises(UserError, match=r"was stopped while .*: it needed more than 0.05 GB") as caught:
        estimate(photos, tmp_path / "scene", memory_bytes=50_000_000)
    assert caught.value.exit_code == OUT_OF_MEMORY
    assert "--max-size" in caught.value.hint


def test_memory_of_this_process_and_machine_is_measured():
    limit = default_memory_limit()
    assert limit is not None
    assert 10_000_000 < resident_bytes(os.getpid()) < limit
    assert resident_bytes(2**22 + 1) == 0  # no process has such a number


def test_planning_writes_nothing(photos: Path):
    before = sorted(path.name for path in photos.parent.iterdir())
    prepared = plan_poses(photos, settings=ONE_THREAD)
    assert (prepared.plan.photos, prepared.plan.rule, prepared.plan.pairs) == (8, "retrieval", 28)
    assert len(prepared.pairing.pairs) == 28
    assert sorted(path.name for path in photos.parent.iterdir()) == before


@pytest.mark.parametrize(
    ("photos", "asked", "search"),
    [
        (29, None, Search(192, 8192)),
        (30, None, Search(192, 4096)),
        (99, None, Search(192, 4096)),
        (100, None, Search(192, 2048, halved_from=4096)),
        (100, 4096, Search(192, 4096)),
        (100, 8192, Search(192, 8192)),
    ],
)
def test_many_photos_need_fewer_features_unless_more_are_asked_for(tmp_path, photos, asked, search):
    for number in range(photos):
        Image.new("RGB", (8, 8), (number, 0, 0)).save(tmp_path / f"{number:03d}.png")
    prepared = plan_poses(tmp_path, settings=replace(ONE_THREAD, max_features=asked))
    assert prepared.search == search
    assert prepared.plan.max_features == search.max_features


def _wait_for_worker(scene: Path) -> None:
    """Until the worker has seen that its parent has gone, and let go of the scene."""
    while True:
        try:
            with workspace(scene):
                return
        except UserError:
            time.sleep(0.05)


@pytest.mark.slow
def test_ten_kills_at_random_moments_change_nothing(photos: Path, whole: Path, tmp_path: Path):
    """The whole process is killed (SIGKILL); its worker then ends by itself, and the next call waits for neither."""
    rng = random.Random(0)
    scene = tmp_path / "scene"
    settings = f"from nerfcli.poses.input.settings import PoseSettings; settings = {ONE_THREAD!r}"
    script = f"import sys, nerfcli; {settings}; nerfcli.estimate_poses(*sys.argv[1:], settings)"
    command = [sys.executable, "-c", script, str(photos), str(scene)]
    environment = {**os.environ, "PYTHONPATH": str(Path(nerfcli.__file__).parent.parent)}
    for _ in range(10):
        process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)
        time.sleep(rng.uniform(0.5, 6.0))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        _wait_for_worker(scene)
        if (scene / "scene.json").exists():  # it was quicker: once more from the beginning
            assert model(scene) == model(whole)
            shutil.rmtree(scene)
    estimate(photos, scene)
    assert model(scene) == model(whole)
