"""Estimate memory, disk space and time of a training before it starts, for users and for cluster schedulers."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from nerfcli.captures.loading import load_scene, refuse_without_training_photos
from nerfcli.training.runs.settings import TrainSettings, automatic_downscale
from nerfcli.training.storage import InFiles, field_bytes, needs_of, storage_for


@dataclass(frozen=True)
class TrainingPlan:
    """Cost of a training.

    Args:
        train_photos, held_out_photos: numbers of photos.
        downscale: factor by which photos are reduced.
        pixels: number of pixels of the reduced training photos.
        memory_bytes: peak memory of the process.
        disk_bytes: largest size of the run folder, including photos that do not fit into memory.
        seconds: the budget, which includes the automatic selection but not the reading of photos; None without one.
        steps: limit on the number of steps; None without one.
    """

    train_photos: int
    held_out_photos: int
    downscale: int
    pixels: int
    memory_bytes: int
    disk_bytes: int
    seconds: float | None
    steps: int | None

    def describe(self) -> str:
        """Return one sentence."""
        length = f"{self.steps} steps" if self.seconds is None else f"{self.seconds:.0f} s"
        return (
            f"{self.train_photos} training photos and {self.held_out_photos} held out, {self.pixels / 1e6:.1f} million "
            f"pixels (photos reduced by {self.downscale}): {length}, about {self.memory_bytes / 1e9:.2f} GB of memory, "
            f"{self.disk_bytes / 1e9:.2f} GB on disk"
        )


def plan_training(
    scene: str | Path, settings: TrainSettings, *, memory_bytes: int | None = None, holdout: str | None = None
) -> TrainingPlan:
    """Estimate the cost of `train_scene` without opening photos or writing anything.

    Example:
        >>> from nerfcli.training.runs.settings import TrainSettings
        >>> from nerfcli.workflows.train_plan import plan_training
        >>> plan_training("photos-scene", TrainSettings(budget_seconds=300)).memory_bytes

    Args:
        scene, settings, memory_bytes, holdout: as for `train_scene`.

    Raises:
        UserError: the scene cannot be read, has no training photo, or does not fit into memory.
    """
    loaded = load_scene(Path(scene), holdout=holdout)
    refuse_without_training_photos(loaded)
    first = loaded.train_frames[0].camera
    factor = settings.downscale or automatic_downscale(first)
    needs = needs_of((*loaded.train_frames, *loaded.test_frames), factor, settings=settings)
    storage, _ = storage_for(needs, memory_bytes, folder=Path(tempfile.gettempdir()))
    in_files = needs.photos if isinstance(storage, InFiles) else 0
    total = needs.photos + needs.rest
    return TrainingPlan(
        train_photos=len(loaded.train_frames),
        held_out_photos=len(loaded.test_frames),
        downscale=factor,
        pixels=sum((f.camera.width // factor) * (f.camera.height // factor) for f in loaded.train_frames),
        memory_bytes=min(total, memory_bytes) if memory_bytes else total,
        # The field, the state with both moments of the optimiser, and the previous state until the next is written.
        disk_bytes=(1 + 3 + 3) * field_bytes(settings) + in_files,
        seconds=settings.budget_seconds,
        steps=settings.steps,
    )
