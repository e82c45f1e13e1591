"""A run: the folder that training wrote, RUN/config.json in it, and access to its files."""

import hashlib
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from nerfcli import __version__
from nerfcli.atomic import read_json, read_sealed, write_sealed
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.registry import photo_folder, recognised
from nerfcli.captures.formats.run_cameras import CAMERAS, REPAIR_HINT, RunCameras, read_cameras, read_given_cameras
from nerfcli.captures.loading import fingerprint
from nerfcli.captures.orientation import describe_rescaling
from nerfcli.errors import UserError, in_shell
from nerfcli.field.checkpoint import load_tensors
from nerfcli.photos.images import read_image
from nerfcli.photos.loading import LoadedPhoto, load_photos
from nerfcli.render.model import Model, load_model
from nerfcli.training.runs.components import Components, Decision, Selection, differences
from nerfcli.training.runs.files import (
    CONFIG,
    FIELD,
    METRICS,
    STATE,
    LogEntry,
    TrainingSummary,
    left_out_mask,
    read_log,
)
from nerfcli.training.runs.settings import TrainSettings


@dataclass(frozen=True)
class RunConfig:
    """Source and settings of a run.

    Args:
        scene: the folder of the scene, absolute or relative to the working directory of the training.
        scene_kind: the format of the scene, see `Capture`.
        unit, unit_source: unit of length, see `Capture`.
        scene_fingerprint: see `captures.loading.fingerprint`.
        split_sha256: see `split_hash`.
        holdout: the rule that chose the held-out photos; None where the scene defines them.
        history: how cameras and points were found, see `Capture`.
        missing_photos: photos that the scene lists but that were not on disk.
        warnings: warnings about the scene.
        settings: as requested, with the downscale and contraction that were chosen.
        selection: automatic selection of the components, if there was one; without its exposures.
        versions: versions of nerfcli, Python, torch and NumPy.
    """

    scene: Path = Path()
    scene_kind: str | None = None
    unit: str | None = None
    unit_source: str | None = None
    scene_fingerprint: str | None = None
    split_sha256: str | None = None
    holdout: str | None = None
    history: Mapping[str, Any] = field(default_factory=dict)
    missing_photos: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    settings: TrainSettings = field(default_factory=TrainSettings)
    selection: Selection | None = None
    versions: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def describing(cls, scene: Capture) -> "RunConfig":
        """Describe a training of a scene that begins now; its settings and selection are still to be filled in."""
        return cls(
            scene=scene.root,
            scene_kind=scene.kind,
            unit=scene.unit,
            unit_source=scene.unit_source,
            scene_fingerprint=fingerprint(scene),
            split_sha256=split_hash(scene.test_names),
            holdout=scene.holdout,
            history=dict(scene.provenance),
            missing_photos=tuple(scene.missing),
            warnings=tuple(describe_rescaling(scene.rescaled)),
            versions={
                "nerfcli": __version__,
                "python": platform.python_version(),
                **{name: version(name) for name in ("torch", "numpy")},
            },
        )

    @property
    def components(self) -> Components:
        """Components of the model: those selected automatically, or as requested."""
        return self.settings.components if self.selection is None else self.selection.components

    @property
    def downscale(self) -> int:
        """Side in pixels of the squares over which photos were averaged."""
        return self.settings.downscale or 1

    def to_json(self) -> dict[str, Any]:
        """Return the content of the file."""
        return {
            **{entry.name: getattr(self, entry.name) for entry in fields(self)},
            "scene": str(self.scene),
            "missing_photos": list(self.missing_photos),
            "warnings": list(self.warnings),
            "settings": self.settings.to_json(),
            "selection": None if self.selection is None else self.selection.to_json(),
            "versions": dict(self.versions),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "RunConfig":
        """Read the content that `to_json` returned.

        Raises:
            KeyError, TypeError, ValueError, AttributeError: the content is invalid.
        """
        selection = content["selection"]
        entries: dict[str, Any] = {
            **content,
            "scene": Path(content["scene"]),
            "missing_photos": tuple(content["missing_photos"]),
            "warnings": tuple(content["warnings"]),
            "settings": TrainSettings.from_json(content["settings"]),
            "selection": None if selection is None else Selection.from_json(selection),
        }
        return cls(**entries)


def write_config(run: Path, config: RunConfig) -> None:
    """Write RUN/config.json."""
    write_sealed(run / CONFIG, config.to_json())


def read_config(run: Path) -> RunConfig:
    """Read RUN/config.json.

    Raises:
        UserError: it is missing or damaged.
    """
    try:
        return RunConfig.from_json(read_sealed(run / CONFIG))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise no_run(run) from error
    except UserError as error:
        raise UserError(f"{run / CONFIG} cannot be read: {error.message}", REPAIR_HINT) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run / CONFIG} cannot be read: {error}", REPAIR_HINT) from error


def no_run(path: Path) -> UserError:
    """Return the error for a path that is not a run folder."""
    hint = "give a run folder written by nerfcli train"
    if not path.exists():
        return UserError(f"{path} does not exist", hint)
    if path.is_file():
        return UserError(f"{path} is a file, not a run folder", hint)
    if recognised(path) is not None:
        return UserError(f"{path} is a scene, not a run", f"train it first: nerfcli train {in_shell(path)}")
    if photos := photo_folder(path):
        return UserError(
            f"{photos} is a folder of photos, not a run", f"make a run of it first: nerfcli run {in_shell(photos)}"
        )
    return UserError(f"{path} is not a run folder: it has no {CONFIG}", hint)


def split_hash(test_names: Iterable[str]) -> str:
    """Return the SHA-256 of the sorted names of the held-out photos: the same split has the same hash."""
    return hashlib.sha256("\n".join(sorted(test_names)).encode()).hexdigest()


# Settings that a training keeps for good, besides its components, see `continued`.
_KEPT = ("contraction", "seed", "log2_rows", "field", "field_memory_bytes")


def continued(run: Path, settings: TrainSettings, *, before: RunConfig) -> TrainSettings:
    """Return the settings with which the training of a run goes on: its own, except for those that are given.

    Limits, device and threads are always those given; any other setting with its default counts as not given.

    Raises:
        UserError: components, or settings that it keeps, are given and differ.
    """
    own, usual = before.settings, TrainSettings()
    given = {name: value for name, value in vars(settings).items() if value != getattr(usual, name)}
    named = settings.fixed if settings.model == "auto" else (*settings.fixed, *differences(settings.components))
    had = vars(own) | vars(before.components)
    wanted = {name: given[name] for name in _KEPT if name in given}
    for name, value in (wanted | {name: getattr(settings.components, name) for name in named}).items():
        if had[name] != value:
            made, asked = (f"{name}={str(one).lower()}" for one in (had[name], value))
            hint = "train into a new folder with -o, or replace it: --overwrite without --resume"
            raise UserError(f"{run} was trained with {made}, not {asked}", hint)
    given |= {name: getattr(settings, name) for name in ("budget_seconds", "steps", "device", "threads")}
    return replace(own, **given | {name: getattr(own, name) for name in ("components", "model", "fixed")})


class Run:
    """A run folder; each file is read on first use. A property raises a UserError if its file is missing or damaged."""

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

    def photos(self, frames: Sequence[Frame]) -> list[LoadedPhoto]:
        """Load photos as for the training; the pixels of their masks, and those that it has left out, are not used.

        Raises:
            UserError: a photo cannot be read.
        """
        factor, masks = self.config.downscale, self.components.masks
        loaded = load_photos(frames, factor=factor, threads=torch.get_num_threads(), masks=masks)
        files = [left_out_mask(self.path, frame.name) for frame in frames]
        left_out = [read_image(file)[..., 0] == 0 if file.exists() else None for file in files]
        return [photo.without(mask) for photo, mask in zip(loaded, left_out, strict=True)]

    def model(self, device: str = "cpu") -> Model:
        """Load the field with everything that rendering needs; each call loads it again.

        Raises:
            UserError: it is missing or damaged.
        """
        if not self.is_trained and not (self.path / CONFIG).exists():
            raise no_run(self.path)
        return load_model(self.field_path, device)

    def checkpoint_sha256(self) -> str:
        """Return the hash of the field's file, which identifies the field in metrics, renders and pages."""
        try:
            return hashlib.sha256(self.field_path.read_bytes()).hexdigest()
        except OSError as error:
            hint = "train first (nerfcli train SCENE), or give another run"
            raise UserError(f"{self.field_path} cannot be read: {error.strerror}", hint) from error

    def metrics(self) -> dict[str, Any] | None:
        """Return the metrics written by `evaluate`; None if there are none."""
        if not self.metrics_path.exists():
            return None
        hint = "evaluate again: nerfcli evaluate RUN --overwrite"
        return read_json(self.metrics_path, needed=("mean",), hint=hint)

    def check_split(self) -> None:
        """Check that the held-out photos of the cameras are those that were held out of the training."""
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
        """Return the steps and training seconds of the last checkpoint."""
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
