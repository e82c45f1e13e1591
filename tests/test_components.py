"""The components of a model and of its training: chosen by name, and each does what its name says."""

import json
from dataclasses import asdict, replace

import pytest
import torch
from kernel_parts import radiance_of
from present import present
from typer.testing import CliRunner

from nerfcli.cli import app
from nerfcli.errors import UserError
from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.kernels import reference, spherical_harmonics
from nerfcli.training.runs.components import CHOICES, Components, choose, differences
from nerfcli.training.runs.settings import TrainSettings


def test_with_and_without_set_what_they_name_and_nothing_else():
    default = Components()
    assert choose(default, included=(), excluded=()) == default
    chosen = choose(default, included=("distortion=0.01",), excluded=("near", "view"))
    assert chosen == replace(default, distortion=0.01, near=False, view=0)
    for name, choice in CHOICES.items():
        on, off = choose(default, included=(name,), excluded=()), choose(default, included=(), excluded=(name,))
        assert getattr(on, name) == choice.on
        assert getattr(off, name) == choice.off
        assert differences(on) == ({} if on == default else {name: choice.on})
        assert replace(on, **{name: getattr(default, name)}) == default


@pytest.mark.parametrize(
    ("included", "excluded", "match"),
    [
        (("sharpness",), (), "--with sharpness: unknown component"),
        ((), ("view=2",), "--without view=2: unknown component"),
        (("view=4",), (), "expected one of 0, 1, 2, 3"),
        (("view=1",), ("view",), "is given twice"),
        (("distortion=-1",), (), "expected a number of at least 0"),
        (("distortion=nan",), (), "expected a number of at least 0"),
        (("near=perhaps",), (), "expected one of false, true"),
    ],
)
def test_unknown_names_and_values_are_wrong_usage(included, excluded, match):
    with pytest.raises(UserError, match=match) as caught:
        choose(Components(), included=included, excluded=excluded)
    assert caught.value.exit_code == 2


def test_only_a_grid_of_levels_can_let_them_fade_out():
    components = replace(Components(), antialias=True)
    TrainSettings(components=components)
    with pytest.raises(UserError, match="--field voxels: it needs the levels of a hash grid") as caught:
        TrainSettings(components=components, field="voxels")
    assert caught.value.exit_code == 2


def test_stereo_without_points_is_refused():
    with pytest.raises(UserError, match="needs points"):
        TrainSettings(components=Components(stereo=True))
    TrainSettings(components=Components(stereo=True), model="auto", fixed=("stereo",))  # auto may add points


def test_components_are_in_the_settings_as_json():
    settings = TrainSettings(components=replace(Components(), view=1)).to_json()
    assert json.loads(json.dumps(settings))["components"] == {**asdict(Components()), "view": 1}


def test_help_names_every_component_with_its_values():
    printed = CliRunner().invoke(app, ["train", "--help"], env={"COLUMNS": "200"}).output
    text = " ".join(printed.replace("│", " ").split())
    for name, choice in CHOICES.items():
        words = {str(value) for value in choice.allowed or ()} - {"True", "False", "1", "2"}
        assert f" {name} " in text
        assert all(word in text for word in words)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_field_of_low_degree_sees_only_its_harmonics(degree):
    # There are (l + 1)^2 harmonics up to degree l; those above the degree are zero, the others stay.
    directions = torch.nn.functional.normalize(torch.randn(7, 3, dtype=torch.float64), dim=-1)
    kept = (degree + 1) ** 2
    assert torch.equal(spherical_harmonics(directions, degree)[:, :kept], spherical_harmonics(directions)[:, :kept])
    assert not spherical_harmonics(directions, degree)[:, kept:].any()


def test_without_view_dependence_a_colour_is_the_same_from_everywhere():
    field = HashField(HashFieldSettings(contraction="none", log2_rows=4, view_degree=0))
    points, directions = torch.rand(5, 3), torch.nn.functional.normalize(torch.randn(2, 3), dim=-1)
    first, second = (radiance_of(field, points, directions, torch.full((5,), ray))[1] for ray in (0, 1))
    assert torch.equal(first, second)
    seen = HashField(HashFieldSettings(contraction="none", log2_rows=4))
    first, second = (radiance_of(seen, points, directions, torch.full((5,), ray))[1] for ray in (0, 1))
    assert (first != second).any()


def test_gradients_near_a_camera_shrink_with_the_square_of_the_distance():
    distance = torch.tensor([0.0, 0.2, 0.4, 1.2])
    density, rgb = torch.ones(4, requires_grad=True), torch.ones(4, 3, requires_grad=True)
    scaled, colours = density * 1.0, rgb * 1.0
    reference.scale_gradients(scaled, colours, distance=distance, near=0.4)
    (scaled.sum() + colours.sum()).backward()
    assert present(density.grad).tolist() == [0.0, 0.25, 1.0, 1.0]
    assert present(rgb.grad)[:, 1].tolist() == [0.0, 0.25, 1.0, 1.0]


@pytest.mark.parametrize("option", ["--with", "--without"])
def test_components_may_be_separated_by_commas(option, tmp_path):
    result = CliRunner().invoke(app, ["train", str(tmp_path), option, "points, stereo,sharpness", option, "near"])
    assert result.exit_code == 2
    assert f"{option} sharpness: unknown component" in result.stderr


def test_components_to_vary_may_be_separated_by_commas(tmp_path):
    result = CliRunner().invoke(app, ["ablate", str(tmp_path), "--only", "view,sharpness"])
    assert result.exit_code == 2
    assert "'sharpness'; choose from background" in result.stderr
