"""Exports that end early resume with the missing frames; parts and threads leave the same files as a single run."""

import hashlib
import json
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fog import fog, foggy_cells

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.errors import UserError
from nerfcli.photos.images import read_image
from nerfcli.render.depth import DepthRequest
from nerfcli.render.files.file_facts import description_of
from nerfcli.render.frames import export_frames, export_part
from nerfcli.render.job import RenderJob
from nerfcli.render.model import Model
from nerfcli.render.one_frame import render_frame
from nerfcli.render.outputs import ExportSettings, VideoSettings

PIXELS = 10 * 8
# A gif, since the other encoders do not promise the same bytes for the same frames.
VIDEO = VideoSettings(("gif",), fps=12)


@pytest.fixture(scope="module")
def model() -> Model:
    cells = foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    return fog(cells, Similarity.identity(), background=(0.2, 0.4, 0.6), step=1 / 32)


def order(count: int = 4, *, convention: str = "conditional", video: VideoSettings | None = VIDEO) -> RenderJob:
    poses = [
        look_at(np.array([0.1 * index, 0.0, -2.0]), np.zeros(3), np.array([0.0, -1.0, 0.0])) for index in range(count)
    ]
    frames = tuple(Frame(f"f{index}/v.png", Camera.pinhole(10, 8, 8.0), pose) for index, pose in enumerate(poses))
    depth = DepthRequest(convention, "z", min_opacity=0.1)
    return RenderJob(frames, ExportSettings(outputs=("rgb", "depth"), depth=depth, video=video), {"run": "a run"})


def export(
    model: Model, ordered: RenderJob, folder: Path, *, on_rays: Callable[[int], None] = lambda rays: None
) -> None:
    export_frames(model, ordered, folder, on_rays=on_rays, notify=lambda text: None)


def stop_in_frame(number: int, problem: BaseException) -> Callable[[int], None]:
    """Return an `on_rays` that raises once frame `number` (from 0) is rendered; each of these frames is one tile."""
    calls = iter(range(1000))

    def on_rays(rays: int) -> None:
        if next(calls) == number:
            raise problem

    return on_rays


def contents(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(scope="module")
def rendered(model, tmp_path_factory) -> Path:
    """The folder of an export in one go. Do not write into it."""
    folder = tmp_path_factory.mktemp("in one go") / "views"
    export(model, order(), folder)
    return folder


@pytest.fixture(scope="module")
def in_one_go(rendered) -> dict[str, str]:
    return contents(rendered)


@pytest.mark.parametrize(
    "problem", [KeyboardInterrupt(), UserError("cannot write: No space left on device", "free space")]
)
def test_an_export_that_ends_early_goes_on_and_ends_the_same(model, tmp_path, in_one_go, problem):
    folder = tmp_path / "views"
    with pytest.raises(type(problem)):
        export(model, order(), folder, on_rays=stop_in_frame(2, problem))
    assert not folder.exists()
    (unfinished,) = tmp_path.glob(".views.unfinished-*")
    assert len(list(unfinished.rglob("v.tiff"))) == 2
    done: list[int] = []
    export(model, order(), folder, on_rays=done.append)
    assert done == [2 * PIXELS, PIXELS, PIXELS]  # existing frames are counted at once
    assert contents(folder) == in_one_go
    assert not list(tmp_path.glob(".views*"))


def lose(path: Path) -> None:
    path.unlink()


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize("file", ["rgb/f1/v.png", "depth/f1/v.tiff", ".frames/done/f1/v.json"])
@pytest.mark.parametrize("damage", [lose, halve])
def test_a_frame_that_is_not_whole_is_rendered_again(model, tmp_path, in_one_go, file, damage):
    if (file.endswith("json"), damage) == (True, halve):
        return  # notes are written in one step
    folder = tmp_path / "views"
    with pytest.raises(KeyboardInterrupt):
        export(model, order(), folder, on_rays=stop_in_frame(3, KeyboardInterrupt()))
    (unfinished,) = tmp_path.glob(".views.unfinished-*")
    damage(unfinished / file)
    (unfinished / "rgb" / "f1" / ".v.partial-1.png").write_bytes(b"of a command that was killed")
    done: list[int] = []
    export(model, order(), folder, on_rays=done.append)
    assert done == [2 * PIXELS, PIXELS, PIXELS]
    assert contents(folder) == in_one_go


def test_another_order_takes_nothing_from_it_and_leaves_it(model, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        export(model, order(), tmp_path / "views", on_rays=stop_in_frame(3, KeyboardInterrupt()))
    left = contents(tmp_path)
    done: list[int] = []
    export(model, order(convention="median"), tmp_path / "views", on_rays=done.append)
    assert done == [PIXELS] * 4
    assert json.loads((tmp_path / "views/render.json").read_text())["settings"]["depth"]["convention"] == "median"
    assert left.items() <= contents(tmp_path).items()


def test_other_videos_of_the_same_pictures_take_them(model, tmp_path):
    """Finished pictures are reused although the requested videos differ."""
    with pytest.raises(KeyboardInterrupt):
        export(model, order(), tmp_path / "views", on_rays=stop_in_frame(3, KeyboardInterrupt()))
    done: list[int] = []
    export(model, order(video=None), tmp_path / "views", on_rays=done.append)
    assert done == [3 * PIXELS, PIXELS]
    assert not list(tmp_path.rglob("*.gif"))


def test_an_export_that_is_stopped_leaves_the_old_one(model, tmp_path):
    export(model, order(2), tmp_path / "views")
    old = contents(tmp_path / "views")
    with pytest.raises(KeyboardInterrupt):
        export(model, order(3), tmp_path / "views", on_rays=stop_in_frame(1, KeyboardInterrupt()))
    assert contents(tmp_path / "views") == old
    export(model, order(3), tmp_path / "views")
    assert len(list((tmp_path / "views").rglob("v.tiff"))) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["views"]


def test_parts_are_put_together_without_rendering(model, tmp_path, in_one_go):
    folder, reported = tmp_path / "views", []
    for part in (range(3, 4), range(0, 3, 2), range(1, 4)):
        export_part(model, order(), folder, part, on_rays=lambda rays: None, notify=reported.append)
        assert not folder.exists()
    assert [text.split(" frames are ")[0] for text in reported] == ["1 of 4", "3 of 4", "resuming: 2 of 3", "4 of 4"]
    done: list[int] = []
    export(model, order(), folder, on_rays=done.append)
    assert done == [4 * PIXELS]
    assert contents(folder) == in_one_go


def test_threads_leave_the_same_files(model, tmp_path, in_one_go):
    done: list[int] = []
    before = torch.get_num_threads()
    export_frames(*(model, order(), tmp_path / "views"), on_rays=done.append, notify=lambda text: None, threads=3)
    assert done == [PIXELS] * 4
    assert contents(tmp_path / "views") == in_one_go
    assert torch.get_num_threads() == before


def test_frames_in_progress_render_in_threads_of_their_own(model, tmp_path):
    """Two frames wait for each other in the middle of their rendering."""
    meeting = threading.Barrier(2, timeout=60)
    met = []

    def on_rays(rays: int) -> None:
        met.append(threading.get_ident())

    def render(*given: Any, **options: Any) -> None:
        meeting.wait()
        render_frame(*given, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nerfcli.render.frames.render_frame", render)
        export_frames(*(model, order(2), tmp_path / "views"), on_rays=on_rays, notify=lambda text: None, threads=2)
    assert len(set(met)) == 2
    assert threading.get_ident() not in met


def test_an_error_in_a_thread_ends_the_others_and_keeps_what_is_complete(model, tmp_path):
    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt):
        export_frames(
            *(model, order(8), tmp_path / "views"),
            on_rays=stop_in_frame(3, KeyboardInterrupt()),
            notify=lambda text: None,
            threads=2,
        )
    (unfinished,) = tmp_path.glob(".views.unfinished-*")
    assert 2 <= len(list(unfinished.rglob("done/**/*.json"))) <= 4
    assert not list(unfinished.rglob("*partial*"))
    assert threading.active_count() == before


def test_threads_stop_before_the_main_thread_hears_of_an_error(model, tmp_path, monkeypatch):
    """The main thread may wake late on a busy machine; the other thread must not render on until it does."""

    def late(futures: list[Future[None]]) -> Iterator[Future[None]]:
        for future in as_completed(futures):
            time.sleep(1.0)
            yield future

    monkeypatch.setattr("nerfcli.render.frames.as_completed", late)
    with pytest.raises(KeyboardInterrupt):
        export_frames(
            *(model, order(8), tmp_path / "views"),
            on_rays=stop_in_frame(1, KeyboardInterrupt()),
            notify=lambda text: None,
            threads=2,
        )
    (unfinished,) = tmp_path.glob(".views.unfinished-*")
    assert len(list(unfinished.rglob("done/**/*.json"))) <= 3


# Videos and levels from existing pictures


@pytest.mark.parametrize(
    "changes",
    [
        {"video": replace(VIDEO, fps=30)},
        {"formats": ("tiff", "png16")},
    ],
    ids=["video", "levels"],
)
def test_other_videos_and_levels_of_a_finished_folder_are_made_without_rendering(model, tmp_path, changes, rendered):
    """The files are the same as if this order had been rendered from the start."""
    changed = replace(order(), settings=replace(order().settings, **changes))
    export(model, changed, tmp_path / "other")
    shutil.copytree(rendered, tmp_path / "views")
    done: list[int] = []
    export(model, changed, tmp_path / "views", on_rays=done.append)
    assert done == [4 * PIXELS]  # all at once, as they exist
    assert contents(tmp_path / "views") == contents(tmp_path / "other")
    assert not list(tmp_path.glob(".views*"))


def test_replacing_needs_overwrite_and_adding_does_not(model, tmp_path):
    folder = tmp_path / "views"
    export(model, order(video=None), folder)
    assert not order().is_held_by(folder)  # a video is added
    assert order(video=None).is_held_by(folder)
    export(model, order(), folder)
    assert order().is_held_by(folder)
    with pytest.raises(UserError, match="contains the same pictures with different videos") as caught:
        order(video=replace(VIDEO, fps=30)).is_held_by(folder)
    assert "--overwrite" in caught.value.hint


def test_a_picture_that_is_damaged_is_rendered_again(model, tmp_path, in_one_go):
    export(model, order(video=None), tmp_path / "views")
    halve(tmp_path / "views/rgb/f1/v.png")
    done: list[int] = []
    export(model, order(), tmp_path / "views", on_rays=done.append)
    assert done == [3 * PIXELS, PIXELS]
    assert contents(tmp_path / "views") == in_one_go


def test_the_same_order_renders_again(model, tmp_path, rendered):
    """As --overwrite says."""
    shutil.copytree(rendered, tmp_path / "views")
    done: list[int] = []
    export(model, order(), tmp_path / "views", on_rays=done.append)
    assert done == [PIXELS] * 4


# Videos of an export


def test_a_video_says_what_it_shows(model, tmp_path):
    export(model, order(video=replace(VIDEO, formats=("mp4", "gif"))), tmp_path / "views")
    description = json.loads((tmp_path / "views/render.json").read_text())
    for name in ("depth.mp4", "depth.gif"):
        reported = description_of(tmp_path / "views" / name)
        assert reported is not None
        assert (reported["convention"], reported["axis"], reported["unit"]) == ("conditional", "z", "arbitrary")
        assert reported["ranges"] == {"depth": description["ranges"]["depth"]}
        assert reported["run"] == "a run"
        assert reported["nerfcli"] == description["nerfcli"]


def test_a_video_gets_the_pictures_of_its_output_in_order(model, tmp_path, monkeypatch):
    seen: dict[str, list[np.ndarray]] = {}

    def collect(path: Path, frames: Callable[[], Iterator[np.ndarray]], **options: Any) -> None:
        seen[path.name] = list(frames())
        path.write_bytes(b"")

    monkeypatch.setattr("nerfcli.render.presentation.write_video", collect)
    export(model, order(), tmp_path / "views")
    assert list(seen) == ["rgb.gif", "depth.gif"]
    for name, frames in seen.items():
        for index, frame in enumerate(frames):
            np.testing.assert_array_equal(frame, read_image(tmp_path / f"views/{name[:-4]}/f{index}/v.png"))
        assert len(frames) == 4


def test_what_cannot_become_a_video_is_refused_before_rendering(model, tmp_path, monkeypatch):
    def rendered(rays: int) -> None:
        raise AssertionError("a picture was rendered")

    first, second = order(2).frames
    other = Frame("other.png", Camera.pinhole(12, 8, 8.0), second.world_from_cam)
    mixed = RenderJob((first, other), order().settings, {})
    with pytest.raises(UserError, match="the views have 2 different sizes \\(10x8, 12x8\\), which cannot be combined"):
        export(model, mixed, tmp_path / "views", on_rays=rendered)
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho ' V....D libx264 H.264'\n")
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    with pytest.raises(UserError, match="cannot write gif videos"):
        export(model, order(video=VideoSettings(formats=("gif",))), tmp_path / "views", on_rays=rendered)
    assert list(tmp_path.iterdir()) == [program]
