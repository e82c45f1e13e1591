"""Export a run as Gaussian splats, and measure splats on the held-out photos of a run."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerfcli import __version__
from nerfcli.cameras.frame import chosen_evenly
from nerfcli.cameras.layout import up_direction
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.errors import UserError, duration, in_shell
from nerfcli.evaluate.photos import HeldOutPhoto
from nerfcli.evaluate.sampled import SampledPixels
from nerfcli.interrupts import deferred_interrupts
from nerfcli.notices import Notify, Reporter, silent
from nerfcli.photos.loading import LoadedPhoto, pinhole_of
from nerfcli.render.model import Model
from nerfcli.splats.files import read_splats, write_splat_page, write_splats
from nerfcli.splats.gaussians import rows_of
from nerfcli.splats.refine import (
    Refinement,
    RunSplats,
    load_splat_state,
    pictures_beside,
    refine,
    save_splats,
    share_of_pictures,
    splat_photos,
)
from nerfcli.splats.render import SplatScene, near_of
from nerfcli.splats.start import count_for, gaussians_of_field
from nerfcli.training.runs.files import SPLATS
from nerfcli.training.runs.run import Run

FORMAT = "nerfcli splat file 1"
# Photos of the training that the field and the splats are compared on.
COMPARED = 8
# Splats that are this much below the field on training photos should be refined for longer.
BELOW_DB = 1.0
# Fractions of the progress bar at which the pictures of the field are rendered, and the refinement begins.
_PICTURES, _START = 0.02, 0.1


@dataclass(frozen=True)
class SplatSettings:
    """Settings of splats.

    Args:
        count: largest number of Gaussians; None to choose it from the photos and the budget.
        budget_seconds: of refinement, wall time.
        degree: of the harmonics of colours, 0 to 3.
        frame: "viewer", whose y points down, or "scene".
        resume: refine the splats that the run has further, to `budget_seconds` in total; None if it has such splats.
    """

    count: int | None = None
    budget_seconds: float = 60.0
    degree: int = 2
    frame: str = "viewer"
    resume: bool | None = False


def export_splats(run: Run, model: Model, path: Path, *, settings: SplatSettings, reporter: Reporter) -> None:
    """Write the splats of a run as .ply, .spz or .html; make and refine them first if the run does not have them.

    Raises:
        UserError: a photo cannot be read or is a 360-degree photo, numbers are not finite, or the file is not written.
        KeyboardInterrupt: passed on after the state of the refinement has been saved.
    """
    if path.suffix.lower() == ".html" and settings.frame == "scene":
        hint = "remove it, or write a .ply"
        raise UserError("--frame scene is for .ply and .spz: the page needs y to point down", hint, exit_code=2)
    if any(frame.camera.is_spherical for frame in run.cameras.train):
        hint = "export it as a page, a mesh or points: --to page, mesh or points"
        raise UserError(f"{run.path} was trained on 360-degree photos, which splats cannot be fitted to", hint)
    splats = run_splats(run, model, settings=settings, reporter=reporter)
    file_from_scene = Similarity.identity() if settings.frame == "scene" else viewer_from_scene(run)
    gaussians = splats.gaussians().moved(file_from_scene)
    if path.suffix.lower() == ".html":
        camera = pinhole_of(run.cameras.train[0].camera)
        write_splat_page(
            path,
            gaussians,
            run=run.path,
            world_from_cam=file_from_scene.apply_pose(run.cameras.train[0].world_from_cam),
            fov_deg=camera.fov_deg[1],
            background=splats.background,
            notify=reporter.note,
        )
        return
    turned = "that of the scene" if settings.frame == "scene" else "that of the scene, turned so that y points down"
    description = {
        "format": FORMAT,
        "frame": turned,
        "file_from_scene": file_from_scene.to_json(),
        "background": list(splats.background),
        **provenance_of(run, model),
    }
    write_splats(path, gaussians, description=description, notify=reporter.note)
    reporter.note(
        f"{len(gaussians)} splats of degree {splats.degree}, {path.stat().st_size / 1e6:.1f} MB, frame: {turned}"
    )


def provenance_of(run: Run, model: Model) -> dict[str, Any]:
    """Return the unit of lengths and the run of an exported file."""
    return {
        "unit": model.unit,
        "unit_source": model.unit_source,
        "nerfcli": __version__,
        "run": run.path.resolve().name,
        "field_sha256": model.sha256,
    }


def y_up_from_scene(run: Run) -> np.ndarray:
    """Return the rotation that turns the up direction of the cameras to +y."""
    up = up_direction(run.cameras.train)
    aside = np.eye(3)[np.argmin(np.abs(up))]
    # The axes (right, down, ahead) of a camera whose down direction is -up.
    right, down, ahead = look_at(np.zeros(3), np.cross(up, aside), up)[:3, :3].T
    return np.stack([right, -down, -ahead])


def viewer_from_scene(run: Run) -> Similarity:
    """Return the rotation of the scene that viewers of splats expect: y points down."""
    return Similarity(1.0, np.diag([1.0, -1.0, -1.0]) @ y_up_from_scene(run), np.zeros(3))


def run_splats(run: Run, model: Model, *, settings: SplatSettings, reporter: Reporter) -> RunSplats:
    """Return the splats of a run, made from its field and refined on its training photos, or those that it has.

    Splats that the run has are returned as they are if they belong to its field and were made with these settings.
    """
    kept = _kept(run, model, settings)
    if kept is not None and kept.refinement.seconds >= settings.budget_seconds:
        reporter.note(f"the splats of {run.path} are used: refined for {kept.refinement.seconds:.0f} s")
        return kept
    if model.device.type != "cpu":
        reporter.note("splats are refined on the CPU; the GPU renders the field that they start from")
    loaded = _with_rays(run.photos(run.cameras.train))
    pictures = pictures_beside(
        model, loaded, on_progress=reporter.part(0.0, _PICTURES, f"pictures of the field, {_before(settings)}")
    )
    splats = kept or _started(run, model, loaded, pictures, settings=settings, reporter=reporter)
    began = splats.refinement.seconds / settings.budget_seconds
    frame = {"splats_from_scene": model.training_from_scene, "near": near_of(splats.refinement.rows[:, :3])}

    def on_step(fraction: float) -> None:
        left = duration(settings.budget_seconds * max(0.0, 1.0 - fraction))
        reporter.progress(
            _START + (1.0 - _START) * (fraction - began) / (1.0 - began),
            f"refining {len(splats.refinement.rows)} splats, {left} left",
        )

    with deferred_interrupts() as interrupts:
        refine(
            splats.refinement,
            splat_photos(loaded, splats.log_gains, **frame),
            background=splats.background,
            beside=splat_photos(pictures, np.zeros((len(pictures), 3)), **frame),
            share=share_of_pictures(len(loaded)),
            seconds=settings.budget_seconds,
            on_step=on_step,
            is_ended=lambda: interrupts.came is not None,
            notify=reporter.note,
        )
        try:
            save_splats(run.path / SPLATS, splats)
        except UserError as error:  # splats of a run in a read-only folder can still be exported
            reporter.note(f"the splats could not be saved in the run: {error.message}")
        else:
            if interrupts.came is not None:
                todo = "repeat the command" if settings.resume is None else "add --resume to the same command"
                reporter.note(f"the splats are saved; to continue, {todo}")
        interrupts.raise_if_pending()
    reporter.note(_compared_in_words(run, model, loaded=loaded, splats=splats))
    return splats


def _kept(run: Run, model: Model, settings: SplatSettings) -> RunSplats | None:
    """Return the splats that the run has, if they are to be used or refined further."""
    path = run.path / SPLATS
    splats = load_splat_state(path) if path.exists() else None
    same = (
        splats is not None
        and splats.field_sha256 == model.sha256
        and settings.degree == splats.degree
        and settings.count in (None, splats.count)
    )
    if settings.resume and not same:
        hint = "leave out --resume to make new splats"
        raise UserError(f"the splats in {run.path} are missing, or were made from another field, --count or --sh", hint)
    if not same or splats is None:
        return None
    is_enough = splats.refinement.seconds >= settings.budget_seconds
    return splats if is_enough or settings.resume is not False else None


def _with_rays(loaded: Sequence[LoadedPhoto]) -> list[LoadedPhoto]:
    """Return the photos without the pixels that have no ray, which the training left out."""
    has_ray = cache(lambda camera: camera.pixel_bearings()[1])
    photos = []
    for photo in loaded:
        without = ~has_ray(photo.frame.camera).reshape(photo.pixels.shape[:2])
        photos.append(photo.without(without if without.any() else None))
    return photos


def _started(
    run: Run,
    model: Model,
    loaded: Sequence[LoadedPhoto],
    pictures: Sequence[LoadedPhoto],
    *,
    settings: SplatSettings,
    reporter: Reporter,
) -> RunSplats:
    core_seconds = settings.budget_seconds * torch.get_num_threads()
    count = settings.count or count_for(loaded, core_seconds=core_seconds)
    start = gaussians_of_field(
        model,
        loaded,
        pictures,
        count=count,
        degree=settings.degree,
        with_gains=run.components.exposure != "none",
        on_progress=reporter.part(_PICTURES, _START, f"depths of the training photos, {_before(settings)}"),
    )
    rows = rows_of(start.gaussians.moved(model.training_from_scene))
    assert model.sha256 is not None
    return RunSplats(
        Refinement.of(rows), start.log_gains, start.background, model.training_from_scene, model.sha256, count
    )


def _before(settings: SplatSettings) -> str:
    """Return the budget of the refinement as text, for the stages before it."""
    return f"{duration(settings.budget_seconds)} of refinement left"


def _compared_in_words(run: Run, model: Model, *, loaded: Sequence[LoadedPhoto], splats: RunSplats) -> str:
    """Compare field and splats on random pixels of training photos, and say how much longer to refine if needed."""
    photos = [
        HeldOutPhoto(photo.frame, photo.pixels, photo.used, tuple(gains.tolist()))
        for photo, gains in chosen_evenly(list(zip(loaded, splats.log_gains, strict=True)), COMPARED)
    ]
    pixels, scene = SampledPixels.drawn(photos, seed=0), SplatScene(splats.gaussians(), splats.background)
    of_field, of_splats = pixels.psnr(model), pixels.psnr_of_pictures(scene)
    seconds = splats.refinement.seconds
    words = (
        f"training photos: field {of_field:.1f} dB, splats {of_splats:.1f} dB after {splats.refinement.steps} steps in "
        f"{seconds:.0f} s"
    )
    if of_splats < of_field - BELOW_DB:
        # On large captures the splats gain about 1 dB each time the seconds are doubled. A larger gap has other causes.
        longer = seconds * 2.0 ** min(of_field - of_splats, 3.0)
        more = f"nerfcli export {in_shell(run.path)} --to splats --resume --overwrite --budget {longer:.0f}s"
        words += f"; the splats are below the field; to go on: {more}"
    return words


def load_splats(path: str | Path, *, notify: Notify = silent) -> SplatScene:
    """Read a .ply or .spz of splats, of any program.

    Example:
        >>> import nerfcli
        >>> splats = nerfcli.load_splats("kitchen.ply")
        >>> picture = splats.render(nerfcli.load_run("photos-scene-run").cameras.test[0])
        >>> picture.rgb.shape

    Args:
        path: the file. Files that nerfcli wrote state how their frame is turned from the scene's, their background and
            unit; others are taken to be in the scene's frame, before black.
        notify: called with lines for the user.

    Returns:
        The splats in the scene's frame.

    Raises:
        UserError: the file is missing, damaged or of another kind.
    """
    gaussians, description = read_splats(Path(path), notify)
    if description.get("format") != FORMAT:
        return SplatScene(gaussians)
    scene_from_file = Similarity.from_json(description["file_from_scene"]).inverse()
    red, green, blue = (float(value) for value in description["background"])
    unit, source = str(description["unit"]), description["unit_source"]
    return SplatScene(gaussians.moved(scene_from_file), (red, green, blue), unit, source)


def are_of(file: Path, run: Run) -> bool:
    """Return whether a file of splats was exported after the splats of a run were made, from the field that it has now.

    Without the run's own splats nothing is known of the file, and it counts as one.
    """
    state = run.path / SPLATS
    if not state.is_file():
        return True
    is_newer = file.stat().st_mtime_ns >= state.stat().st_mtime_ns
    return is_newer and load_splat_state(state).field_sha256 == run.checkpoint_sha256()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
