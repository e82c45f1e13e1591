"""Which photos are held out: rules in closed form, and invalid rules."""

from pathlib import PurePosixPath

import pytest

from nerfcli.captures.holdout import DEFAULT_HOLDOUT, check_holdout, default_split, names_held_out
from nerfcli.captures.loading import fingerprint, load_scene
from nerfcli.errors import UserError

NAMES = [f"frame_{index}.png" for index in range(1, 21)]


def test_every_n_counts_names_in_order():
    assert names_held_out("every:5", ["d", "b", "a", "c", "f", "e"]) == {"a", "f"}
    assert default_split([]) == frozenset()


def test_a_block_is_the_middle_of_the_capture_with_numbers_counted():
    # 15 % of 20 are 3; in alphabetical order, frame_10 would be before frame_2.
    assert names_held_out("block:0.15", NAMES) == {"frame_9.png", "frame_10.png", "frame_11.png"}
    assert len(names_held_out("block:0.001", NAMES)) == 1


RIG = [f"{camera}/{index:04d}.png" for camera in ("left", "right") for index in range(20)]


def test_photos_of_a_rig_are_held_out_together():
    """The camera beside a held-out one would show nearly the same picture."""
    expected = {f"{camera}/{index:04d}.png" for camera in ("left", "right") for index in (0, 8, 16)}
    assert names_held_out(DEFAULT_HOLDOUT, RIG) == expected == default_split(RIG)
    middle = {f"{camera}/{index:04d}.png" for camera in ("left", "right") for index in (8, 9, 10)}
    assert names_held_out("block:0.15", RIG) == middle


def test_photos_of_a_rig_without_their_neighbours_count_like_the_others():
    """Photos that could not be placed are missing on one side."""
    names = sorted({*RIG} - {"left/0003.png", "right/0000.png", "right/0008.png"})
    held_out = names_held_out(DEFAULT_HOLDOUT, names)
    assert {"left/0000.png", "left/0009.png", "right/0009.png"} <= held_out
    assert not {PurePosixPath(name).name for name in held_out} & {PurePosixPath(n).name for n in {*names} - held_out}


def test_cameras_around_a_scene_are_held_out_one_by_one():
    """A dome takes all its photos at once: none would be left for training."""
    names = [f"cam{index:02d}/frame.png" for index in range(20)]
    assert names_held_out(DEFAULT_HOLDOUT, names) == {f"cam{index:02d}/frame.png" for index in (0, 8, 16)}
    three = [f"cam{index:02d}/{frame}.png" for index in range(20) for frame in range(3)]
    assert names_held_out(DEFAULT_HOLDOUT, three) == set(sorted(three)[::8])


def test_a_file_lists_names(tmp_path):
    path = tmp_path / "test.txt"
    path.write_text("frame_3.png\n\n  frame_5.png \nunplaced.png\n", encoding="utf-8")
    rule = check_holdout(str(path))
    assert names_held_out(rule, NAMES, others=["unplaced.png"]) == {"frame_3.png", "frame_5.png"}
    with pytest.raises(UserError, match=r"lists 1 name that matches no photo: unplaced\.png"):
        names_held_out(rule, NAMES)


@pytest.mark.parametrize("rule", ["every", "every:1", "every:0", "every:x", "block:1", "block:0", "block:1.5", "gone"])
def test_what_is_no_rule_is_refused(rule):
    with pytest.raises(ValueError, match="is not a valid split: expected every:N"):
        check_holdout(rule)


def test_something_must_be_left_on_both_sides(tmp_path):
    path = tmp_path / "all.txt"
    path.write_text("\n".join(NAMES))
    for rule in (str(path), "block:0.99"):
        with pytest.raises(UserError, match="holds out 20 of 20 photos"):
            names_held_out(rule, NAMES)
    path.write_text("")
    with pytest.raises(UserError, match="holds out 0 of 20"):
        names_held_out(str(path), NAMES)


def test_a_scene_is_split_by_a_rule(spheres):
    again = load_scene(spheres.root, holdout="block:0.25")
    assert len(again.test_frames) == round(0.25 * len(spheres.frames))
    assert again.holdout == "block:0.25"
    assert {frame.name for frame in again.frames} == {frame.name for frame in spheres.frames}
    assert fingerprint(again) != fingerprint(spheres)
