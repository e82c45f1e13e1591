"""Fine cells: air that rays of photos cross is closed, everything else stays as it was, and pictures do not change."""

import numpy as np
import pytest
import torch
from present import present

from nerfcli import kernels
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, from_parts
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model, load_model, save_model
from nerfcli.render.pictures import render_picture
from nerfcli.render.tracing import PictureRays, pixel_rays, render_rays
from nerfcli.render.trained_field import Marching
from nerfcli.training import picture_cells

BLACK = (0.0, 0.0, 0.0)
# Cells along an edge of the cube. All 256 of a training take a minute; `spheres_run` has those.
SIDE = 64


@pytest.mark.parametrize("share", [0.0, 1e-3, 0.02, 1.0])
def test_distances_are_those_of_a_double_loop(share, generator):
    occupied = torch.rand(9, 9, 9, generator=generator) < share
    filled, places = occupied.nonzero(), torch.cartesian_prod(*[torch.arange(9)] * 3)
    apart = (places[:, None] - filled[None]).abs().amax(-1)
    expected = apart.amin(1) if len(filled) else torch.full((9**3,), 255)
    assert torch.equal(kernels.distances_to_occupied(occupied).long().view(-1), expected)


def test_distances_of_a_large_grid_are_those_of_its_blocks(generator):
    occupied = torch.rand(256, 256, 256, generator=generator) < 1e-5
    blocks = occupied.view(128, 2, 128, 2, 128, 2).any(5).any(3).any(1)
    assert torch.equal(kernels.distances_to_occupied(occupied), kernels.distances_to_occupied(blocks))


RADIUS, VERTICES = 0.45, 17


def ball() -> Model:
    """A dense ball in air that the coarse grid leaves open: log density 6 at vertices inside, -12 outside."""
    field = HashField(HashFieldSettings(contraction="none", levels=8, log2_rows=13, coarsest=16, finest=64))
    axis = torch.linspace(-1, 1, VERTICES)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    inside = (x.square() + y.square() + z.square()).sqrt() < RADIUS
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.zero_()
        field.table[0, : VERTICES**3, 0] = torch.where(inside, 1.0, -1.0).view(-1)
        field.weights[0][0, 0], field.weights[0][1, 0] = 1.0, -1.0
        field.weights[1][0, 0], field.weights[1][0, 1] = 6.0, -12.0
    occupied = torch.ones(32, 32, 32, dtype=torch.bool)
    return Model(field, occupied, Marching(0.5, 3.0, 1 / 192, 0.0), BLACK, Similarity(1.0, np.eye(3), np.zeros(3)), "m")


def looking_at_it(angle: float, size: int) -> Frame:
    """A camera on a circle of radius 2 that sees all of the cube."""
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    pose = from_parts(turn, turn @ (0, 0, -2.0))
    return Frame(f"{angle:.2f}", Camera.pinhole(size, size, 0.6 * size), pose)


@pytest.fixture(scope="module")
def models() -> tuple[Model, Model, list[Frame]]:
    """The ball without and with fine cells, found by views from one half of the circle, and new views from there."""
    frames = [looking_at_it(angle, 60) for angle in np.linspace(0, np.pi, 7)]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(picture_cells, "SIDE", SIDE)
        fine = picture_cells.with_picture_cells(ball(), frames)
    return ball(), fine, [looking_at_it(angle, 60) for angle in (0.3, 1.5, 2.9)]


def samples_of(model: Model, rays: PictureRays) -> tuple[int, torch.Tensor]:
    origins = rays.origin.expand_as(rays.directions).contiguous()
    seen = render_rays(model, origins, rays.directions, background=torch.zeros(3), cones=rays.cones)
    return len(seen.intervals.density), seen.rgb


def test_pictures_do_not_change_and_take_fewer_samples(models):
    """Most steps from the border of the cube to the ball are skipped, more than half of all."""
    coarse, fine, frames = models
    for frame in frames:
        pixels = np.arange(60 * 60)
        rays = pixel_rays(frame, fine.training_from_scene, pixels=pixels, device=torch.device("cpu"))
        (before, was), (after, now) = samples_of(coarse, rays), samples_of(fine, rays)
        assert after < 0.5 * before
        assert (was - now).abs().max() < 1 / 255
        request = DepthRequest("median", "ray")
        one, other = (render_picture(model, frame, background=BLACK, depth=request) for model in models[:2])
        np.testing.assert_allclose(present(one.depth), present(other.depth), rtol=1e-3)


def test_only_crossed_cells_without_content_are_closed(models):
    """The air before the ball is closed, the ball and its inside, which no ray reaches, stay open."""
    _, fine, _ = models
    centres = (torch.arange(SIDE) + 0.5) / SIDE * 2 - 1
    z, y, x = torch.meshgrid(centres, centres, centres, indexing="ij")
    radius = (x.square() + y.square() + z.square()).sqrt()
    spacing = 2 / (VERTICES - 1)
    assert fine.open_cells[radius < RADIUS - 2 * spacing].all()
    seen = (radius > RADIUS + 2 * spacing) & (radius < 0.9)
    assert fine.open_cells[seen].float().mean() < 0.5
    behind = seen & (x > 0.5)  # where no photo looks from; rays past the ball cross some of it
    assert fine.open_cells[behind].float().mean() >= fine.open_cells[seen].float().mean()


def test_fine_cells_are_in_the_file_if_there_are_any(models, tmp_path):
    coarse, fine, frames = models
    save_model(tmp_path / "fine", fine)
    save_model(tmp_path / "coarse", coarse)
    again, without = load_model(tmp_path / "fine", "cpu"), load_model(tmp_path / "coarse", "cpu")
    assert without.fine is None
    assert torch.equal(present(again.fine), fine.open_cells)
    assert (tmp_path / "fine").stat().st_size - (tmp_path / "coarse").stat().st_size < 1.01 * SIDE**3 / 8 + 1000
    frame = frames[0]
    pictures = [render_picture(model, frame, background=BLACK).rgb for model in (fine, again, coarse, without)]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[2], pictures[3])
