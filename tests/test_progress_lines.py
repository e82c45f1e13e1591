"""Lines of progress without a terminal: at most one in ten seconds, with the time that is left."""

import time
from collections.abc import Callable

import pytest

from nerfcli.cli.console import PLAIN_LINE_SECONDS, Console


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return lambda seconds: now.__setitem__(0, now[0] + seconds)


def test_the_time_left_follows_from_the_speed_since_the_first_step(clock, capsys):
    """Compiling takes 60 s before the first of 100 frames, and a frame 0.5 s."""
    with Console(quiet=False, json_lines=False).stage("render orbit") as reporter:
        reporter.progress(0.0, "of 100 frames")
        clock(60.0)
        reporter.progress(0.01, "of 100 frames")
        clock(PLAIN_LINE_SECONDS - 1)
        reporter.progress(0.19, "of 100 frames")  # too early for a line
        clock(3.0)
        reporter.progress(0.25, "of 100 frames")
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["render orbit: 1 % of 100 frames", "render orbit: 25 % of 100 frames, about 38 s left"]


def test_resumed_work_takes_as_long_for_the_rest_as_since_it_began_again(clock, capsys):
    with Console(quiet=False, json_lines=False).stage("train desk") as reporter:
        reporter.progress(0.6, "step 600")
        clock(8.0)
        reporter.progress(0.601, "step 601")
        clock(33.0)
        reporter.progress(0.7, "step 700")
    assert capsys.readouterr().err == "train desk: 70 % step 700, about 2 min left\n"


def test_no_time_is_estimated_from_hardly_any_work_or_beside_a_better_estimate(clock, capsys):
    with Console(quiet=False, json_lines=False).stage("poses desk") as reporter:
        reporter.progress(0.0, "")
        clock(20.0)
        reporter.progress(0.01, "")
        clock(20.0)
        reporter.progress(0.5, "(5 of 10 photos, about 34 s left)")
    assert capsys.readouterr().err == "poses desk: 1 %\nposes desk: 50 % (5 of 10 photos, about 34 s left)\n"
