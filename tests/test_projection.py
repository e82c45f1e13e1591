"""Line integrals through voxels: against closed forms, their transpose, and the compiled kernels."""

import numpy as np
import pytest
import torch
from conftest import TOLERANCE
from examples import examples
from hypothesis import given
from hypothesis import strategies as st

from nerfcli.ct.geometry import Circle
from nerfcli.ct.grid import VoxelGrid, centred_grid, grid_of_scan
from nerfcli.kernels import numba_cpu, reference

GRID = {"first": (-2.5, -1.5, -2.0), "size": 0.5}
SHAPE = (9, 7, 11)


def lines(count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Lines in all directions, some along axes, some that miss, some through centres of voxels."""
    origins = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 3
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    directions[::7, 1] = 0
    directions[::11, :2] = 0
    origins[::5] = torch.tensor([-2.5, 0.0, -1.0], dtype=torch.float64)
    return origins, directions


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_constant_slab_gives_its_thickness(dtype: torch.dtype) -> None:
    """Closed form: n layers of value v, crossed at slope s, integrate to v n size sqrt(1 + s^2)."""
    volume = torch.full((40, 40, 10), 0.3, dtype=dtype)
    slopes = torch.tensor([0.0, 0.1, 0.7, -0.99], dtype=torch.float64)
    directions = torch.stack([torch.ones(4, dtype=torch.float64), slopes, torch.zeros(4, dtype=torch.float64)], 1)
    origins = torch.zeros(4, 3, dtype=torch.float64)
    found = reference.project(volume, origins, directions, first=(-4.5, -19.5, -19.5), size=1.0)
    expected = 0.3 * 10 * torch.sqrt(1 + slopes**2)
    torch.testing.assert_close(found.double(), expected, rtol=TOLERANCE[dtype], atol=0)


def test_linear_volume_is_integrated_exactly() -> None:
    """Closed form: the integral of a + b y along x over whole voxels."""
    y = torch.arange(8, dtype=torch.float64)
    volume = (1 + 0.25 * y)[None, :, None].expand(3, 8, 6).contiguous()
    origins = torch.tensor([[0.0, 2.3, 1.0]], dtype=torch.float64)
    directions = torch.tensor([[2.0, 0.1, 0.0]], dtype=torch.float64)
    found = reference.project(volume, origins, directions, first=(0.0, 0.0, 0.0), size=1.0)
    heights = 2.3 + 0.05 * torch.arange(6, dtype=torch.float64)
    expected = (1 + 0.25 * heights).sum() * (1 + 0.05**2) ** 0.5
    torch.testing.assert_close(found[0], expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("beam", ["parallel", "fan", "cone"])
def test_error_of_a_smooth_ball_falls_with_the_square_of_the_voxel(beam: str) -> None:
    """Closed form: a Gaussian ball's integral is a Gaussian of the line's distance from its centre."""
    angles = np.linspace(0.1, 3.0, 5)
    if beam == "parallel":
        geometry = Circle("parallel", tuple(angles), 0.4, 0.4, 8, 12).geometry()
    else:
        geometry = Circle("cone", tuple(angles), 0.6, 0.6, 1 if beam == "fan" else 8, 12, 20, 30).geometry()
    origins, directions = (torch.from_numpy(x.reshape(-1, 3)) for x in geometry.rays())
    width, centre = 1.5, torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    apart = torch.linalg.cross(origins - centre, directions).norm(dim=1)
    expected = (2 * torch.pi) ** 0.5 * width * torch.exp(-(apart**2) / (2 * width**2))
    errors = []
    for size in (0.25, 0.125):
        grid = centred_grid((14.0, 14.0, 14.0), size)
        z, y, x = np.meshgrid(*(grid.axis(name) for name in "zyx"), indexing="ij")
        squared = (x - 0.3) ** 2 + (y + 0.2) ** 2 + (z - 0.1) ** 2
        volume = torch.from_numpy(np.exp(-squared / (2 * width**2)))
        found = reference.project(volume, origins, directions, first=grid.first, size=grid.size)
        errors.append(float((found - expected).square().mean().sqrt()))
    assert errors[1] < 1e-2
    assert 3.5 < errors[0] / errors[1] < 5


@examples(40)
@given(count=st.sampled_from([0, 1, 5, 123]), seed=st.integers(0, 2**31), exponent=st.integers(-10, 10))
def test_transpose_is_the_transpose(count: int, seed: int, exponent: int) -> None:
    """<A x, y> = <x, A^T y>, in float64 across magnitudes."""
    generator = torch.Generator().manual_seed(seed)
    origins, directions = lines(count, generator)
    volume = torch.randn(SHAPE, generator=generator, dtype=torch.float64) * 10.0**exponent
    values = torch.randn(count, generator=generator, dtype=torch.float64)
    forward = (reference.project(volume, origins, directions, **GRID) * values).sum()
    backward = (reference.back_project(values, origins, directions, shape=SHAPE, **GRID) * volume).sum()
    torch.testing.assert_close(forward, backward, rtol=1e-10, atol=1e-10 * 10.0**exponent)


@pytest.mark.parametrize("count", [0, 1, 5, 123, 2000])
def test_compiled_kernels_agree(count: int, generator: torch.Generator) -> None:
    origins, directions = lines(count, generator)
    volume = torch.randn(SHAPE, generator=generator)
    values = torch.randn(count, generator=generator)
    found = numba_cpu.project(volume, origins, directions, **GRID)
    expected = reference.project(volume.double(), origins, directions, **GRID)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=5e-6)
    spread = numba_cpu.back_project(values, origins, directions, shape=SHAPE, **GRID)
    transposed = reference.back_project(values.double(), origins, directions, shape=SHAPE, **GRID)
    torch.testing.assert_close(spread.double(), transposed, rtol=0, atol=5e-5)


def test_back_projection_has_the_same_bits_with_one_and_two_threads(generator: torch.Generator) -> None:
    origins, directions = lines(3000, generator)
    values = torch.randn(3000, generator=generator)
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(numba_cpu.back_project(values, origins, directions, shape=SHAPE, **GRID))
    assert torch.equal(*found)


def test_lines_at_the_very_edge_are_finite_and_agree() -> None:
    """Along the outermost voxel centres, half a voxel further, and where interpolation has just become 0."""
    volume = torch.ones(SHAPE)
    edge = -1.5 + 0.5 * np.array([0.0, -0.5, -1.0, -1.0 + 1e-9, 6.0, 6.5, 7.0, 7.0 - 1e-9])
    origins = torch.tensor([[0.0, y, 0.0] for y in edge], dtype=torch.float64)
    directions = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(8, 3).contiguous()
    expected = reference.project(volume.double(), origins, directions, **GRID)
    torch.testing.assert_close(
        numba_cpu.project(volume, origins, directions, **GRID).double(), expected, atol=1e-6, rtol=0
    )
    np.testing.assert_allclose(expected / 5.5, [1, 0.5, 0, 0, 1, 0.5, 0, 0], atol=1e-8)


@pytest.mark.parametrize("module", [reference, numba_cpu])
def test_denoising_keeps_a_flat_volume_and_lowers_total_variation(module: object, generator: torch.Generator) -> None:
    flat = torch.full((5, 6, 7), 0.4)
    threshold = torch.full_like(flat, 0.05)
    assert torch.allclose(module.denoise_total_variation(flat, threshold, torch.zeros(3, 5, 6, 7), iterations=5), flat)  # type: ignore[attr-defined]
    rough = flat + 0.1 * torch.randn(flat.shape, generator=generator)
    smooth = module.denoise_total_variation(rough, threshold, torch.zeros(3, 5, 6, 7), iterations=200)  # type: ignore[attr-defined]
    assert (smooth >= 0).all()
    before, after = (float((x - rough).square().sum() / 0.1 + reference.total_variation(x)) for x in (rough, smooth))
    assert after < before
    for scale in (0.9, 1.1):  # a minimum: the objective rises in both directions away from it
        moved = flat.mean() + scale * (smooth - flat.mean())
        assert float((moved - rough).square().sum() / 0.1 + reference.total_variation(moved)) > after


def test_denoising_of_two_voxels_has_a_closed_form() -> None:
    """Two neighbours move towards each other by the threshold, and meet where they are nearer than twice that."""
    target = torch.tensor([1.0, 2.0], dtype=torch.float64).view(1, 1, 2)
    for limit, expected in ((0.2, [1.2, 1.8]), (0.5, [1.5, 1.5]), (0.9, [1.5, 1.5])):
        threshold = torch.full_like(target, limit)
        dual = torch.zeros(3, 1, 1, 2, dtype=torch.float64)
        found = reference.denoise_total_variation(target, threshold, dual, iterations=500)
        np.testing.assert_allclose(found.view(-1), expected, atol=1e-6)


def test_compiled_denoising_agrees(generator: torch.Generator) -> None:
    for shape in ((1, 1, 1), (1, 5, 4), (6, 1, 3), (5, 6, 7)):
        target = torch.randn(shape, generator=generator)
        threshold = torch.rand(shape, generator=generator) * 0.1 + 0.02
        duals = torch.zeros(3, *shape), torch.zeros(3, *shape, dtype=torch.float64)
        found = numba_cpu.denoise_total_variation(target, threshold, duals[0], iterations=20)
        expected = reference.denoise_total_variation(target.double(), threshold.double(), duals[1], iterations=20)
        torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=0)
        torch.testing.assert_close(duals[0].double(), duals[1], atol=2e-4, rtol=0)


def test_grids_of_a_scan_cover_what_it_sees() -> None:
    geometry = Circle("cone", tuple(np.linspace(0, 6, 7)), 0.3, 0.3, 20, 30, 40, 60).geometry()
    grid = grid_of_scan(geometry)
    assert isinstance(grid, VoxelGrid)
    assert grid.size == pytest.approx(0.2)
    # The outermost ray touches a circle of 40 sin(atan(29/2 * 0.3 / 60)).
    assert -grid.axis("x")[0] + 0.1 == pytest.approx(40 * np.sin(np.arctan(14.5 * 0.3 / 60)), abs=0.2)
