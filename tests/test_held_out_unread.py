"""No stage of training or component selection opens held-out photos; they are opened only when both are over.

Evidence: the interpreter's own audit of opened files; and fields that are the same to the bit whatever is in the
held-out photos, which also covers what a library opens by itself. (Reading the scene comes first: where a format has no
sizes of pictures, they are in the pictures' headers.)
"""

import json
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import SPHERES
from trainings import FEW, fit, weights

from nerfcli.captures.loading import load_scene
from nerfcli.matching.sky import sky_masks
from nerfcli.photos.images import read_image, write_png
from nerfcli.training import checkpoints, evidence, loop, schedule, selection
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.files import FIELD, read_log
from nerfcli.training.runs.settings import TrainSettings

HELD_OUT = "test"  # the folder of these photos in the capture
_listeners: list[list[str]] = []


def _audit(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open" and _listeners and isinstance(arguments[0], str | bytes):
        name = arguments[0] if isinstance(arguments[0], str) else arguments[0].decode(errors="replace")
        for listener in _listeners:
            listener.append(name)


sys.addaudithook(_audit)  # for the rest of the process: Python cannot remove it


@pytest.fixture
def opened() -> Iterator[list[str]]:
    """Names of the files opened during the test."""
    names: list[str] = []
    _listeners.append(names)
    yield names
    _listeners.remove(names)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """The spheres with every other photo to train on."""
    folder = Path(shutil.copytree(SPHERES, tmp_path / "capture"))
    listed = json.loads((folder / "transforms_train.json").read_text())
    listed["frames"] = listed["frames"][::2]
    (folder / "transforms_train.json").write_text(json.dumps(listed))
    return folder


@pytest.fixture
def short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have `auto` try components in trainings of a few steps."""
    monkeypatch.setattr(selection, "FEWEST_STEPS", 1)
    monkeypatch.setattr(schedule, "FEWEST_STEPS", 1)
    monkeypatch.setattr(schedule, "SEARCH_FRACTION", 1.0)


def settings(model: str, components: Components) -> TrainSettings:
    return replace(FEW, model=model, components=components)


def is_held_out(name: str, capture: Path) -> bool:
    return str(capture / HELD_OUT) + "/" in name


def fill_background(capture: Path) -> None:
    """Put a bright sky behind the objects of all photos, above textured ground; they then have no alpha."""
    for photo in capture.glob("*/*.png"):
        rgba = read_image(photo).astype(np.float64)
        opacity = rgba[..., 3:] / 255
        behind = np.random.default_rng(0).uniform(0, 255, rgba[..., :3].shape)
        behind[: len(behind) // 2] = (90, 160, 250)
        write_png(photo, (rgba[..., :3] * opacity + behind * (1 - opacity)).astype(np.uint8))


CASES = {
    "default": ("default", Components()),
    "auto": ("auto", Components()),
    "stereo": ("default", Components(points=0.1, stereo=True, exposure="learned")),
    "occluders": ("default", Components(occluders=True)),
    "sky": ("default", Components(background="sphere")),
    "exposures": ("default", Components(exposure="learned", masks="empty")),
    "matched exposures": ("default", Components(exposure="matched")),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.usefixtures("short_search")
def test_no_held_out_photo_is_opened_before_the_training_is_over(case, capture, opened, tmp_path, monkeypatch):
    until_then: list[str] = []
    measure = checkpoints.measure_waypoints

    def after_training(*arguments, **named) -> None:
        until_then.extend(opened)
        measure(*arguments, **named)

    monkeypatch.setattr(loop, "measure_waypoints", after_training)
    skies: list[float] = []

    def count_sky(photos, *, threads: int) -> list[np.ndarray]:
        masks = sky_masks(photos, threads=threads)
        skies.append(float(np.mean([mask.mean() for mask in masks])))
        return masks

    monkeypatch.setattr(evidence, "sky_masks", count_sky)
    if case == "sky":
        fill_background(capture)
    scene = load_scene(capture)
    opened.clear()
    fit(scene, tmp_path / "run", settings(*CASES[case]))
    # Occluders are searched outside the sky; black behind the objects looks like one.
    assert (max(skies, default=0.0) > 0.01) == (case in ("sky", "occluders"))
    assert any(str(capture / "train") in name for name in until_then), "the audit sees training photos"
    assert [name for name in until_then if is_held_out(name, capture)] == []
    assert any(is_held_out(name, capture) for name in opened), "they are compared with afterwards"


@pytest.mark.parametrize("case", ["default", "auto"])
@pytest.mark.usefixtures("short_search")
def test_the_field_does_not_depend_on_what_is_in_held_out_photos(case, capture, tmp_path):
    # A budget in steps gives trials of equal length; seconds would differ.
    chosen = settings(*CASES[case])
    fit(load_scene(capture), tmp_path / "run", chosen)
    noise = np.random.default_rng(0).integers(0, 256, (72, 96, 4), dtype=np.uint8)
    for photo in (capture / HELD_OUT).glob("*.png"):
        write_png(photo, noise)
    fit(load_scene(capture), tmp_path / "other", chosen)
    assert weights(tmp_path / "run") == weights(tmp_path / "other")
    # The metrics of held-out photos do depend on them.
    psnr, of_noise = (read_log(tmp_path / name)[-1].get("heldout_psnr", 0.0) for name in ("run", "other"))
    assert psnr != pytest.approx(of_noise, abs=0.1)


def test_held_out_photos_that_are_gone_do_not_undo_a_training(capture, tmp_path):
    loaded = load_scene(capture)
    for photo in (capture / HELD_OUT).glob("*.png"):
        photo.unlink()
    fit(loaded, tmp_path / "run", replace(settings("default", Components()), steps=4), notes=(reported := []))
    assert (tmp_path / "run" / FIELD).exists()
    assert any("PSNR on held-out photos could not be measured" in line for line in reported)
    assert not (tmp_path / "run" / checkpoints.WAYPOINTS_FOLDER).exists()
    assert "heldout_psnr" not in read_log(tmp_path / "run")[-1]
