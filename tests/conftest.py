"""Shared fixtures, the trained run that several test files use, and the table of tolerances."""

import gc
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

# Threads of two test processes on two cores must not spin while they wait. Must be set before torch is imported.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
# Those of OpenBLAS spin in any case: a turntable is drawn in 1.2 s of CPU with one thread, in 2.4 to 3.9 s with two.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
import torch
from examples import MANY
from filelock import FileLock
from fog import CUBE, fog
from hypothesis import settings

from nerfcli.atomic import write_json
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.run_cameras import write_cameras
from nerfcli.captures.loading import load_scene
from nerfcli.render.model import Model, save_model
from nerfcli.training import checkpoints, preparation
from nerfcli.training.extent import Extent, choose_extent, object_frame
from nerfcli.training.loop import train
from nerfcli.training.runs.files import CONFIG, FIELD, append_log
from nerfcli.training.runs.run import RunConfig
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.workflows import photo_depths

# Relative tolerance of a chain of about a dozen operations, per dtype. A test with a looser one states its reason.
TOLERANCE = {torch.float64: 1e-12, torch.float32: 5e-6}

# Five balls and a box with known geometry: 21 views to train on, 3 held out, 96 x 72 RGBA.
SPHERES = Path(__file__).parent.parent / "sample_scenes" / "spheres"


# No deadlines: machines may be slow, and the first example of a test may import or compile something.
settings.register_profile("quick", deadline=None)
# The profile of `make test-slow`: this many examples of every property. See `examples.py`.
settings.register_profile("thorough", deadline=None, max_examples=MANY)
settings.load_profile("quick")


def pytest_collection_finish() -> None:
    """Spare the garbage collector what stays until the end: the modules and 4,600 collected tests."""
    gc.collect()
    gc.freeze()


def pytest_unconfigure() -> None:
    """Leave to the system what is left at the end."""
    gc.freeze()


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(autouse=True)
def _two_threads():
    """Use two threads: small tensors do not benefit from more, and results must not depend on the number."""
    torch.set_num_threads(2)


@pytest.fixture(scope="session", autouse=True)
def _few_held_out_pixels() -> Iterator[None]:
    """Use 512 held-out pixels: most tests train only to fog, where the default 4096 would take longer than training."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(checkpoints, "WAYPOINT_PIXELS", 512)
        yield


@pytest.fixture(scope="session")
def spheres() -> Capture:
    return load_scene(SPHERES)


@pytest.fixture(scope="session")
def spheres_run(spheres: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train on the spheres, briefly but for real, once for all pytest-xdist processes. Do not write into this run."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    run = shared / "trained" / "spheres-run"
    run.parent.mkdir(exist_ok=True)
    # 22 dB, and 0.06 between median and true depth; 250 steps with the default rows, and 8192 samples, take 10 CPU s.
    training = TrainSettings(budget_seconds=None, steps=200, log2_rows=14, samples_per_step=2**12, threads=2)
    with FileLock(run.parent / "lock"):
        if not run.exists():
            with pytest.MonkeyPatch.context() as patched:
                patched.setattr(checkpoints, "WAYPOINT_PIXELS", 1024)
                train(spheres, run, training, resume=False, notify=lambda text: None, on_progress=lambda progress: None)
    return run


@pytest.fixture
def small_photo_depths(monkeypatch: pytest.MonkeyPatch) -> None:
    """Render depth maps of training photos with 48 x 36 pixels: those of the spheres take a quarter of the time."""
    monkeypatch.setattr(photo_depths, "MAX_SIZE", 48)


@pytest.fixture
def coarse_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut rays into an eighth of the steps: after a step of training all space is fog, and pictures take seconds."""

    def choose(captured: Capture, settings: TrainSettings, *, is_object: bool) -> Extent:
        extent = choose_extent(captured, settings, is_object=is_object)
        return replace(extent, marching=extent.marching.stretched(8.0))

    monkeypatch.setattr(preparation, "choose_extent", choose)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A scene of a few views, in a path with a space and non-ASCII letters."""
    folder = tmp_path / "Küche 2" / "spheres"
    for split, names in (("train", range(4)), ("test", range(1))):
        (folder / split).mkdir(parents=True)
        listed = json.loads((SPHERES / f"transforms_{split}.json").read_text())
        listed["frames"] = listed["frames"][: len(names)]
        (folder / f"transforms_{split}.json").write_text(json.dumps(listed))
        for index in names:
            shutil.copy(SPHERES / split / f"r_{index:03d}.png", folder / split)
    return folder


@pytest.fixture
def finished(capture: Path) -> Path:
    """A run of `capture` whose field is fog; nothing was trained."""
    run = capture.with_name("spheres-run")
    loaded = load_scene(capture)
    similarity, _ = object_frame(loaded)
    write_run(run, loaded, fog(CUBE, similarity, background=(1.0, 1.0, 1.0), step=1 / 32), factor=8)
    return run


def write_run(run: Path, captured: Capture, model: Model, *, factor: int) -> None:
    """Write the folder that a training of seven steps at 1 / factor of the resolution leaves, with the given model."""
    settings = TrainSettings(budget_seconds=None, steps=7, downscale=factor, contraction="none")
    run.mkdir()
    write_json(run / CONFIG, replace(RunConfig.describing(captured), settings=settings).to_json())
    write_cameras(run, captured.train_frames, captured.test_frames)
    save_model(run / FIELD, model)
    speeds: Any = {"samples_per_second": 50, "rays_per_second": 5, "rollbacks": 0, "peak_memory_bytes": 9}
    append_log(run, {"step": 7, "seconds": 2.0, "samples": 100, "rays": 10, "loss": 0.1, **speeds})
