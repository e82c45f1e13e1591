"""Colours by direction: what is painted, and whether they tell a sky from surfaces."""

import math
from collections.abc import Callable

import pytest
import torch
from present import present
from torch import Tensor

from nerfcli.field.background import SphereBackground
from nerfcli.training.losses import colour_losses
from nerfcli.training.optimiser import Adam
from nerfcli.training.schedule import ROUGHNESS_WEIGHT
from nerfcli.training.trials import explained_by_direction, paint

PHOTOS = 12
PIXELS = 150


def directions_of(count: int, seed: int) -> Tensor:
    """Return directions, uniform on the half of the sphere in front of a wall."""
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    directions[:, 2] = directions[:, 2].abs()
    return torch.nn.functional.normalize(directions, dim=-1)


def gradient(directions: Tensor) -> Tensor:
    """A sky that becomes brighter to one side."""
    return 0.5 + 0.4 * directions[:, :1] * torch.tensor([1.0, 0.5, -0.5])


def test_a_painted_background_has_the_colours_of_its_directions():
    """Directions in one half of the sphere see one colour, in the other half another: both are painted."""
    generator = torch.Generator().manual_seed(0)

    def seen() -> tuple[Tensor, Tensor]:
        directions = torch.nn.functional.normalize(torch.randn(4096, 3, generator=generator), dim=-1)
        above, below = torch.tensor([0.2, 0.4, 0.9]), torch.tensor([0.5, 0.3, 0.1])
        return directions, torch.where(directions[:, 2:] > 0, above, below)

    background = SphereBackground()
    paint(background, seen)
    up, down = background(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])).detach()
    assert up.tolist() == pytest.approx([0.2, 0.4, 0.9], abs=0.08)
    assert down.tolist() == pytest.approx([0.5, 0.3, 0.1], abs=0.08)
    assert background.logits.grad is None or not background.logits.grad.any()


def seen_by_photos(colour: Callable[[Tensor, Tensor], Tensor], *, noise: float = 0.02) -> tuple[Tensor, Tensor, Tensor]:
    """Return pixels of photos at random places in a square of side 2; `colour` takes places and directions."""
    generator = torch.Generator().manual_seed(1)
    photos = torch.arange(PHOTOS).repeat_interleave(PIXELS)
    centres = torch.cat([2.0 * torch.rand(PHOTOS, 2, generator=generator) - 1.0, torch.zeros(PHOTOS, 1)], dim=1)
    directions = directions_of(len(photos), seed=2)
    colours = colour(centres[photos], directions) + noise * torch.randn(len(photos), 3, generator=generator)
    return directions, colours.clamp(0.0, 1.0), photos


def stripes(places: Tensor, directions: Tensor) -> Tensor:
    """Return colours of a wall at distance 1, in stripes about as wide as the photos are apart."""
    on_wall = places + directions / directions[:, 2:].clamp_min(0.1)
    return 0.5 + 0.4 * torch.sin(4.0 * on_wall[:, :1]).sign().expand(-1, 3)


def test_directions_predict_the_colours_of_a_sky_but_not_of_surfaces():
    one, painted = explained_by_direction(*seen_by_photos(lambda places, directions: gradient(directions)))
    assert painted > max(25.0, one + 6.0)
    one, painted = explained_by_direction(*seen_by_photos(stripes))
    assert painted < one + 0.5 < 10.0


@pytest.mark.parametrize("level", [0.5, 0.8, 1.0, 0.0])
def test_a_sky_of_one_colour_is_recognized_by_directions_too(level):
    """Overcast, burnt out or black; noise of a small camera, 2 % of the range, is 34 dB."""
    seen = seen_by_photos(lambda places, directions: torch.full((len(places), 3), level))
    assert min(explained_by_direction(*seen)) > 30.0


def test_directions_without_evidence_have_the_single_colour():
    """Photos that look right are explained by those that look left, which saw none of their directions."""
    directions, colours, photos = seen_by_photos(lambda places, directions: torch.full((len(places), 3), 0.9))
    directions[:, 0] = directions[:, 0].abs() * (1 - 2 * (photos % 2))
    assert min(explained_by_direction(directions, colours, photos)) > 25.0


def test_too_few_pixels_give_no_estimate():
    directions, colours, photos = seen_by_photos(stripes)
    few = torch.cat([torch.nonzero(photos % 2 == 0)[:, 0], torch.nonzero(photos % 2 == 1)[:11, 0]])
    none = torch.zeros(0, dtype=torch.long)
    for chosen in (few, none):
        assert explained_by_direction(directions[chosen], colours[chosen], photos[chosen]) == (math.inf, math.inf)


def test_the_result_is_the_same_without_gradients():
    with torch.no_grad():
        result = explained_by_direction(*seen_by_photos(stripes))
    assert result == explained_by_direction(*seen_by_photos(stripes))


def test_roughness_is_the_sum_of_squared_differences_between_neighbours():
    """Closed form of a linear function, 4 x 4 x 3 pairs along each axis and colour; one vertex has no neighbour."""
    background = SphereBackground(4)
    x = torch.arange(4.0)
    background.logits.data[:] = 2.0 * x[None, None, None, :] + 0.5 * x[None, None, :, None]
    assert float(background.roughness().detach()) == pytest.approx(3 * 4 * 4 * 3 * (2.0**2 + 0.5**2))
    assert float(SphereBackground(1).roughness().detach()) == 0.0


def test_the_gradient_of_roughness_moves_each_vertex_towards_its_neighbours():
    """Against differences in float64, and the Laplacian of a single raised vertex."""
    background = SphereBackground(3).double()
    generator = torch.Generator().manual_seed(0)
    background.logits.data[:] = torch.randn(background.logits.shape, generator=generator, dtype=torch.float64)

    def roughness(logits: Tensor) -> Tensor:
        return torch.func.functional_call(background, {"logits": logits}, (), tie_weights=False)

    background.forward = lambda: background.roughness()  # type: ignore[method-assign]
    assert torch.autograd.gradcheck(roughness, (background.logits,))
    background.logits.data.zero_()
    background.logits.data[0, 1, 1, 1] = 1.0
    background.roughness().backward()
    gradient = present(background.logits.grad)
    assert float(gradient[0, 1, 1, 1]) == 2.0 * 6
    assert float(gradient[0, 1, 1, 2]) == -2.0
    assert float(gradient[0, 0, 0, 0]) == float(gradient[1, 1, 1, 1]) == 0.0


@pytest.mark.parametrize("weight", [0.0, ROUGHNESS_WEIGHT])
def test_directions_behind_surfaces_take_the_colours_of_the_sky_beside_them(weight):
    """Above the horizon all photos see a blue sky; below, surfaces let 0.1 % of the light pass and look too red.

    Without roughness the directions behind the surfaces become as red as they can.
    """
    generator = torch.Generator().manual_seed(0)
    sky, background = torch.tensor([0.3, 0.5, 0.9]), SphereBackground()
    adam = Adam(background.parameters())
    for _ in range(150):
        directions = torch.nn.functional.normalize(torch.randn(1024, 3, generator=generator), dim=-1)
        above = directions[:, 2:] > 0
        transmittance = torch.where(above, 1.0, 1e-3)
        surface = torch.where(above, torch.zeros(3), torch.tensor([0.4, 0.5, 0.5]))
        photo = torch.where(above, sky, torch.tensor([0.5, 0.4, 0.4]))
        losses = colour_losses(surface + transmittance * background(directions), photo)
        adam.zero_grad()
        (losses.mean() + weight * background.roughness()).backward()
        adam.step(0.1)
    angles = torch.deg2rad(torch.tensor([60.0, -10.0]))
    up, below = background(torch.stack([angles.cos(), torch.zeros(2), angles.sin()], dim=-1)).detach()
    assert up.tolist() == pytest.approx(sky.tolist(), abs=0.03)
    distance = float((below - sky).abs().max())
    assert distance < 0.15 if weight else distance > 0.5
