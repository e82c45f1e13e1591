"""Formats of scans: pixels by each format's own formula, and the stated circle recovered from stored vectors."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import completed, error_of, nerfcli
from scan_files import WRITERS, Written, nikon, stack

from nerfcli.ct.convert import read_scan
from nerfcli.ct.formats.assemble import axis_column
from nerfcli.ct.formats.statement import ScanOptions
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.recognise import recognise
from nerfcli.ct.scan import load_scan, load_truth


def pixels_by_formula(written: Written, geometry: ScanGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and rows (views, points, 2) of points near the axis, by `pixel_of` and by the format's formula."""
    size = geometry.pixel_at_origin[1]
    points = np.random.default_rng(1).normal(0, 2 * size, (8, 3))
    if geometry.rows == 1:
        points[:, 2] = 0
    views = range(geometry.views)
    by_vectors = np.array([geometry.pixel_of(view, points) for view in views])
    by_formula = np.array([[written.seen(view, point) for point in points] for view in views])
    return by_vectors, by_formula


@pytest.mark.parametrize("form", WRITERS)
def test_points_are_seen_where_the_formula_of_the_format_says(form: str, tmp_path: Path) -> None:
    """Independent: every format's formula turns the object, or is a pinhole camera; 1e-9 px in all views.

    What convert stores is the same.
    """
    written = WRITERS[form](tmp_path)
    assert recognise(written.path) == form
    scan = read_scan(written.path)
    by_vectors, by_formula = pixels_by_formula(written, scan.geometry)
    np.testing.assert_allclose(by_vectors, by_formula, atol=1e-9)
    np.testing.assert_allclose(scan.values, written.values, rtol=1e-6)
    result = completed("ct", "convert", written.path, tmp_path / "out", "--json")
    assert json.loads(result.stdout)["views"] == scan.geometry.views
    stored = load_scan(tmp_path / "out")
    np.testing.assert_allclose(stored.geometry.vectors(), scan.geometry.vectors(), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(stored.values, scan.values)


@pytest.mark.parametrize(("top", "bottom"), [(0.0, 0.0), (5.0, 5.0), (0.4, -0.4)])
@pytest.mark.parametrize("recorded", [False, True])
def test_the_axis_of_nikon_is_moved_and_tilted(top: float, bottom: float, recorded: bool, tmp_path: Path) -> None:
    """Independent: rotation about a tilted axis, as the Core Imaging Library describes these files."""
    written = nikon(tmp_path, top=top, bottom=bottom, recorded=recorded)
    scan = read_scan(written.path)
    by_vectors, by_formula = pixels_by_formula(written, scan.geometry)
    np.testing.assert_allclose(by_vectors, by_formula, atol=1e-9)


@pytest.mark.parametrize(("form", "per_value"), [("r2-gaussian", 1.0), ("transmission-transforms", None)])
def test_the_true_volume_is_found_in_its_unit(form: str, per_value: float | None, tmp_path: Path) -> None:
    """Values of R2-Gaussian are indexed x, y, z; those of transforms are 8-bit, x fastest."""
    found = load_truth(read_scan(WRITERS[form](tmp_path).path).history)
    assert found is not None
    grid, volume = found
    assert volume.shape == grid.shape
    if per_value is None:
        assert volume[1, 2, 3] == pytest.approx(23 * 0.5 / 255)
        assert grid.first == (-1.5, -1.0, -0.5)
    else:
        assert volume[3, 2, 1] == pytest.approx(per_value * (16 * 1 + 4 * 2 + 3))


def test_options_say_more_than_the_file(tmp_path: Path) -> None:
    written = stack(tmp_path)
    plain = read_scan(written.path)
    scan = read_scan(
        written.path, ScanOptions(photons=4e4, unit="mm", centre_column=3.25, holdout="every:4", mirrored=True)
    )
    assert axis_column(plain.geometry) == pytest.approx(5.5)
    assert axis_column(scan.geometry) == pytest.approx(3.25)
    assert scan.photons_per_value == pytest.approx(4e4 / 50000)
    assert scan.held_out == (0, 4, 8)
    assert plain.held_out == (1, 4)
    assert scan.geometry.pixel_at_origin[1] == pytest.approx(plain.geometry.pixel_at_origin[1] / 10)
    np.testing.assert_allclose(scan.geometry.column_step, -plain.geometry.column_step / 10, rtol=1e-12)


def test_a_view_that_is_stated_twice_is_held_out_once(tmp_path: Path) -> None:
    assert read_scan(stack(tmp_path, changed={"held_out": [4, 1, 4]}).path).held_out == (1, 4)


def test_a_scan_is_not_replaced_unless_one_says_so(tmp_path: Path) -> None:
    written = stack(tmp_path)
    out = tmp_path / "o"
    assert nerfcli("ct", "convert", written.path, out).exit_code == 0
    assert error_of(nerfcli("ct", "convert", written.path, out))[0].endswith(" exists")
    assert nerfcli("ct", "convert", written.path, out, "--overwrite").exit_code == 0
    foreign = tmp_path / "mine"
    foreign.mkdir()
    (foreign / "diary.txt").write_text("dear diary")
    assert error_of(nerfcli("ct", "convert", written.path, foreign, "--overwrite"))[0].endswith(" exists")
    assert (foreign / "diary.txt").exists()


def test_scans_of_a_batch_get_names_of_their_own(tmp_path: Path) -> None:
    """Formats fix some names of files; these scans are named after their folders, and others after their files."""
    paths = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        paths.append(WRITERS["r2-gaussian"](tmp_path / name).path / "meta_data.json")
    paths.append(nikon(tmp_path).path)
    result = nerfcli("ct", "convert", "-", tmp_path / "out", stdin="".join(f"{path}\n" for path in paths))
    assert result.stdout.splitlines() == [str(tmp_path / "out" / name) for name in ("a", "b", "bone")]


def test_info_says_what_a_scan_is(tmp_path: Path) -> None:
    written = stack(tmp_path)
    nerfcli("ct", "convert", written.path, tmp_path / "o")
    facts = json.loads(nerfcli("ct", "info", tmp_path / "o", "--json").stdout)
    stated = {"views": 9, "held_out": 2, "detector": "10 x 6 pixels", "beam": "cone", "unit": "mm", "orbit": "a circle"}
    assert {name: facts[name] for name in stated} == stated
    lengths = (facts["magnification"], facts["source_origin"], facts["source_detector"])
    assert lengths == pytest.approx((55 / 41, 410, 550), rel=1e-5)
    assert facts["angles_deg"] == {"from": -250, "to": -10}
    text = nerfcli("ct", "info", tmp_path / "o").stdout
    assert "detector: 10 x 6 pixels" in text
