"""How well a capture determines a lens, against synthetic truth: noise, highlights that slide, and little depth."""

import numpy as np
import pycolmap
import pytest
import synthetic_captures as synthetic
from synthetic_captures import Lens
from test_pose_lenses import camera_of, ring_model, started_from

from nerfcli.poses.model import held_out
from nerfcli.poses.model.intrinsics import choose_lenses
from nerfcli.poses.model.lens_evidence import NAMES, UndeterminedError, lens_evidence
from nerfcli.poses.model.lens_observability import determine_lens, uncertainty

FOCAL_PX = 1400.0


def robot_capture(
    *, seed: int = 0, k1: float = 0.0, centre: tuple[float, float] = (400.0, 300.0), shiny: float = 0.0
) -> pycolmap.Reconstruction:
    """Twenty-five photos of a boulder with a long lens from one side, as the mapper leaves them."""
    views = synthetic.dome(25, Lens("SIMPLE_RADIAL", 800, 600, (FOCAL_PX, *centre, k1)), seed=1)
    model = synthetic.observed_model(views, synthetic.boulder(500, seed=2), noise_px=0.4, seed=seed, shiny=shiny)
    return started_from(model, "SIMPLE_RADIAL")


def test_deviations_are_those_of_repeated_captures():
    """Monte Carlo: 24 captures that differ only in their noise, adjusted with the principal point free."""
    found, predicted = [], []
    for seed in range(24):
        model = ring_model("SIMPLE_RADIAL", (800.0, 512.0, 384.0, 0.05), points=(150, 350), seed=seed)
        held_out.adjust(model, principal_points=True)
        found.append(np.array(camera_of(model).params))
        if seed < 4:
            evidence = lens_evidence(model, 1).estimate(["f", "cx", "cy", "k1"])
            predicted.append([np.sqrt(evidence.covariances[0][i, i]) for i in range(4)])
    assert np.mean(predicted, axis=0) / np.std(found, axis=0, ddof=1) == pytest.approx(np.ones(4), abs=0.45)


def test_one_step_is_where_an_adjustment_goes():
    """Against bundle adjustment by Ceres with the principal point free, to one standard deviation."""
    model = ring_model("SIMPLE_RADIAL", (800.0, 527.0, 380.0, 0.05))
    start = started_from(model, "SIMPLE_RADIAL")
    found = lens_evidence(start, 1).estimate(["f", "cx", "cy", "k1"])
    held_out.adjust(start, principal_points=True)
    camera = camera_of(start)
    adjusted = [camera.mean_focal_length(), camera.principal_point_x - 512, camera.principal_point_y - 384]
    for name, value in zip(("f", "cx", "cy"), adjusted, strict=True):
        assert found.value(name) == pytest.approx(value, abs=found.deviation(name)), name


@pytest.mark.parametrize("seed", range(3))
def test_highlights_free_no_parameter_that_is_not_there(seed: int):
    model = robot_capture(seed=seed, shiny=0.4)
    found = determine_lens(model, 1, mapped=model)
    assert not found.principal_point
    assert found.camera.model.name in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL")


@pytest.mark.parametrize("shiny", [0.0, 0.2])
def test_what_is_there_is_found_in_spite_of_highlights(shiny: float):
    strong = choose_lenses(robot_capture(k1=-0.2, shiny=shiny))
    assert camera_of(strong.model).model.name == "SIMPLE_RADIAL"
    assert camera_of(strong.model).params[3] == pytest.approx(-0.2, abs=0.03)
    off_axis = choose_lenses(robot_capture(centre=(440.0, 300.0), shiny=shiny))
    assert off_axis.uncertainty[1]["principal_point_free"]
    assert camera_of(off_axis.model).principal_point_x == pytest.approx(440, abs=12)


def test_highlights_pull_a_robust_adjustment_less():
    """By the mean focal length over three captures in which a fifth of the points are highlights."""
    plain, robust = [], []
    for seed in range(3):
        model = robot_capture(seed=seed, shiny=0.2)
        plain.append(camera_of(model).mean_focal_length())
        scale_px = held_out.loss_scale_px(held_out.observation_errors_px(model))
        held_out.adjust(model, robust_px=scale_px)
        robust.append(camera_of(model).mean_focal_length())
    assert abs(np.mean(robust) - FOCAL_PX) < 0.6 * abs(np.mean(plain) - FOCAL_PX)


def shallow_capture() -> pycolmap.Reconstruction:
    """Eight photos of a nearly flat scene from nearly one side."""
    lens = Lens("SIMPLE_RADIAL", 800, 600, (FOCAL_PX, 400.0, 300.0, 0.0))
    boulder = synthetic.boulder(300, seed=2)
    flat = synthetic.Scene(boulder.points * [0.02, 1, 1], np.tile([1.0, 0.0, 0.3], (300, 1)), boulder.looks)
    views = synthetic.dome(8, lens, seed=1, span_deg=3)
    return synthetic.observed_model(views, flat, noise_px=1.5, seed=0)


def test_an_undetermined_focal_length_stays_at_that_of_exif_and_is_reported_as_weak():
    model = shallow_capture()
    lenses = choose_lenses(model, exif_focal_px={1: 1380.0})
    assert camera_of(lenses.model).model.name == "SIMPLE_PINHOLE"
    assert camera_of(lenses.model).params.tolist() == [1380.0, 400.0, 300.0]
    assert lenses.uncertainty[1]["weak"]
    assert lenses.uncertainty[1]["focal_percent"] > 3
    assert lenses.uncertainty[1]["distortion_border_px"] is None  # the lens has none: not a distortion known exactly
    firm = choose_lenses(ring_model("SIMPLE_RADIAL", (800.0, 512.0, 384.0, 0.05)))
    assert not firm.uncertainty[1]["weak"]
    assert firm.uncertainty[1]["focal_percent"] < 0.3
    assert 0 < firm.uncertainty[1]["distortion_border_px"] < 1


def test_too_few_observations_have_a_reason():
    """A point or none, all points on one ray, and photos that have lost their pose."""
    model = ring_model("SIMPLE_RADIAL", (800.0, 512.0, 384.0, 0.05))
    for image_id in (3, 4):
        model.deregister_frame(model.image(image_id).frame_id)
    assert uncertainty(model, 1, principal_point=False)["reason"] is None
    for point_id in sorted(model.point3D_ids())[1:]:
        model.delete_point3D(point_id)
    with pytest.raises(UndeterminedError, match="unknowns"):
        lens_evidence(model, 1)
    found = uncertainty(model, 1, principal_point=False)
    assert (found["focal_percent"], found["weak"]) == (None, None)
    assert "unknowns" in found["reason"]
    model.delete_point3D(min(model.point3D_ids()))
    assert "unknowns" in uncertainty(model, 1, principal_point=False)["reason"]


def test_numbers_that_are_not_finite_say_nothing():
    model = ring_model("SIMPLE_RADIAL", (800.0, 512.0, 384.0, 0.05))
    whole = lens_evidence(model, 1)
    for point_id in sorted(model.point3D_ids())[:5]:
        model.point3D(point_id).xyz = np.full(3, np.nan)
    found = lens_evidence(model, 1)
    assert np.isfinite(found.information).all()
    deviations = [evidence.estimate(["f", "k1"]).deviation("f") for evidence in (whole, found)]
    assert deviations[1] == pytest.approx(deviations[0], rel=0.2)
    assert len(found.current) == len(NAMES)
