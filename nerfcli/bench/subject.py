"""What is measured: a trained run, or a scene that is trained first."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfcli import scene as scenes
from nerfcli.bench.heldout import held_out_photos
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.evaluate.protocol import HeldOut
from nerfcli.render.model import Model
from nerfcli.runs.folder import CONFIG, FIELD, read_cameras, read_config, read_log
from nerfcli.runs.settings import TrainSettings, automatic_downscale
from nerfcli.scene import Scene


@dataclass(frozen=True)
class Subject:
    """A run, a scene, or both.

    Args:
        path: what the user named.
        run: the folder of a trained run; None for a scene.
        scene: the folder of the scene; None where it cannot be found, and nothing be trained.
        test_frames: the held-out ones.
        base: settings of trainings where they are not varied, the resolution among them.
        identity: changes when what is measured changes.
        trained: what the run says of its training, keys as in the records; empty where it says nothing.
        why_no_scene: where the scene cannot be found, in words.
    """

    path: Path
    run: Path | None
    scene: Path | None
    test_frames: tuple[Frame, ...]
    base: TrainSettings
    identity: str
    trained: dict[str, Any]
    why_no_scene: str = ""

    @property
    def shown(self) -> str:
        """The name of the held-out photo whose renderings are kept."""
        return self.test_frames[len(self.test_frames) // 2].name

    def held_out(self, model: Model) -> list[HeldOut]:
        """The held-out photos as `model` is compared with them.

        Raises:
            UserError: a photo cannot be read.
        """
        return held_out_photos(self.test_frames, model, settings=self.base)


def find_subject(path: Path, *, device: str, threads: int, seed: int) -> Subject:
    """The run or scene at a path.

    Raises:
        UserError: it is neither, or nothing was held out.
    """
    if (path / CONFIG).exists():
        subject = _run_at(path, device=device, threads=threads, seed=seed)
    else:
        subject = _scene_at(path, device=device, threads=threads, seed=seed)
    if not subject.test_frames:
        raise UserError(
            f"{path} has no held-out photo to compare with", "the default split holds out every 8th; check the split"
        )
    return subject


def _run_at(run: Path, *, device: str, threads: int, seed: int) -> Subject:
    config, log = read_config(run), read_log(run)
    if not (run / FIELD).exists():
        raise UserError(f"{run} is not trained yet", "train it first (nerfcli train SCENE), or give a scene")
    trained = TrainSettings.from_json(config["settings"])
    base = TrainSettings(
        seed=seed, device=device, threads=threads, downscale=trained.downscale, components=trained.components
    )
    named = Path(config.get("scene", ""))
    # As the training named it, which is relative to where the user then was; or beside the run, where both moved.
    places = (named, run.resolve().parent / named.name)
    scene = next((place for place in places if named.name and scenes.is_scene(place)), None)
    why = "" if scene is not None else f"its scene {named} is not there"
    if scene is not None and scenes.fingerprint(scenes.load(scene)) != config.get("scene_fingerprint"):
        scene, why = None, f"{scene} has changed since"
    return Subject(
        path=run,
        run=run,
        scene=scene,
        test_frames=read_cameras(run)["test"],
        base=base,
        identity=hashlib.sha256((run / FIELD).read_bytes()).hexdigest(),
        trained=_told_by(log),
        why_no_scene=why,
    )


def _told_by(log: list[dict[str, Any]]) -> dict[str, Any]:
    """What a run's log says of its training; nothing where an earlier version wrote it, or nobody."""
    if not log:
        return {}
    return {
        "seconds": log[-1]["seconds"],
        "steps": log[-1]["step"],
        "samples_per_second": log[-1]["samples"] / log[-1]["seconds"],
        "peak_memory_bytes": max(entry["peak_memory_bytes"] for entry in log),
    }


def _scene_at(path: Path, *, device: str, threads: int, seed: int) -> Subject:
    scene = scenes.load(path)
    return Subject(
        path=path,
        run=None,
        scene=path,
        test_frames=scene.test_frames,
        base=TrainSettings(seed=seed, device=device, threads=threads, downscale=_factor(scene)),
        identity=scenes.fingerprint(scene),
        trained={},
    )


def _factor(scene: Scene) -> int:
    camera = (scene.train_frames or scene.frames)[0].camera
    return automatic_downscale(camera.width, camera.height)
