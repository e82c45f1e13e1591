"""Pictures: the same bits for every tile, and bounds that hold."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fog import SIDE, fog, foggy_cells
from present import present

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts
from nerfcli.captures.formats.run_cameras import read_cameras
from nerfcli.field.hash_field import HashField
from nerfcli.render import pictures
from nerfcli.render.accuracy import IN_WORDS, measure_error, refine_cuts, truncation_bounds
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model, load_model
from nerfcli.render.pictures import RenderedPicture, render_picture, straight_rgba
from nerfcli.training.runs.files import FIELD

BLACK = (0.0, 0.0, 0.0)
MAPS = ("rgb", "opacity", "depth", "spread", "disagreement", "median", "truncation_error", "valid")


@pytest.fixture(scope="module")
def trained(spheres_run: Path) -> tuple[Model, Frame]:
    """A trained field of the real size, so that the compiled kernels run, and a small view of it."""
    frame = read_cameras(spheres_run).test[0]
    return load_model(spheres_run / FIELD, "cpu"), replace(frame, camera=frame.camera.resized(16, 12))


def same_bits(one: RenderedPicture, other: RenderedPicture) -> list[str]:
    """Return the names of the maps that differ in any bit."""
    return [name for name in MAPS if not np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)]


def test_no_bit_depends_on_tiles_or_threads(trained, monkeypatch):
    model, frame = trained
    options = {"background": BLACK, "depth": DepthRequest("median", "z", 0.1), "tolerance": 1e-3}
    whole = render_picture(model, frame, **options)
    assert 0.1 < np.isfinite(present(whole.depth)).mean() < 0.9
    for tile, threads in ((1, 2), (7, 1), (64, 2), (4095, 1)):
        torch.set_num_threads(threads)
        counts: list[int] = []
        monkeypatch.setattr(pictures, "RAYS_PER_TILE", tile)
        tiled = render_picture(model, frame, on_tile=counts.append, **options)
        assert same_bits(tiled, whole) == []
        assert sum(counts) == 16 * 12
        assert len(counts) == -(-16 * 12 // tile)
    monkeypatch.setattr(pictures, "RAYS_PER_BLOCK", 50)
    assert same_bits(render_picture(model, frame, **options), whole) == []


@pytest.mark.parametrize("background", [BLACK, (1.0, 0.5, 0.25)])
def test_what_is_left_out_stays_within_the_bound_and_the_tolerance(background, trained):
    model, frame = trained
    exact = render_picture(model, frame, background=background, tolerance=1e-7)
    previous = np.inf
    for tolerance in (0.2, 1 / 255, 1e-4):
        picture = render_picture(model, frame, background=background, tolerance=tolerance)
        difference = np.abs(picture.rgb - exact.rgb).max(-1)
        # Sums of float32 colours differ in their last digits.
        assert (difference <= picture.truncation_error + 1e-6).all()
        assert picture.truncation_error.max() <= tolerance
        assert 0 < picture.truncation_error.max() < previous
        previous = picture.truncation_error.max()
    assert truncation_bounds(picture, 1e-4)["truncation_of_colour_max"] == pytest.approx(previous)


def test_a_ray_that_sees_all_misses_nothing():
    # Fog of optical depth 1/2 in front of a background: no early stop, and every sample's colour is evaluated.
    model = fog(foggy_cells((-1, -1, 0), (1, 1, 0.5)), Similarity.identity())
    picture = render_picture(model, TOWARDS, background=BLACK)
    assert picture.opacity.max() > 0.3
    assert picture.truncation_error.max() == 0


# A camera that looks along +z at right angles to walls.
TOWARDS = Frame("view", Camera.pinhole(32, 32, 32.0), from_parts(np.eye(3), np.array([0.0, 0.0, -1.0])))


def two_walls() -> Model:
    """Return dense walls: the front one covers the outer part of the left pixels, the back one covers everything."""
    cells = foggy_cells((-1, -1, 0.5), (1, 1, 1)) | foggy_cells((-1, -1, -0.5), (-0.15, 1, 0.0))
    dense = fog(cells, Similarity.identity())
    assert isinstance(dense.field, HashField)
    with torch.no_grad():
        dense.field.weights[1].zero_()
        dense.field.weights[1][0, 0] = 6.0  # density exp(6)
    return dense


def test_black_background_is_premultiplied():
    model, frame = two_walls(), TOWARDS
    on_black = render_picture(model, frame, background=BLACK)
    on_white = render_picture(model, frame, background=(1.0, 1.0, 1.0))
    composited = on_black.rgb + (1 - on_black.opacity[..., None])
    np.testing.assert_allclose(on_white.rgb, composited, atol=2e-6)


def test_straight_alpha_is_the_colour_of_what_is_there():
    # Fog of colour 1/2 everywhere: straight colours are 1/2 wherever there is any.
    model = fog(foggy_cells((-1, -1, 0), (0.3, 1, 0.5)), Similarity.identity())
    picture = render_picture(model, TOWARDS, background=BLACK)
    rgba = straight_rgba(picture)
    there = picture.opacity > 0
    assert 0.2 < there.mean() < 0.9
    np.testing.assert_allclose(rgba[there][:, :3], 0.5, rtol=1e-5)
    np.testing.assert_array_equal(rgba[~there], 0)
    np.testing.assert_array_equal(rgba[..., 3], picture.opacity)


def test_steps_twice_as_long_are_the_steps_of_such_a_training(trained):
    model, frame = trained
    marching = replace(model.marching, shortest_step=2 * model.marching.shortest_step, growth=2 * model.marching.growth)
    made = replace(model, marching=marching)
    options = {"background": BLACK, "depth": DepthRequest("median", "z", 0.1)}
    assert same_bits(*(render_picture(one, frame, **options) for one in (model.stretched(2.0), made))) == []
    assert model.stretched(1.0) == model


def test_refined_cuts_keep_the_cuts():
    cuts = torch.tensor([0.0, 1.0, 4.0, 5.0], dtype=torch.float64)
    assert refine_cuts(cuts, 1).tolist() == cuts.tolist()
    assert refine_cuts(cuts, 2).tolist() == [0.0, 0.5, 1.0, 2.5, 4.0, 4.5, 5.0]


def test_quadrature_error_shrinks_with_the_step_and_repeats():
    # The only error is at the borders of the fog, which fall somewhere inside of an interval.
    request = DepthRequest("conditional", "z", 0.1)
    cells = foggy_cells((-1, -1, 0), (1, 1, 4 / SIDE))
    foggy = [fog(cells, Similarity.identity(), step=step) for step in (1 / 20, 1 / 160)]
    coarse, fine = (measure_error(model, TOWARDS, depth=request) for model in foggy)
    assert coarse["pixels_measured"] == fine["pixels_measured"] == 256
    for name in ("quadrature_of_colour_p95", "quadrature_of_depth_p95"):
        assert coarse[name] / fine[name] == pytest.approx(8, rel=0.5)
    again = measure_error(fog(cells, Similarity.identity(), step=1 / 20), TOWARDS, depth=request)
    assert again == coarse
    assert "not how close the field is to the scene" in IN_WORDS
    without = measure_error(fog(cells, Similarity.identity(), step=1 / 20), TOWARDS, depth=None)
    assert without == {name: value for name, value in coarse.items() if "depth" not in name}
