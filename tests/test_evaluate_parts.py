"""Colour correction, novelty of views, pose refinement, ledger, requirements, spread: cases with known answers."""

import math
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from examples import examples
from fog import fog, foggy_cells
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, apply, inverse, look_at, transform_from_twist
from nerfcli.errors import UserError
from nerfcli.evaluate import perceptual
from nerfcli.evaluate.colour_alignment import align_gains, colour_aligned
from nerfcli.evaluate.ledger import leak_ledger, summary_line
from nerfcli.evaluate.novelty import novelty
from nerfcli.evaluate.pose_refinement import align_pose, halves
from nerfcli.evaluate.requirements import known_numbers, parse_requirements, unmet
from nerfcli.evaluate.spread import spread
from nerfcli.field.exposure import exposed
from nerfcli.kernels import RaysSeen
from nerfcli.render.model import Model
from nerfcli.render.rays import CENTRES, pixel_rays
from nerfcli.runs.components import Components
from nerfcli.runs.config import RunConfig
from nerfcli.runs.decisions import Selection

UP = np.array([0.0, -1.0, 0.0])
BLACK = (0.0, 0.0, 0.0)


# Colours


def test_a_quadratic_change_of_colours_is_taken_back():
    photo = np.random.default_rng(0).uniform(0.3, 0.7, (20, 30, 3))
    # The photo as a quadratic polynomial of the picture: the picture's own values are found by a square root.
    used = np.ones((20, 30), dtype=bool)
    picture = np.sqrt(photo * 0.9 + 0.05)
    assert np.abs(picture - photo).max() > 0.1
    np.testing.assert_allclose(colour_aligned(picture, photo, used=used), photo, atol=1e-9)


def test_channels_mix_and_masked_pixels_have_no_influence():
    rng = np.random.default_rng(0)
    photo = rng.uniform(0.3, 0.7, (20, 30, 3))
    picture = photo @ np.array([[0.8, 0.1, 0.0], [0.1, 0.9, 0.1], [0.0, 0.1, 0.8]]) + 0.02
    used = rng.uniform(size=(20, 30)) < 0.5
    spoilt = np.where(used[..., None], photo, 1.0 - photo)
    np.testing.assert_allclose(colour_aligned(picture, spoilt, used=used), photo, atol=1e-9)


def test_saturated_pixels_have_no_say_and_too_few_change_nothing():
    rng = np.random.default_rng(0)
    photo = rng.uniform(0.3, 0.7, (20, 30, 3))
    picture = photo * 0.5 + 0.1
    clipped = photo.copy()
    clipped[:5] = 1.0
    used = np.ones((20, 30), dtype=bool)
    np.testing.assert_allclose(colour_aligned(picture, clipped, used=used), photo, atol=1e-9)
    few = np.zeros_like(used)
    few[0, :9] = True
    np.testing.assert_array_equal(colour_aligned(picture, photo, used=few), picture)


GAIN = st.floats(-1.5, 1.5)


@examples(20)
@given(st.tuples(GAIN, GAIN, GAIN))
def test_gains_are_found_again_from_half_of_a_photo_though_parts_of_it_are_wrong(wanted):
    # Closed form: the photo is the picture with these gains, cut at white.
    picture = np.random.default_rng(0).uniform(0.0, 1.0, (40, 60, 3))
    photo = exposed(torch.from_numpy(picture), torch.tensor(wanted, dtype=torch.float64)).clamp(0, 1).numpy()
    left, right = halves(np.ones((40, 60), dtype=bool))
    exact = np.where(right[..., None], 0.5, photo)  # the right half is not used
    assert align_gains(picture, exact, used=left, log_gains=(0.4,) * 3) == pytest.approx(wanted, abs=1e-9)
    photo[::5], picture[1::5] = 1.0, 0.0  # white and black pixels are not used
    photo[2, 1:5] = 0.5
    assert align_gains(picture, photo, used=left, log_gains=(0.4,) * 3) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(("shown", "level"), [(0.5, 0.0), (0.5, 1.0), (0.0, 0.5), (1.0, 0.5)])
def test_black_and_white_leave_the_given_gains(shown, level):
    given = (0.2, 0.0, -0.2)
    picture, photo, used = np.full((9, 9, 3), shown), np.full((9, 9, 3), level), np.ones((9, 9), dtype=bool)
    assert align_gains(picture, photo, used=used, log_gains=given) == given
    grey, nothing = np.full((9, 9, 3), 0.5), np.zeros((9, 9), dtype=bool)
    assert align_gains(grey, grey, used=nothing, log_gains=given) == given
    assert align_gains(grey, grey, used=used, log_gains=given) == (0.0, 0.0, 0.0)


# Novelty


def looking(name: str, x: float, z: float = -4.0) -> Frame:
    """A camera at (x, 0, z) that looks along +z."""
    return Frame(name, Camera.pinhole(64, 48, 60.0), look_at(np.array([x, 0, z]), np.array([x, 0, 9.0]), UP))


def test_distance_and_angle_to_the_nearest_training_view():
    training = [looking(f"{x}", float(x)) for x in range(5)]
    turned = replace(looking("turned", 1.0), world_from_cam=look_at(np.array([1.0, 0, -4]), np.array([5.0, 0, 0]), UP))
    between, beyond, away = novelty([looking("a", 1.4), looking("b", 7.0), turned], training)
    assert (between.nearest, between.kind) == ("1", "interpolation")
    assert (between.distance, between.spacings) == (pytest.approx(0.4), pytest.approx(0.4))
    assert between.angle_deg == pytest.approx(0, abs=1e-6)
    assert (beyond.nearest, beyond.kind, beyond.spacings) == ("4", "extrapolation", pytest.approx(3.0))
    # In the same place as a training view, but turned by 45 degrees: the smaller field of view is 43.6.
    assert (away.distance, away.kind, away.angle_deg) == (0, "extrapolation", pytest.approx(45))


def test_distances_are_reported_in_scene_radii_whatever_the_unit():
    def ring(scale: float) -> list[Frame]:
        angles = np.arange(8) * np.pi / 4
        centres = [scale * 3 * np.array([math.cos(a), 0, math.sin(a)]) for a in angles]
        return [replace(looking(f"{i}", 0), world_from_cam=look_at(c, np.zeros(3), UP)) for i, c in enumerate(centres)]

    for scale in (1e-4, 1.0, 1e4):
        frames = ring(scale)
        found = novelty(frames[:1], frames[1:])[0]
        assert found.distance_relative == pytest.approx(2 * math.sin(math.pi / 8), rel=1e-6)
        assert found.angle_deg == pytest.approx(45)


def test_one_training_view_has_no_spacing():
    assert novelty([looking("a", 1.0)], [looking("b", 0.0)])[0].spacings is None


# Pose refinement


class Wall:
    """A painted wall at z = 0 in closed form, in place of the renderer; the model only sets the scale."""

    def __init__(self) -> None:
        self.model = fog(foggy_cells((0, 0, 0), (0, 0, 0)), Similarity(1 / 3, np.eye(3), np.zeros(3)))
        self.calls = 0

    def render(
        self,
        model: Model,
        origins: Tensor,
        directions: Tensor,
        *,
        background: Tensor,
        cones: Tensor | None = None,
    ) -> RaysSeen:
        self.calls += 1
        hit = 3.0 * (origins - directions * (origins[:, 2:] / directions[:, 2:])).double()  # scene units
        waves = torch.stack(
            [hit[:, 0] * 5 + hit[:, 1], hit[:, 1] * 4 - hit[:, 0], hit[:, 0] * 3 + hit[:, 1] * 3], dim=1
        )
        rgb = 0.5 + 0.3 * torch.sin(waves) + 0.1 * torch.cos(hit[:, :1] * hit[:, 1:2])
        return RaysSeen(rgb.float(), *(None, None, None))  # type: ignore[arg-type]


def test_a_pose_is_found_again_from_half_of_the_picture(monkeypatch):
    # Closed form: a wall, seen from a pose that is off by about 2 pixels of rotation and 2 of translation.
    wall = Wall()
    monkeypatch.setattr("nerfcli.evaluate.pose_refinement.render_rays", wall.render)
    pose = look_at(np.array([0.5, -0.4, -3.0]), np.array([0.2, 0.1, 0.0]), UP)
    truth = Frame("a", Camera.pinhole(96, 72, 90.0), pose)
    everything = np.ones((72, 96), dtype=bool)
    rays = pixel_rays(
        truth, wall.model.training_from_scene, pixels=np.arange(96 * 72), places=CENTRES, device=torch.device("cpu")
    )
    seen = wall.render(wall.model, rays.origin.expand_as(rays.directions), rays.directions, background=torch.zeros(3))
    photo = seen.rgb.numpy().astype(np.float64).reshape(72, 96, 3)
    off = replace(truth, world_from_cam=pose @ transform_from_twist(np.array([0.06, -0.05, 0.1, 0.02, -0.02, 0.02])))
    left, right = halves(everything)
    spoilt = np.where(right[..., None], 0.0, photo)  # the right half is not used
    found = align_pose(wall.model, off, spoilt, used=left, background=BLACK)
    assert found is not None
    # Points of the wall seen in the right half, which the alignment did not use.
    seen_right = rays.directions.numpy().reshape(72, 96, 3)[::8, 48::8].reshape(-1, 3).astype(np.float64)
    on_wall = truth.centre - seen_right * (truth.centre[2] / seen_right[:, 2:])
    shifts = [
        np.linalg.norm(truth.camera.project(apply(inverse(frame.world_from_cam), on_wall))[0] - pixels, axis=1).max()
        for pixels in [truth.camera.project(apply(inverse(pose), on_wall))[0]]
        for frame in (off, found.frame)
    ]
    assert shifts[0] > 2
    assert shifts[1] < 0.05
    assert found.error_after < 1e-6 < 1e-3 < found.error_before
    assert found.rotation_deg == pytest.approx(math.degrees(math.sqrt(3) * 0.02), rel=0.05)
    assert wall.calls < 100
    again = align_pose(wall.model, off, spoilt, used=left, background=BLACK)
    assert again is not None
    np.testing.assert_array_equal(again.frame.world_from_cam, found.frame.world_from_cam)
    assert align_pose(wall.model, off, photo, used=np.zeros_like(left), background=BLACK) is None


def test_halves_share_no_pixel_and_leave_none():
    left, right = halves(np.ones((3, 7), dtype=bool))
    assert (left.sum(), right.sum()) == (9, 12)
    assert not (left & right).any()


# Ledger


def seen(config: dict[str, Any]) -> dict[str, bool | None]:
    return {entry.stage: entry.saw_held_out for entry in leak_ledger(RunConfig(**config))}


def test_the_ledger_says_what_each_way_to_poses_has_seen():
    together = seen({"history": {"command": "poses", "settings": {}}})
    assert (together["poses"], together["intrinsics"], together["points"]) == (True, True, True)
    given = seen({"history": {"command": "poses", "settings": {}, "intrinsics": {"use": "fixed"}}})
    assert (given["poses"], given["intrinsics"]) == (True, False)
    strict = seen({"history": {"command": "poses", "settings": {"strict": True}}})
    assert (strict["poses"], strict["intrinsics"], strict["points"]) == (False, False, False)
    foreign = seen({"history": {"from": "blender"}})
    assert (foreign["poses"], foreign["training"]) == (None, False)
    assert seen({})["poses"] is None
    chosen = Selection(Components(exposure="matched"), (), 0.0)
    (exposure,) = [entry for entry in leak_ledger(RunConfig(selection=chosen)) if entry.stage == "exposure"]
    assert "training photos share" in exposure.how
    assert summary_line(leak_ledger(RunConfig(history={"from": "llff"}))).startswith(
        "held-out photos were used by normalisation; perhaps used by poses, intrinsics, points; not used by "
    )


# Requirements


def test_requirements_are_read_and_held_against_numbers():
    found = parse_requirements("psnr>=25, registered >= 0.9,seconds_per_image<2e0")
    assert [str(requirement) for requirement in found] == ["psnr>=25", "registered>=0.9", "seconds_per_image<2"]
    numbers = {"psnr": 25.0, "registered": 0.89, "seconds_per_image": None}
    assert unmet(found, numbers) == [
        "registered>=0.9 (registered is 0.89)",
        "seconds_per_image<2 (seconds_per_image is not known)",
    ]


@pytest.mark.parametrize("text", ["", "psnr", "psnr=25", "psnr>=", "psnr>=nan", "psnr>=inf", "beauty>=1", "psnr>=25,,"])
def test_what_is_no_requirement_is_refused(text):
    with pytest.raises(ValueError, match=r"is not a requirement; write|unknown metric"):
        parse_requirements(text)


def test_registered_is_the_share_of_photos_with_a_pose():
    metrics = {"mean": {"psnr": 20.0}, "training": {"seconds": 5.0}, "render": {"seconds_per_image": 1.0}}
    config = RunConfig(history={"registered": 9, "total": 12})
    assert known_numbers(metrics, config)["registered"] == 0.75
    assert known_numbers(metrics, RunConfig(history={"from": "llff"}))["registered"] is None


# Spread


def test_spread_in_closed_form_and_only_of_what_can_be_compared():
    runs = [{"protocol": "p: 3, at 4x4", "mean": {"psnr": value, "lpips": None}} for value in (20.0, 21.0, 25.0)]
    found = spread(runs, ["a", "b", "c"])
    assert found["psnr"]["mean"] == 22
    assert found["psnr"]["standard_deviation"] == pytest.approx(math.sqrt((4 + 1 + 9) / 2))
    assert (found["psnr"]["lowest"], found["psnr"]["highest"]) == (20, 25)
    assert "lpips" not in found
    other = {"protocol": "p: 3, at 8x8", "mean": {"psnr": 1.0}}
    with pytest.raises(UserError, match="b and a cannot be compared: 'at 8x8' instead of 'at 4x4'"):
        spread([runs[0], other], ["a", "b"])


# LPIPS


def test_without_its_libraries_or_weights_lpips_is_left_out_in_one_line(monkeypatch):
    notes: list[str] = []

    def missing(name: str) -> ModuleType:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(perceptual.importlib, "import_module", missing)
    assert perceptual.find_perceptual(notes.append) is None

    class Unreachable:
        def __init__(self, **settings: object):
            raise OSError("<urlopen error [Errno -2] Name or service not known>\nmore")

    module = ModuleType("lpip")
    module.LearnedPerceptualImagePatchSimilarity = Unreachable  # type: ignore[attr-defined]
    monkeypatch.setattr(perceptual.importlib, "import_module", lambda name: module)
    assert perceptual.find_perceptual(notes.append) is None
    assert len(notes) == 2
    assert "nerfcli[lpips]" in notes[0]
    assert notes[1].endswith("weights could not be loaded (<urlopen error [Errno -2] Name or service not known>)")
    assert "\n" not in "".join(notes)
