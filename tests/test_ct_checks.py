"""Checks of nerfcli doctor on scans of a phantom with one fault each, and on one without."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, nerfcli
from ellipsoids import Ellipsoid
from scan_of_phantom import phantom_circle, scan_of_phantom

from nerfcli.ct.checks import sample_of
from nerfcli.ct.examine import CHECKS, examine_scan
from nerfcli.ct.geometry import Beam
from nerfcli.ct.scan import Scan, save_scan
from nerfcli.errors import GATE_NOT_MET
from nerfcli.pages.findings import Finding

VIEWS, COLUMNS = 96, 48
SOLID = (Ellipsoid((0.5, -0.3, 0), (8, 6, 7), 0.3, turn=0.4),)


def scan(photons: float | None = 3e4, phantom: Sequence[Ellipsoid] = SOLID, **changes: object) -> Scan:
    """A fan beam of a solid with 30,000 photons."""
    circle = phantom_circle(views=VIEWS, columns=COLUMNS, **changes)  # type: ignore[arg-type]
    return scan_of_phantom(circle, photons=photons, phantom=phantom)


def checked(name: str, of: Scan) -> Finding | str:
    return CHECKS[name](sample_of(of))


def finding(name: str, of: Scan) -> Finding:
    found = checked(name, of)
    assert isinstance(found, Finding), found
    return found


def changed(of: Scan, change: Callable[[np.ndarray], np.ndarray]) -> Scan:
    return replace(of, values=change(np.array(of.values)).astype(np.float32))


def test_a_sound_scan_is_sound() -> None:
    found = examine_scan(scan())
    verdicts = {each.check: each.verdict for each in found.findings}
    assert not found.not_checked
    assert verdicts == dict.fromkeys(CHECKS, "good")


def test_pixels_brighter_than_the_open_beam() -> None:
    found = finding("open beam", changed(scan(), lambda values: values * 1.1))
    assert found.verdict == "bad"
    assert "have I > I0" in found.summary


def test_drift_of_the_source() -> None:
    """A sine of +- 2 %: 4 % between views."""
    factors = 1 + 0.02 * np.sin(np.linspace(0, 6, VIEWS))[:, None, None]
    found = finding("drift", changed(scan(), lambda values: values * factors))
    assert found.verdict == "bad"
    assert found.number == pytest.approx(0.04, rel=0.2)


def test_constant_columns_are_rings() -> None:
    def wrong(values: np.ndarray) -> np.ndarray:
        values[:, :, [20, 41]] *= 0.95
        return values

    found = finding("rings", changed(scan(photons=1e6), wrong))
    assert found.verdict != "good"
    # A wrong column also changes the values with which its neighbours are compared.
    assert 2 / 60 <= (found.number or 0) <= 6 / 60


def test_few_photons() -> None:
    """Closed form: through a line integral of 2 * 8 * 0.3 = 4.8, 100 photons leave 0.8, and 500 leave 4."""
    low = scan(photons=500)
    found = finding("counts", low)
    assert found.verdict == "bad"
    assert 1 < (found.number or 0) < 6
    assert "--photons" in str(checked("counts", replace(low, photons_per_value=None)))


def test_an_object_wider_than_the_detector() -> None:
    found = finding("truncation", scan(None, [Ellipsoid((6, 0, 0), (9, 5, 5), 0.3)]))
    assert found.verdict == "bad"
    assert "on both sides" in found.summary
    assert "no column sees" not in str(found)


@pytest.mark.parametrize(
    ("beam", "span", "missing", "verdict"),
    [
        ("parallel", 180, 0, "good"),
        ("parallel", 120, 60, "bad"),
        ("parallel", 170, 10, "look"),
        ("cone", 360, 0, "good"),
        ("cone", 90, 90, "bad"),
        ("cone", 190, 0, "good"),
    ],
)
def test_the_missing_wedge_is_named(beam: Beam, span: float, missing: float, verdict: str) -> None:
    """Closed form, within two steps between views."""
    found = finding("missing wedge", scan(None, (), beam=beam, span_deg=span))
    assert found.verdict == verdict
    assert found.number == pytest.approx(missing, abs=2 * span / VIEWS)
    assert ("is missing" in found.summary) == (missing > 0)


def test_empty_projections_are_no_air_and_no_views() -> None:
    """Regression: line integrals of 0 in place of 60 of 96 views hid the missing wedge and a bad column."""
    usable = np.ones((VIEWS, 1, 1), bool)
    usable[36:] = False
    cut = replace(scan(None), usable=usable)
    half = replace(scan(span_deg=180, beam="parallel"), usable=usable)
    assert finding("open beam", half).verdict == "good"
    wedge = finding("missing wedge", half)
    assert (wedge.verdict, wedge.number) == ("bad", pytest.approx(180 * 60 / VIEWS, abs=4))
    bright = np.where(np.arange(COLUMNS) == 20, 0.9, 1.0)
    assert finding("rings", changed(cut, lambda values: values * bright)).verdict == "bad"


@pytest.mark.parametrize("truth", ["as stated", "mirrored", "reversed", "both"])
def test_a_mirrored_detector_is_recognized_with_a_fan_beam(truth: str) -> None:
    """A wrong side is worse by a large margin; mirrored and reversed together give the mirror image, which holds."""
    circle = phantom_circle()
    angles = tuple(-a for a in circle.angles) if truth in ("reversed", "both") else circle.angles
    real = replace(circle, angles=angles, mirrored=truth in ("mirrored", "both"))
    found = finding("side and direction", scan_of_phantom(real, stated=circle, photons=2e4))
    assert found.verdict == ("bad" if truth in ("mirrored", "reversed") else "good")
    assert found.number is not None
    assert found.number > 1.5
    assert ("--mirrored" in found.advice) == (found.verdict == "bad")


def test_parallel_beams_and_air_decide_nothing_and_the_reason_is_reported() -> None:
    parallel = scan_of_phantom(phantom_circle(beam="parallel", span_deg=180))
    assert "parallel beams cannot tell" in str(checked("side and direction", parallel))
    air = scan_of_phantom(phantom_circle())
    noise = np.random.default_rng(0).normal(0, 0.01, air.values.shape)
    assert "predict other views as well" in str(checked("side and direction", changed(air, lambda _: noise)))
    assert checked("side and direction", scan_of_phantom(phantom_circle(views=5))) == "too few views"


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("shift", [-3.3, 0.0, 2.5, 5.75])
def test_a_centre_off_the_middle(beam: Beam, shift: float) -> None:
    """Known truth: within 0.1 columns."""
    circle = phantom_circle(beam=beam, views=48, columns=COLUMNS)
    moved = scan_of_phantom(replace(circle, column_shift=shift), stated=circle, photons=3e4)
    found = finding("centre of rotation", moved)
    assert found.verdict == ("bad" if shift else "good")
    assert found.number == pytest.approx(abs(shift), abs=0.1)
    column = re.search("--centre-of-rotation ([0-9.]+)", found.advice)
    assert (column is not None) == (shift != 0)
    if column is not None:
        assert float(column[1]) == pytest.approx((COLUMNS - 1) / 2 - shift, abs=0.1)


@pytest.mark.parametrize(("bend", "verdict"), [(0.0, "good"), (0.10, "look"), (0.30, "bad")])
def test_beam_hardening_is_named(bend: float, verdict: str) -> None:
    """Line integrals minus a quadratic term, which takes a known fraction of the longest one, 16 * 0.3 = 4.8."""
    found = finding("beam hardening", changed(scan(None), lambda p: p * (1 - bend * p / 4.8)))
    assert found.verdict == verdict
    assert found.number == pytest.approx(bend, abs=0.04)


def test_hardening_is_not_distinguished_from_two_materials() -> None:
    answer = checked("beam hardening", scan(None, [*SOLID, Ellipsoid((2, 1, 0), (2, 2, 2), 3.0)]))
    assert "not of one material" in str(answer)


def test_the_command_writes_a_page_and_holds_a_gate(tmp_path: Path) -> None:
    folder, page = tmp_path / "scan", tmp_path / "page.html"
    save_scan(folder, changed(scan(), lambda values: values * 1.1))
    result = nerfcli("ct", "doctor", folder, "-o", page, "--json", "--require", "look")
    record = json.loads(result.stdout)
    assert record["verdict"] == "bad"
    assert {each["check"] for each in record["findings"]} <= set(CHECKS)
    text = page.read_text()
    assert "Sinogram" in text
    assert "have I &gt; I0" in text
    assert result.exit_code == GATE_NOT_MET
    assert "open beam (bad)" in error_of(result)[0]


def test_flats_determine_the_number_of_photons() -> None:
    """Known truth, within 5 %: 8000 photons a pixel at a gain of 0.25 values a photon, with read noise and drift."""
    from nerfcli.ct.formats.assemble import open_beam_of

    rng = np.random.default_rng(0)
    lamp = 1 + 0.02 * rng.normal(size=(12, 1, 1))
    flats = 50 + 0.25 * rng.poisson(8000 * lamp * np.ones((12, 40, 40))) + rng.normal(0, 12, (12, 40, 40))
    darks = 50 + rng.normal(0, 12, (12, 40, 40))
    found = open_beam_of(flats, darks, projections=(1, 40, 40), path=Path())
    assert found.photons_per_value == pytest.approx(4.0, rel=0.05)
    assert float(found.values.mean()) == pytest.approx(2000, rel=0.01)
