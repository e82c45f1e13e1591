"""RUN/cameras.json: cameras that a field was trained with, refined where training did so, and exposures of photos."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.atomic import SEAL, read_sealed, write_sealed
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import read_json_object
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.photo_names import seen_from, with_photos
from nerfcli.errors import UserError
from nerfcli.photos.held_out_exposure import PhotoExposures

CAMERAS = "cameras.json"
_CONFIG = "config.json"
# Hint for a damaged file of a run.
REPAIR_HINT = f"train again with --overwrite, or restore the file; if you edited it yourself, remove its entry {SEAL}"
# Keys: in an entry, camera and pose as the scene had them; beside the entries, exposures, and the run's absolute path.
_GIVEN, _EXPOSURES, _WRITTEN_AT = "given", "exposures", "written_at"


@dataclass(frozen=True)
class RunCameras:
    """The frames that were trained on, those that were held out, and what is known of their exposures."""

    train: tuple[Frame, ...]
    test: tuple[Frame, ...]
    exposures: PhotoExposures = field(default_factory=PhotoExposures)


def write_cameras(
    run: Path,
    train: Sequence[Frame],
    test: Sequence[Frame],
    *,
    given: Mapping[str, Frame] | None = None,
    exposures: PhotoExposures = PhotoExposures(),
) -> None:
    """Write the frames of both sets: full-size cameras and poses in the scene's frame.

    Rendering needs nothing else from the scene; evaluation finds the photos through this file.

    Args:
        train, test: frames as the field knows them.
        given: by name, the frames that training refined, as the scene has them.
        exposures: as the field knows them.
    """
    frames = {"train": train, "test": test}
    content = {name: [_frame_to_json(frame, run, given or {}) for frame in frames[name]] for name in frames}
    write_sealed(run / CAMERAS, {**content, _EXPOSURES: asdict(exposures), _WRITTEN_AT: os.path.abspath(run)})


def read_cameras(run: Path) -> RunCameras:
    """Return the frames of a run."""
    return _read_frames(run / CAMERAS, given=False)


def read_given_cameras(run: Path) -> RunCameras:
    """Return the frames of a run as `read_cameras`, but as the scene had them, before training refined them."""
    return _read_frames(run / CAMERAS, given=True)


def find_run(path: Path) -> Path | None:
    """Return RUN/cameras.json, given the folder of a run or that file itself; None if the path is neither."""
    file = path if path.is_file() and path.name == CAMERAS else path / CAMERAS
    return file if file.is_file() and (file.parent / _CONFIG).is_file() else None


def parse_run(path: Path, given: UserInputs = UserInputs()) -> Capture:
    """Return the frames of a RUN/cameras.json, training photos first, in the unit of the scene; a run has no points.

    Photos are where the run found them, unless the user gives their folder.
    """
    cameras = _read_frames(path, given=False)
    splits = (("train", cameras.train), ("test", cameras.test))
    frames = tuple(replace(frame, split=split) for split, frames in splits for frame in frames)
    config = read_json_object(path.with_name(_CONFIG))
    unit, source = config.get("unit") or "arbitrary", config.get("unit_source")
    capture = Capture(frames, kind="run", unit=unit, unit_source=source, pixels="upright")
    return capture if given.images is None else with_photos(capture, given=given.images)


def _read_frames(path: Path, *, given: bool) -> RunCameras:
    run = path.parent
    try:
        content = read_sealed(path)
        written_at = Path(content.get(_WRITTEN_AT, run))
        train, test = (
            tuple(
                _frame_from_json({**entry, **(entry.get(_GIVEN, {}) if given else {})}, run, written_at)
                for entry in content[name]
            )
            for name in ("train", "test")
        )
        exposures = PhotoExposures(**content[_EXPOSURES])
    except FileNotFoundError as error:
        hint = "give a run folder written by nerfcli train"
        raise UserError(f"{run} is not a run folder: it has no {CAMERAS}", hint) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} cannot be read: {error}", REPAIR_HINT) from error
    return RunCameras(train, test, exposures)


def _frame_to_json(frame: Frame, run: Path, given: Mapping[str, Frame]) -> dict[str, Any]:
    before = given.get(frame.name)
    return {
        "name": frame.name,
        **_view_to_json(frame),
        **({} if before is None else {_GIVEN: _view_to_json(before)}),
        # Relative, so that scene and run can be moved together; if only the run was moved, `written_at` locates them.
        "image": None if frame.image is None else seen_from(run, frame.image),
        "mask": None if frame.mask is None else seen_from(run, frame.mask),
    }


def _view_to_json(frame: Frame) -> dict[str, Any]:
    return {"camera": frame.camera.to_json(), "world_from_cam": frame.world_from_cam.tolist()}


def _frame_from_json(entry: dict[str, Any], run: Path, written_at: Path) -> Frame:
    pose = np.array(entry["world_from_cam"], dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"world_from_cam of {entry['name']} is not 4 rows of 4 finite numbers")
    return Frame(
        name=entry["name"],
        camera=Camera.from_json(entry["camera"]),
        world_from_cam=pose,
        image=None if entry["image"] is None else _found(entry["image"], run, written_at),
        mask=None if entry["mask"] is None else _found(entry["mask"], run, written_at),
    )


def _found(file: str, run: Path, written_at: Path) -> Path:
    """Return a file's path from the run, or if only that exists, its path from where the run was written."""
    here, there = run / file, Path(os.path.normpath(written_at / file))
    return there if there.exists() and not here.exists() else here


FORMAT = Format("run", "cameras refined by training", find_run, parse_run)
