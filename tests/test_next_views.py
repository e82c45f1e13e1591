"""Where to take photos next: the choice against all choices, the surface of balls in closed form, and the command."""

import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, nerfcli
from views import PINHOLE

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import look_at
from nerfcli.render.visibility import DepthMap, coverage_and_parallax, sees, without_steep
from nerfcli.surface import next_views as candidates
from nerfcli.surface.extent import Grid
from nerfcli.surface.next_views import ENOUGH, candidate_frames, in_free_space, next_views, surface_points
from nerfcli.workflows import next_views as workflow

CAMERA = Camera.pinhole(120, 120, 130.0)
UP = np.array([0.0, 0.0, 1.0])


def ball_map(angle_deg: float, *, name: str = "a", distance: float = 3.0) -> DepthMap:
    """Return the depth map of the unit ball from a camera on a level ring, in closed form."""
    angle = np.radians(angle_deg)
    frame = Frame(name, CAMERA, look_at(distance * np.array([np.cos(angle), np.sin(angle), 0.3]), np.zeros(3), UP))
    rays, _ = CAMERA.pixel_bearings()
    along = rays @ frame.world_from_cam[:3, :3].T @ frame.centre
    root = along**2 - frame.centre @ frame.centre + 1
    distances = np.where(root > 0, -along - np.sqrt(np.maximum(root, 0)), np.nan)
    return without_steep(DepthMap(frame, distances.reshape(120, 120).astype(np.float32)))


@pytest.mark.parametrize("seed", range(5))
def test_the_choice_is_within_its_bound_of_the_best_of_all(seed):
    rng = np.random.default_rng(seed)
    seen, coverage = rng.random((200, 9)) < rng.random(9) * 0.5, rng.integers(0, 4, 200).astype(float)

    def total(views: tuple[int, ...]) -> float:
        return float(np.minimum(coverage + seen[:, views].sum(axis=1), ENOUGH).sum())

    chosen = next_views(seen, coverage, count=3)
    indices = tuple(index for index, _ in chosen)
    best = max(map(total, itertools.combinations(range(9), 3)))
    nothing = total(())
    assert total(indices) - nothing >= (1 - 1 / np.e) * (best - nothing)
    assert total(indices) - nothing == sum(gain for _, gain in chosen)
    assert chosen[0][1] == max(total((index,)) for index in range(9)) - nothing


def test_no_view_is_chosen_that_adds_nothing():
    seen = np.array([[True, False, True], [False, False, True]])
    assert next_views(seen, np.array([1.0, 2.0]), count=3) == [(0, 1)]
    # Nor is a view chosen twice, though the point needs two.
    assert next_views(seen, np.array([0.0, 2.0]), count=3) == [(0, 1), (2, 1)]


def test_the_unseen_side_of_a_ball_is_looked_at_next():
    """Photos from -60 to 60 degrees: the middle of what they lack is at 180."""
    photos = [ball_map(angle) for angle in (-60, -30, 0, 30, 60)]
    candidates = [ball_map(angle) for angle in range(0, 360, 10)]
    points = surface_points([*photos, *candidates], Grid.over((-1.1, -1.1, -1.1, 1.1, 1.1, 1.1), 0.05))
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-5)
    # A sphere of area 4 pi meets about 1.5 * area / side^2 voxels; the cap below is out of sight.
    assert 0.6 < len(points) / (1.5 * 4 * np.pi / 0.05**2) < 1.0
    coverage, _ = coverage_and_parallax(photos, points)
    seen = np.stack([sees(view, points) for view in candidates], axis=1)
    chosen = [10 * index for index, _ in next_views(seen, coverage, count=4)]
    assert 150 <= chosen[0] <= 210
    after = coverage + seen[:, [angle // 10 for angle in chosen]].sum(axis=1)
    assert (coverage >= ENOUGH).mean() < 0.7
    assert (after >= ENOUGH).mean() > 0.9


def test_views_that_stand_in_something_are_left_out():
    photos = [ball_map(0), ball_map(40)]
    near, far = ball_map(90, name="near", distance=1.1), ball_map(90, name="far", distance=2.5)
    assert in_free_space([near, far], photos) == [far]


def test_candidates_go_around_and_change_height():
    frames = [ball_map(angle, name=str(angle)).frame for angle in range(0, 360, 30)]
    found = candidate_frames(frames, depth_hint=3.0)
    assert len({frame.name for frame in found}) == len(found) == 240
    centres = np.stack([frame.centre for frame in found])
    elevations = np.degrees(np.arcsin(centres[60:, 2] / np.linalg.norm(centres[60:], axis=1)))
    level = np.degrees(np.arctan(0.3))
    np.testing.assert_allclose(np.unique(elevations.round(3)), [level - 15, level, level + 15], atol=0.01)
    for frame in found[60:]:
        np.testing.assert_allclose(frame.world_from_cam[:3, 2], -frame.centre / np.linalg.norm(frame.centre), atol=1e-3)


def test_photos_from_one_place_have_only_their_flight_as_candidates():
    places = [look_at(np.zeros(3), np.array([np.cos(a), np.sin(a), 0.0]), UP) for a in (0.0, 2.0, 4.0)]
    found = candidate_frames([Frame(str(i), PINHOLE, pose) for i, pose in enumerate(places)], depth_hint=1.0)
    assert {frame.name.split("_")[0] for frame in found} == {"flight"}


@pytest.mark.usefixtures("small_photo_depths")
def test_doctor_reports_what_the_photos_of_a_run_see(spheres_run, tmp_path, monkeypatch):
    monkeypatch.setattr(candidates, "PER_PATH", 6)  # 60 on each path take 18 CPU seconds
    monkeypatch.setattr(workflow, "CANDIDATE_PX", 48)
    monkeypatch.setattr(workflow, "PICTURE_PX", 96)
    run = shutil.copytree(spheres_run, tmp_path / "spheres-run")
    result = nerfcli("doctor", run, "--views", "2", "--threads", "2", "--json")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["photos"] == 21
    assert sum(found["shares"].values()) == pytest.approx(1.0)
    assert found["shares"]["two or three"] + found["shares"]["four or more"] == pytest.approx(found["seen_twice"][0])
    assert found["seen_twice"][1] >= found["seen_twice"][0]
    assert found["next_views"][0]["gain"] >= found["next_views"][1]["gain"] > 0
    folder = Path(found["path"])
    assert folder == tmp_path / "spheres-run-next-views"
    text = (folder / "next_views.html").read_text(encoding="utf-8")
    assert f"Two photos or more see {100 * found['seen_twice'][0]:.1f} % of the surface" in text
    for view in found["next_views"]:
        position = ", ".join(f"{row[3]:.3g}" for row in view["world_from_cam"][:3])
        assert f"<b>{view['name']}</b> at {position}; first or second to see {100 * view['gain']:.1f} %" in text
    assert text.count('alt="coverage"') == text.count('alt="rendered"') == 2
    assert text.count('class="train" x1') == 21
    assert text.count('class="test" x1') == 2
    rendered = nerfcli("render", run, "--cameras", folder / "cameras.json", "--cameras-only", "-o", tmp_path / "again")
    assert rendered.exit_code == 0, rendered.stderr
    written = json.loads((tmp_path / "again/cameras.json").read_text())["frames"]
    assert [Path(entry["file_path"]).stem for entry in written] == ["next_01", "next_02"]
    assert "cameras.json exists" in error_of(nerfcli("doctor", run))[0]
    assert "are for photos, and this is a run" in error_of(nerfcli("doctor", run, "--require", "good"))[0]
