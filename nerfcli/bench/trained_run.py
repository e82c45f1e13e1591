"""The subject of a bench: a trained run, or a scene that is trained first."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from nerfcli import scene as scenes
from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.evaluate.protocol import HeldOutPhoto
from nerfcli.evaluate.run_photos import held_out_photos
from nerfcli.render.model import Model
from nerfcli.runs.files import CONFIG, RECONSTRUCTION
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings, automatic_downscale, sizes_for


@dataclass(frozen=True)
class BenchedRun:
    """A run, a scene, or both.

    Args:
        path: the path that the user gave.
        run: the folder of a trained run; None for a scene.
        scene: the folder of the scene; None if it cannot be used, so that nothing can be trained.
        test_frames: the held-out frames.
        base: training settings that are not varied, including the resolution.
        identity: hash of the trained field or of the scene.
        trained: the run's summary of its training, with the keys of the records; empty if there is none.
        why_no_scene: the reason if the scene of a run cannot be used; else empty.
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

    def held_out(self, model: Model) -> list[HeldOutPhoto]:
        """Return the held-out photos, prepared for comparison with `model`.

        Raises:
            UserError: a photo cannot be read.
        """
        assert self.base.downscale is not None
        masks, threads = self.base.components.masks, self.base.threads
        return held_out_photos(self.test_frames, model, downscale=self.base.downscale, masks=masks, threads=threads)


def find_subject(path: Path, *, device: str, threads: int, seed: int) -> BenchedRun:
    """Find the run or scene at a path.

    Raises:
        UserError: it is neither, or nothing was held out.
    """
    if not path.exists():
        raise UserError(f"{path} does not exist", "give a run folder, or a scene folder")
    usual = TrainSettings(seed=seed, device=device, threads=threads, **sizes_for(device))
    if (path / CONFIG).exists() or (path / RECONSTRUCTION).exists():
        subject = _run_at(path, usual)
    else:
        subject = _scene_at(path, usual)
    if not subject.test_frames:
        raise UserError(f"{path} has no held-out photos", "by default every 8th photo is held out; check the split")
    return subject


def _run_at(path: Path, usual: TrainSettings) -> BenchedRun:
    run = Run(path)
    trained, named = run.config.settings, run.config.scene
    if not run.is_trained:
        raise UserError(f"{path} is not trained yet", "train it first (nerfcli train SCENE), or give a scene")
    # The path that the training was given, possibly relative to another folder; or beside the run, if both were moved.
    places = (named, path.resolve().parent / named.name)
    scene = next((place for place in places if named.name and scenes.is_scene(place)), None)
    why = "" if scene is not None else f"its scene {named} is missing"
    if scene is not None and scenes.fingerprint(scenes.load(scene)) != run.config.scene_fingerprint:
        scene, why = None, f"{scene} has changed since"
    return BenchedRun(
        path=path,
        run=path,
        scene=scene,
        test_frames=run.cameras.test,
        base=replace(usual, downscale=trained.downscale, components=trained.components),
        identity=run.checkpoint_sha256(),
        trained=training_record(run),
        why_no_scene=why,
    )


def training_record(run: Run) -> dict[str, Any]:
    """Return the run's summary of its training, with the keys of the records; empty without a summary."""
    summary = {} if run.summary is None else asdict(run.summary)
    return {name: value for name, value in summary.items() if name != "rays_per_second"}


def _scene_at(path: Path, usual: TrainSettings) -> BenchedRun:
    scene = scenes.load(path)
    camera = (scene.train_frames or scene.frames)[0].camera
    return BenchedRun(
        path=path,
        run=None,
        scene=path,
        test_frames=scene.test_frames,
        base=replace(usual, downscale=automatic_downscale(camera)),
        identity=scenes.fingerprint(scene),
        trained={},
    )
