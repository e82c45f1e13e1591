"""Tolerance and alpha in the files that are written, and the options that ask for them."""

import json

import numpy as np
import pytest
import typer
from fog import fog, foggy_cells
from PIL import Image

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.cli.render_options import tolerance_of
from nerfcli.export.frames import export_frames
from nerfcli.export.order import Order
from nerfcli.export.settings import ExportSettings
from nerfcli.media.float_tiff import read_tiff
from nerfcli.media.images import read_image
from nerfcli.render.depth import DepthRequest

VIEW = Frame(
    "a.png", Camera.pinhole(10, 8, 8.0), look_at(np.array([0.0, 0.0, -2.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
)


@pytest.fixture
def views(tmp_path):
    """The export of one view on alpha, with a tolerance of 1/100."""
    settings = ExportSettings(("rgb", "depth"), DepthRequest("conditional", "z", 0.1), tolerance=0.01, rgba=True)
    cells = foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    model = fog(cells, Similarity.identity(), background=(0.2, 0.4, 0.6), step=1 / 32)
    order = Order((VIEW,), settings, {"run": "a run"})
    export_frames(model, order, tmp_path / "views", on_rays=lambda rays: None, notify=lambda text: None)
    return tmp_path / "views"


def test_alpha_is_straight_and_holds_no_background(views):
    rgba = read_image(views / "rgb/a.png")
    assert rgba.shape == (8, 10, 4)
    there = rgba[..., 3] > 20
    assert 0.2 < there.mean() < 1
    assert np.abs(rgba[there][:, :3].astype(int) - 128).max() <= 1  # the fog's colour is 1/2, its background is not
    assert (rgba[rgba[..., 3] == 0] == 0).all()


def test_every_file_states_the_error_of_its_rendering(views):
    description = json.loads((views / "render.json").read_text())
    facts = description["facts"]["a"]
    assert facts["tolerance"] == 0.01
    assert 0 <= facts["truncation_of_colour_mean"] <= facts["truncation_of_colour_max"] <= 0.01
    assert facts["pixels_measured"] == 80
    assert facts["quadrature_of_depth_p95"] > 0
    assert "not how close the field is to the scene" in description["error_meaning"]
    _, meta = read_tiff(views / "depth/a.tiff")
    assert {name: meta.error_bounds[name] for name in facts} == facts
    assert meta.error_bounds["meaning"] == description["error_meaning"]
    with Image.open(views / "rgb/a.png") as picture:
        assert picture.info["background"] == "none: straight alpha"
        assert float(picture.info["error truncation_of_colour_max"]) == facts["truncation_of_colour_max"]
    assert description["settings"]["tolerance"] == 0.01


@pytest.mark.parametrize(("text", "value"), [("1/255", 1 / 255), ("0.001", 0.001), ("1e-6", 1e-6), (" 1 ", 1.0)])
def test_tolerances_are_fractions_or_numbers(text, value):
    assert tolerance_of(text) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("text", ["0", "1/0", "-1/255", "2", "nan", "inf", "a", "", "1e-30"])
def test_other_tolerances_are_refused(text):
    with pytest.raises(typer.BadParameter, match="write a fraction like 1/255"):
        tolerance_of(text)
