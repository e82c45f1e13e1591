"""The kinds of fields: interpolation against SciPy, harmonics and features in closed form, gradients, checkpoints."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from kernel_parts import radiance_of
from pools import pool_of_photos
from present import present
from scipy.ndimage import map_coordinates

from nerfcli.cameras.rigid import Similarity, rotation_from_quaternion
from nerfcli.captures.capture import Capture
from nerfcli.errors import BAD_INPUT, UserError
from nerfcli.field.fourier_field import FourierField, FourierFieldSettings, fourier_features
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.interface import Field, FieldSettings
from nerfcli.field.kinds import KINDS, fresh_field, settings_from_json
from nerfcli.field.voxel_field import VoxelField, VoxelFieldSettings
from nerfcli.kernels import HashGrid, March, Rays, RaySums, Targets, spherical_harmonics
from nerfcli.photos.loading import load_photos
from nerfcli.render.model import Model, load_model, save_model
from nerfcli.render.trained_field import Marching
from nerfcli.training import fitting
from nerfcli.training.extent import Extent
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.optimiser import FieldOptimiser
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.step import row_decay

DEFAULTS = Components()
SMALL: dict[str, FieldSettings] = {
    "hash": HashFieldSettings(contraction="none", log2_rows=8, coarsest=4, finest=32),
    "voxels": VoxelFieldSettings(contraction="none", view_degree=2, log2_vertices=9),
    "mlp": FourierFieldSettings(contraction="none", octaves=4, width=16, layers=2),
}


@pytest.fixture(params=KINDS)
def field(request: pytest.FixtureRequest) -> Field:
    """A field of each kind whose numbers are not small."""
    torch.manual_seed(0)
    made = fresh_field(SMALL[request.param])
    if (rows := made.rows()) is not None:
        with torch.no_grad():
            rows.normal_()
    return made


def places(count: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(1), dtype=dtype)


def looks(count: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    g = torch.Generator().manual_seed(2)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=g, dtype=dtype), dim=-1)


def test_every_kind_is_made_here():
    assert set(SMALL) == set(KINDS)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("hash", "hash grid, 8 levels of 4 to 32 cells per axis, 2^8 rows each; networks of width 32"),
        ("voxels", "7x7x7 voxels"),  # 8^3 = 2^9 vertices
        ("mlp", "network of 2 layers of width 16 on 4 octaves of Fourier features"),
    ],
)
def test_every_kind_states_its_size(kind: str, text: str):
    assert SMALL[kind].size_text == text


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_dense_grid_interpolates_as_scipy_does(dtype):
    """Log density and harmonics, by scipy.ndimage.map_coordinates of order 1, borders included."""
    torch.manual_seed(0)
    settings = VoxelFieldSettings(contraction="none", view_degree=1, log2_vertices=10)
    field = VoxelField(settings).to(dtype)
    with torch.no_grad():
        field.table.normal_()
    side = settings.resolution + 1
    corners = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 0.0, 0.5]], dtype=dtype)
    coordinates = torch.cat([places(200, dtype), corners])
    volumes = field.table[:, : side**3].detach().double().numpy().reshape(settings.layers, side, side, side, 4)
    at = (coordinates.double().numpy() * settings.resolution)[:, ::-1].T  # the grid is indexed [z, y, x]
    columns = [map_coordinates(volumes[layer, ..., i], at, order=1) for layer in range(4) for i in range(4)]
    values = np.stack(columns, axis=1)
    directions = looks(len(coordinates), dtype)
    density, rgb = field.radiance(coordinates, directions, torch.arange(len(coordinates)))
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    np.testing.assert_allclose(density.detach().log().numpy(), values[:, 0], atol=tolerance)
    np.testing.assert_allclose(field.density(coordinates).detach().log().numpy(), values[:, 0], atol=tolerance)
    harmonics = spherical_harmonics(directions.double(), 1)[:, :4].numpy()  # those of SciPy, see test_field
    colours = np.einsum("nk,nkc->nc", harmonics, values[:, 1:13].reshape(-1, 4, 3))
    np.testing.assert_allclose(rgb.detach().numpy(), 1 / (1 + np.exp(-colours)), atol=tolerance)


def test_the_dense_grid_has_as_many_cells_as_fit():
    # The cube of vertices fits into the power of two, and the next larger one does not.
    for log2_vertices in range(6, 28):
        side = VoxelFieldSettings(contraction="none", log2_vertices=log2_vertices).resolution + 1
        assert side**3 <= 2**log2_vertices < (side + 1) ** 3


def test_the_network_field_is_its_formula():
    torch.manual_seed(0)
    field = FourierField(FourierFieldSettings(contraction="none", octaves=3, width=8, layers=2)).double()
    coordinates, directions = places(20, torch.float64), looks(4, torch.float64)
    rays = torch.arange(20) // 5
    numbers = {name: value.detach().numpy() for name, value in field.named_parameters()}

    def layer(name: str, x: np.ndarray) -> np.ndarray:
        return x @ numbers[f"{name}.weight"].T + numbers[f"{name}.bias"]

    hidden = fourier_features(2 * coordinates - 1, 3).numpy()
    for name in ("trunk.0", "trunk.2"):
        hidden = np.maximum(layer(name, hidden), 0)
    seen = np.concatenate([hidden, np.asarray(spherical_harmonics(directions)[rays])], axis=1)
    rgb = 1 / (1 + np.exp(-layer("colour.2", np.maximum(layer("colour.0", seen), 0))))
    density, colours = field.radiance(coordinates, directions, rays)
    np.testing.assert_allclose(density.detach().numpy(), np.exp(layer("log_density", hidden)[:, 0]), rtol=1e-12)
    np.testing.assert_allclose(colours.detach().numpy(), rgb, rtol=1e-12)


def test_gradients_of_every_kind(field):
    """gradcheck in float64 of density and colour with respect to all parameters, including rows."""
    field = field.double()
    coordinates, directions = places(3, torch.float64), looks(2, torch.float64)
    rays = torch.tensor([0, 0, 1])
    names = [f"field.{name}" for name, _ in field.named_parameters()]
    chosen = [parameter.detach().clone().requires_grad_() for parameter in field.parameters()]

    def outputs(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        replaced = dict(zip(names, values, strict=True))
        return torch.func.functional_call(_Radiance(field), replaced, (coordinates, directions, rays))

    assert torch.autograd.gradcheck(outputs, chosen, fast_mode=True)


class _Radiance(torch.nn.Module):
    """`radiance_of` as a module."""

    def __init__(self, field: Field):
        super().__init__()
        self.field = field

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return radiance_of(self.field, *inputs)


def test_the_sink_gets_the_gradient_of_the_rows(field):
    """Against autograd, up to the order of sums; the optimiser then changes only rows that a sample touched."""
    directions, background = looks(5), torch.rand(5, 3, generator=torch.Generator().manual_seed(4))
    rays = Rays(-2 * directions, directions, torch.zeros(5))
    march = March(torch.linspace(1, 3, 9), torch.ones(4, 4, 4, dtype=torch.bool), "none", 50.0)
    before = {name: value.detach().clone() for name, value in field.named_parameters()}

    def rendered() -> torch.Tensor:
        return field.backend.render_rays(rays, march, field.medium(), background=background).rgb.sum()

    rows = field.rows()
    wanted = None if rows is None else torch.autograd.grad(rendered(), rows)[0]
    optimiser = FieldOptimiser(field)
    rendered().backward()
    table_grad, touched = field.table_grad, torch.zeros(0)
    if rows is not None and table_grad is not None and wanted is not None:
        assert rows.grad is None
        torch.testing.assert_close(table_grad, wanted, rtol=1e-4, atol=1e-4 * float(wanted.abs().max()))
        touched = (table_grad != 0).any(-1)
        assert touched.any()
    optimiser.step(1, 1e-3, decay=field.row_decay)
    assert table_grad is None or not table_grad.any()
    for name, value in field.named_parameters():
        changed = value != before[name]
        if value is rows:
            assert torch.equal(changed.any(-1), touched)
        else:
            assert changed.float().mean() > 0.5


def test_rows_of_the_hash_grid_decay_where_photos_say_little():
    """The decay of a row of value 0.1 outweighs its gradient of -1e-15: Adam's first step moves it by the full learning
    rate towards zero. Rows without a gradient stay unchanged, and a voxel's row does not decay."""
    for kind, towards_zero in (("hash", 1), ("voxels", -1)):
        field = fresh_field(SMALL[kind])
        optimiser, rows = FieldOptimiser(field), present(field.rows())
        rows.data.fill_(0.1)
        present(field.table_grad).view(-1, 4)[3] = -1e-15
        optimiser.step(1, 1e-3, decay=field.row_decay)
        moved = rows.data.view(-1, 4) - 0.1
        assert (moved[:3] == 0).all()
        assert (moved[4:] == 0).all()
        assert (moved[3] * towards_zero < 0).all()
        if towards_zero > 0:
            torch.testing.assert_close(moved[3], torch.full((4,), -1e-3), rtol=1e-4, atol=0)


def training_of_two_photos(
    scene: Capture, *, has_alpha: bool, log2_rows: int = 8, near: float = 0.1, components: Components = DEFAULTS
) -> Fitting:
    photos = load_photos(scene.train_frames[:2], factor=8, threads=1)
    photos = [replace(photo, pixels=photo.pixels[..., : 3 + has_alpha]) for photo in photos]
    pool = pool_of_photos(photos)
    settings = TrainSettings(
        budget_seconds=None, steps=9, log2_rows=log2_rows, first_samples_per_step=2**20, samples_per_step=2**20,
        components=components,
    )  # fmt: skip
    extent = Extent("none", Similarity.identity(), Marching(near, 4.0, 0.5, 0.0))
    return Fitting(TrainingInputs(settings, extent, pool))


@pytest.mark.parametrize("has_alpha", [True, False])
def test_decay_shrinks_with_the_rays_of_a_step_only_where_photos_have_alpha(has_alpha, spheres, monkeypatch):
    """The law of `row_decay`, and what the optimiser gets in a step of all rays that there may be."""
    training = training_of_two_photos(spheres, has_alpha=has_alpha)
    full = training.field.row_decay
    assert full > 0
    assert [row_decay(training, rays) for rays in (1, 4000)] == [full, full]
    assert row_decay(training, 16000) == (full / 4 if has_alpha else full)
    given: list[float] = []
    monkeypatch.setattr(training.optimiser, "step", lambda number, rate, *, decay: given.append(decay))
    rays = training.advance(0.5).rays
    assert rays > 8000
    assert given == [row_decay(training, rays)]


@pytest.mark.parametrize(("log2_rows", "most"), [(6, 16), (8, 32)])
def test_steps_of_large_tables_have_more_rays(log2_rows, most, spheres, monkeypatch):
    monkeypatch.setattr(fitting, "MOST_RAYS", 16)
    monkeypatch.setattr(fitting, "ROWS_PER_RAY", 8)
    training = training_of_two_photos(spheres, has_alpha=True, log2_rows=log2_rows)
    assert training.advance(0.5).rays == most


@pytest.mark.parametrize(("begin", "near", "wanted"), [(0.12, True, 0.4), (0.6, True, 1.0), (0.12, False, None)])
def test_gradients_are_scaled_up_to_the_nearest_point_or_the_unit_ball(begin, near, wanted, spheres, monkeypatch):
    """Rays begin at 0.3 of the distance of the nearest point."""
    training = training_of_two_photos(spheres, has_alpha=False, near=begin, components=Components(near=near))
    backend, given = training.field.backend, []

    def render_rays(rays: Rays, march: March, medium: HashGrid, targets: Targets, **others: Any) -> RaySums:
        given.append(targets.near)
        return type(backend).render_rays(backend, rays, march, medium, targets, **others)

    monkeypatch.setattr(backend, "render_rays", render_rays)
    training.advance(0.5)
    assert given == [pytest.approx(wanted)]


def test_a_model_of_every_kind_comes_back_bit_for_bit(field, tmp_path):
    frame = Similarity(1 / 3, rotation_from_quaternion(np.array([0.9, 0.1, -0.3, 0.2])), np.array([1.0, -2.0, 0.1]))
    marching = Marching(near=0.1, far=4.0, shortest_step=0.01, growth=1 / 128)
    model = Model(field, torch.rand(4, 4, 4) > 0.5, marching, (0.1, 0.2, 1 / 3), frame, "metre")
    save_model(tmp_path / "a.safetensors", model)
    loaded = load_model(tmp_path / "a.safetensors", "cpu")
    assert loaded.field.settings == field.settings
    assert type(loaded.field) is type(field)
    for name, value in field.state_dict().items():
        assert torch.equal(loaded.field.state_dict()[name], value), name
    assert torch.equal(loaded.occupied, model.occupied)
    assert (loaded.marching, loaded.background, loaded.unit) == (marching, model.background, "metre")
    for name, value in vars(frame).items():
        np.testing.assert_array_equal(getattr(loaded.training_from_scene, name), value)


def test_a_kind_of_a_later_version_is_reported():
    with pytest.raises(UserError, match="unknown type of field: 'gaussians'") as caught:
        settings_from_json({"kind": "gaussians", "contraction": "l2"})
    assert caught.value.exit_code == BAD_INPUT
