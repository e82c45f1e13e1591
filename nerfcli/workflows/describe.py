"""Describe a folder or file as plain values: scenes, captures, runs, renders, depth, pictures, training states.

Imports that need torch are local, so that a depth file can be described without importing torch.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerfcli.cameras.camera import by_lens
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import vector_from_rotation
from nerfcli.captures.formats.registry import recognise, recognised, refuse_archive
from nerfcli.captures.formats.run_cameras import CAMERAS
from nerfcli.captures.loading import describe_unused_masks, fingerprint, with_photos_on_disk
from nerfcli.captures.orientation import describe_rescaling
from nerfcli.errors import UserError
from nerfcli.export.mesh_facts import SUFFIXES as MODEL_SUFFIXES
from nerfcli.export.mesh_facts import is_splat_file, model_facts
from nerfcli.render.files.file_facts import RENDERS, file_facts, renders_facts
from nerfcli.training.runs.files import CONFIG, DEPTH_ERRORS, LOG, METRICS, REPORT

if TYPE_CHECKING:
    from nerfcli.training.runs.run import Run


# Suffixes of files of cameras; a .json may also be something else.
_CAPTURE_SUFFIXES = (".sfm", ".json", ".xml", ".csv", ".out", ".npz")


def describe(path: str | Path) -> dict[str, Any]:
    """Return the facts of a capture, a run, renders, a file of data, or else of a scene."""
    folder = Path(path)
    if not folder.exists():
        raise UserError(f"{folder} does not exist", "give a scene, a run, renders, or one of their files")
    if folder.name == RENDERS:
        folder = folder.parent
    refuse_archive(folder)
    folder = _whole(folder)
    if folder.is_file() and folder.suffix == ".safetensors":
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
    capture = form.parse(found)
    if not any(frame.has_photo for frame in capture.frames):
        return {
            "kind": form.name,
            "photos": 0,
            "missing": len(capture.frames) + len(capture.missing),
            **_camera_facts(capture.frames),
            "points": len(capture.points),
            "unit": capture.unit,
            "unit_source": capture.unit_source,
            "notes": list(capture.notes) or None,
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
        "notes": list(scene.notes) or None,
        "points": len(scene.points),
        "unit": scene.unit,
        "unit_source": scene.unit_source,
        "fingerprint": fingerprint(scene),
    }


def describe_run(run: "Run") -> dict[str, Any]:
    """Return the facts of a run."""
    from nerfcli.field.kinds import field_bytes

    config, cameras = run.config, run.cameras
    settings = config.settings.facts()
    content: dict[str, Any] = {
        "kind": "run",
        "scene": str(config.scene),
        "photos": len(cameras.train),
        "held_out": len(cameras.test),
        "unit": config.unit,
        "unit_source": config.unit_source,
        "settings": {name: value for name, value in settings.items() if name != "components"},
        "components": asdict(run.components),
        "decisions": [decision.in_words() for decision in run.decisions],
        "versions": config.versions,
    }
    if run.log:
        content |= {key: run.log[-1].get(key) for key in ("step", "seconds", "loss", "samples_per_second")}
    if run.is_trained:
        model = run.model()
        content |= {
            "field": model.field.settings.to_json(),
            "field_bytes": field_bytes(model.field),
            "occupied_share": round(model.occupied.float().mean().item(), 4),
            "contraction": model.contraction,
        }
        if run.components.cameras != "fixed":
            radius = 1.0 / model.training_from_scene.scale
            content["cameras_moved"] = camera_moves(run.given_cameras.train, cameras.train, radius=radius)
    if (metrics := run.metrics()) is not None:
        content["metrics"] = metrics["mean"]
    return content


def describe_tensors(path: Path) -> dict[str, Any]:
    """Describe a file of tensors: a field, a training state, or the state before a failure, whose step is repeated."""
    from nerfcli.field.checkpoint import load_tensors
    from nerfcli.training.sentinel import FAILURE_FORMAT, replay

    tensors, description = load_tensors(path, "cpu")
    facts: dict[str, Any] = {
        "kind": description.get("format"),
        "bytes": path.stat().st_size,
        "tensors": {name: f"{str(tensor.dtype)[6:]} {list(tensor.shape)}" for name, tensor in tensors.items()},
    }
    if description.get("format") != FAILURE_FORMAT:
        return facts
    _, bad = replay(path)
    again = None if bad is None else f"{bad.name}: {bad.count} of {bad.total} numbers"
    return {**facts, "failure": description["message"], "pixels": description["pixels"], "repeated_now": again}


def camera_moves(before: Sequence[Frame], after: Sequence[Frame], *, radius: float) -> dict[str, Any]:
    """Return the median and the largest change of the cameras of photos.

    Args:
        before, after: the same photos in the same order, at least one.
        radius: radius of the scene, in its units.

    Returns:
        "rotation_deg", "translation_percent" (of the radius) and "focal_percent", each with "median" and "max".
    """
    given, refined = (np.array([frame.world_from_cam for frame in frames]) for frames in (before, after))
    turns = np.linalg.norm(vector_from_rotation(np.swapaxes(given[:, :3, :3], 1, 2) @ refined[:, :3, :3]), axis=1)
    moves = np.linalg.norm(refined[:, :3, 3] - given[:, :3, 3], axis=1)
    focal = [abs(b.camera.focal_px / a.camera.focal_px - 1) for a, b in zip(before, after, strict=True)]
    columns = {
        "rotation_deg": np.degrees(turns),
        "translation_percent": 100 * moves / radius,
        "focal_percent": 100 * np.array(focal),
    }
    return {
        name: {"median": round(float(np.median(values)), 4), "max": round(float(values.max()), 4)}
        for name, values in columns.items()
    }
