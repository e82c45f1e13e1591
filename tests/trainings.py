"""Short trainings in this process, and what they leave."""

from pathlib import Path

from nerfcli.captures.capture import Capture
from nerfcli.field.checkpoint import load_tensors
from nerfcli.training.loop import Progress, train
from nerfcli.training.runs.settings import TrainSettings


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
        stop_at: the step after which the training ends as by Ctrl-C.
        notes: receives the messages for the user.
    """
    steps: list[Progress] = []

    def record(progress: Progress) -> None:
        steps.append(progress)
        if progress.step == stop_at:
            raise KeyboardInterrupt

    train(scene, run, settings, resume=resume, notify=([] if notes is None else notes).append, on_progress=record)
    return steps


def weights(run: Path) -> dict[str, bytes]:
    """Return every tensor of a run's field, as bytes."""
    tensors, _ = load_tensors(run / "field.safetensors", "cpu")
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}
