"""A run: the folder that training wrote, and access to its files."""

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Any

from nerfcli.atomic import read_json
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.run_cameras import CAMERAS, RunCameras, read_cameras, read_given_cameras
from nerfcli.captures.loading import fingerprint
from nerfcli.errors import UserError
from nerfcli.field.checkpoint import load_tensors
from nerfcli.render.model import Model, load_model
from nerfcli.training.runs.components import Components, Decision
from nerfcli.training.runs.config import RunConfig, no_run, read_config, split_hash
from nerfcli.training.runs.files import CONFIG, FIELD, METRICS, STATE
from nerfcli.training.runs.log import LogEntry, TrainingSummary, read_log
from nerfcli.training.runs.settings import TrainSettings


class Run:
    """A run folder; each file is read on first use.

    Args:
        path: the folder; it is not read yet.

    Every property raises a UserError if its file is missing or damaged.
    """

    def __init__(self, path: Path):
        self.path = path

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    @cached_property
    def config(self) -> RunConfig:
        """RUN/config.json."""
        return read_config(self.path)

    @cached_property
    def cameras(self) -> RunCameras:
        """Training and held-out frames, with the cameras that the field was trained with."""
        return read_cameras(self.path)

    @cached_property
    def given_cameras(self) -> RunCameras:
        """The same frames as the scene had them, before training refined their cameras."""
        return read_given_cameras(self.path)

    @cached_property
    def log(self) -> list[LogEntry]:
        """RUN/log.jsonl, up to the first incomplete line; empty if there is none."""
        return read_log(self.path)

    @property
    def summary(self) -> TrainingSummary | None:
        """Summary of the training; None without a log."""
        return TrainingSummary.of(self.log) if self.log else None

    @property
    def components(self) -> Components:
        """The components of the model."""
        return self.config.components

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """Decisions of the automatic selection; empty without one."""
        return () if self.config.selection is None else self.config.selection.decisions

    @property
    def field_path(self) -> Path:
        """RUN/field.safetensors."""
        return self.path / FIELD

    @property
    def is_trained(self) -> bool:
        """Whether the run has a field."""
        return self.field_path.exists()

    @property
    def metrics_path(self) -> Path:
        """RUN/metrics.json."""
        return self.path / METRICS

    def model(self, device: str = "cpu") -> Model:
        """Load the field with everything that rendering needs; each call loads it again.

        Raises:
            UserError: it is missing or damaged.
        """
        if not self.is_trained and not (self.path / CONFIG).exists():
            raise no_run(self.path)
        return load_model(self.field_path, device)

    def checkpoint_sha256(self) -> str:
        """Return the hash of the field's file, which identifies the field in metrics, renders and pages.

        Raises:
            UserError: the file cannot be read.
        """
        try:
            return hashlib.sha256(self.field_path.read_bytes()).hexdigest()
        except OSError as error:
            hint = "train first (nerfcli train SCENE), or give another run"
            raise UserError(f"{self.field_path} cannot be read: {error.strerror}", hint) from error

    def metrics(self) -> dict[str, Any] | None:
        """Return the metrics written by `evaluate`; None if there are none.

        Raises:
            UserError: the file is damaged.
        """
        if not self.metrics_path.exists():
            return None
        hint = "evaluate again: nerfcli evaluate RUN --overwrite"
        return read_json(self.metrics_path, needed=("mean",), hint=hint)

    def check_split(self) -> None:
        """Check that the held-out photos of the cameras are those that were held out of the training.

        Raises:
            UserError: they differ.
        """
        if self.config.split_sha256 != split_hash(frame.name for frame in self.cameras.test):
            raise UserError(
                f"the held-out photos in {self.path / CAMERAS} differ from those recorded in {CONFIG} (split_sha256)",
                "photos used for training cannot be used for evaluation: train again with --overwrite",
            )

    def is_trained_from(self, scene: Capture, settings: TrainSettings) -> bool:
        """Return whether the run was trained from this scene with these settings.

        Threads and device do not matter; an automatic downscale, contraction or number of rows matches any value.
        """
        wanted = {key: value for key, value in settings.to_json().items() if key not in ("device", "threads")}
        for name in ("downscale", "contraction", "log2_rows"):
            if wanted[name] is None:
                del wanted[name]
        trained = self.config.settings.to_json()
        return self.config.scene_fingerprint == fingerprint(scene) and all(
            trained[key] == value for key, value in wanted.items()
        )

    def is_complete(self, settings: TrainSettings) -> bool:
        """Return whether training reached the budget, by its last checkpoint.

        The log of a killed training may be ahead of the checkpoint.
        """
        if not self.is_trained:
            return False
        if (self.path / STATE).exists():
            step, seconds = self.saved_progress()
        elif log := self.log:  # the state was deleted to save space
            step, seconds = log[-1]["step"], log[-1]["seconds"]
        else:
            return False
        by_time = settings.budget_seconds is not None and seconds >= settings.budget_seconds
        by_steps = settings.steps is not None and step >= settings.steps
        return by_time or by_steps

    def saved_progress(self) -> tuple[int, float]:
        """Return the steps and training seconds of the last checkpoint.

        Raises:
            UserError: it cannot be read.
        """
        _, description = load_tensors(self.path / STATE, "cpu")
        return description["step"], description["totals"]["seconds"]


def load_run(path: str | Path) -> Run:
    """Open a run folder.

    Example:
        >>> import nerfcli
        >>> run = nerfcli.load_run("photos-scene-run")
        >>> run.config.settings.seed, run.summary.seconds, run.components.background
        >>> model = run.model()

    Args:
        path: the folder that `train_scene` or `nerfcli train` wrote.

    Returns:
        The run; its configuration and cameras have been read, the field is loaded by `Run.model`.

    Raises:
        UserError: the folder is not a run, or is damaged.
    """
    run = Run(Path(path))
    _ = run.config, run.cameras
    return run
