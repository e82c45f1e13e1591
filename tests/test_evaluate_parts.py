"""Colour correction, novelty of views, ledger, requirements: cases with known answers."""

import math
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import look_at
from nerfcli.evaluate import metrics
from nerfcli.evaluate.ledger import leak_ledger, summary_line
from nerfcli.evaluate.metrics import Metrics, colour_aligned
from nerfcli.evaluate.protocol import PhotoMetrics, RunMetrics, copy_warnings, novelty
from nerfcli.evaluate.requirements import known_numbers, parse_requirements, unmet
from nerfcli.training.runs.components import Components, Selection
from nerfcli.training.runs.run import RunConfig

UP = np.array([0.0, -1.0, 0.0])


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


def test_held_out_copies_of_training_photos_are_told():
    training = [looking(f"{x}", float(x)) for x in range(4)]
    near = [looking("a", 1.0), looking("b", 2.0 + 1e-4), looking("c", 2.5)]
    (text,) = copy_warnings(novelty(near, training))
    assert text.startswith("2 of 3 held-out views have the pose of a training photo")
    assert text.endswith("nerfcli train SCENE --holdout FILE --overwrite")
    turned = replace(near[1], world_from_cam=look_at(np.array([2.0, 0, -4]), np.array([2.1, 0, 9.0]), UP))
    assert copy_warnings(novelty([near[0], turned], training)) == []  # half of the views, as of a camera at rest


def test_held_out_copies_are_told_if_the_training_photos_have_copies_too():
    """As of every:8 of photos that are all in the capture twice, of brackets of exposures, of a camera at rest."""
    training = [looking(f"{x}-{copy}", float(x)) for x in range(4) for copy in range(2)]
    assert len(copy_warnings(novelty([looking("a", 1.0), looking("b", 2.0)], training))) == 1
    assert len(copy_warnings(novelty([looking("a", 0.0)], training[:2]))) == 1
    assert copy_warnings(novelty([looking("a", 1.5)], training)) == []


def test_one_training_view_has_no_spacing():
    (view,) = novelty([looking("a", 1.0)], [looking("b", 0.0)])
    assert view.spacings is None
    assert not view.is_training_view


# Ledger


def seen(config: dict[str, Any]) -> dict[str, bool | None]:
    return {entry.stage: entry.saw_held_out for entry in leak_ledger(RunConfig(**config))}


def test_the_ledger_says_what_each_way_to_poses_has_seen():
    together = seen({"history": {"command": "poses", "settings": {}}})
    assert (together["poses"], together["intrinsics"], together["points"]) == (True, True, True)
    given = seen({"history": {"command": "poses", "settings": {}, "intrinsics": {"file": "/a.txt", "key": "0"}}})
    assert (given["poses"], given["intrinsics"]) == (True, False)
    strict = seen({"history": {"command": "poses", "settings": {"strict": True}}})
    assert (strict["poses"], strict["intrinsics"], strict["points"]) == (False, False, False)
    others = seen({"history": {"command": "poses", "settings": {"strict": True}}, "holdout": "block:0.15"})
    assert (others["poses"], others["intrinsics"], others["points"]) == (None, None, None)
    foreign = seen({"history": {"from": "blender"}})
    assert (foreign["poses"], foreign["training"]) == (None, False)
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
    metrics = RunMetrics("nerfcli-2", Metrics(20.0), (PhotoMetrics("a.png", Metrics(20.0), seconds=1.0),))
    config = RunConfig(history={"registered": 9, "total": 12})
    found = known_numbers(metrics, config)
    assert (found["registered"], found["psnr"], found["seconds_per_image"]) == (0.75, 20.0, 1.0)
    assert known_numbers(metrics, RunConfig(history={"from": "llff"}))["registered"] is None


# LPIPS


@pytest.fixture
def _nothing_is_loaded_yet() -> Iterator[None]:
    metrics._perceptual.cache_clear()
    yield
    metrics._perceptual.cache_clear()


@pytest.mark.usefixtures("_nothing_is_loaded_yet")
def test_without_its_libraries_or_weights_lpips_is_left_out_in_one_line(monkeypatch):
    notes: list[str] = []
    attempts: list[str] = []

    def missing(name: str) -> ModuleType:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(metrics.importlib, "import_module", missing)
    assert metrics.find_perceptual(notes.append) is None
    metrics._perceptual.cache_clear()

    class Unreachable:
        def __init__(self, net_type: str, **settings: object):
            attempts.append(net_type)
            raise OSError("<urlopen error [Errno -2] Name or service not known>\nmore")

    module = ModuleType("lpip")
    module.LearnedPerceptualImagePatchSimilarity = Unreachable  # type: ignore[attr-defined]
    monkeypatch.setattr(metrics.importlib, "import_module", lambda name: module)
    assert metrics.find_perceptual(notes.append) is None
    assert len(notes) == 2
    assert metrics.find_perceptual(lambda text: None) is None
    assert attempts == ["alex"], "without a network, each attempt waits for it"
    assert "nerfcli[lpips]" in notes[0]
    assert notes[1].endswith("weights could not be loaded (<urlopen error [Errno -2] Name or service not known>)")
    assert "\n" not in "".join(notes)
