"""The selftest passes here, and catches operations that are written the way textbooks write them."""

import json
import math
from dataclasses import replace
from decimal import Decimal, getcontext

import pytest
import torch
from hard_cases import depths, exact, exact_depths, learning, light, lookup, space, volumes
from hard_cases import suite as strict
from typer.testing import CliRunner

from nerfcli import cli, kernels
from nerfcli.errors import GATE_NOT_MET
from nerfcli.kernels import numba_cpu, reference
from nerfcli.kernels.reference import compositing, depth
from nerfcli.kernels.selftest import table, textbook
from nerfcli.kernels.selftest.cases import Ray, Segments
from nerfcli.kernels.selftest.measure import MET, NOT_MET, Errors, Precision, Row, by_formula, largest_error
from nerfcli.kernels.selftest.table import checks, row_of

SINGLE = Precision("float32", torch.float32, "cpu")
COMPILED = Precision("compiled", torch.float32, "cpu", compiled=True)


def failed(rows) -> set[str]:
    return {row.operation for row in rows if row.verdict == NOT_MET}


@pytest.fixture(scope="module")
def all_rows() -> list[Row]:
    """The definitions and the kernels against answers in 60 digits and closed forms."""
    return list(strict.rows("cpu", lambda text: None))


@pytest.fixture(scope="module")
def own_rows() -> list[Row]:
    """The rows that the command measures: the kernels against the definitions in float64."""
    return list(table.rows("cpu", lambda text: None))


def test_every_bound_is_met_and_has_a_reason(all_rows, own_rows):
    for rows in (all_rows, own_rows):
        assert [row for row in rows if row.verdict == NOT_MET] == []
        assert all(row.reason and row.seconds is not None for row in rows)


def test_the_command_tries_what_the_strict_suite_tries_and_is_about_as_strict(all_rows, own_rows):
    """The same kernel operations; bounds of compiled ones are at most four times as loose."""
    for name in ("float32", "bfloat16", "compiled"):
        tried = {row.operation for row in all_rows if row.precision == name}
        cameras = {
            "frame_rays",
            "uncontract",
            "Occupancy.above",
            "visible_samples, composite, ray_termination",
            "radiance",
        }
        assert {row.operation for row in own_rows if row.precision == name} >= tried - cameras - {"hash_encode"}
    loosest = {row.operation: row.bounds.value for row in all_rows if row.precision == "compiled"}
    for row in own_rows:
        if row.precision == "compiled" and row.operation in loosest:
            assert row.bounds.value <= 4 * loosest[row.operation], row


def test_every_textbook_formula_breaks_a_bound_somewhere(all_rows, own_rows):
    for rows, least in ((all_rows, 16), (own_rows, 10)):
        formulas = by_formula(rows)
        assert len(formulas) >= least
        assert [row.formula for row in formulas if not row.textbook_fails] == []
    # The compiled kernels compute in float32 too; its formula counts once.
    assert all(row.textbook is None for row in all_rows if row.precision == "compiled")


def test_every_kernel_has_rows_in_every_arithmetic_that_it_is_made_for(all_rows):
    tried = {(row.operation, row.precision) for row in all_rows}
    depths = ("ray_termination", "optical_depth_before")
    for operation in ("composite", "distortion", "hash_encode", "pixel_rays", "project", "visible_samples", *depths):
        assert {(operation, name) for name in ("float64", "float32", "compiled")} <= tried
    assert {("hash_encode", "float16"), ("composite", "bfloat16")} <= tried
    assert {(operation, "bfloat16") for operation in ("hash_encode", *depths)} <= tried


def test_a_depth_has_a_gradient_or_says_why_not(all_rows):
    for row in all_rows:
        if row.operation in ("ray_termination", "optical_depth_before"):
            assert (row.errors.gradient is None) == bool(row.no_gradient), row


def test_weights_by_one_minus_exp_are_caught(monkeypatch):
    def textbook_weights(density, lengths, offsets):
        before = reference.optical_depth_before(density, lengths, offsets)
        total = reference.sum_along_rays(density * lengths, offsets)
        return torch.exp(-before) * (1 - torch.exp(-density * lengths)), torch.exp(-total)

    monkeypatch.setattr(compositing, "interval_weights", textbook_weights)
    assert failed(light.rows((SINGLE,))) == {"composite"}


def test_a_gradient_of_expm1_by_its_value_is_caught(monkeypatch):
    monkeypatch.setattr(compositing, "opacity", lambda x: -torch.expm1(-x))
    assert failed(light.rows((SINGLE,))) == {"composite"}


def test_a_broken_compiled_kernel_is_caught(monkeypatch):
    monkeypatch.setattr(numba_cpu, "composite", textbook.composite)
    assert failed(light.rows((COMPILED,))) == {"composite"}
    assert failed(row_of(check, COMPILED) for check in checks() if check.operation == "composite") == {"composite"}


def test_depth_at_midpoints_and_distortion_by_differences_are_caught(monkeypatch):
    monkeypatch.setattr(depth, "mean_fraction", lambda x: torch.full_like(x, 0.5))
    monkeypatch.setattr(
        reference,
        "distortion",
        lambda weights, starts, ends, offsets: textbook.distortion(weights, starts, ends, offsets)[None],
    )
    assert failed(light.rows((SINGLE,))) == {"distortion"}
    assert failed(depths.rows((SINGLE,))) == {"ray_termination"}


def test_the_spread_of_a_far_thin_surface_was_once_the_rounding_of_its_distance(monkeypatch):
    monkeypatch.setattr(depth, "max_weight", lambda weights, means, offsets: means.new_zeros(len(offsets) - 1))
    rows = [row for row in depths.rows((SINGLE,)) if row.verdict == NOT_MET]
    assert [row.case for row in rows if row.case.startswith("spread")] == [
        "spread of depth, of shells and fog; 1 to 15 intervals"
    ]
    # And the gradient of its mean was the rounding of its distance.
    assert "mean depth, of next to no light and of none; 1 to 15 intervals" in [row.case for row in rows]


def test_the_gradients_of_depths_are_difference_quotients_in_sixty_digits():
    """Independent of the closed forms: (depth(density + h) - depth(density - h)) / 2 h, of the exact values."""
    ray = Ray("slabs", [0.7, 1e-9, 2.5, 1.25], [1.0, 1.5, 2.0, 2.25], [1.5, 1.75, 2.25, 3.25])
    answer, h = exact_depths.ray_termination(ray).depths, 2.0**-16
    for k, sigma in enumerate(ray.density):
        if sigma < h:
            continue
        up, down = (
            exact_depths.ray_termination(replace(ray, density=[*ray.density[:k], sigma + s * h, *ray.density[k + 1 :]]))
            for s in (1, -1)
        )
        for name, found in answer.items():
            quotient = (up.depths[name].value - down.depths[name].value) / (2 * h)
            defined = math.isfinite(found.value)  # what is undefined has no gradient
            assert found.gradient[k] == pytest.approx(quotient if defined else 0.0, rel=1e-7, abs=1e-9), name
            assert found.size[k] >= abs(found.gradient[k]) * (1 - 1e-12)


def test_optical_depth_by_subtraction_and_half_precision_are_caught(monkeypatch):
    for module in (reference, compositing):  # the function itself, and the one used by the weights of intervals
        monkeypatch.setattr(
            module, "optical_depth_before", lambda *given: textbook.optical_depth_before(*given[:2], offsets=given[2])
        )
    assert failed(depths.rows((SINGLE,))) == {"optical_depth_before", "ray_termination"}
    interpolated, pixel_rays = reference.hash_encode, reference.pixel_rays

    def in_half(points, table, resolutions, widths=None):
        return interpolated(points.half(), table.half(), resolutions)

    monkeypatch.setattr(reference, "hash_encode", in_half)
    monkeypatch.setattr(reference, "pixel_rays", lambda chosen, pixels: pixel_rays(chosen.float().long(), pixels))
    assert failed(lookup.rows((SINGLE,))) == {"hash_encode", "pixel_rays"}


def test_a_projector_and_a_transpose_that_do_not_fit_are_caught(monkeypatch):
    """Joseph's step without the slope of the line, and a transpose of another grid."""
    project, back_project = reference.project, reference.back_project
    monkeypatch.setattr(reference, "project", lambda v, o, d, **grid: project(v, o, d, **grid) / d.norm(dim=1))
    assert failed(volumes.rows((SINGLE,))) == {"project"}
    monkeypatch.setattr(reference, "project", project)
    moved = {"first": (-2.0, -1.5, -1.2), "size": 0.5}
    monkeypatch.setattr(
        reference, "back_project", lambda v, o, d, *, shape, **grid: back_project(v, o, d, shape=shape, **moved)
    )
    assert {row.case.split(",")[0] for row in volumes.rows((SINGLE,)) if row.verdict == NOT_MET} == {
        "projector and transpose"
    }


def test_other_textbook_formulas_are_caught(monkeypatch):
    monkeypatch.setattr(kernels, "contract", textbook.contract)
    monkeypatch.setattr(learning, "density_from_log", torch.exp)
    assert failed(space.rows((SINGLE,))) == {"contract"}
    assert failed(learning.rows((SINGLE,))) == {"density_from_log"}


def test_the_decimal_gradient_is_the_difference_quotient_in_sixty_digits():
    """Independent of the closed form: loss(density + h) - loss(density - h) over 2 h, with h = 1e-20."""
    ray, rgb, h = Segments((0.7, 2.5, 1.25), (0.5, 0.25, 1.0)), [[0.3], [0.9], [0.1]], Decimal("1e-20")
    getcontext().prec = 60

    def loss(density):
        passing, total = Decimal(1), Decimal(0)
        for sigma, length, (c,) in zip(density, ray.lengths, rgb, strict=True):
            through = (-sigma * Decimal(length)).exp()
            total += passing * (1 - through) * Decimal(c)
            passing *= through
        return total + passing * Decimal("0.5")

    answer = exact.composited(
        ray, rgb, [0.5], colour_gradient=[1.0], transmittance_gradient=0.0, weights_gradient=[0.0] * 3
    )
    for k, gradient in enumerate(answer.density_gradient):
        up, down = ([Decimal(x) + s * h * (i == k) for i, x in enumerate(ray.density)] for s in (1, -1))
        assert gradient == pytest.approx(float((loss(up) - loss(down)) / (2 * h)), rel=1e-14)


def test_errors_are_relative_and_nan_counts_only_where_one_of_the_two_is():
    nan, inf = float("nan"), float("inf")
    assert largest_error(torch.tensor([1.0, nan]), [1.0, nan], tiny=1e-38) == 0
    assert largest_error(torch.tensor([nan]), [1.0], tiny=1e-38) == inf
    assert largest_error(torch.tensor([1.0]), [nan], tiny=1e-38) == inf
    assert largest_error(torch.tensor([3e-6]), [2e-6], tiny=1e-38) == pytest.approx(0.5)
    assert largest_error(torch.tensor([]), [], tiny=1e-38) == 0
    row = Row("case", "op", "float32", Errors(nan), Errors(1.0), "reason")
    assert row.verdict == NOT_MET
    assert json.loads(json.dumps(row.to_json(), allow_nan=False))["errors"]["value"] == "nan"


def test_the_command_prints_a_line_per_row_and_ends_with_7_where_a_bound_is_not_met(monkeypatch):
    good = Row("thin", "composite", "float32", Errors(1e-8), Errors(1e-6), "u", "1 - exp", Errors(1.0), 0.001)
    bad = Row("thick", "composite", "float32", Errors(1e-2), Errors(1e-6), "u", "1 - exp", Errors(1.0), 0.001)
    monkeypatch.setattr(table, "rows", lambda device, notify: iter([good]))
    result = CliRunner().invoke(cli.app, ["selftest", "--json", "--device", "cpu"])
    assert result.exit_code == 0
    assert json.loads(result.stdout)["verdict"] == MET
    monkeypatch.setattr(table, "rows", lambda device, notify: iter([good, bad]))
    result = CliRunner().invoke(cli.app, ["selftest", "--device", "cpu"])
    assert result.exit_code == GATE_NOT_MET
    assert "thick" in result.stdout
    assert "1 of 1 textbook formulas exceed them somewhere" in result.stderr
    assert "1 of 2 rows exceed their bounds; first: thick (composite, float32)" in result.stderr


def test_a_nan_in_the_occupancy_was_once_lost():
    """A fault found by the selftest: a NaN closed its cell."""
    assert NOT_MET not in {row.verdict for row in learning.rows((SINGLE,))}
