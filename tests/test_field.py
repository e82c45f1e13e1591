"""Encodings, activations and the field: closed forms, SciPy, quadrature; files on disk come back bit for bit."""

import hashlib
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from kernel_parts import density_of, radiance_of
from present import present
from safetensors.torch import save_file
from scipy.special import sph_harm_y

from nerfcli import kernels
from nerfcli.cameras.rigid import Similarity, rotation_from_quaternion
from nerfcli.errors import BAD_INPUT, UserError
from nerfcli.field.checkpoint import load_tensors, save_tensors
from nerfcli.field.fourier_field import fourier_features
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.kernels import spherical_harmonics
from nerfcli.render import model as model_file
from nerfcli.render.model import Model, load_model, save_model
from nerfcli.render.trained_field import Marching
from nerfcli.training.open_cells import uncontract

TINY = HashFieldSettings(contraction="none", levels=3, log2_rows=8, coarsest=4, finest=32, width=16)


def directions_of(polar: np.ndarray, azimuth: np.ndarray) -> torch.Tensor:
    """Unit vectors (..., 3) of spherical angles."""
    xyz = (np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar))
    return torch.from_numpy(np.stack(np.broadcast_arrays(*xyz), axis=-1))


def test_spherical_harmonics_are_scipys_real_combinations():
    # Y_l^m from SciPy has the Condon-Shortley phase (-1)^m, which the real ones leave out.
    rng = np.random.default_rng(0)
    polar, azimuth = np.arccos(rng.uniform(-1, 1, 200)), rng.uniform(0, 2 * math.pi, 200)
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            y = np.asarray(sph_harm_y(degree, abs(order), polar, azimuth)) * (-1) ** order
            columns.append(y.real if order == 0 else math.sqrt(2) * (y.real if order > 0 else y.imag))
    ours = spherical_harmonics(directions_of(polar, azimuth))
    np.testing.assert_allclose(ours.numpy(), np.stack(columns, axis=-1), atol=1e-14)


def test_spherical_harmonics_at_the_poles_have_finite_gradients():
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(spherical_harmonics, poles)


def test_fourier_features_in_their_order_by_a_loop():
    x = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    waves = [(2**octave * math.pi, f) for octave in range(4) for f in (math.sin, math.cos)]
    expected = [[f(rate * value) for value in row for rate, f in waves] for row in x]
    np.testing.assert_allclose(fourier_features(torch.from_numpy(x), 4).numpy(), expected, atol=1e-13)


def test_uncontract_is_the_inverse_of_contract_across_magnitudes():
    g = torch.Generator().manual_seed(0)
    unit = torch.nn.functional.normalize(torch.randn(500, 3, generator=g, dtype=torch.float64), dim=-1)
    points = unit * torch.logspace(-12, 5, 500, dtype=torch.float64)[:, None]
    # The contracted radius 2 - 1/r carries r with a relative error of r * eps.
    torch.testing.assert_close(uncontract(kernels.contract(points)), points, rtol=1e-10, atol=0)
    assert torch.equal(uncontract(torch.zeros(1, 3)), torch.zeros(1, 3))
    assert kernels.contract(torch.tensor([[1e38, 0.0, 0.0]])).tolist() == [[2.0, 0.0, 0.0]]  # no overflow
    assert uncontract(torch.tensor([[2.0, 2.0, 2.0]])).norm().item() == pytest.approx(1e6, rel=1e-6)


def test_coordinates_move_by_at_most_a_quarter():
    """The kernel for skipping empty space relies on it."""
    g = torch.Generator().manual_seed(0)
    radii = torch.logspace(-2, 2, 60, dtype=torch.float64)[:, None]
    points = torch.randn(60, 3, generator=g, dtype=torch.float64) * radii
    near = points + 1e-6 * torch.randn(60, 3, generator=g, dtype=torch.float64)
    moved = kernels.grid_coordinates(near, "l2") - kernels.grid_coordinates(points, "l2")
    assert (moved.abs().amax(-1) <= 0.25 * (near - points).norm(dim=-1) * (1 + 1e-6)).all()


def test_an_unknown_contraction_is_refused():
    with pytest.raises(ValueError, match="contraction must be one of"):
        kernels.grid_coordinates(torch.zeros(1, 3), "l1")


@pytest.mark.parametrize("contraction", kernels.CONTRACTIONS)
@pytest.mark.parametrize("count", [0, 1, 123])
def test_field_shapes_and_ranges(contraction, count):
    field = HashField(replace(TINY, contraction=contraction))
    g = torch.Generator().manual_seed(0)
    coordinates = torch.rand(count, 3, generator=g)
    directions = torch.nn.functional.normalize(torch.randn(7, 3, generator=g), dim=-1)
    density, rgb = radiance_of(field, coordinates, directions, torch.arange(count) * 7 // max(count, 1))
    assert density.shape == (count,)
    assert rgb.shape == (count, 3)
    assert (density > 0).all()
    assert ((rgb > 0) & (rgb < 1)).all()
    torch.testing.assert_close(density_of(field, coordinates), density, rtol=1e-5, atol=0)


def test_a_fresh_field_is_a_thin_grey_fog():
    torch.manual_seed(0)
    field = HashField(HashFieldSettings(contraction="l2", log2_rows=12))
    g = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(1000, 3, generator=g), dim=-1)
    density, rgb = radiance_of(field, torch.rand(1000, 3, generator=g), directions, torch.arange(1000))
    torch.testing.assert_close(density, torch.full((1000,), 1.0), rtol=0.01, atol=0)
    # Grey on average: with random weights, the colour depends on the direction from the start.
    assert (rgb.mean(0) - 0.5).abs().max() < 0.25


@pytest.mark.parametrize("seed", [0, 1])
def test_fresh_networks_are_linear(seed: int):
    """Outputs of sums are sums of outputs: no sign of a weight decides whether a feature can raise the density."""
    torch.manual_seed(seed)
    weights = [weight.detach().double() for weight in HashField(HashFieldSettings(contraction="l2")).weights]
    for network in (weights[:2], weights[2:]):

        def output(inputs: torch.Tensor, network: list[torch.Tensor] = network) -> torch.Tensor:
            for weight in network[:-1]:
                inputs = torch.relu(inputs @ weight.T)
            return inputs @ network[-1].T

        one, other = torch.randn(2, 50, network[0].shape[1], dtype=torch.float64)
        torch.testing.assert_close(output(2 * one - other), 2 * output(one) - output(other))
        assert 0.5 < output(one).std() < 2


@pytest.mark.parametrize(
    ("detail", "learning"), [(None, 6), (-0.1, 3), (0.0, 4), (0.49, 4), (0.51, 5), (1.0, 6), (2.0, 6)]
)
def test_fine_levels_learn_later(detail, learning):
    """Of 6 levels, 4 learn from the start and the others open one by one with the detail; a field read from a file has
    all. Levels that do not learn have no gradient, nor do the weights that read them."""
    field = HashField(replace(TINY, levels=6, finest=64))
    given = {} if detail is None else {"detail": detail}
    directions = torch.nn.functional.normalize(torch.randn(5, 3), dim=-1)
    density, rgb = radiance_of(field, torch.rand(50, 3), directions, torch.arange(50) // 10, **given)
    (density.sum() + rgb.sum()).backward()
    by_weight = field.weights[0].grad
    wanted = [level < learning for level in range(6)]
    assert (present(field.table.grad) != 0).any((1, 2)).tolist() == wanted
    assert (present(by_weight) != 0).any(0).view(6, -1).any(1).tolist() == wanted


def test_resolutions_run_from_coarsest_to_finest_in_geometric_progression():
    sides = HashFieldSettings(contraction="none", levels=5, coarsest=16, finest=256).resolutions
    assert sides == (16, 32, 64, 128, 256)
    assert HashFieldSettings(contraction="none", levels=1, coarsest=16).resolutions == (16,)


def awkward_tensors() -> dict[str, torch.Tensor]:
    """Return what a file could lose: signed zero, NaN, subnormals, flags, 64-bit integers, empty, transposed."""
    return {
        "floats": torch.tensor([0.0, -0.0, math.nan, math.inf, -math.inf, 1e-45, 3.4e38]),
        "doubles": torch.tensor([math.pi, 5e-324], dtype=torch.float64),
        "flags": torch.tensor([[True, False], [False, True]]),
        "integers": torch.tensor([2**62 + 1, -1]),
        "empty": torch.zeros(0, 3),
        "transposed": torch.arange(6.0).reshape(2, 3).T,
    }


def test_checkpoint_round_trip_is_bit_exact(tmp_path):
    path = tmp_path / "Ordner mit Ümlaut" / "a.safetensors"
    description = {"name": "Küche", "numbers": [1, 0.1, 1e-300], "nothing": None}
    save_tensors(path, awkward_tensors(), description)
    loaded, stored = load_tensors(path, "cpu")
    assert stored == description
    assert set(loaded) == set(awkward_tensors())
    for name, tensor in awkward_tensors().items():
        assert loaded[name].dtype == tensor.dtype
        assert loaded[name].shape == tensor.shape
        assert loaded[name].contiguous().numpy().tobytes() == tensor.contiguous().numpy().tobytes(), name


def test_checkpoint_that_is_missing_cut_short_or_foreign(tmp_path):
    names = ("missing", "short", "text", "other", "number")
    missing, short, text, foreign, number = (tmp_path / f"{name}.safetensors" for name in names)
    save_tensors(short, awkward_tensors(), {})
    short.write_bytes(short.read_bytes()[:-5])
    text.write_text("no tensors at all")
    save_file({"a": torch.zeros(3)}, foreign)  # by another program, without our description or with one of its own
    save_file({"a": torch.zeros(3)}, number, metadata={"description": "3"})
    for path in (missing, short, text, foreign, number, tmp_path):
        problem = "does not exist" if path == missing else "is not a readable checkpoint"
        with pytest.raises(UserError, match=f"{path.name} {problem}") as caught:
            load_tensors(path, "cpu")
        assert caught.value.exit_code == BAD_INPUT


def some_model() -> Model:
    torch.manual_seed(3)
    rotation = rotation_from_quaternion(np.array([0.9, 0.1, -0.3, 0.2]))
    similarity = Similarity(1 / 3, rotation, np.array([1.0, -2.0, 0.1]))
    field, occupied = HashField(TINY), torch.rand(8, 8, 8) > 0.5
    return Model(field, occupied, Marching(0.1, 4.0, 0.01, 1 / 128), (0.1, 0.2, 1 / 3), similarity, "metre")


def test_a_model_keeps_the_digest_of_the_loaded_file_even_if_the_file_is_replaced(tmp_path, monkeypatch):
    """A training replaces its field while another command reads it."""
    path = tmp_path / "field.safetensors"
    save_model(path, some_model())
    wanted = hashlib.sha256(path.read_bytes()).hexdigest()
    parse = model_file.tensors_of

    def parse_late(content, *given):
        save_model(path, replace(some_model(), unit="inch"))
        return parse(content, *given)

    monkeypatch.setattr(model_file, "tensors_of", parse_late)
    loaded = load_model(path, "cpu")
    assert (loaded.sha256, loaded.unit) == (wanted, "metre")
    assert hashlib.sha256(path.read_bytes()).hexdigest() != wanted


def test_model_of_another_format_is_named(tmp_path):
    path = tmp_path / "state.safetensors"
    save_tensors(path, {"a": torch.zeros(1)}, {"format": "another field 9"})
    with pytest.raises(UserError, match="is of format 'another field 9', expected 'nerfcli field 2'"):
        load_model(path, "cpu")


def test_the_same_content_is_the_same_file(tmp_path):
    files = [tmp_path / f"{number}.safetensors" for number in range(12)]
    for path in files:
        save_tensors(path, awkward_tensors(), {"step": 3, "name": "küche"})
    assert len({path.read_bytes() for path in files}) == 1


def test_a_bit_that_flips_anywhere_in_a_checkpoint_is_noticed(tmp_path):
    path = tmp_path / "a.safetensors"
    save_tensors(path, {"a": torch.arange(40.0), "flags": torch.tensor([True, False])}, {"step": 3, "name": "küche"})
    whole = path.read_bytes()
    tensors, description = load_tensors(path, "cpu")
    for bit in range(0, 8 * len(whole), 5):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            again, stored = load_tensors(path, "cpu")
        except UserError:
            continue
        # Flips that go unnoticed lose nothing: they are in the spaces that pad the header.
        assert stored == description
        assert {name: tensor.tolist() for name, tensor in again.items()} == {n: t.tolist() for n, t in tensors.items()}
