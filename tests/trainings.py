"""Short trainings in this process, and what they leave."""

from contextlib import nullcontext
from pathlib import Path

import pytest
from torch import Tensor

from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.run_cameras import read_cameras
from nerfcli.evaluate.photos import HeldOutPhoto
from nerfcli.field.checkpoint import load_tensors
from nerfcli.photos.loading import load_photos
from nerfcli.training.fitting import TrainingInputs
from nerfcli.training.loop import Progress, train
from nerfcli.training.preparation import prepare
from nerfcli.training.runs.files import FIELD, STATE
from nerfcli.training.runs.settings import TrainSettings

# A step of a few rays is enough where bits are compared, not pictures.
FEW = TrainSettings(
    budget_seconds=None, steps=12, first_samples_per_step=2**9, samples_per_step=2**9, log2_rows=10, threads=2
)


def fit(
    scene: Capture,
    run: Path,
    settings: TrainSettings,
    *,
    resume: bool = False,
    stop_at: int | None = None,
    notes: list[str] | None = None,
) -> list[Progress]:
    """Train, and return the progress of every step.

    Args:
        stop_at: the step after which the training ends by Ctrl-C.
        notes: receives the messages for the user.
    """
    steps: list[Progress] = []

    def record(progress: Progress) -> None:
        steps.append(progress)
        if progress.step == stop_at:
            raise KeyboardInterrupt

    with nullcontext() if stop_at is None else pytest.raises(KeyboardInterrupt):
        train(scene, run, settings, resume=resume, notify=([] if notes is None else notes).append, on_progress=record)
    return steps


def resumed_bit_for_bit(scene: Capture, folder: Path, settings: TrainSettings, *, stop_at: int) -> dict[str, Tensor]:
    """Train without and with an interrupt, which must make no difference; return the state.

    The run `parts` in the folder is the one that was interrupted.
    """
    straight = fit(scene, folder / "straight", settings)
    fit(scene, folder / "parts", settings, stop_at=stop_at)
    second = fit(scene, folder / "parts", settings, resume=True)
    assert [progress.loss for progress in second] == [progress.loss for progress in straight[stop_at:]]
    for file in (FIELD, STATE):
        assert weights(folder / "parts", file) == weights(folder / "straight", file)
    cameras = [
        [(frame.camera, frame.world_from_cam.tolist()) for frame in read_cameras(folder / name).train]
        for name in ("straight", "parts")
    ]
    assert cameras[0] == cameras[1]
    return load_tensors(folder / "parts" / STATE, "cpu")[0]


def prepared(scene: Capture, folder: Path, settings: TrainSettings) -> tuple[TrainingInputs, list[str]]:
    """Return what a training begins from, and the messages for the user."""
    notes: list[str] = []
    return prepare(scene, settings, run=folder, notify=notes.append), notes


def held_out_photos(scene: Capture) -> list[HeldOutPhoto]:
    """Return the held-out photos of a scene as they are, without gains."""
    photos = load_photos(scene.test_frames, factor=1, threads=1)
    return [HeldOutPhoto(photo.frame, photo.pixels, photo.used) for photo in photos]


def weights(run: Path, file: str = FIELD) -> dict[str, bytes]:
    """Return every tensor of a run's field, or of another file, as bytes."""
    tensors, _ = load_tensors(run / file, "cpu")
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}
