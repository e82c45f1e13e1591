"""Time limits: matching and merging are stopped far beyond their plan, and the result says so.

That of a check is in test_pose_checks.
"""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pycolmap
import pytest
import synthetic_captures as synthetic
from synthetic_captures import WIDE, Noise

from nerfcli.kernels import nearest
from nerfcli.poses.engine import attempts, features, worker
from nerfcli.poses.engine.attempts import map_with_fallbacks
from nerfcli.poses.engine.database import clear_matches
from nerfcli.poses.engine.mapping import mapping_key, read_mapped, write_mapped
from nerfcli.poses.input.job import Job
from nerfcli.poses.input.pairs import all_pairs, in_blocks
from nerfcli.poses.input.plan import checking_seconds, limit_seconds
from nerfcli.poses.model import merging
from nerfcli.poses.model.two_views import count_matches


@pytest.fixture(scope="module")
def matched(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """Eight photos with features and matches."""
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    folder = tmp_path_factory.mktemp("capture")
    views = synthetic.ring(8, [WIDE], seed=0, turn_deg=160)
    synthetic.write_database(folder / "database.db", views, synthetic.boulder(700, seed=0), noise=Noise(), seed=0)
    return synthetic.synthetic_job(folder, views, seed=0)


@pytest.fixture
def job(matched: Job, tmp_path: Path) -> Job:
    """The same in a folder that may be changed."""
    shutil.copytree(matched.database.parent, tmp_path / "again")
    return replace(matched, folder=str(tmp_path / "again" / "work"))


def looked_at(job: Job) -> set[tuple[int, int]]:
    """Return the pairs that the matcher has tried, with or without a result."""
    with pycolmap.Database.open(str(job.database)) as database:
        return {(i, j) for i, j in all_pairs(8) if database.exists_two_view_geometry(i + 1, j + 1)}


def test_limits_are_ten_times_the_plan():
    """In closed form: 1,000 photos are checked in 1 + (0.04 + 0.0002 * 1000) * 1000 s."""
    assert limit_seconds(checking_seconds(1000)) == pytest.approx(2410)
    assert limit_seconds(checking_seconds(10)) == 120


def test_pairs_of_photos_near_in_the_order_come_first():
    pairs = in_blocks(all_pairs(70))
    assert sorted(pairs) == sorted(all_pairs(70))
    apart = [j // 16 - i // 16 for i, j in pairs]
    assert apart == sorted(apart)


def test_matching_ends_at_its_limit_and_the_next_call_does_the_rest(job: Job, monkeypatch: pytest.MonkeyPatch):
    """The clock advances by 80 s at each reading and the limit is 120 s: time for one batch of 10 pairs."""
    clear_matches(job, "matches", "two_view_geometries")
    pairs = sorted(all_pairs(8))
    with monkeypatch.context() as patched:
        now = iter(range(0, 10_000, 80))
        patched.setattr(features, "_PAIRS_PER_CALL", 10)
        patched.setattr(features.time, "perf_counter", lambda: next(now))
        said = features.match(job, pairs, lambda *progress: None)
    assert said == "matching: 18 of 28 pairs are not matched after 2 min"
    assert looked_at(job) == set(pairs[:10])
    assert features.match(job, pairs, lambda *progress: None) is None
    assert looked_at(job) == set(pairs)


def test_without_numba_pycolmap_matches(job: Job, monkeypatch: pytest.MonkeyPatch):
    """Its index is approximate, and may miss a few of the matches."""
    pairs = sorted(all_pairs(8))
    found = []
    for module in (nearest, None):
        clear_matches(job, "matches", "two_view_geometries")
        monkeypatch.setitem(sys.modules, "nerfcli.kernels.nearest", module)
        assert features.match(job, pairs, lambda *progress: None) is None
        found.append(sum(count for _, _, count in count_matches(job.database)))
    assert found[0] > 1000
    assert found[1] == pytest.approx(found[0], rel=0.1)


def test_what_was_cut_short_is_kept_with_the_models(job: Job):
    mapped = map_with_fallbacks(job, lambda *progress: None)
    assert mapped.cut_short == ()
    write_mapped(replace(mapped, cut_short=("matching: 1 of 28 pairs",)), mapping_key(job))
    again = read_mapped(job, mapping_key(job))
    assert again is not None
    assert again.cut_short == ("matching: 1 of 28 pairs",)


def test_no_attempt_begins_after_the_time_for_all(job: Job, monkeypatch: pytest.MonkeyPatch):
    """Three of eight photos are not placed, so others would be tried; the clock advances by 250 s at each reading.

    All attempts together may take 240 s: the second reading is too late.
    """
    real = attempts.map_photos

    def without_three(*arguments, **options) -> list[pycolmap.Reconstruction]:
        models = real(*arguments, **options)
        for photo in {6, 7, 8} & set(models[0].reg_image_ids()):
            models[0].deregister_frame(models[0].image(photo).frame_id)
        return models

    now = iter(range(0, 100_000, 250))
    monkeypatch.setattr(attempts, "map_photos", without_three)
    monkeypatch.setattr(attempts.time, "perf_counter", lambda: next(now))
    notes: list[str] = []
    mapped = map_with_fallbacks(job, lambda *progress: None, notes.append)
    assert mapped.attempts[0]["what"] == "default thresholds"
    assert not any("start from" in attempt["what"] for attempt in mapped.attempts)
    said = "no further attempts to place photos after 4 min"
    assert mapped.cut_short == (said,)
    assert notes.count(f"cut short: {said}") == 1


def test_a_way_to_map_that_was_ended_is_reported_and_a_check_once(job: Job, monkeypatch: pytest.MonkeyPatch):
    """The worker was ended before in two stages: one is a check of the accepted model, the other is a mapper."""
    ended = (("pose uncertainty", "it took longer than 5 min"), ("global mapper", "it took longer than 2 min"))
    job = replace(job, skipped_checks=ended)
    # There are no photos: their features are in the database already.
    monkeypatch.setattr(worker, "extract", lambda job, report: None)
    monkeypatch.setattr(worker, "mask_turning_object", lambda job, training: (job, None))
    worker.solve(job, lambda *progress: None, lambda note: None)
    content = json.loads((Path(job.folder) / "result.json").read_text(encoding="utf-8"))["content"]
    assert content["not_computed"] == {"pose uncertainty": "it took longer than 5 min"}
    assert content["cut_short"] == ["global mapper: it took longer than 2 min"]


def test_merging_ends_at_its_limit(job: Job):
    """Without time, two overlapping models stay two; with time, they become one."""
    whole = map_with_fallbacks(job, lambda *progress: None).models[0]
    first, second = pycolmap.Reconstruction(whole), pycolmap.Reconstruction(whole)
    for photo in range(1, 9):
        if photo > 5:
            first.deregister_frame(first.image(photo).frame_id)
        if photo < 5:
            second.deregister_frame(second.image(photo).frame_id)
    sizes, said = {}, []
    for seconds in (-1.0, 1e9):
        merged = merging.merge_models([first, second], job, seconds=seconds, tell=said.append)
        sizes[seconds] = [model.num_reg_images() for model in merged]
    assert sizes == {-1.0: [5, 4], 1e9: [8]}
    assert said == ["merging: 1 of 2 sub-models are left after -1 s"]
