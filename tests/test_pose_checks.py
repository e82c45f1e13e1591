"""Checks never lose a model: whatever is wrong with it, they end with a report that JSON can hold.

Models are synthetic (benchmarks/synthetic_captures.py) and then damaged: photos without a pose, one point or none,
coordinates that are not finite, cameras in one place or on a line.
"""

import json
import math
import shutil
import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import synthetic_captures as synthetic
from corner import NAMES, write_capture
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from in_this_process import worker_in_this_process
from synthetic_captures import LONG, WIDE, Noise

from nerfcli.captures.loading import load_scene
from nerfcli.errors import TOO_FEW_PHOTOS, UserError
from nerfcli.poses import structure_from_motion
from nerfcli.poses.engine import worker
from nerfcli.poses.engine.attempts import map_with_fallbacks
from nerfcli.poses.engine.mapping import mapping_key, read_mapped, write_mapped
from nerfcli.poses.engine.worker import describe_components, replace_non_finite
from nerfcli.poses.input.job import Job
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.judge import acceptance, examine
from nerfcli.poses.judge.checks import UNDERWAY, Checks
from nerfcli.poses.judge.parallax import RotationFit, best_rotation_fit
from nerfcli.poses.model.two_views import VerifiedPair
from nerfcli.poses.report import PosesReport, closing_notes, refusal
from nerfcli.poses.structure_from_motion import estimate_poses

ONE_THREAD = PoseSettings(max_features=200, max_image_size=192, threads=1, camera_model="SIMPLE_PINHOLE")
PLACES = st.sampled_from([0.0, 1e-300, 1.0, 1e30, math.inf, -math.inf, math.nan])


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """Eight photos of two cameras, mapped: the models are in the work folder."""
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    folder = tmp_path_factory.mktemp("capture")
    views = synthetic.ring(8, [WIDE, LONG], seed=0, turn_deg=160)
    scene = synthetic.boulder(450, seed=0)
    synthetic.write_database(folder / "database.db", views, scene, noise=Noise(outliers=0.1), seed=0)
    job = synthetic.synthetic_job(folder, views, seed=0)
    write_mapped(map_with_fallbacks(job, lambda *progress: None), mapping_key(job))
    return job


@pytest.fixture(scope="module", autouse=True)
def _one_rotation_fit() -> Iterator[None]:
    """Find how well rotations explain the matches of a capture once: no test damages matches."""
    found: dict[tuple[int, ...], RotationFit | None] = {}

    def fit(pairs: Sequence[VerifiedPair], sizes: Mapping[int, tuple[int, int]]) -> RotationFit | None:
        matches = tuple(pair.matches for pair in pairs)
        if matches not in found:
            found[matches] = best_rotation_fit(pairs, sizes)
        return found[matches]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(examine, "best_rotation_fit", fit)
        yield


def mapped_model(job: Job) -> pycolmap.Reconstruction:
    mapped = read_mapped(job, mapping_key(job))
    assert mapped is not None
    return mapped.models[0]


def named(job: Job) -> Job:
    """Return the job with the user's names of the photos, which are unlike those of the files in the model."""
    return replace(job, names=tuple(f"kitchen {number}.jpg" for number in range(8)))


def examined(model: pycolmap.Reconstruction, job: Job, checks: Checks | None = None) -> dict[str, Any]:
    """Return what the report says about a model, after a round trip through JSON."""
    found = examine.examine([model], job, checks=checks)
    content = {"verdict": found.verdict.to_json(), "blur": found.blur_px, "left_out": found.left_out, **found.details}
    return json.loads(json.dumps(replace_non_finite(content), allow_nan=False))


@given(
    without_pose=st.sets(st.integers(1, 8), max_size=8),
    points=st.sampled_from([0, 1, 2, 15, 10_000]),
    place=PLACES,
    moved=st.integers(0, 3),
)
@examples(12)
def test_a_damaged_model_is_reported_and_ends_nothing(
    job: Job, without_pose: set[int], points: int, place: float, moved: int
):
    model = mapped_model(job)
    for image_id in without_pose:
        model.deregister_frame(model.image(image_id).frame_id)
    for point_id in sorted(model.point3D_ids())[points:]:
        model.delete_point3D(point_id)
    for point_id in sorted(model.point3D_ids())[:moved]:
        model.point3D(point_id).xyz = np.array([place, 1.0, place])
    content = examined(model, job)
    assert set(content["verdict"]) == {"accepted", "measures", "failures"}
    if len(without_pose) == 8:
        assert content["verdict"]["measures"]["observations_per_photo"] == {"median": 0.0, "least": 0}


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_cameras_in_one_place_or_on_a_line_are_refused_or_reported(job: Job, spread: float):
    """All centres are put at the origin, or on the x axis: the model is refused, without an exception."""
    model = mapped_model(job)
    for index, image_id in enumerate(sorted(model.reg_image_ids())):
        image = model.image(image_id)
        rotation = image.cam_from_world().rotation
        centre = np.array([spread * index, 0.0, 0.0])
        model.frame(image.frame_id).rig_from_world = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ centre))
    content = examined(model, job)
    assert not content["verdict"]["accepted"]


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0])
def test_degenerate_intrinsics_are_reported(job: Job, value: float):
    model = mapped_model(job)
    camera = model.cameras[1]
    camera.params = [value, *camera.params[1:]]
    content = examined(model, job)
    assert isinstance(content["not_computed"], dict)


def test_photos_without_a_pose_do_not_end_the_covariance(job: Job):
    """pycolmap's covariance raises on a frame without a pose; the lens models and the uncertainty leave it out."""
    model = mapped_model(job)
    model.deregister_frame(model.image(3).frame_id)
    content = examined(model, named(job))
    assert content["not_computed"] == {}
    assert content["verdict"]["accepted"]
    assert sorted(content["blur"]) == [f"kitchen {number}.jpg" for number in range(8) if number != 2]


def test_a_check_that_raises_is_listed_and_the_others_go_on(job: Job, monkeypatch: pytest.MonkeyPatch):
    def broken(*arguments: object, **options: object) -> None:
        raise ValueError("[frame.h:188] Check failed: no pose\nstack")

    monkeypatch.setattr(acceptance, "rotation_errors", broken)
    monkeypatch.setattr(examine, "pose_blur_px", broken)
    content = examined(mapped_model(job), job)
    why = "ValueError: [frame.h:188] Check failed: no pose"
    assert content["not_computed"] == {"rotations of pairs": why, "pose uncertainty": why}
    assert content["verdict"]["measures"]["rotations"] == {"pairs": 0, "median_deg": None, "gross_share": None}
    assert content["verdict"]["measures"]["pairs"]["judged"] > 10


def test_a_skipped_check_is_not_started(job: Job, tmp_path: Path):
    checks = Checks(tmp_path, skip={"pose uncertainty": "it ended the process"})
    content = examined(mapped_model(job), job, checks)
    assert content["not_computed"] == {"pose uncertainty": "it ended the process"}
    assert content["blur"] == {}
    assert not (tmp_path / UNDERWAY).exists()


def test_a_result_that_is_not_finite_is_written_as_null(job: Job, monkeypatch: pytest.MonkeyPatch):
    infinite = dict.fromkeys(range(1, 9), math.inf)
    monkeypatch.setattr(examine, "pose_blur_px", lambda *arguments: infinite)
    # There are no photos: their features are in the database already.
    monkeypatch.setattr(worker, "extract", lambda job, report: None)
    monkeypatch.setattr(worker, "mask_turning_object", lambda job, training: (job, None))
    job = replace(job, skipped_checks=(("another check", "too long"),))
    worker.solve(job, lambda *progress: None, lambda note: None)
    content = json.loads((Path(job.folder) / "result.json").read_text(encoding="utf-8"))["content"]
    assert set(content["pose_blur_px"].values()) == {None}


def test_components_say_what_joins_them(job: Job):
    """Photos 1...5 and 6...8 of one capture: the database has pairs that connect them, and the report says so."""
    first, second = mapped_model(job), mapped_model(job)
    for image_id in range(1, 9):
        model = first if image_id > 5 else second
        model.deregister_frame(model.image(image_id).frame_id)
    names = list(named(job).names)
    largest, other = describe_components([first, second], named(job))
    assert (largest["size"], largest["photos"], largest["apart"]) == (5, names[:5], None)
    assert (other["size"], other["photos"]) == (3, names[5:])
    assert "pairs connect it to the largest" in other["apart"]


# From here on the whole command, on the room corner of `corner`.


@pytest.fixture
def same_process() -> Iterator[None]:
    with worker_in_this_process():
        yield


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("photos") / "corner")


def estimate(
    photos: Path, scene: Path, settings: PoseSettings = ONE_THREAD, **options: Any
) -> tuple[PosesReport, list[str]]:
    notes: list[str] = []
    return estimate_poses(photos, scene, settings=settings, notify=notes.append, **options), notes


class EndedError(Exception):
    """The time is over."""


@pytest.fixture(scope="module")
def mapped(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a call that was ended in its first check, after mapping."""
    scene = tmp_path_factory.mktemp("mapped") / "scene"

    def end_in_check(stage: str, done: int, total: int) -> None:
        if stage == "check":
            raise EndedError

    with worker_in_this_process(), pytest.raises(EndedError):
        estimate(photos, scene, progress=end_in_check)
    return scene


@pytest.fixture(scope="module")
def report(photos: Path, mapped: Path, tmp_path_factory: pytest.TempPathFactory) -> PosesReport:
    """The report on these photos."""
    scene = shutil.copytree(mapped, tmp_path_factory.mktemp("estimated") / "scene")
    with worker_in_this_process():
        return estimate(photos, scene)[0]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="POSIX signals")
def test_checks_that_end_the_process_or_never_end_are_left_out(
    photos: Path, mapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The worker aborts in the covariance, as C++ may, sleeps for an hour where half a second is allowed, takes 1 GB.

    The fourth one, which nothing ends, works in this process.

    The photos, which are mapped already, are not mapped again, and the scene says which checks it lacks.
    """
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(
        "import os, time\n"
        "from nerfcli.poses.judge import checks, examine\n"
        "examine.pose_blur_px = lambda *a, **o: os.abort()\n"
        "examine.choose_lenses = lambda *a, **o: time.sleep(3600)\n"
        "examine.shared_pairs = lambda *a, **o: (b'x' * 10**9, time.sleep(3600))\n"
        "run = checks.Checks.run\n"
        "def bounded(self, name, compute, *, otherwise, seconds=None):\n"
        "    most = 0.5 if name == 'lens models' else seconds\n"
        "    return run(self, name, compute, otherwise=otherwise, seconds=most)\n"
        "checks.Checks.run = bounded\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))
    with worker_in_this_process():
        here = structure_from_motion.run_worker
    workers = iter([structure_from_motion.run_worker] * 3 + [here])
    monkeypatch.setattr(structure_from_motion, "run_worker", lambda *a, **o: next(workers)(*a, **o))
    stages: list[str] = []
    scene = shutil.copytree(mapped, tmp_path / "scene")
    report, notes = estimate(
        photos, scene, progress=lambda stage, done, total: stages.append(f"{stage} {done}"), memory_bytes=1_000_000_000
    )
    assert report.registered == len(NAMES)
    assert set(report.not_computed) == {"pose uncertainty", "lens models", "points of single photos"}
    assert report.not_computed["points of single photos"].endswith("it needed more than 1 GB of memory")
    assert "SIGABRT" in report.not_computed["pose uncertainty"]
    assert report.not_computed["lens models"] == "it took longer than 0 s"
    assert report.cut_short == ()
    for check in report.not_computed:
        assert sum(f"could not compute a check ({check}): " in note for note in notes) == 2
    assert stages.count("check 0") == 4
    assert not any(stage.startswith(("extract", "match", "map")) for stage in stages)
    assert notes.count("the photos are already mapped: running the checks") == 4
    assert load_scene(scene).frames


@pytest.mark.usefixtures("same_process")
def test_a_refused_model_stays_and_can_be_accepted(
    photos: Path, mapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuse(*arguments: Any, **options: Any) -> acceptance.Verdict:
        failure = acceptance.Failure("it is wrong", "so", "do better")
        return acceptance.Verdict(acceptance.judge(*arguments, **options).measures, (failure,))

    monkeypatch.setattr(examine, "judge", refuse)
    scene = shutil.copytree(mapped, tmp_path / "scene")
    with pytest.raises(UserError, match=r"cannot be trusted: it is wrong: so") as caught:
        estimate(photos, scene)
    assert caught.value.exit_code == TOO_FEW_PHOTOS
    assert "--accept-refused" in caught.value.hint
    kept = pycolmap.Reconstruction(str(scene / "refused-model"))
    assert kept.num_reg_images() == len(NAMES)
    assert (scene / "refused-model" / "points.ply").read_bytes().startswith(b"ply")
    with pytest.raises(UserError, match="scene"):
        load_scene(scene)
    stages: list[str] = []
    report, notes = estimate(
        photos,
        scene,
        replace(ONE_THREAD, accept_refused=True),
        progress=lambda stage, done, total: stages.append(stage),
    )
    assert {"map", "match", "extract", "check"}.isdisjoint(stages)  # nothing is done again
    assert not report.verdict["accepted"]
    assert any("because of --accept-refused" in note for note in notes)
    assert not (scene / "refused-model").exists()
    assert len(load_scene(scene).frames) == len(NAMES)


def test_closing_notes_name_components_and_checks(report: PosesReport):
    other = {"size": 2, "photos": ["x.jpg", "y.jpg"], "apart": "no photo of it matches"}
    not_computed = {"pose uncertainty": "ValueError: singular"}
    attempts = (*report.attempts, {"what": "only a part", "models": [4], "doubt": "two sides may look alike"})
    two = replace(report, components=(report.components[0], other), not_computed=not_computed, attempts=attempts)
    assert closing_notes(two) == [
        "2 photos (x.jpg ... y.jpg) form a model of their own: no photo of it matches; estimate their poses separately",
        "two sides may look alike",
        "could not compute a check (pose uncertainty): ValueError: singular",
    ]


def test_a_lens_without_distortion_has_no_uncertainty_of_it(report: PosesReport):
    certain = {"weak": True, "focal_percent": 15.34, "distortion_border_px": None}

    def note(uncertainty: Mapping[str, object]) -> str:
        return closing_notes(replace(report, cameras=({"images": 4, "uncertainty": uncertainty},)))[0]

    start = "intrinsics are weakly determined (camera with 4 photos: focal length ± 15.3 %"
    assert note(certain) == f"{start}): give --intrinsics"
    distorted = note({**certain, "distortion_border_px": 3.0})
    assert distorted == f"{start}, distortion ± 3.0 px at the corners): give --intrinsics"


def test_photos_without_features_and_a_failing_search_for_motions_end_nothing(
    job: Job, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """The search for a turntable is auxiliary: if it raises, a note says so, and the photos are mapped as they are."""

    def broken(job: Job, training: Job) -> None:
        raise IndexError("tuple index out of range")

    monkeypatch.setattr(worker, "extract", lambda job, report: None)
    monkeypatch.setattr(worker, "mask_turning_object", broken)
    notes: list[str] = []
    worker.solve(replace(job, skipped_checks=(("a third check", "slow"),)), lambda *progress: None, notes.append)
    why = "IndexError: tuple index out of range"
    assert f"could not check for an object moving in front of a static background: {why}" in notes


def test_a_refusal_speaks_of_as_many_photos_as_are_missing(photos: Path, report: PosesReport):
    there = [replace(image, registered=True, reason=None) for image in report.images[:4]]
    missing = replace(there[0], registered=False, reason="matches no other photo well (best 0 verified matches)")

    for registered, said in (
        (3, "only 3 of 4 photos"),
        (3, "; the other:"),
        (2, "; most of the others:"),
        (0, "; most of them:"),
    ):
        images = (*there[:registered], *[missing] * (4 - registered))
        refused = str(refusal(replace(report, registered=registered, total=4, images=images, parts=(4,)), photos))
        assert said in refused
        assert ": matches no other photo well" in refused


@pytest.mark.parametrize(("parts", "more"), [((3, 3), ""), ((5, 4), ", or process each part separately")])
def test_only_parts_that_are_large_enough_are_worth_processing(photos: Path, report: PosesReport, parts, more):
    refused = refusal(replace(report, registered=3, total=sum(parts), parts=parts), photos)
    assert refused is not None
    assert refused.hint == f"take photos that connect the parts{more}"
