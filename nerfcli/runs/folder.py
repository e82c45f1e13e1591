"""The folder that training writes: settings, cameras, log, weights, and the state to go on from."""

import hashlib
import json
import math
import os
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli import __version__
from nerfcli.atomic import atomic_path, cannot_write, write_json
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.orientation import rescaling_told
from nerfcli.errors import UserError
from nerfcli.field.checkpoint import load_tensors
from nerfcli.runs.components import Components
from nerfcli.runs.decisions import Selection
from nerfcli.runs.settings import TrainSettings
from nerfcli.scene import Scene, fingerprint

CONFIG = "config.json"
CAMERAS = "cameras.json"
FIELD = "field.safetensors"
STATE = "state.safetensors"
LOG = "log.jsonl"
LOCK = ".train.lock"
_SEAL = "blake2b"
# In an entry of RUN/cameras.json: camera and pose as the scene had them.
_GIVEN = "given"
_MEND = f"train again with --overwrite, or restore the file; if you changed it yourself, take out its {_SEAL}"
# What every line of the log has.
_LOGGED = ("step", "seconds", "loss", "samples", "rays", "peak_memory_bytes")


def describe_run(
    scene: Scene, settings: TrainSettings, *, factor: int, contraction: str, selection: Selection | None = None
) -> dict[str, Any]:
    """What RUN/config.json holds: enough to know what was done, and to tell whether it is the same again.

    Args:
        scene: what was trained on.
        settings: as they were asked for.
        factor: by which photos were made smaller.
        contraction: of the field.
        selection: how the components were chosen, where the scene decided.
    """
    return {
        "scene": str(scene.root),
        "scene_kind": scene.kind,
        "unit": scene.unit,
        "unit_source": scene.unit_source,
        "scene_fingerprint": fingerprint(scene),
        "split_sha256": split_hash(scene.test_names),
        "holdout": scene.holdout,
        "history": dict(scene.history),
        "missing_photos": list(scene.missing),
        "warnings": list(rescaling_told(scene.rescaled)),
        "settings": {**settings.to_json(), "downscale": factor, "contraction": contraction},
        "selection": None if selection is None else selection.to_json(),
        "versions": {
            "nerfcli": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "numpy")},
        },
    }


def settings_of(config: dict[str, Any]) -> TrainSettings:
    """The settings that a run was trained with, from its config.json; an automatic downscale is what it became."""
    settings = config["settings"]
    return TrainSettings(**{**settings, "components": Components(**settings.get("components", {}))})


def split_hash(test_names: Iterable[str]) -> str:
    """SHA-256 over the names of the held-out photos, in order: the same split has the same hash."""
    return hashlib.sha256("\n".join(sorted(test_names)).encode()).hexdigest()


def check_split(run: Path, config: dict[str, Any], test: Sequence[Frame]) -> None:
    """Refuse cameras whose held-out photos are not those that were held out of the training.

    Raises:
        UserError: they are others.
    """
    if config.get("split_sha256") != split_hash(frame.name for frame in test):
        raise UserError(
            f"the held-out photos in {run / CAMERAS} are not those that {CONFIG} was written for (split_sha256)",
            "numbers on photos that may have been trained on mean nothing: train again with --overwrite",
        )


def write_cameras(
    run: Path, train: Sequence[Frame], test: Sequence[Frame], *, given: Mapping[str, Frame] | None = None
) -> None:
    """The frames of both sets, full-size cameras and poses in the scene's frame.

    Rendering needs nothing else of the scene; evaluation finds the photos through it.

    Args:
        run: the folder.
        train, test: frames as the field knows them.
        given: by name, as the scene has them, where training has refined them.
    """
    frames = {"train": train, "test": test}
    content = {name: [_frame_to_json(frame, run, given or {}) for frame in frames[name]] for name in frames}
    write_sealed(run / CAMERAS, content)


def read_cameras(run: Path) -> dict[str, tuple[Frame, ...]]:
    """The frames of "train" and "test".

    Raises:
        UserError: the folder is not one that `train` wrote.
    """
    return _read_frames(run, lambda entry: entry)


def read_given_cameras(run: Path) -> dict[str, tuple[Frame, ...]]:
    """The frames of "train" and "test" as the scene had them, before training refined them.

    Raises:
        UserError: see `read_cameras`.
    """
    return _read_frames(run, lambda entry: {**entry, **entry.get(_GIVEN, {})})


def _read_frames(run: Path, chosen: Callable[[dict[str, Any]], dict[str, Any]]) -> dict[str, tuple[Frame, ...]]:
    path = run / CAMERAS
    try:
        content = _read_sealed(path)
        return {
            name: tuple(_frame_from_json(chosen(entry), run) for entry in content[name]) for name in ("train", "test")
        }
    except FileNotFoundError as error:
        raise UserError(
            f"{run} is not a run: it has no {CAMERAS}", "give the folder that nerfcli train wrote"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} cannot be read: {error}", _MEND) from error


def read_config(run: Path) -> dict[str, Any]:
    """RUN/config.json.

    Raises:
        UserError: it is missing or not JSON.
    """
    try:
        return _read_sealed(run / CONFIG)
    except FileNotFoundError as error:
        raise UserError(
            f"{run} is not a run: it has no {CONFIG}", "give the folder that nerfcli train wrote"
        ) from error
    except (OSError, ValueError) as error:
        raise UserError(f"{run / CONFIG} cannot be read: {error}", _MEND) from error


def write_sealed(path: Path, content: dict[str, Any]) -> None:
    """A JSON file with a digest of its content: a digit that changes on a disk would be another camera."""
    write_json(path, {**content, _SEAL: _digest(content)})


def _read_sealed(path: Path) -> dict[str, Any]:
    """What `write_sealed` wrote; a file without a digest is taken as it is.

    Raises:
        ValueError: it is no JSON object, or its content is not what was written.
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ValueError("it is no JSON object")
    if (seal := content.pop(_SEAL, None)) is not None and seal != _digest(content):
        raise ValueError("its content is not what was written")
    return content


def _digest(content: dict[str, Any]) -> str:
    return hashlib.blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=16).hexdigest()


def chosen_components(config: dict[str, Any]) -> Components:
    """The components of a run that has this RUN/config.json: those that the scene decided on, or as asked for."""
    chosen = (config.get("selection") or {}).get("components") or config.get("settings", {}).get("components", {})
    return Components(**chosen)


def append_log(run: Path, entry: dict[str, Any]) -> None:
    """One line of RUN/log.jsonl, whole."""
    try:
        with (run / LOG).open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry, allow_nan=False) + "\n")
    except OSError as error:
        raise cannot_write(run / LOG, error) from error


def read_log(run: Path) -> list[dict[str, Any]]:
    """The entries of RUN/log.jsonl up to the first line that is not whole: a kill may have cut the last one short."""
    try:
        lines = (run / LOG).read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UserError(f"{run / LOG} cannot be read: {error.strerror}", "train again with --overwrite") from error
    entries: list[dict[str, Any]] = []
    for line in lines:
        try:
            entry = json.loads(line)
        except ValueError:
            break
        if not isinstance(entry, dict) or not all(_is_number(entry.get(name)) for name in _LOGGED):
            break
        entries.append(entry)
    return entries


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def cut_log(run: Path, step: int) -> None:
    """Forget the entries behind `step`: a killed training logs more than its last checkpoint knows of."""
    _write_log(run, [entry for entry in read_log(run) if entry["step"] <= step])


def add_to_log(run: Path, measured: Mapping[int, dict[str, Any]]) -> None:
    """Put what was measured afterwards, by step, into the entries of these steps."""
    _write_log(run, [entry | measured.get(entry["step"], {}) for entry in read_log(run)])


def _write_log(run: Path, entries: Iterable[dict[str, Any]]) -> None:
    with atomic_path(run / LOG) as partial:
        partial.write_text("".join(f"{json.dumps(entry)}\n" for entry in entries), encoding="utf-8")


def _frame_to_json(frame: Frame, run: Path, given: Mapping[str, Frame]) -> dict[str, Any]:
    before = given.get(frame.name)
    return {
        "name": frame.name,
        **_view_to_json(frame),
        **({} if before is None else {_GIVEN: _view_to_json(before)}),
        # Relative, so that scene and run can be moved together.
        "image": None if frame.image is None else os.path.relpath(frame.image, run),
        "mask": None if frame.mask is None else os.path.relpath(frame.mask, run),
    }


def _view_to_json(frame: Frame) -> dict[str, Any]:
    return {"camera": frame.camera.to_json(), "world_from_cam": frame.world_from_cam.tolist()}


def _frame_from_json(entry: dict[str, Any], run: Path) -> Frame:
    pose = np.array(entry["world_from_cam"], dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"world_from_cam of {entry['name']} is not 4 rows of 4 finite numbers")
    return Frame(
        name=entry["name"],
        camera=Camera.from_json(entry["camera"]),
        world_from_cam=pose,
        image=None if entry["image"] is None else run / entry["image"],
        mask=None if entry["mask"] is None else run / entry["mask"],
    )


def is_same_run(run: Path, scene: Scene, settings: TrainSettings) -> bool:
    """Whether `run` was trained from this scene with these settings; threads and device aside, an automatic downscale
    and contraction counting as whatever was chosen. Settings that a run of an earlier version does not name were the
    defaults."""
    config = read_config(run)
    wanted = {key: value for key, value in settings.to_json().items() if key not in ("device", "threads")}
    for name in ("downscale", "contraction"):
        if wanted[name] is None:
            del wanted[name]
    defaults, named = TrainSettings().to_json(), config.get("settings", {})
    components = {**defaults["components"], **named.get("components", {})}
    trained = {**defaults, **named, "components": components}
    return config.get("scene_fingerprint") == fingerprint(scene) and all(
        trained.get(key) == value for key, value in wanted.items()
    )


def is_complete(run: Path, settings: TrainSettings) -> bool:
    """Whether training reached the budget, by its last checkpoint: the log of a killed training is ahead of it."""
    if not (run / FIELD).exists():
        return False
    if (run / STATE).exists():
        step, seconds = saved_progress(run)
    elif log := read_log(run):  # somebody needed the room
        step, seconds = log[-1]["step"], log[-1]["seconds"]
    else:
        return False
    by_time = settings.budget_seconds is not None and seconds >= settings.budget_seconds
    by_steps = settings.steps is not None and step >= settings.steps
    return by_time or by_steps


def saved_progress(run: Path) -> tuple[int, float]:
    """Steps and training seconds of the last checkpoint.

    Raises:
        UserError: it cannot be read.
    """
    _, description = load_tensors(run / STATE, "cpu")
    return description["step"], description["totals"]["seconds"]
