"""Which model becomes the scene where the photos form several: two boulders far apart, against synthetic truth.

In each, the last photos and half of the points are in a wrong place, as a misled mapper leaves them.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import synthetic_captures as synthetic
from synthetic_captures import WIDE, Noise, View

from nerfcli.poses.engine import second_chance, selected_component
from nerfcli.poses.engine.ladder import climb
from nerfcli.poses.engine.mapped import MappedModels
from nerfcli.poses.engine.second_chance import ChosenModel
from nerfcli.poses.engine.selected_component import choose_component
from nerfcli.poses.judge.checks import Checks
from nerfcli.poses.judge.examine import examine

FAR = (40.0, 0.0, 0.0)
FIRST = list(range(1, 11))
SECOND = list(range(11, 20))


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[View], MappedModels]:
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    folder = tmp_path_factory.mktemp("apart")
    ring = synthetic.ring
    views = [*ring(10, [WIDE], seed=0, turn_deg=200), *ring(9, [WIDE], seed=1, at=FAR, turn_deg=180)]
    scene = synthetic.together(synthetic.boulder(800, seed=0), synthetic.boulder(800, seed=1, centre=FAR))
    synthetic.write_database(folder / "database.db", views, scene, noise=Noise(outliers=0.2), seed=0)
    reports: list[tuple[str, int, int]] = []
    climbed = climb(
        synthetic.synthetic_job(folder, views, seed=0), lambda stage, done, total: reports.append((stage, done, total))
    )
    # A second model does not set progress back: it counts 2 to 10 photos of the first, then stays at 10.
    placed = [done for stage, done, _ in reports if stage == "map"]
    assert placed[:17] == [*range(2, 11), *[10] * 8]
    assert [sorted(model.reg_image_ids()) for model in climbed.models] == [FIRST, SECOND]
    return views, climbed


@pytest.fixture
def misled(apart: tuple[list[View], MappedModels], tmp_path: Path) -> MappedModels:
    _, right = apart
    shutil.copytree(right.job.database.parent, tmp_path / "again")
    job = replace(right.job, folder=str(tmp_path / "again" / "work"))
    wrong = [synthetic.bent(right.models[0], 8), synthetic.bent(right.models[1], 17)]
    return MappedModels(wrong, job, [{"what": "default thresholds", "models": [10, 9]}], seconds=1000.0)


def choose(mapped: MappedModels, component: int) -> tuple[ChosenModel, list[str]]:
    notes: list[str] = []
    found = choose_component(mapped, lambda *progress: None, notes.append, component=component, checks=Checks)
    return found, notes


def worst_rotation_deg(model: pycolmap.Reconstruction, views: list[View]) -> float:
    """Return the largest rotation error of a model's photos, relative to its first one."""
    truth = synthetic.true_model(views)
    first, *others = sorted(model.reg_image_ids())
    turned = [
        [m.image(i).cam_from_world().rotation * m.image(first).cam_from_world().rotation.inverse() for i in others]
        for m in (model, truth)
    ]
    return max(float(np.degrees((one * other.inverse()).angle())) for one, other in zip(*turned, strict=True))


@pytest.mark.parametrize("failing", [(), ("_regrown", "_all_at_once")])
def test_a_smaller_component_gets_a_second_chance_of_its_own(
    apart: tuple[list[View], MappedModels],
    misled: MappedModels,
    monkeypatch: pytest.MonkeyPatch,
    failing: tuple[str, ...],
):
    """Its three photos that were off by 40 degrees come out within 0.4 degrees; the largest, which is right, stays."""
    for name in failing:
        monkeypatch.setattr(second_chance, name, lambda *arguments: None)
    views, right = apart
    found, notes = choose(replace(misled, models=[right.models[0], misled.models[1]]), 2)
    assert notes[0] == "component 1 is checked first, as the others are numbered after it"
    assert "mapping the photos of component 2 again, for at most 16 min" in notes[1]
    assert found.examined.verdict.accepted
    assert found.examined.model is not None
    assert sorted(found.examined.model.reg_image_ids()) == SECOND
    assert worst_rotation_deg(found.examined.model, views) < 0.4
    assert [sorted(model.reg_image_ids()) for model in found.mapped.models] == [FIRST, SECOND]
    assert found.mapped.models[0] is right.models[0]
    assert found.mapped.job == misled.job  # with all pairs of photos


def test_a_model_is_not_grown_over_photos_that_match_none_of_its_own(
    apart: tuple[list[View], MappedModels], misled: MappedModels
):
    found, notes = choose(replace(misled, models=apart[1].models), 1)
    assert [sorted(model.reg_image_ids()) for model in found.mapped.models] == [FIRST, SECOND]
    assert notes == []


def test_components_keep_the_numbers_that_were_reported(misled: MappedModels):
    listed, _ = choose(misled, 1)
    assert [sorted(model.reg_image_ids()) for model in listed.mapped.models] == [FIRST, SECOND]
    again, notes = choose(misled, 2)
    assert not any("component 1" in note for note in notes)
    assert [sorted(model.reg_image_ids()) for model in again.mapped.models] == [FIRST, SECOND]
    assert again.mapped.models[0].num_points3D() == listed.mapped.models[0].num_points3D()


@pytest.mark.parametrize(("taken", "components"), [(16, [16]), (14, [14, 9])])
def test_a_component_has_most_of_its_photos_for_itself(
    apart: tuple[list[View], MappedModels],
    misled: MappedModels,
    monkeypatch: pytest.MonkeyPatch,
    taken: int,
    components: list[int],
):
    """The second chance of the largest component takes in six or four of the other's nine photos."""
    views, right = apart
    grown = synthetic.true_model(views)
    for image_id in range(taken + 1, 20):
        grown.deregister_frame(grown.image(image_id).frame_id)
    accepted = examine(right.models[:1], right.job, lambda *progress: None)

    def chance(mapped: MappedModels, *arguments: object, **options: object) -> ChosenModel:
        return ChosenModel(replace(mapped, models=[grown]), accepted)

    monkeypatch.setattr(selected_component, "second_chance", chance)
    found, _ = choose(misled, 1)
    assert [model.num_reg_images() for model in found.mapped.models] == components
    last, _ = choose(misled, len(components) + 1)
    assert last.examined.model is None
