"""Describe a run or a file of tensors as plain values: settings, decisions, metrics, how far cameras have moved."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import vector_from_rotation
from nerfcli.field.checkpoint import load_tensors
from nerfcli.field.kinds import field_bytes
from nerfcli.training.runs.run import Run
from nerfcli.training.sentinel import FAILURE_FORMAT, replay


def describe_run(run: Run) -> dict[str, Any]:
    """Return the facts of a run."""
    config, cameras = run.config, run.cameras
    settings = config.settings.to_json()
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
