"""Which photos are held out: rules in closed form, and invalid rules."""

import pytest

from nerfcli import scene as scenes
from nerfcli.errors import UserError
from nerfcli.holdout import DEFAULT_HOLDOUT, check_holdout, names_held_out

NAMES = [f"frame_{index}.png" for index in range(1, 21)]


def test_the_default_is_the_split_of_scenes():
    assert names_held_out(DEFAULT_HOLDOUT, NAMES) == scenes.default_split(NAMES)


def test_every_n_counts_names_in_order():
    assert names_held_out("every:5", ["d", "b", "a", "c", "f", "e"]) == {"a", "f"}


def test_a_block_is_the_middle_of_the_capture_with_numbers_counted():
    # 15 % of 20 are 3; in alphabetical order, frame_10 would be before frame_2.
    assert names_held_out("block:0.15", NAMES) == {"frame_9.png", "frame_10.png", "frame_11.png"}
    assert len(names_held_out("block:0.001", NAMES)) == 1


def test_a_file_lists_names(tmp_path):
    path = tmp_path / "test.txt"
    path.write_text("frame_3.png\n\n  frame_5.png \nunplaced.png\n", encoding="utf-8")
    rule = check_holdout(str(path))
    assert names_held_out(rule, NAMES, others=["unplaced.png"]) == {"frame_3.png", "frame_5.png"}
    with pytest.raises(UserError, match=r"lists 1 names that match no photo: unplaced\.png"):
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
    again = scenes.load(spheres.root, holdout="block:0.25")
    assert len(again.test_frames) == round(0.25 * len(spheres.frames))
    assert again.holdout == "block:0.25"
    assert {frame.name for frame in again.frames} == {frame.name for frame in spheres.frames}
    assert scenes.fingerprint(again) != scenes.fingerprint(spheres)
