"""The phantom itself: its chords beside quadrature, and beside the closed form of a sphere."""

from pathlib import Path

import make_phantom
import numpy as np
import pytest
import tifffile
import torch
from commands import error_of, nerfcli
from ellipsoids import Ellipsoid, attenuation_at, attenuation_of_voxels, bean, line_integrals
from scan_of_phantom import transmissions

from nerfcli.ct.convert import read_scan
from nerfcli.ct.likelihood import likelihood_of
from nerfcli.ct.scan import load_truth

PHANTOM = Path(__file__).parent.parent / "sample_scenes" / "phantom"


def test_line_integrals_are_those_of_quadrature() -> None:
    """Independent: a sum of the attenuation at 200,000 points of each line."""
    rng = np.random.default_rng(3)
    origins = rng.normal(0, 3, (6, 3))
    directions = rng.normal(0, 1, (6, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    t = (np.arange(200_000) + 0.5) / 200_000 * 60 - 30
    along = origins[:, None] + t[:, None] * directions[:, None]
    expected = attenuation_at(bean(), along).sum(1) * 60 / len(t)
    assert line_integrals(bean(), origins, directions) == pytest.approx(expected, abs=2e-4)


def test_mass_of_voxels_is_the_volume_of_the_ellipsoid() -> None:
    """Closed form: 4/3 pi abc times the attenuation, of a tilted ellipsoid; 1 % for voxels of 1/8 of a semi-axis."""
    solid = Ellipsoid((0.3, -0.2, 0.1), (3, 2, 2.5), 0.7, turn=0.4, tilt=1.1)
    axis = (np.arange(28) - 13.5) * 0.25
    voxels = attenuation_of_voxels([solid], x=axis, y=axis, z=axis, samples=2)
    assert voxels.sum() * 0.25**3 == pytest.approx(0.7 * 4 / 3 * np.pi * 3 * 2 * 2.5, rel=0.01)


def test_the_sample_scan_follows_its_statement(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Chords along the rays read from scan.json leave only noise in the counts; the script states its geometry
    independently of the program. Running the script again writes the same files.
    """
    scan = read_scan(PHANTOM)
    assert (scan.geometry.views, scan.geometry.rows, scan.geometry.columns) == (48, 48, 64)
    every, n = np.arange(scan.geometry.views), make_phantom.SUBPIXELS
    passed = transmissions(scan.geometry, rows=n, columns=n)
    integrals = torch.from_numpy(-np.log(passed).reshape(len(every), -1)).float()
    deviance = likelihood_of(scan, every).deviance(integrals, torch.from_numpy(every))
    # The flats are counts, too: their mean adds its own variance, in proportion to what passes.
    assert float(deviance.mean()) == pytest.approx(1 + passed.mean() / make_phantom.FLATS, abs=0.02)
    truth = load_truth(scan.history)
    assert truth is not None
    grid, volume = truth
    mass = sum(p.attenuation * 4 / 3 * np.pi * np.prod(p.semi_axes) for p in bean())
    assert float(volume.sum()) * grid.size**3 == pytest.approx(mass, rel=2e-3)
    monkeypatch.setattr("sys.argv", ["make_phantom.py", "--out", str(tmp_path)])
    make_phantom.main()
    for name in ("projections.tif", "flats.tif", "darks.tif"):
        np.testing.assert_array_equal(tifffile.imread(tmp_path / name), tifffile.imread(PHANTOM / name))
    np.testing.assert_array_equal(np.load(tmp_path / "truth" / "volume.npy"), np.load(PHANTOM / "truth" / "volume.npy"))
    assert (tmp_path / "scan.json").read_text() == (PHANTOM / "scan.json").read_text()


def test_train_asks_to_convert_the_sample_scan(tmp_path: Path) -> None:
    error, hint = error_of(nerfcli("ct", "train", PHANTOM, "-o", tmp_path / "run"))
    assert error == f"Error: {PHANTOM} is a scan in a scanner's format"
    assert hint == f"Hint:  convert it first: nerfcli ct convert {PHANTOM} SCAN"
    assert not (tmp_path / "run").exists()
