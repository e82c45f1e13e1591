"""nerfcli info: what a folder or a file is, and what is in it."""

from pathlib import Path
from typing import Annotated, Any

import typer

from nerfcli.cli.batch import for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.costs import cost_lines, costs_of_run
from nerfcli.cli.options import Json
from nerfcli.cli.words import lines_of, words_of


@command
def info(
    path: Annotated[
        str, typer.Argument(help="A scene, a run, renders, or one file of them; - for paths on standard input.")
    ],
    json: Json = False,
) -> None:
    """Say what a scene, a run or one of their files holds.

    Of a scene: cameras, photos, missing files, split, unit. Of a run: settings, time, numbers.

    \b
    Of a depth file (TIFF, EXR, NPZ, NPY, PNG), a picture, a video or a folder of renders: which depth it is, along
    which axis, in which unit and how that is known, what stands for no value, which camera saw it, which run it is of,
    and the range of its numbers. Of depth that another program wrote: what can be known, and what nobody states.
    Of a failure that a training kept: which numbers became non-finite, where, and whether they do again.

    \b
    Of a run, by arithmetic: bytes of weights, optimiser (gradients and moments) and what a step keeps; operations and
    memory traffic per sample and per picture, for its field and for the other kinds at equal storage. Where training
    refined cameras: how far they moved, as median and maximum.

    \b
    Examples:
      nerfcli info photos-scene
      nerfcli info photos-scene-run --json
      nerfcli info photos-scene-run/failure-1200.safetensors
      nerfcli info photos-scene-run/renders/test-conditional-z/depth/a.tiff
    """
    console = Console(quiet=True, json_lines=True)

    def work(folder: Path, one_of_many: bool) -> None:
        content = describe(folder)
        if json:
            console.result(folder, content)
        elif "in_words" in content:
            typer.echo("\n".join([str(folder), *(f"  {line}" for line in words_of(content))]))
        else:
            costs = content.pop("cost", {})
            lines = lines_of(content)
            if costs:
                lines += [f"storage and work of the {next(iter(costs))} field, and of others of as many bytes:"]
                lines += [f"  {line}" for line in cost_lines(costs)]
            typer.echo("\n".join([str(folder), *(f"  {line}" for line in lines)]))

    for_each_input(path, work)


def describe(folder: Path) -> dict[str, Any]:
    """The facts of a file of depth, pictures or video, of renders, or of a run; else of a scene."""
    from nerfcli.media.facts import RENDERS, file_facts, renders_facts

    if folder.name == RENDERS:
        folder = folder.parent
    if folder.is_file() and folder.suffix == ".safetensors":
        return _describe_tensors(folder)
    if folder.is_file() and folder.suffix.lower() != ".json":
        return file_facts(folder)
    if (folder / RENDERS).exists():
        return renders_facts(folder)
    from nerfcli.runs.folder import CONFIG

    return _describe_run(folder) if (folder / CONFIG).exists() else _describe_scene(folder)


def _describe_scene(folder: Path) -> dict[str, Any]:
    from nerfcli import scene as scenes
    from nerfcli.cameras.orientation import rescaling_told

    scene = scenes.load(folder)
    cameras = {frame.camera for frame in scene.frames}
    return {
        "kind": scene.kind,
        "photos": len(scene.frames),
        "held_out": len(scene.test_frames),
        "missing": len(scene.missing),
        "cameras": [f"{c.model} {c.width}x{c.height} focal {c.focal_px:.1f} px" for c in list(cameras)[:5]],
        "camera_count": len(cameras),
        "rescaled": rescaling_told(scene.rescaled),
        "points": len(scene.points),
        "unit": scene.unit,
        "unit_source": scene.unit_source,
        "fingerprint": scenes.fingerprint(scene),
    }


def _describe_run(folder: Path) -> dict[str, Any]:
    from nerfcli.atomic import read_json
    from nerfcli.evaluate.protocol import METRICS
    from nerfcli.field.cost import field_bytes
    from nerfcli.render.model import load_model
    from nerfcli.runs.camera_moves import camera_moves
    from nerfcli.runs.decisions import decisions_in_words
    from nerfcli.runs.folder import (
        FIELD,
        chosen_components,
        read_cameras,
        read_config,
        read_given_cameras,
        read_log,
    )

    config = read_config(folder)
    cameras = read_cameras(folder)
    log = read_log(folder)
    content: dict[str, Any] = {
        "kind": "run",
        "scene": config.get("scene"),
        "photos": len(cameras["train"]),
        "held_out": len(cameras["test"]),
        "unit": config.get("unit"),
        "unit_source": config.get("unit_source"),
        "settings": {k: v for k, v in config.get("settings", {}).items() if k != "components"},
        "components": chosen_components(config).to_json(),
        "decisions": decisions_in_words(config),
        "versions": config.get("versions"),
    }
    if log:
        content |= {key: log[-1].get(key) for key in ("step", "seconds", "loss", "samples_per_second")}
    if (folder / FIELD).exists():
        model = load_model(folder / FIELD, "cpu")
        content |= {
            "field": model.field.settings.to_json(),
            "field_bytes": field_bytes(model.field),
            "occupied_share": round(model.occupied.float().mean().item(), 4),
            "contraction": model.contraction,
            "cost": costs_of_run(model, cameras["train"], config.get("settings", {}), log),
        }
        if chosen_components(config).cameras != "fixed":
            radius = 1.0 / model.training_from_scene.scale
            given = read_given_cameras(folder)["train"]
            content["cameras_moved"] = camera_moves(given, cameras["train"], radius=radius)
    if (folder / METRICS).exists():
        content["metrics"] = read_json(
            folder / METRICS, needed=("mean",), hint="measure again: nerfcli evaluate RUN --overwrite"
        )["mean"]
    return content


def _describe_tensors(path: Path) -> dict[str, Any]:
    """A field, the state of a training, or the state before a failure, whose step is taken again."""
    from nerfcli.field.checkpoint import load_tensors
    from nerfcli.train.sentinel import FAILURE_FORMAT, replay

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
    return {**facts, "failure": description["told"], "pixels": description["pixels"], "repeated_now": again}
