"""Describe a folder or file as plain values: scenes, captures, runs, renders, depth, pictures, training states.

Imports that need torch are local, so that a depth file can be described without importing torch.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from nerfcli.cameras.camera import by_lens
from nerfcli.cameras.frame import Frame
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import recognise, recognised
from nerfcli.captures.formats.run_cameras import CAMERAS
from nerfcli.captures.loading import describe_unused_masks, fingerprint, with_photos_on_disk
from nerfcli.captures.orientation import describe_rescaling
from nerfcli.errors import UserError
from nerfcli.export.model_facts import SUFFIXES as MODEL_SUFFIXES
from nerfcli.export.model_facts import is_splat_file, model_facts
from nerfcli.render.files.file_facts import RENDERS, file_facts, renders_facts
from nerfcli.training.runs.files import CONFIG, DEPTH_ERRORS, LOG, METRICS, REPORT

# Suffixes of files of cameras; a .json may also be something else.
_CAPTURE_SUFFIXES = (".sfm", ".json", ".xml", ".csv", ".out", ".npz")


def describe(path: str | Path) -> dict[str, Any]:
    """Return the facts of a capture, a run, renders, a file of data, or else of a scene.

    Raises:
        UserError: the path is none of these, or damaged.
    """
    folder = Path(path)
    if not folder.exists():
        raise UserError(f"{folder} does not exist", "give a scene, a run, renders, or one of their files")
    if folder.name == RENDERS:
        folder = folder.parent
    folder = _whole(folder)
    if folder.is_file() and folder.suffix == ".safetensors":
        from nerfcli.workflows.describe_run import describe_tensors

        return describe_tensors(folder)
    may_be_capture = folder.suffix.lower() in _CAPTURE_SUFFIXES if folder.is_file() else not (folder / CONFIG).exists()
    if may_be_capture and recognised(folder) is not None:
        return _describe_capture(folder)
    if is_splat_file(folder):
        from nerfcli.splats.files import splat_facts

        return splat_facts(folder)
    if folder.suffix.lower() in MODEL_SUFFIXES:
        return model_facts(folder)
    if folder.is_file() and folder.suffix.lower() != ".json":
        return file_facts(folder)
    if (folder / RENDERS).exists():
        return renders_facts(folder)
    if not (folder / CONFIG).exists():
        return _describe_capture(folder)
    from nerfcli.training.runs.run import Run
    from nerfcli.workflows.describe_run import describe_run

    return describe_run(Run(folder))


def _whole(path: Path) -> Path:
    """Return the run or scene that a file such as metrics.json or poses_report.json is part of; else the path."""
    parts_of_runs = (CONFIG, CAMERAS, LOG, METRICS, DEPTH_ERRORS, REPORT)
    if path.name in parts_of_runs and (path.parent / CONFIG).is_file():
        return path.parent
    if path.name == "poses_report.json" and (path.parent / "scene.json").is_file():
        return path.parent
    return path


def _camera_facts(frames: Iterable[Frame]) -> dict[str, Any]:
    lenses = by_lens([frame.camera for frame in frames])
    return {
        "cameras": [
            f"{lens.model} {lens.width}x{lens.height} "
            + ("all directions" if lens.is_spherical else f"focal {lens.focal_px:.1f} px")
            + (f", {len(cameras)} principal points" if len(cameras) > 1 else "")
            for lens, cameras in list(lenses.items())[:5]
        ],
        "camera_count": len(lenses),
    }


def _describe_capture(path: Path) -> dict[str, Any]:
    form, found = recognise(path)
    capture = form.parse(found, UserInputs())
    if not any(frame.has_photo for frame in capture.frames):
        return {
            "kind": form.name,
            "photos": 0,
            "missing": len(capture.frames) + len(capture.missing),
            **_camera_facts(capture.frames),
            "points": len(capture.points),
            "unit": capture.unit,
            "unit_source": capture.unit_source,
        }
    scene = with_photos_on_disk(path, form, found, capture)
    return {
        "kind": scene.kind,
        "photos": len(scene.frames),
        "held_out": len(scene.test_frames),
        "missing": len(scene.missing),
        "masks": sum(frame.mask is not None for frame in scene.frames) or None,
        "unused_masks": describe_unused_masks(scene),
        **_camera_facts(scene.frames),
        "rescaled": describe_rescaling(scene.rescaled),
        "points": len(scene.points),
        "unit": scene.unit,
        "unit_source": scene.unit_source,
        "fingerprint": fingerprint(scene),
    }
