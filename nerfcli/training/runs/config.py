"""RUN/config.json: what was trained, from what, and how the components were chosen."""

import hashlib
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from nerfcli.atomic import read_sealed, write_sealed
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.registry import photo_folder, recognised
from nerfcli.captures.formats.run_cameras import MEND
from nerfcli.captures.loading import fingerprint
from nerfcli.captures.orientation import describe_rescaling
from nerfcli.errors import UserError, in_shell
from nerfcli.training.runs.components import Components, Selection
from nerfcli.training.runs.files import CONFIG
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.version import __version__


@dataclass(frozen=True)
class RunConfig:
    """Source and settings of a run; entries missing in files of earlier versions have their defaults.

    Args:
        scene: the folder of the scene, absolute or relative to the working directory of the training.
        scene_kind: the format of the scene, see `Capture`.
        unit, unit_source: unit of length, see `Capture`.
        scene_fingerprint: see `captures.loading.fingerprint`.
        split_sha256: see `split_hash`.
        holdout: the rule that chose the held-out photos; None where the scene defines them.
        history: how cameras and points were found, see `Capture`; None if not recorded.
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
    history: Mapping[str, Any] | None = None
    missing_photos: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    settings: TrainSettings = field(default_factory=TrainSettings)
    selection: Selection | None = None
    versions: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def describing(
        cls,
        scene: Capture,
        settings: TrainSettings,
        *,
        factor: int,
        contraction: str,
        selection: Selection | None = None,
    ) -> "RunConfig":
        """Describe a training that begins now."""
        return cls(
            settings=replace(settings, downscale=factor, contraction=contraction),
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
            selection=selection,
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
        """Return the content of the file; its keys, as the fields, are in the same order as in all earlier versions."""
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
        """Read the content that `to_json` returned, in this or an earlier version.

        Raises:
            KeyError, TypeError, ValueError, AttributeError: the content is invalid.
        """
        settings, selection = TrainSettings.from_json(content.get("settings", {})), content.get("selection")
        return cls(
            settings=settings,
            scene=Path(content.get("scene", "")),
            selection=None if selection is None else Selection.from_json(selection, wanted=settings.components),
            missing_photos=tuple(content.get("missing_photos", ())),
            warnings=tuple(content.get("warnings", ())),
            versions=content.get("versions") or {},
            **{name: content.get(name) for name in _COPIED_KEYS},
        )


_COPIED_KEYS = ("scene_kind", "unit", "unit_source", "scene_fingerprint", "split_sha256", "holdout", "history")


def write_config(run: Path, config: RunConfig) -> None:
    """Write RUN/config.json.

    Raises:
        UserError: it cannot be written.
    """
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
        raise UserError(f"{run / CONFIG} cannot be read: {error.message}", MEND) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run / CONFIG} cannot be read: {error}", MEND) from error


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
