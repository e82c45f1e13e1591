"""Rendering jobs that end early, at any moment, go on with the missing frames and leave the same files as in one go."""

import hashlib
import json
import random
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fog import CUBE, fog
from present import present

from nerfcli import atomic
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.errors import UserError
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.images import read_image
from nerfcli.render import frames as rendering
from nerfcli.render.depth import DepthRequest
from nerfcli.render.files.file_facts import description_of
from nerfcli.render.frames import render_job
from nerfcli.render.job import RenderJob, RenderSettings, VideoSettings
from nerfcli.render.model import Model

# A gif, since the other encoders do not promise the same bytes for the same frames.
VIDEO = VideoSettings(("gif",), fps=12)


@pytest.fixture(scope="module")
def model() -> Model:
    return foggy()


def foggy() -> Model:
    return fog(CUBE, Similarity.identity(), background=(0.2, 0.4, 0.6), step=1 / 32)


def job_of(count: int = 4, *, convention: str = "conditional", video: VideoSettings | None = VIDEO) -> RenderJob:
    up, middle = np.array([0.0, -1.0, 0.0]), np.zeros(3)
    poses = [look_at(np.array([0.1 * index, 0.0, -2.0]), middle, up) for index in range(count)]
    frames = tuple(Frame(f"f{index}/v.png", Camera.pinhole(10, 8, 8.0), pose) for index, pose in enumerate(poses))
    depth = DepthRequest(convention, "z", min_opacity=0.1)
    return RenderJob(frames, RenderSettings(("rgb", "depth"), depth, video=video), {"run": "a run"})


def render(
    model: Model, job: RenderJob, folder: Path, *, on_frames: Callable[[float], None] | None = None,
    overwrite: bool = True, threads: int = 1,
) -> list[float]:  # fmt: skip
    """Render, and return how many of the frames were done after each tile, which is a whole frame here.

    `on_frames` receives the same while it renders.
    """
    counts: list[float] = []

    def progress(fraction: float, detail: str) -> None:
        if detail:
            counts.append(fraction * int(detail.split()[1]))
            if on_frames is not None:
                on_frames(counts[-1])

    torch.set_num_threads(threads)
    render_job(model, job, Output(folder, overwrite), reporter=Reporter(progress=progress))
    return counts


def stop_after(frames: int, problem: BaseException) -> Callable[[float], None]:
    """Return an `on_frames` that raises in the frame after this many."""

    def on_frames(done: float) -> None:
        if done > frames + 0.5:
            raise problem

    return on_frames


def contents(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(scope="module")
def rendered(model, tmp_path_factory) -> Path:
    """The folder of a job in one go. Do not write into it."""
    folder = tmp_path_factory.mktemp("in one go") / "views"
    render(model, job_of(), folder)
    return folder


@pytest.fixture(scope="module")
def in_one_go(rendered) -> dict[str, str]:
    return contents(rendered)


@pytest.mark.parametrize(
    "problem", [KeyboardInterrupt(), UserError("cannot write: No space left on device", "free space")]
)
def test_a_job_that_ends_early_goes_on_and_ends_the_same(model, tmp_path, in_one_go, problem):
    folder = tmp_path / "views"
    with pytest.raises(type(problem)):
        render(model, job_of(), folder, on_frames=stop_after(2, problem))
    assert not folder.exists()
    (unfinished,) = tmp_path.glob(".views.unfinished-*")
    assert len(list(unfinished.rglob("v.tiff"))) == 2
    done = render(model, job_of(), folder)
    assert done == [2, 3, 4]  # existing frames are counted at once
    assert contents(folder) == in_one_go
    assert [path.name for path in tmp_path.iterdir()] == ["views"]


KILLED = """
import os, signal, sys, threading
from pathlib import Path
from nerfcli.output import Output
from nerfcli.render.frames import render_job
from test_render_job import foggy, job_of
model, job = foggy(), job_of(12)
render_job(model, job, Output(Path(sys.argv[1]) / "warm"))
threading.Timer(float(sys.argv[2]), os.kill, (os.getpid(), signal.SIGKILL)).start()
render_job(model, job, Output(Path(sys.argv[1]) / "views"))
threading.Event().wait()
"""


@pytest.mark.parametrize("kills", [3, pytest.param(40, marks=pytest.mark.slow)])
def test_a_job_that_is_killed_at_any_moment_ends_the_same(model, tmp_path, kills):
    """SIGKILL gives no time to clean up; the moments are random, in the frames and in what follows them."""
    moments = random.Random(kills)
    for _ in range(kills):
        # The pictures take about 0.2 s, previews and video another 0.2 s.
        words = [sys.executable, "-c", KILLED, tmp_path, str(moments.uniform(0.0, 0.5))]
        killed = subprocess.run(words, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
        assert killed.returncode == -signal.SIGKILL, killed.stderr
        if moments.random() < 0.3:
            shutil.rmtree(tmp_path / "views", ignore_errors=True)
    render(model, job_of(12), tmp_path / "views", overwrite=False)
    assert contents(tmp_path / "views") == contents(tmp_path / "warm")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["views", "warm"]


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_job_that_is_killed_while_it_replaces_a_folder_ends_the_same(model, tmp_path, in_one_go, monkeypatch, moved):
    """Before the older folder is moved aside, between, and when the new one has its place but nothing is removed."""
    folder = tmp_path / "views"
    render(model, job_of(2), folder)
    with subprocess.Popen([sys.executable, "-c", ""]) as dead:
        pass

    def killed(complete: Path, path: Path) -> None:
        for source, target in ((path, tmp_path / f".views.old-{atomic._host()}-{dead.pid}"), (complete, path))[:moved]:
            source.rename(target)
        raise SystemExit

    with monkeypatch.context() as patched:
        patched.setattr(rendering, "replace_folder", killed)
        with pytest.raises(SystemExit):
            render(model, job_of(), folder)
    render(model, job_of(), folder, overwrite=moved < 2)
    assert contents(folder) == in_one_go
    assert [path.name for path in tmp_path.iterdir()] == ["views"]


def test_another_job_takes_nothing_from_it_and_leaves_it(model, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        render(model, job_of(), tmp_path / "views", on_frames=stop_after(3, KeyboardInterrupt()))
    left = contents(tmp_path)
    done = render(model, job_of(convention="median"), tmp_path / "views")
    assert done == [1, 2, 3, 4]
    assert json.loads((tmp_path / "views/render.json").read_text())["settings"]["depth"]["convention"] == "median"
    assert left.items() <= contents(tmp_path).items()


def test_a_disk_that_cannot_be_replaced_is_refused_before_rendering(model, tmp_path, monkeypatch):
    """Regression: the pictures were collected beside it, on another disk, and could not be moved in the end."""
    disk, link = tmp_path / "disk", tmp_path / "views"
    disk.mkdir()
    link.symlink_to(disk)
    monkeypatch.setattr("os.path.ismount", lambda path: path == disk)
    for folder in (disk, link):
        with pytest.raises(UserError, match=f"{folder} is a mounted disk"):
            render(model, job_of(), folder, on_frames=stop_after(-1, AssertionError("a picture was rendered")))
    assert set(tmp_path.iterdir()) == {disk, link}


@pytest.mark.parametrize(("folder", "inside"), [(".", "renders"), ("/", "/renders")])
def test_a_folder_without_a_name_is_refused(model, tmp_path, monkeypatch, folder, inside):
    """Regression: `-o .` was a traceback."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=f"{Path(folder).resolve()} cannot be the output itself") as refused:
        render(model, job_of(), Path(folder))
    assert refused.value.hint == f"choose a folder in it: -o {inside}"


def test_videos_of_a_mounted_folder_are_written_into_it(model, tmp_path, monkeypatch):
    render(model, job_of(video=None), tmp_path / "views")
    monkeypatch.setattr("os.path.ismount", lambda path: path == tmp_path / "views")
    render(model, job_of(), tmp_path / "views")
    assert list((tmp_path / "views").glob("*.gif"))


def test_a_job_that_is_stopped_leaves_the_old_folder(model, tmp_path):
    render(model, job_of(2), tmp_path / "views")
    old = contents(tmp_path / "views")
    with pytest.raises(KeyboardInterrupt):
        render(model, job_of(3), tmp_path / "views", on_frames=stop_after(1, KeyboardInterrupt()))
    assert contents(tmp_path / "views") == old
    render(model, job_of(3), tmp_path / "views")
    assert len(list((tmp_path / "views").rglob("v.tiff"))) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["views"]


def test_parts_are_put_together_without_rendering(model, tmp_path, in_one_go):
    folder, notes = tmp_path / "views", []
    for part in (slice(3, 4), slice(0, 3, 2), slice(1, None)):
        render_job(model, job_of(), Output(folder), part=part, reporter=Reporter(note=notes.append))
        assert not folder.exists()
    assert [text.split(" frames are ")[0] for text in notes] == ["1 of 4", "3 of 4", "resuming: 2 of 3", "4 of 4"]
    done = render(model, job_of(), folder)
    assert done == [4]
    assert contents(folder) == in_one_go


def test_threads_leave_the_same_files(model, tmp_path, in_one_go):
    done = render(model, job_of(), tmp_path / "views", threads=3)
    assert done == [1, 2, 3, 4]
    assert contents(tmp_path / "views") == in_one_go
    assert torch.get_num_threads() == 3


def test_frames_in_progress_render_in_threads_of_their_own(model, tmp_path):
    """Two frames wait for each other in the middle of their rendering."""
    meeting = threading.Barrier(2, timeout=60)
    met = []

    def on_frames(done: float) -> None:
        met.append(threading.get_ident())

    def wait(*given: Any) -> None:
        meeting.wait()
        render_frame(*given)

    render_frame = rendering._render_frame
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering, "_render_frame", wait)
        render(model, job_of(2), tmp_path / "views", on_frames=on_frames, threads=2)
    assert len(set(met)) == 2
    assert threading.get_ident() not in met


def test_an_error_in_a_thread_ends_the_others_and_keeps_what_is_complete(model, tmp_path):
    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt):
        render(model, job_of(8), tmp_path / "views", on_frames=stop_after(3, KeyboardInterrupt()), threads=2)
    (unfinished,) = tmp_path.glob(".views.unfinished-*")
    assert 2 <= len(list((unfinished / "frames").rglob("*.json"))) <= 4
    assert not list(unfinished.rglob("*partial*"))
    assert threading.active_count() == before


# Videos and levels from existing pictures


@pytest.mark.parametrize(
    "changes",
    [{"video": replace(VIDEO, fps=30)}, {"video": None}, {"formats": ("tiff", "png16")}],
    ids=["video", "no video", "levels"],
)
def test_other_videos_and_levels_of_a_finished_folder_are_made_without_rendering(model, tmp_path, changes, rendered):
    """The files are the same as if this job had been rendered from the start."""
    changed = replace(job_of(), settings=replace(job_of().settings, **changes))
    render(model, changed, tmp_path / "other")
    shutil.copytree(rendered, tmp_path / "views")
    done = render(model, changed, tmp_path / "views")
    assert done == [4]  # all at once, as they exist
    assert contents(tmp_path / "views") == contents(tmp_path / "other")
    assert not list(tmp_path.glob(".views*"))


def test_videos_that_others_were_to_replace_are_made_again(model, tmp_path, rendered, monkeypatch):
    """Regression: after Ctrl-C, the command for those that had been there found the folder complete."""

    def interrupted(*given: Any, **options: Any) -> None:
        raise KeyboardInterrupt

    folder = shutil.copytree(rendered, tmp_path / "views")
    with monkeypatch.context() as patched:
        patched.setattr("nerfcli.render.presentation.write_video", interrupted)
        with pytest.raises(KeyboardInterrupt):
            render(model, job_of(video=VideoSettings(("mp4",))), folder)
    done = render(model, job_of(), folder, overwrite=False)
    assert done == [4]  # all at once, as they exist
    assert contents(folder) == contents(rendered)


def test_replacing_needs_overwrite_and_adding_does_not(model, tmp_path):
    folder = tmp_path / "views"
    render(model, job_of(video=None), folder, overwrite=False)
    before = contents(folder)
    render(model, job_of(), folder, overwrite=False)  # a video is added
    written = {name for name in contents(folder) if before.get(name) != contents(folder)[name]}
    assert written == {"rgb.gif", "depth.gif", "render.json"}
    before = contents(folder)
    render(model, job_of(), folder, overwrite=False, on_frames=stop_after(-1, AssertionError("a picture was rendered")))
    with pytest.raises(UserError, match="contains the same pictures with different videos") as caught:
        render(model, job_of(video=replace(VIDEO, fps=30)), folder, overwrite=False)
    assert "--overwrite" in caught.value.hint
    with pytest.raises(UserError, match="exists"):
        render(model, job_of(3), folder, overwrite=False)
    assert contents(folder) == before


def test_the_same_job_renders_again(model, tmp_path, rendered):
    """As --overwrite says."""
    shutil.copytree(rendered, tmp_path / "views")
    done = render(model, job_of(), tmp_path / "views")
    assert done == [1, 2, 3, 4]


def test_the_first_and_the_last_picture_are_measured_and_all_on_request(model, tmp_path, rendered):
    facts = json.loads((rendered / "render.json").read_text())["facts"]
    assert [name for name, of_frame in facts.items() if "pixels_measured" in of_frame] == ["f0/v", "f3/v"]
    assert all("truncation_of_colour_max" in of_frame for of_frame in facts.values())
    every = replace(job_of(video=None), settings=replace(job_of().settings, check_accuracy=True))
    render(model, every, tmp_path / "views")
    checked = json.loads((tmp_path / "views/render.json").read_text())["facts"]
    assert all("pixels_measured" in of_frame for of_frame in checked.values())
    assert (checked["f0/v"], checked["f3/v"]) == (facts["f0/v"], facts["f3/v"])


# Videos of a job


def test_a_video_says_what_it_shows(model, tmp_path):
    """Regression: of a run whose name is not UTF-8, the gif ended in an error of encoding after all pictures."""
    job = replace(job_of(2, video=replace(VIDEO, formats=("mp4", "gif"))), provenance={"run": "caf\udce9"})
    render(model, job, tmp_path / "views")
    description = json.loads((tmp_path / "views/render.json").read_text())
    for name in ("depth.mp4", "depth.gif"):
        reported = present(description_of(tmp_path / "views" / name))
        assert (reported["convention"], reported["axis"], reported["unit"]) == ("conditional", "z", "arbitrary")
        assert reported["ranges"] == {"depth": description["ranges"]["depth"]}
        assert reported["run"] == "caf\udce9"
        assert reported["nerfcli"] == description["nerfcli"]


def test_a_video_gets_the_pictures_of_its_output_in_order(model, tmp_path, monkeypatch):
    seen: dict[str, list[np.ndarray]] = {}

    def collect(path: Path, frames: Callable[[], Iterator[np.ndarray]], **options: Any) -> None:
        seen[path.name] = list(frames())
        path.write_bytes(b"")

    monkeypatch.setattr("nerfcli.render.presentation.write_video", collect)
    render(model, job_of(), tmp_path / "views")
    assert list(seen) == ["rgb.gif", "depth.gif"]
    for name, frames in seen.items():
        for index, frame in enumerate(frames):
            np.testing.assert_array_equal(frame, read_image(tmp_path / f"views/{name[:-4]}/f{index}/v.png"))
        assert len(frames) == 4


def test_what_cannot_become_a_video_is_refused_before_rendering(model, tmp_path, monkeypatch):
    rendered = stop_after(-1, AssertionError("a picture was rendered"))
    first, second = job_of(2).frames
    other = Frame("other.png", Camera.pinhole(12, 8, 8.0), second.world_from_cam)
    mixed = RenderJob((first, other), job_of().settings, {})
    with pytest.raises(UserError, match="the views have 2 different sizes \\(10x8, 12x8\\), which cannot be combined"):
        render(model, mixed, tmp_path / "views", on_frames=rendered)
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho ' V....D libx264 H.264'\n")
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    with pytest.raises(UserError, match="cannot write gif videos"):
        render(model, job_of(video=VideoSettings(formats=("gif",))), tmp_path / "views", on_frames=rendered)
    assert list(tmp_path.iterdir()) == [program]
