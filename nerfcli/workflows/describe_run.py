"""Describe a run or a file of tensors as plain values: settings, decisions, metrics."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from nerfcli.field.checkpoint import load_tensors
from nerfcli.field.cost import field_bytes
from nerfcli.training.runs.camera_moves import camera_moves
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
