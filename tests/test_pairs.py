"""Which photos are compared: the rules, pairs that the user lists, look-alikes, and the estimate of the time."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from test_photos import NO_EXIF

from nerfcli.errors import BAD_INPUT, UserError
from nerfcli.poses.engine.retrieval import alike, likeness, promising
from nerfcli.poses.input.pairs import (
    ALL_ALIKE_UP_TO,
    Pairing,
    capture_order,
    choose_pairs,
    read_pairs,
    sequential_pairs,
)
from nerfcli.poses.input.photos import Photo, Photos
from nerfcli.poses.input.plan import Plan, TimeEstimate, make_plan
from nerfcli.poses.input.settings import Search


def named(*names: str) -> list[Photo]:
    return [Photo(name, 64, 48, NO_EXIF) for name in names]


def lettered(count: int) -> list[Photo]:
    """Photos whose names have no order."""
    return named(*(f"{chr(97 + k % 26)}{chr(97 + k // 26)}.jpg" for k in range(count)))


@pytest.mark.parametrize(
    "names",
    [
        ["IMG_9.jpg", "IMG_10.jpg", "IMG_8.jpg"],
        ["0009.png", "0010.png", "0008.png"],
        ["a.b9.jp2", "a.b10.jp2", "a.b8.jp2"],
    ],
)
def test_names_are_ordered_by_their_number(names: list[str]):
    assert capture_order(names) == [2, 0, 1]


@pytest.mark.parametrize("names", [["a.jpg", "b.jpg"], ["a1.jpg", "b2.jpg"], ["a1.jpg", "a01.jpg"], ["1.jpg", "x.jpg"]])
def test_names_that_differ_in_more_than_a_number_have_no_order(names: list[str]):
    assert capture_order(names) is None


@pytest.mark.parametrize("count", [0, 1, 2, ALL_ALIKE_UP_TO])
@pytest.mark.parametrize("rule", ["auto", "exhaustive"])
def test_all_pairs_of_small_captures_are_compared(count: int, rule: str):
    """By default, those whose photos have no features in common are left out later."""
    pairing = choose_pairs(named(*(f"{number:03}.jpg" for number in range(count))), rule=rule)
    assert (pairing.rule, pairing.neighbours) == (("retrieval", 25) if rule == "auto" else ("exhaustive", 0))
    assert sorted(pairing.pairs) == list(combinations(range(count), 2))


def test_large_unordered_captures_are_compared_by_likeness():
    pairing = choose_pairs(lettered(100))
    assert (pairing.rule, pairing.pairs) == ("retrieval", ())
    assert 20 <= pairing.neighbours <= 30


def test_large_numbered_captures_compare_neighbours_and_look_for_loops():
    count = 300
    pairing = choose_pairs(named(*(f"frame_{number}.jpg" for number in range(count))))
    pairs = set(pairing.pairs)
    assert pairing.rule == "sequential"
    assert pairing.neighbours > 0
    assert len(pairs) == len(pairing.pairs) < 0.15 * count * (count - 1) / 2
    assert all(0 <= i < j < count for i, j in pairs)
    assert all((i, i + step) in pairs for step in (1, 10, 16, 256) for i in range(count - step))


@pytest.mark.parametrize(("gap", "rule"), [(2.0, "sequential"), (600.0, "retrieval")])
def test_the_clock_orders_a_walk_but_not_a_holiday(gap: float, rule: str):
    photos = lettered(80)
    # The last by name was taken first.
    timed = [replace(p, exif=replace(NO_EXIF, taken=1e9 - gap * k)) for k, p in enumerate(photos)]
    pairing = choose_pairs(timed)
    assert pairing.rule == rule
    if rule == "sequential":
        assert {(i, i + 1) for i in range(79)} <= set(pairing.pairs)
        # Photos far apart in time are compared only at steps that are powers of two.
        assert (0, 13) not in pairing.pairs


def grid(spacing_deg: float) -> list[Photo]:
    """Ten by ten photos on a grid on the ground, at 60 degrees north, across the antimeridian."""
    gps = [(60 + spacing_deg * (k // 10), 2 * spacing_deg * (k % 10 - 5) % 360 - 180, None) for k in range(100)]
    return [replace(one, exif=replace(NO_EXIF, gps=place)) for one, place in zip(lettered(100), gps, strict=True)]


def test_photos_that_gps_separates_are_compared_with_the_nearest():
    """On a square grid, the 20 photos nearest to an inner one are within 3 steps and include the 8 around it."""
    pairing = choose_pairs(grid(spacing_deg=0.0002))  # 22 metres
    pairs = set(pairing.pairs)
    assert pairing.rule == "spatial"
    around = (44 - 10, 44 + 10, 44 - 1, 44 + 1, 44 - 11, 44 - 9, 44 + 9, 44 + 11)
    assert all((min(44, j), max(44, j)) in pairs for j in around)
    assert all(abs(i // 10 - j // 10) <= 5 and abs(i % 10 - j % 10) <= 5 for i, j in pairs)
    assert choose_pairs(grid(spacing_deg=0.00001)).rule == "retrieval"  # closer than the error of GPS


@pytest.mark.parametrize("rule", ["auto", "spatial"])
def test_a_photo_without_a_position_is_left_to_look_alikes(rule):
    """The pairs of the others, by number, are those without it."""
    photos = grid(spacing_deg=0.0002)
    rest = choose_pairs([*photos[:7], *photos[8:]])
    photos[7] = replace(photos[7], exif=NO_EXIF)
    pairing = choose_pairs(photos, rule=rule)
    assert pairing.rule == rest.rule == "spatial"
    assert set(pairing.pairs) == {(i + (i >= 7), j + (j >= 7)) for i, j in rest.pairs}


def test_spatial_pairing_asks_for_positions():
    photos = grid(spacing_deg=0.0002)
    photos[7:18] = [replace(photo, exif=NO_EXIF) for photo in photos[7:18]]
    with pytest.raises(UserError, match=r"11 of 100 photos have no GPS position \(ha.jpg\)"):
        choose_pairs(photos, rule="spatial")
    assert choose_pairs(photos).rule != "spatial"


# Pairs that the user lists

SPACED = Photos(Path("my photos"), tuple(named("a.jpg", "b 1.jpg", "b.jpg", "c d.jpg")), {"torn.jpg": "damaged"})


def pairs_of(tmp_path: Path, text: str) -> set[tuple[int, int]]:
    (tmp_path / "pairs.txt").write_text(text, encoding="utf-8")
    pairing = read_pairs(tmp_path / "pairs.txt", SPACED)
    assert (pairing.rule, pairing.neighbours) == ("file", 0)
    return set(pairing.pairs)


@pytest.mark.parametrize(
    ("text", "pairs"),
    [
        ("a.jpg b.jpg\n", {(0, 2)}),
        ("\ufeff# listed by hand\n\nb.jpg  a.jpg\r\na.jpg b.jpg", {(0, 2)}),
        ("b 1.jpg c d.jpg\nc d.jpg a.jpg", {(1, 3), (0, 3)}),
        ("\"b 1.jpg\" 'a.jpg'\nb 1.jpg\tb.jpg", {(0, 1), (1, 2)}),
        ("a.jpg b.jpg\na.jpg torn.jpg", {(0, 2)}),
    ],
    ids=["plain", "comment, either order, twice", "spaces", "quotes and tabs", "unreadable"],
)
def test_pairs_are_read(tmp_path: Path, text: str, pairs: set[tuple[int, int]]):
    assert pairs_of(tmp_path, text) == pairs


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a.jpg b.jpg\na.jpg e.jpg", r"pairs.txt, line 2: there is no photo 'e.jpg'"),
        ("a.jpg", r"line 1: 'a.jpg' does not contain two names of photos"),
        ("x y z", r"line 1: 'x y z' does not contain two names of photos"),
        ("\n\na.jpg a.jpg", r"line 3: a.jpg is paired with itself"),
        ("# nothing", r"lists no pairs"),
    ],
)
def test_lines_that_are_not_pairs_are_reported_with_their_number(tmp_path: Path, text: str, words: str):
    with pytest.raises(UserError, match=words) as caught:
        pairs_of(tmp_path, text)
    assert caught.value.exit_code == BAD_INPUT


def test_a_file_of_pairs_that_is_not_there_is_reported(tmp_path: Path):
    with pytest.raises(UserError, match=r"cannot read the pairs in .*none.txt: No such file"):
        read_pairs(tmp_path / "none.txt", SPACED)


# Look-alikes


def shared_descriptors(photos: int, *, seed: int = 0) -> tuple[list[np.ndarray], np.ndarray]:
    """Return descriptors of photos that see windows of one row of things, and the true number that each pair shares."""
    rng = np.random.default_rng(seed)
    things = rng.integers(0, 256, (20 * photos + 80, 128))
    noise = rng.integers(-8, 9, (photos, *things.shape))
    seen = [range(20 * k, 20 * k + 80) for k in range(photos)]
    descriptors = [np.clip(things[list(s)] + noise[k][list(s)], 0, 255).astype(np.uint8) for k, s in enumerate(seen)]
    truth = np.array([[len(set(a) & set(b)) if a != b else 0 for b in seen] for a in seen])
    return [rows[rng.permutation(len(rows))] for rows in descriptors], truth


def test_likeness_counts_the_features_that_two_photos_share():
    """Synthetic truth; random descriptors are far from each other, so no match is wrong and none is missed.

    One photo has a feature more than the others, so that these have a row of padding each.
    """
    descriptors, truth = shared_descriptors(70)  # more than a block
    descriptors[9] = np.vstack([descriptors[9], np.random.default_rng(1).integers(0, 256, (1, 128))])
    descriptors[5] = descriptors[5][:0]
    truth[5] = truth[:, 5] = 0
    np.testing.assert_array_equal(likeness(descriptors, lambda *reported: None), truth)


def test_look_alikes_are_the_neighbours_that_are_not_known():
    _, truth = shared_descriptors(30)
    assert alike(truth, 2, paired=()) == sorted(
        {(min(i, j), max(i, j)) for i in range(30) for j in np.argsort(-truth[i], kind="stable")[:2].tolist()}
    )
    paired = [(i, i + 1) for i in range(29)]
    found = alike(truth, 2, paired=paired)
    assert not set(found) & set(paired)
    assert {(i, i + 2) for i in range(28)} <= set(found)


def test_pairs_without_common_features_are_left_out_except_the_best_of_each_photo():
    """Photos up to three apart share features; those at the ends have fewer than four such partners."""
    _, truth = shared_descriptors(30)
    pairs = sequential_pairs(range(30))
    kept = promising(truth, pairs)
    assert set(kept) <= set(pairs)
    assert {(i, j) for i, j in pairs if j - i <= 3} <= set(kept)
    assert all(sum(photo in pair for pair in kept) >= 4 for photo in range(30))
    assert all({0, 29} & set(pair) for pair in kept if pair[1] - pair[0] > 3)


def test_pairs_with_few_common_features_are_left_out_where_both_photos_have_better_ones():
    """By hand: two groups of 15 that look alike, 8 features in common between them; two photos have no group."""
    common = np.full((32, 32), 8)
    common[:15, :15] = common[15:30, 15:30] = 20
    kept = set(promising(common, combinations(range(32), 2)))
    within = {(i, j) for start in (0, 15) for i, j in combinations(range(start, start + 15), 2)}
    assert kept == within | {(i, j) for j in (30, 31) for i in range(j)}


# The plan


def plan_of(pairing: Pairing, *, photos: int = 100, threads: int = 1, features: int = 4096) -> Plan:
    return make_plan(Photos(Path("x"), tuple(lettered(photos)), {}), pairing, Search(1600, features), threads=threads)


def test_the_estimate_falls_with_threads_and_features():
    pairing = choose_pairs(lettered(100), rule="exhaustive")
    alone, many = plan_of(pairing, features=20), plan_of(pairing, threads=4, features=10)
    assert alone.pairs == 4950
    assert many.seconds["match"] == pytest.approx(alone.seconds["match"] / 8, abs=0.1)


def test_small_photos_are_not_planned_with_as_many_features_as_large_ones():
    """The plan's own figure: 0.009 features per searched pixel, but never more than the settings allow."""
    photos = lettered(100)
    pixels = photos[0].width * photos[0].height
    assert plan_of(choose_pairs(photos, rule="exhaustive")).features == round(0.009 * pixels) < 4096
    assert plan_of(choose_pairs(photos, rule="exhaustive"), features=20).features == 20


def test_the_memory_of_a_search_counts_enlarged_pictures():
    """Photos that may be searched enlarged by 1.5 need as much as photos of that size."""
    memory = []
    for size, searched_px in (((800, 600), 1600), ((1200, 900), 1200), ((800, 600), 1000), ((1000, 750), 1000)):
        photos = tuple(replace(photo, width=size[0], height=size[1]) for photo in lettered(20))
        plan = make_plan(Photos(Path("x"), photos, {}), Pairing("", (), 4), Search(searched_px, 4096), threads=16)
        memory.append(plan.memory_bytes)
    assert memory[0] == memory[1] > 2e9
    assert memory[2] == memory[3] > 2e9


def test_look_alikes_bound_the_number_of_pairs():
    assert plan_of(Pairing("retrieval", (), 25)).pairs == 2500
    assert plan_of(Pairing("retrieval", (), 90)).pairs == 4950


@pytest.mark.parametrize(("photos", "seconds"), [(100, 1.5), (1000, 37.5), (5000, 234.3)])
def test_looking_for_similar_photos_stays_affordable(photos: int, seconds: float):
    """Closed form: 0.3 ms a pair with 256 features, a quarter of that with half as many."""
    plan = plan_of(Pairing("retrieval", (), 25), photos=photos)
    assert plan.seconds["pair"] == pytest.approx(seconds, abs=0.1)


class Outlook:
    """A time estimate whose clock is set by each report; by default of ten photos."""

    def __init__(self, seconds: dict[str, float], *, photos: int = 10, features: int = 4096):
        self._now = 0.0
        plan = Plan(photos, 1600, 4096, "exhaustive", 45, seconds, features=features)
        self._estimate = TimeEstimate(plan, clock=lambda: self._now)

    def at(self, now: float, stage: str, done: int, total: int) -> tuple[float, float]:
        """Return the fraction done and the seconds left when a stage reports at this time."""
        self._now = now
        return self._estimate.update(stage, done, total)

    def left(self, now: float, stage: str, done: int, total: int) -> float:
        return self.at(now, stage, done, total)[1]

    def whole(self, start: float, end: float, stage: str, total: int) -> tuple[float, float]:
        """Return the same at the end of a stage that reports its beginning and its end."""
        self.at(start, stage, 0, total)
        return self.at(end, stage, total, total)


def test_the_outlook_measures_and_stretches_what_is_to_come():
    """If the first stage takes twice its planned time, so will the rest, until a later stage proves faster."""
    outlook = Outlook({"extract": 10.0, "match": 30.0, "map": 10.0})
    assert outlook.at(0, "extract", 0, 10) == (0.0, 50.0)
    assert outlook.at(10, "extract", 5, 10) == (pytest.approx(0.1), pytest.approx(90.0))
    assert outlook.left(20, "extract", 10, 10) == pytest.approx(80.0)
    # Half of the pairs were already done: the rate is measured on the other half alone.
    outlook.at(20, "match", 20, 40)
    # A quarter planned for 7.5 s takes 5 s. The machine may be faster than planned: a fifth is taken off mapping.
    assert outlook.left(25, "match", 30, 40) == pytest.approx(5.0 + 10.0 * 0.8)
    outlook.at(30, "map", 10, 10)
    assert outlook.at(30, "map", 10, 10) == (1.0, 0.0)
    assert outlook.at(30, "check", 1, 4) == (1.0, 0.0)


def test_a_stage_that_takes_long_does_not_stretch_the_others():
    """A stage planned for 1 s takes 20 s; the other 100 s are not predicted to become 2000 s."""
    outlook = Outlook({"extract": 50.0, "pair": 1.0, "match": 100.0})
    outlook.whole(0, 50, "extract", 10)
    outlook.whole(50, 70, "pair", 10)
    assert outlook.left(70, "match", 0, 45) == pytest.approx(100.0)


@pytest.mark.parametrize("seconds_per_photo", [0.2, 1.0, 5.0])
def test_the_mapper_takes_longer_for_later_photos(seconds_per_photo: float):
    """Closed form: seconds grow as the number of photos to the power of 1.3, and the remaining time is exact."""
    outlook = Outlook({"map": 100.0}, photos=300)
    whole = seconds_per_photo * 300**1.3
    outlook.at(0, "map", 0, 300)
    for done in range(30, 300, 30):
        now = seconds_per_photo * done**1.3
        assert outlook.left(now, "map", done, 300) == pytest.approx(whole - now)


def test_merging_and_locating_add_to_what_is_left_and_take_nothing_from_the_share():
    """Merging takes a fifth of the planned mapping time on a machine as fast as planned, and precedes the checks."""
    outlook = Outlook({"map": 100.0, "check": 20.0})
    assert outlook.whole(0, 100, "map", 10) == (pytest.approx(100.0 / 120.0), pytest.approx(20.0))
    assert outlook.at(100, "merge", 0, 4) == (pytest.approx(100.0 / 120.0), pytest.approx(20.0 + 20.0))
    # The first of four has nothing to merge with and takes no time, which says little about the others.
    assert outlook.left(100, "merge", 1, 4) == pytest.approx(0.75 * 15.0 + 0.8 * 20.0)
    assert outlook.left(105, "merge", 1, 4) == pytest.approx(15.0 + 20.0)
    outlook.at(120, "merge", 4, 4)
    # Then 20 trials to locate single photos, at 0.7 s each.
    assert outlook.at(120, "locate", 0, 20) == (pytest.approx(120.0 / 140.0), pytest.approx(14.0 + 20.0))
    outlook.at(134, "locate", 20, 20)
    # Ten more trials after another attempt to merge.
    assert outlook.left(134, "locate", 0, 10) == pytest.approx(7.0 + 20.0)
    outlook.at(141, "locate", 10, 10)
    assert outlook.at(141, "check", 0, 4) == (pytest.approx(141.0 / 161.0), pytest.approx(20.0))


def test_principal_points_of_the_photos_add_to_what_is_left_and_take_nothing_from_the_share():
    """A trial of them is planned; going on with them takes five times as long on a machine as fast as planned."""
    outlook = Outlook({"map": 10.0, "check": 20.0, "stabilise": 4.0})
    outlook.whole(0, 10, "map", 10)
    assert outlook.whole(10, 30, "check", 4) == (pytest.approx(30.0 / 34.0), pytest.approx(4.0))
    outlook.at(30, "stabilise", 0, 2)
    assert outlook.at(32, "stabilise", 1, 2) == (pytest.approx(32.0 / 34.0), pytest.approx(2.0))
    assert outlook.at(34, "settle", 0, 4) == (pytest.approx(32.0 / 34.0), pytest.approx(20.0))
    assert outlook.left(44, "settle", 2, 4) == pytest.approx(10.0)
    assert outlook.at(54, "settle", 4, 4) == (1.0, 0.0)


@pytest.mark.parametrize("checked", [(0.0, 0.03, 0.46, 0.8, 1.0), (0.0, 0.02, 0.54, 0.82, 1.0)])
@pytest.mark.parametrize(
    ("planned", "taken"),
    [
        ((29, 55, 25, 12), (44, 117, 46, 20)),  # 50 photos by phone
        # 49 photos of a shiny object: a match takes three times as long as planned
        ((9, 53, 21, 10), (10, 184, 20, 13)),
        ((18, 11, 10, 8), (15, 17, 7, 8)),  # 23 photos
    ],
)
def test_what_is_left_is_right_within_a_half_from_a_quarter_on(
    planned: tuple[int, ...], taken: tuple[int, ...], checked: tuple[float, ...]
):
    """Captures measured on one core. Within a stage, progress is even, except that the mapper slows down as the model
    grows, and that the four checks advance as measured on the 50 photos and on 20 others.
    """
    stages = ("extract", "match", "map", "check")
    outlook = Outlook({stage: float(seconds) for stage, seconds in zip(stages, planned, strict=True)}, photos=50)
    began, whole = 0.0, sum(taken)
    for stage, seconds in zip(stages, taken, strict=True):
        steps = 4 if stage == "check" else 50
        for done in range(steps + 1):
            even = (done / steps) ** (1.3 if stage == "map" else 1.0)
            now = began + seconds * (checked[done] if stage == "check" else even)
            left = outlook.left(now, stage, done, steps)
            if whole / 4 <= now < 0.97 * whole:
                assert 1 / 1.5 < left / (whole - now) < 1.5, (stage, done)
        began += seconds


def test_matching_is_planned_by_the_features_that_were_found():
    """Closed form: a quarter of the features that the plan counts on take a quarter of its time."""
    outlook = Outlook({"extract": 10.0, "match": 100.0, "map": 20.0}, features=4000)
    assert outlook.whole(0, 10, "extract", 10)[1] == pytest.approx(120.0)
    assert outlook.at(10, "features", 1000, 4096) == (pytest.approx(10.0 / 55.0), pytest.approx(45.0))


def test_mapping_is_planned_by_the_matches_that_were_found():
    """By hand: ten photos with four times the usual 2,000 matches take twice the usual 0.09 + 10 * 0.0005 s each.

    Checks of them take twice 1 + 10 * (0.04 + 10 * 0.0002) s.
    """
    outlook = Outlook({"match": 10.0, "map": 20.0})
    assert outlook.whole(0, 10, "match", 45)[1] == pytest.approx(20.0)
    assert outlook.left(10, "matches", 8000, 0) == pytest.approx(1.9 + 2.84)


def test_another_attempt_is_measured_from_its_own_start():
    """The mapper took 100 s to get stuck at 60 of 100 photos, and starts anew from two photos, as it did then."""
    outlook = Outlook({"map": 120.0}, photos=100)
    outlook.at(0, "map", 2, 100)
    outlook.at(100, "map", 60, 100)
    outlook.at(100, "map", 2, 100)
    assert 60.0 < outlook.left(101, "map", 3, 100) < 300.0


def test_another_attempt_does_not_count_single_photos_of_the_first_again():
    """Closed form: the last of ten photos, of 10 s of mapping, and checks of 2 s are left, and no trials."""
    outlook = Outlook({"map": 10.0, "check": 2.0})
    outlook.whole(0, 10, "map", 10)
    outlook.at(10, "locate", 0, 20)
    outlook.whole(24, 26, "check", 4)
    assert outlook.left(26, "map", 9, 10) == pytest.approx(10.0 * (1 - 0.9**1.3) + 2.0)


def test_another_attempt_lowers_the_share():
    """Mapping begins again after the checks: the work is not at its end."""
    outlook = Outlook({"extract": 10.0, "map": 10.0, "check": 2.0})
    outlook.at(20, "map", 10, 10)
    assert outlook.at(22, "check", 4, 4)[0] == 1.0
    fraction, left = outlook.at(22, "map", 0, 10)
    assert left > 5.0
    assert fraction == pytest.approx(22.0 / (22.0 + left))
