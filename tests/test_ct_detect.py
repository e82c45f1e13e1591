"""--detect on a phantom whose projections have a closed form: side, direction and centre are found or called open."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import nerfcli
from scan_of_phantom import phantom_circle, scan_of_phantom

from nerfcli.ct.detect import judge
from nerfcli.ct.scan import save_scan


@pytest.mark.parametrize("truth", ["as stated", "mirrored", "reversed", "both"])
def test_a_mirrored_detector_is_recognized_with_a_fan_beam(truth: str) -> None:
    """A wrong side is worse by a large margin; mirrored and reversed together give the mirror image, which holds."""
    circle = phantom_circle()
    angles = tuple(-a for a in circle.angles) if truth in ("reversed", "both") else circle.angles
    real = replace(circle, angles=angles, mirrored=truth in ("mirrored", "both"))
    found = judge(scan_of_phantom(real, stated=circle, photons=2e4))
    assert found.verdict == ("mirrored" if truth in ("mirrored", "reversed") else "holds")
    assert found.ratio > 1.5
    assert found.standard_errors > 5
    assert ("--mirrored" in found.options) == (found.verdict == "mirrored")
    assert (found.as_stated.rms < found.mirrored.rms) == (found.verdict == "holds")


@pytest.mark.parametrize("truth", ["as stated", "mirrored", "reversed"])
def test_parallel_beams_decide_nothing_and_the_reason_is_reported(truth: str) -> None:
    circle = phantom_circle(beam="parallel", span_deg=180)
    angles = tuple(-a for a in circle.angles) if truth == "reversed" else circle.angles
    real = replace(circle, angles=angles, mirrored=truth == "mirrored")
    found = judge(scan_of_phantom(real, stated=circle))
    assert found.verdict == "undecided"
    assert "parallel beams cannot distinguish them" in found.ambiguity
    assert found.centre_holds


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("shift", [-3.3, 0.0, 5.75])
def test_the_centre_of_rotation_is_found(beam: str, shift: float) -> None:
    """Known truth: within 0.1 columns."""
    kind = "cone" if beam == "cone" else "parallel"
    circle = phantom_circle(beam=kind, span_deg=360 if beam == "cone" else 180)
    real = replace(circle, column_shift=shift)
    found = judge(scan_of_phantom(real, stated=circle, photons=2e4))
    truth = (circle.columns - 1) / 2 - shift
    assert found.centre_column == pytest.approx(truth, abs=0.1)
    assert found.centre_holds == (shift == 0)
    assert ("--centre-of-rotation" in found.options) == (shift != 0)


def test_the_command_ranks_and_the_options_mend(tmp_path: Path) -> None:
    circle = phantom_circle()
    real = replace(circle, mirrored=True)
    save_scan(tmp_path / "scan", scan_of_phantom(real, stated=circle))
    result = nerfcli("ct", "convert", tmp_path / "scan", "--detect", "--json")
    record = json.loads(result.stdout)
    assert record["verdict"] == "mirrored"
    assert record["options"].startswith("--mirrored")
    text = nerfcli("ct", "convert", tmp_path / "scan", "--detect").stdout
    assert "mirrored or reversed; as stated is worse" in text
    assert "To read it this way: nerfcli ct convert IN SCAN --mirrored" in text


def test_few_views_are_refused() -> None:
    from nerfcli.errors import UserError

    circle = phantom_circle(views=5)
    with pytest.raises(UserError, match="5 views are too few"):
        judge(scan_of_phantom(circle))


def test_air_decides_nothing() -> None:
    """Without an object, no hypothesis is better than another."""
    scan = scan_of_phantom(phantom_circle())
    noise = np.random.default_rng(0).normal(0, 0.01, scan.values.shape).astype(np.float32)
    assert judge(replace(scan, values=noise)).verdict == "undecided"
