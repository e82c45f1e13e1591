"""The ablation of a scene: which models are compared, their differences with intervals, and resuming after a kill."""

import csv
import json
import math
from pathlib import Path
from typing import Any

import pytest
from commands import error_of, listing, nerfcli, refusal
from conftest import SPHERES

from nerfcli.bench.ablation import (
    AUTO,
    CHOSEN,
    CaptureTraits,
    MeasuredTraining,
    Variant,
    half_interval,
    rows_of,
    variants,
)
from nerfcli.output import Output
from nerfcli.training.runs.components import CHOICES, Components
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.workflows import ablate as ablation

ALL = CaptureTraits(has_alpha=False, has_points=True, has_exif=True)


def test_every_component_is_varied_but_those_that_change_what_is_measured():
    found = variants(Components(), ALL)
    assert {variant.name.partition("=")[0] for variant in found} == set(CHOICES) - {"masks", "stereo", "sensor"}
    adds = {variant.name: variant.adds for variant in found}
    assert adds["view=0"] is False
    assert adds["near=false"] is False
    assert adds["background=sphere"] is True
    assert adds["exposure=exif"] is adds["exposure=matched"] is adds["exposure=learned"] is True
    for variant in found:
        name = variant.name.partition("=")[0]
        changed = {key for key in CHOICES if getattr(variant.components, key) != getattr(Components(), key)}
        assert changed == {name}


def test_stereo_is_varied_beside_points_and_goes_with_them():
    stereo, points = Components(points=0.1, stereo=True), Components(points=0.1)
    assert [v.components for v in variants(points, ALL, only=("points", "stereo"))] == [Components(), stereo]
    assert [v.components for v in variants(stereo, ALL, only=("points", "stereo"))] == [Components(), points]


def test_what_the_capture_cannot_have_is_not_tried():
    found = {variant.name for variant in variants(Components(), CaptureTraits(True, False, False))}
    assert not {"background=sphere", "points=0.1", "exposure=exif"} & found
    assert [v.name for v in variants(Components(view=0), ALL, only=("view",))] == ["view=3"]


def test_the_interval_is_students():
    """Three differences 1, 2, 3: their deviation is 1, and t(0.975, 2) = 4.3027 (any table)."""
    assert half_interval([1.0, 2.0, 3.0]) == pytest.approx(4.30265 / math.sqrt(3), rel=1e-5)
    assert half_interval([1.0]) is None


def test_differences_are_taken_seed_by_seed_and_get_a_verdict():
    models = [Variant(CHOSEN, Components()), Variant("view=0", Components(view=0), False)]
    models.append(Variant("antialias=true", Components(antialias=True), True))
    psnr = {CHOSEN: (20.0, 22.0, 21.0), "view=0": (19.0, 21.1, 19.9), "antialias=true": (20.5, 21.5, 21.1)}
    measured = [
        MeasuredTraining(name, seed, value, 60.0, 100, "protocol")
        for name, values in psnr.items()
        for seed, value in enumerate(values)
    ]
    chosen, view, antialias = rows_of(measured, models)
    assert (chosen.difference_db, chosen.verdict) == (None, "")
    # Seeds differ by 2 dB; the differences -1, -0.9, -1.1 by 0.1.
    assert view.difference_db == pytest.approx(-1.0)
    assert view.interval_db == pytest.approx(0.1 * 4.30265 / math.sqrt(3), rel=1e-5)
    assert view.verdict == "needed: worse without it"
    assert antialias.verdict == "no difference shown"
    assert rows_of(measured[:4], models)[1].verdict == "one seed: no verdict"


def test_an_ablation_goes_on_where_it_stopped(tmp_path, monkeypatch):
    """After kills before its first and third training, the same command trains only the models that are left."""
    from nerfcli.training import loop

    monkeypatch.setattr("nerfcli.training.runs.settings.FEWEST_LOG2_ROWS", 10)  # 34 MB for each run otherwise
    trained, real, kills = [], loop.train, [0, 2]

    def train(scene, run, settings, **rest):
        if kills and len(trained) == kills[0]:
            del kills[0]
            raise KeyboardInterrupt
        trained.append((settings.components.view, settings.seed))
        real(scene, run, settings, **rest)

    command = ["ablate", SPHERES, "-o", tmp_path / "out", "--seeds", "2", "--steps", "2", "--quiet"]
    command += ["--downscale", "8", "--threads", "1"]
    of_view = [*command, "--only", "view"]
    monkeypatch.setattr(loop, "train", train)
    assert [nerfcli(*of_view).exit_code for _ in range(2)] == [130, 130]
    assert json.loads((tmp_path / "out" / "ablation.json").read_text())["complete"] is False
    done = nerfcli(*of_view)
    assert (done.exit_code, done.stdout.strip()) == (0, str(tmp_path / "out" / "ablation.csv"))
    assert trained == [(3, 0), (3, 0), (0, 0), (3, 1), (0, 1)]  # the first one selects the components
    content = json.loads((tmp_path / "out" / "ablation.json").read_text())
    assert content["complete"] is True
    assert [(row["name"], row["seeds"]) for row in content["rows"]] == [(CHOSEN, 2), ("view=0", 2), (AUTO, 1)]
    with (tmp_path / "out" / "ablation.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[1]["difference_db"]) == pytest.approx(content["rows"][1]["difference_db"])
    assert "sampled: 324 random pixels of 3 held-out photos at 12x9" in rows[1]["protocol"]
    # What would drop results is refused, before anything is written.
    before = listing(tmp_path / "out")
    others = [[*of_view, name, value] for name, value in (("--steps", "3"), ("--seed", "1"), ("--seeds", "1"))]
    for other in (*others, [*command, "--only", "near"]):
        assert "ablation.json exists" in refusal(*other)[0]
    assert len(trained) == 5
    assert listing(tmp_path / "out") == before


def test_sizes_that_depend_on_the_device_are_compared(monkeypatch, tmp_path):
    """Regression: an ablation begun on a CPU went on with the larger steps and tables of a GPU."""
    about = []

    def compared(output: Output, folder: Path, what: dict[str, Any]) -> None:
        about.append({name: value for name, value in what["settings"].items() if name != "device"})
        raise KeyboardInterrupt

    monkeypatch.setattr(ablation, "refuse_others", compared)
    for device in ("cpu", "cuda"):
        with pytest.raises(KeyboardInterrupt):
            ablation.ablate_scene(SPHERES, Output(tmp_path), TrainSettings(device=device), seeds=1)
    assert about[0] != about[1]


def test_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "is not an ablation" in refusal("ablate", SPHERES, "-o", tmp_path, "--steps", "2")[0]
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("command", ["ablate", "bench"])
def test_a_scene_without_held_out_photos_is_refused_with_the_file_that_names_them(command, capture):
    scene = capture.with_name("scene")
    assert nerfcli("convert", capture, scene, "--to", "nerfcli").exit_code == 0
    content = json.loads((scene / "scene.json").read_text())
    (scene / "scene.json").write_text(json.dumps(content | {"split": {"test": []}}))
    error, hint = error_of(nerfcli(command, scene))
    assert error == f"Error: {scene} has no held-out photos"
    assert f'name some in {scene / "scene.json"}, such as every 8th: "split": {{"test": [' in hint
