"""Which model becomes the scene where the photos form several: two boulders far apart, against synthetic truth.

In each, the last photos and half of the points are in a wrong place, as a misled mapper leaves them.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import pycolmap
import pytest
import synthetic_captures as synthetic
from synthetic_captures import WIDE, Noise, View

from nerfcli.poses.engine import remap
from nerfcli.poses.engine.attempts import map_with_fallbacks
from nerfcli.poses.engine.mapping import MappedModels
from nerfcli.poses.engine.remap import ChosenModel, choose_model
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
    mapped = map_with_fallbacks(
        synthetic.synthetic_job(folder, views, seed=0), lambda stage, done, total: reports.append((stage, done, total))
    )
    # A second model does not set progress back: it counts 2 to 10 photos of the first, then stays at 10.
    placed = [done for stage, done, _ in reports if stage == "map"]
    assert placed[:17] == [*range(2, 11), *[10] * 8]
    assert [sorted(model.reg_image_ids()) for model in mapped.models] == [FIRST, SECOND]
    return views, mapped


@pytest.fixture
def misled(apart: tuple[list[View], MappedModels], tmp_path: Path) -> MappedModels:
    _, right = apart
    shutil.copytree(right.job.database.parent, tmp_path / "again")
    job = replace(right.job, folder=str(tmp_path / "again" / "work"))
    wrong = [synthetic.bent(right.models[0], 8), synthetic.bent(right.models[1], 17)]
    return MappedModels(wrong, job, [{"what": "default thresholds", "models": [10, 9]}], seconds=1000.0)


def choose(mapped: MappedModels) -> tuple[ChosenModel, list[str]]:
    notes: list[str] = []
    return choose_model(mapped, lambda *progress: None, notes.append), notes


def test_a_model_is_not_grown_over_photos_that_match_none_of_its_own(
    apart: tuple[list[View], MappedModels], misled: MappedModels
):
    found, notes = choose(replace(misled, models=apart[1].models))
    assert [sorted(model.reg_image_ids()) for model in found.mapped.models] == [FIRST, SECOND]
    assert notes == []


@pytest.mark.parametrize(("taken", "components"), [(16, [16]), (14, [14, 9])])
def test_a_component_has_most_of_its_photos_for_itself(
    apart: tuple[list[View], MappedModels],
    misled: MappedModels,
    monkeypatch: pytest.MonkeyPatch,
    taken: int,
    components: list[int],
):
    """Mapped again, the largest component takes in six or four of the other's nine photos."""
    views, right = apart
    grown = synthetic.true_model(views)
    for image_id in range(taken + 1, 20):
        grown.deregister_frame(grown.image(image_id).frame_id)
    accepted = examine(right.models[:1], right.job)

    def remapped(given: ChosenModel, *arguments: object, **options: object) -> ChosenModel:
        return ChosenModel(replace(given.mapped, models=[grown]), accepted)

    monkeypatch.setattr(remap, "remap_refused", remapped)
    found, _ = choose(misled)
    assert [model.num_reg_images() for model in found.mapped.models] == components
