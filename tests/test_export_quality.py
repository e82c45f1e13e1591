"""Tolerance and alpha in the files that are written, and the options that ask for them."""

import json

import numpy as np
import pytest
from fog import fog, foggy_cells
from PIL import Image

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.photos.images import read_image
from nerfcli.render.depth import DepthRequest
from nerfcli.render.files.float_maps import read_tiff
from nerfcli.render.frames import export_frames
from nerfcli.render.job import RenderJob
from nerfcli.render.outputs import ExportSettings
from nerfcli.render.tracing import TOLERANCE

VIEW = Frame(
    "a.png", Camera.pinhole(10, 8, 8.0), look_at(np.array([0.0, 0.0, -2.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
)


@pytest.fixture
def views(tmp_path):
    """The export of one view on alpha."""
    settings = ExportSettings(("rgb", "depth"), DepthRequest("conditional", "z", 0.1), rgba=True)
    cells = foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    model = fog(cells, Similarity.identity(), background=(0.2, 0.4, 0.6), step=1 / 32)
    order = RenderJob((VIEW,), settings, {"run": "a run"})
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
    assert facts["tolerance"] == TOLERANCE
    assert 0 <= facts["truncation_of_colour_mean"] <= facts["truncation_of_colour_max"] <= TOLERANCE
    assert facts["pixels_measured"] == 80
    assert facts["quadrature_of_depth_p95"] > 0
    assert "not how close the field is to the scene" in description["error_meaning"]
    _, meta = read_tiff(views / "depth/a.tiff")
    assert {name: meta.error_bounds[name] for name in facts} == facts
    assert meta.error_bounds["meaning"] == description["error_meaning"]
    with Image.open(views / "rgb/a.png") as picture:
        assert picture.info["background"] == "none: straight alpha"
        assert float(picture.info["error truncation_of_colour_max"]) == facts["truncation_of_colour_max"]
    assert description["settings"]["step"] == 1.0
