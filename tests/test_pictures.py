"""Pictures: the same bits for every tile, samples per pixel as mixtures, and bounds that hold."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fog import SIDE, STEP, fog, foggy_cells

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.run_cameras import read_cameras
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts
from nerfcli.field.hash_field import HashField
from nerfcli.render import pictures
from nerfcli.render.accuracy import IN_WORDS, measure_error, refined, truncation_bounds
from nerfcli.render.depth import CONVENTIONS, DepthRequest
from nerfcli.render.model import Model, load_model
from nerfcli.render.pictures import Quality, RenderedPicture, render_picture, straight_rgba
from nerfcli.render.rays import places_in_pixel
from nerfcli.runs.files import FIELD

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


@pytest.mark.parametrize("samples", [1, 3])
def test_no_bit_depends_on_tiles_or_threads(samples, trained, monkeypatch):
    model, frame = trained
    options = {"background": BLACK, "depth": DepthRequest("median", "z", 0.1), "quality": Quality(1e-3, samples)}
    whole = render_picture(model, frame, **options)
    assert whole.depth is not None
    assert 0.1 < np.isfinite(whole.depth).mean() < 0.9
    for tile, threads in ((1, 2), (7, 1), (64, 2), (4095, 1)):
        torch.set_num_threads(threads)
        counts: list[int] = []
        tiled = render_picture(model, frame, on_tile=counts.append, rays_per_tile=tile, **options)
        assert same_bits(tiled, whole) == []
        assert sum(counts) == 16 * 12
        assert len(counts) == -(-16 * 12 // max(1, tile // samples))
    monkeypatch.setattr(pictures, "RAYS_PER_BLOCK", 50)
    assert same_bits(render_picture(model, frame, **options), whole) == []


@pytest.mark.parametrize("background", [BLACK, (1.0, 0.5, 0.25)])
def test_what_is_left_out_stays_within_the_bound_and_the_tolerance(background, trained):
    model, frame = trained
    exact = render_picture(model, frame, background=background, quality=Quality(1e-7))
    previous = np.inf
    for tolerance in (0.2, 1 / 255, 1e-4):
        picture = render_picture(model, frame, background=background, quality=Quality(tolerance))
        difference = np.abs(picture.rgb - exact.rgb).max(-1)
        # Sums of float32 colours differ in their last digits.
        assert (difference <= picture.truncation_error + 1e-6).all()
        assert picture.truncation_error.max() <= tolerance
        assert 0 < picture.truncation_error.max() < previous
        previous = picture.truncation_error.max()
    assert truncation_bounds(picture, 1e-4)["truncation_of_colour_max"] == pytest.approx(previous)


def test_a_ray_that_sees_all_misses_nothing():
    # Fog of optical depth 1/2 in front of a background: no early stop, and every sample's colour is evaluated.
    picture = render_picture(
        fog(foggy_cells((-1, -1, 0), (1, 1, 0.5)), Similarity.identity()), TOWARDS, background=BLACK
    )
    assert picture.opacity.max() > 0.3
    assert picture.truncation_error.max() == 0


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 16])
def test_places_in_a_pixel_take_every_row_and_column_once(count):
    places = places_in_pixel(count)
    for axis in range(2):
        np.testing.assert_allclose(np.sort(places[:, axis]), (np.arange(count) + 0.5) / count, rtol=1e-15)
    np.testing.assert_allclose(places.mean(0), 0.5, rtol=1e-12)


def test_four_places_fill_the_quarters_of_a_pixel():
    assert len({(x >= 0.5, y >= 0.5) for x, y in places_in_pixel(4)}) == 4


# Two cameras that look along +z at right angles to walls.
TOWARDS = Frame("view", Camera.pinhole(32, 32, 32.0), from_parts(np.eye(3), np.array([0.0, 0.0, -1.0])))
COARSE = Frame("view", Camera.pinhole(2, 2, 4.0), from_parts(np.eye(3), np.array([0.0, 0.0, -1.0])))


def two_walls() -> Model:
    """Return dense walls: the front one covers the outer part of the left pixels, the back one covers everything."""
    cells = foggy_cells((-1, -1, 0.5), (1, 1, 1)) | foggy_cells((-1, -1, -0.5), (-0.15, 1, 0.0))
    dense = fog(cells, Similarity.identity())
    assert isinstance(dense.field, HashField)
    with torch.no_grad():
        dense.field.weights[1].zero_()
        dense.field.weights[1][0, 0] = 6.0  # density exp(6)
    return dense


@pytest.mark.parametrize("convention", [*CONVENTIONS, "quantile:0.3", "quantile:0.8"])
def test_a_pixel_of_several_samples_is_their_mixture(convention):
    model = two_walls()
    request = DepthRequest(convention, "z", 0.5, 9.0)
    picture = render_picture(model, COARSE, background=BLACK, depth=request, quality=Quality(1e-6, 8))
    # Each place rendered alone sees one wall or the other; the pixel is the mixture of these.
    alone = [_at_place(model, place, request) for place in places_in_pixel(8)]
    z, mass = np.array([a for a, _ in alone]), np.array([b for _, b in alone])
    near = (z < 1).mean()
    assert 0 < near < 1
    assert picture.depth is not None
    value = picture.depth[0, 0]
    match convention:
        case "conditional" | "moment" | "background":
            expected = (z * mass).sum() / mass.sum()
        case "max-weight":
            expected = z.min() if near > 0 else z.max()
        case _:
            fraction = request.fraction
            assert fraction is not None
            expected = np.sort(z)[int(np.floor(fraction * 8))]
    assert value == pytest.approx(expected, abs=3 * STEP)
    assert picture.spread is not None
    assert picture.spread[0, 0] == pytest.approx(z.std(), abs=3 * STEP)


def _at_place(model: Model, place: np.ndarray, request: DepthRequest) -> tuple[float, float]:
    """Return conditional z and opacity at one place in pixel (0, 0) of `COARSE`, rendered as a picture of its own."""
    camera = Camera("PINHOLE", 2, 2, (4.0, 4.0, 1.0 - (place[0] - 0.5), 1.0 - (place[1] - 0.5)))
    picture = render_picture(
        model,
        replace(COARSE, camera=camera),
        background=BLACK,
        depth=replace(request, convention="conditional"),
        quality=Quality(1e-6),
    )
    assert picture.depth is not None
    return float(picture.depth[0, 0]), float(picture.opacity[0, 0])


def test_samples_per_pixel_bring_the_mean_over_the_pixel_nearer(trained):
    model, frame = trained
    fine = replace(frame, camera=frame.camera.resized(16 * 8, 12 * 8))
    truth = render_picture(model, fine, background=BLACK).rgb.reshape(12, 8, 16, 8, 3).mean((1, 3))
    errors = [
        np.sqrt(((render_picture(model, frame, background=BLACK, quality=Quality(1e-3, n)).rgb - truth) ** 2).mean())
        for n in (1, 4, 16)
    ]
    assert errors[1] < errors[0] / 2
    assert errors[2] < errors[1] / 1.5


def test_black_background_is_premultiplied():
    model, frame = two_walls(), TOWARDS
    on_black = render_picture(model, frame, background=BLACK)
    on_white = render_picture(model, frame, background=(1.0, 1.0, 1.0))
    np.testing.assert_allclose(
        on_white.rgb, on_black.rgb + (1 - on_black.opacity[..., None]), atol=2e-6, err_msg="alpha compositing"
    )


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
    assert refined(cuts, 1).tolist() == cuts.tolist()
    assert refined(cuts, 2).tolist() == [0.0, 0.5, 1.0, 2.5, 4.0, 4.5, 5.0]


def test_quadrature_error_shrinks_with_the_step_and_repeats():
    # The only error is at the borders of the fog, which fall somewhere inside of an interval.
    request = DepthRequest("conditional", "z", 0.1)
    cells = foggy_cells((-1, -1, 0), (1, 1, 4 / SIDE))
    coarse, fine = (
        measure_error(fog(cells, Similarity.identity(), step=step), TOWARDS, depth=request, tolerance=1e-3)
        for step in (1 / 20, 1 / 160)
    )
    for name in ("colour", "depth"):
        one, other = getattr(coarse, name), getattr(fine, name)
        assert one.values == other.values == 256
        assert one.percentile_95 / other.percentile_95 == pytest.approx(8, rel=0.5)
    again = measure_error(fog(cells, Similarity.identity(), step=1 / 20), TOWARDS, depth=request, tolerance=1e-3)
    assert again == coarse
    assert "not how close the field is to the scene" in IN_WORDS
    assert coarse.depth is not None
    assert coarse.to_json()["quadrature_of_depth_p95"] == coarse.depth.percentile_95
    without = measure_error(fog(cells, Similarity.identity(), step=1 / 20), TOWARDS, depth=None, tolerance=1e-3)
    assert without.depth is None
    assert without.colour == coarse.colour
    assert not [name for name in without.to_json() if "depth" in name]
