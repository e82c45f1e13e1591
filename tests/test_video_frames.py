"""poses.input.frame_choice and video_frames: the sharpest frame of each stretch, nothing twice, nothing lost."""

import json
from pathlib import Path

import numpy as np
import pytest
from clips import encode, pan
from hypothesis import given
from hypothesis import strategies as st

from nerfcli.errors import UserError
from nerfcli.notices import Reporter
from nerfcli.poses.input.pairs import capture_order
from nerfcli.poses.input.video_frames import (
    FRAMES_FILE,
    MOVED_FRACTION,
    FrameMeasure,
    FrameMeter,
    MotionPicture,
    choose_frames,
    extract_frames,
)

# One frame in five is sharp; each moves by 2 pixels of 160.
SHARP = [3, 5, 13, 19, 20, 26, 34, 36]
MOVING = [2.0 * number for number in range(40)]


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    """A steadily moving camera at 25 frames per second; in each fifth of a second, all frames but one are blurred."""
    blurred = [number for number in range(40) if number not in SHARP]
    return encode(tmp_path_factory.mktemp("clip") / "clip.mp4", pan(MOVING, blurred=blurred), fps=25)


def extract(path: Path, folder: Path, *, count: int | None = None, overwrite: bool = False) -> list[str]:
    """Extract frames and return the notes."""
    notes: list[str] = []
    fractions: list[float] = []
    reporter = Reporter(note=notes.append, progress=lambda fraction, what: fractions.append(fraction))
    extract_frames(path, folder, count=count, overwrite=overwrite, reporter=reporter)
    assert fractions == sorted(fractions)
    return notes


def numbers_in(folder: Path) -> list[int]:
    return [int(path.stem.removeprefix("frame_")) for path in sorted(folder.glob("*.jpg"))]


@pytest.mark.parametrize("shift", [0.0, 0.5, 1.0, 3.0, 8.0])
def test_motion_is_the_share_of_the_longer_side(shift):
    """Closed form: a picture 160 wide that moves by `shift` pixels."""
    one, other = pan([10.0, 10.0 + shift])
    assert MotionPicture(one).moved_to(MotionPicture(other)) == pytest.approx(shift / 160, abs=0.1 / 160)


def test_another_scene_has_moved_and_a_blank_wall_has_not():
    (one,), other = pan([0.0]), np.random.default_rng(1).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    assert MotionPicture(one).moved_to(MotionPicture(other)) > MOVED_FRACTION
    grey = np.full((120, 160), 100, np.uint8)
    assert MotionPicture(grey).moved_to(MotionPicture(grey + 1)) == 0
    assert MotionPicture(grey).moved_to(MotionPicture(grey + 50)) == np.inf


def test_the_sharp_frame_of_each_stretch_is_taken(clip, tmp_path):
    """Truth by construction: one frame in each of eight stretches is sharp."""
    (note,) = extract(clip, tmp_path / "frames", count=8)
    assert numbers_in(tmp_path / "frames") == SHARP
    assert note.endswith("8 of 40 frames of clip.mp4")
    content = json.loads((tmp_path / "frames" / FRAMES_FILE).read_text())
    assert [frame["number"] for frame in content["frames"]] == SHARP
    np.testing.assert_allclose([frame["seconds"] for frame in content["frames"]], np.array(SHARP) / 25, atol=1e-3)


def test_the_names_are_in_the_order_of_capture(clip, tmp_path):
    extract(clip, tmp_path / "frames", count=8)
    assert capture_order([path.name for path in sorted((tmp_path / "frames").glob("*.jpg"))]) == list(range(8))


def test_the_same_video_gives_the_same_bytes(clip, tmp_path):
    for name in ("one", "two"):
        extract(clip, tmp_path / name, count=8)
    one, two = ({p.name: p.read_bytes() for p in (tmp_path / name).iterdir()} for name in ("one", "two"))
    assert one == two


def test_a_camera_that_stands_still_gets_no_frames_for_it(tmp_path):
    """2 s of motion, 4 s of standing with noise, 2 s of motion: no frames of the standstill except at its ends."""
    offsets = [*np.arange(50), *np.full(100, 50.0), *range(50, 100)]
    noise = np.random.default_rng(0).normal(scale=3, size=(200, 120, 160, 1))
    frames = [np.clip(f + n, 0, 255).astype(np.uint8) for f, n in zip(pan(offsets), noise, strict=True)]
    extract(encode(tmp_path / "a.mp4", frames, fps=25), tmp_path / "frames", count=20)
    numbers = np.array(numbers_in(tmp_path / "frames"))
    assert len(numbers) == 20
    assert np.sum((numbers > 52) & (numbers < 148)) <= 2
    distances = np.diff(np.array(offsets)[numbers]) / 160
    assert distances.min() > 0.9 * MOVED_FRACTION


@pytest.mark.parametrize(("pixels", "count", "expected"), [(20.0, None, 22), (20.0, 10, 10), (80.0, None, 45)])
def test_a_video_that_moves_little_still_gets_enough_frames(
    tmp_path: Path, pixels: float, count: int | None, expected: int
):
    """A picture 160 wide that moves by 20 pixels in 4 s differs 12 times by 1 %, and twice as often by half of it."""
    offsets = np.linspace(0, pixels, 100)
    path = encode(tmp_path / "far.mp4", pan(list(offsets)), fps=25)
    extract(path, tmp_path / "frames", count=count)
    numbers = numbers_in(tmp_path / "frames")
    assert len(numbers) == pytest.approx(expected, rel=0.15)
    assert np.diff(offsets[numbers]).min() > 0.9 * 160 * 0.005


def test_frames_are_kept_and_not_replaced_without_overwrite(clip, tmp_path):
    folder = tmp_path / "frames"
    extract(clip, folder, count=8)
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    (note,) = extract(clip, folder, count=8, overwrite=True)
    assert "is kept: 8 frames" in note
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    with pytest.raises(UserError, match=r"contains other frames: 8 of clip\.mp4"):
        extract(clip, folder, count=6)
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    extract(clip, folder, count=6, overwrite=True)
    assert len(numbers_in(folder)) == 6


def test_frames_that_were_thrown_out_by_hand_stay_out(clip, tmp_path):
    folder = tmp_path / "frames"
    extract(clip, folder, count=8)
    (folder / "frame_000013.jpg").unlink()
    (note,) = extract(clip, folder, count=8)
    assert note.endswith("1 of which are missing")
    extract(clip, folder, count=8, overwrite=True)
    assert numbers_in(folder) == SHARP


def test_a_folder_of_something_else_is_never_replaced(clip, tmp_path):
    (tmp_path / "letters.txt").write_text("dear")
    with pytest.raises(UserError, match="it contains other files"):
        extract(clip, tmp_path, count=8, overwrite=True)
    assert (tmp_path / "letters.txt").read_text() == "dear"


def test_fewer_frames_than_requested(clip, tmp_path):
    notes = extract(clip, tmp_path / "frames", count=41)
    assert f"{clip.name} has only 40 frames, but --frames is 41: using all of them" in notes
    extract(clip, tmp_path / "all")  # without a number: all frames that differ
    assert numbers_in(tmp_path / "frames") == numbers_in(tmp_path / "all") == list(range(40))


@given(data=st.data(), total=st.integers(1, 40))
def test_chosen_frames_are_as_many_as_requested_and_in_order(data, total):
    """For any measures, including infinite motion and equal sharpness."""
    moved = data.draw(st.lists(st.sampled_from([0.0, 0.004, 0.01, 0.3, np.inf]), min_size=total, max_size=total))
    sharp = data.draw(st.lists(st.integers(0, 3), min_size=total, max_size=total))
    steps = data.draw(st.lists(st.sampled_from([0.01, 0.04, 1.0]), min_size=total, max_size=total))
    count = data.draw(st.integers(1, total))
    measures = [FrameMeasure(float(s), m) for s, m in zip(sharp, moved, strict=True)]
    numbers = choose_frames(np.cumsum(steps), measures, count=count)
    assert len(numbers) == count
    assert numbers == sorted(set(numbers))
    assert numbers[0] >= 0
    assert numbers[-1] < total


def test_a_meter_keeps_one_picture():
    meter = FrameMeter()
    moved = [meter.measure(frame[..., 0]).moved for frame in pan([0.0, 1.0, 2.0, 3.0, 4.0])]
    assert moved[0] == np.inf
    # Motion is from an anchor, which is replaced by the first frame that has moved by 1 %, 1.6 of 160 pixels.
    np.testing.assert_allclose(moved[1:], np.array([1, 2, 1, 2]) / 160, atol=0.1 / 160)
