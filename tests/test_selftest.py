"""The table of hard cases: against exact answers, as the command measures it, and with textbook formulas put in."""

import functools
import json
from collections.abc import Iterator
from dataclasses import replace
from decimal import Decimal, getcontext
from typing import Any

import exact_answers
import exact_depths
import pytest
import torch
from exact_answers import ANSWERS
from typer.testing import CliRunner

from nerfcli import cli, kernels
from nerfcli.errors import GATE_NOT_MET
from nerfcli.kernels import numba_cpu, reference
from nerfcli.kernels.reference import compositing, depth
from nerfcli.kernels.selftest import cases, operations, table
from nerfcli.kernels.selftest.cases import MEANINGLESS, Ray, Segments
from nerfcli.kernels.selftest.measure import MET, NOT_MET, Errors, Precision, Row, largest_error
from nerfcli.kernels.selftest.table import SINGLE, Check, checks, row_of

DTYPES = (torch.float64, torch.float32, torch.bfloat16)
DOUBLE, FLOAT, BFLOAT = (Precision(str(dtype)[6:], dtype, "cpu") for dtype in DTYPES)
COMPILED = Precision("compiled", torch.float32, "cpu", compiled=True)
PRECISIONS = (DOUBLE, FLOAT, BFLOAT, COMPILED)
# With exact answers and sizes of terms, these bounds are stricter than those of the table, in roundings.
STRICTER = {"contract": (8, 16), "density_from_log": (4, 4)}
# A loss by colour minus a running sum from the front would lose the gradient behind these walls.
LAST_LIGHT = Segments((2.0**-4,) * 64 + (32.0, 16.0, 8.0, 4.0), (2.0**-6,) * 64 + (1.0,) * 4)


def hard_cases() -> Iterator[Check]:
    """Yield the cases of the command and one more."""
    listed = list(checks())
    yield from listed
    yield replace(
        next(check for check in listed if check.operation == "composite"),
        case="gradient where hardly any light is left",
        inputs=functools.partial(operations.light_inputs, [LAST_LIGHT]),
        bound=functools.partial(operations.light_bound, [LAST_LIGHT]),
    )


def errors_of(check: Check, precision: Precision) -> Errors:
    """Measure the largest errors against exact answers."""
    given = check.inputs(precision)
    return operations.errors(check.run(precision.parts, given), ANSWERS[check.operation](given), tiny=precision.tiny)


def exceeds(check: Check, precision: Precision) -> bool:
    """Return whether a value or a gradient is farther from its exact answer than permitted."""
    bounds = check.bound(precision)
    if check.operation in STRICTER and not precision.compiled:
        bounds = Errors(*(count * precision.unit for count in STRICTER[check.operation]))
    found = errors_of(check, precision)
    assert found.gradient is None or bounds.gradient is not None
    return not Row(check.case, check.operation, precision.name, found, bounds, "", 0.0).holds(found)


def is_for(check: Check, precision: Precision) -> bool:
    """Return whether a case is tried in a precision: float64 where float32 is."""
    tried = SINGLE in check.precisions if precision is DOUBLE else precision.name in check.precisions
    return tried and check.operation in ANSWERS and check.bound(precision).value <= MEANINGLESS


@pytest.mark.parametrize(
    ("check", "precision"),
    [
        pytest.param(check, precision, id=f"{check.operation}: {check.case}, {precision.name}")
        for check in hard_cases()
        for precision in PRECISIONS
        if is_for(check, precision)
    ],
)
def test_hard_cases_have_their_exact_answers(check, precision):
    """In value and gradient, in every precision: 60 digits, exact fractions or closed forms."""
    assert not exceeds(check, precision), errors_of(check, precision)


def depths_beyond_their_bounds(precision: Precision) -> set[str]:
    """Return the depths that are farther from their 60-digit answers than permitted.

    The bound of a ray is u (16 + (n + 2) (1 + tau)), compiled 16 u; of a spread times 1 + the mean, from where most
    light ends, over the spread.
    """
    beyond = set()
    for given in cases.depth_rays():
        inputs = operations.depth_inputs([given], precision)
        del inputs["settled"]
        ray = Ray(given.name, *(inputs[name].double().tolist() for name in ("density", "starts", "ends")))
        bound = operations.depth_bound([ray], 1, precision).value
        if bound > MEANINGLESS:
            continue
        found, exact = operations.depths(precision.parts, inputs), exact_depths.ray_termination(ray)
        for name, wanted in exact.depths.items():
            fraction, own = operations.QUANTILES.get(name), bound
            if fraction is not None and not exact_depths.is_settled(ray, fraction, within=bound):
                continue  # it jumps over a gap
            if name == "spread" and wanted > 0:
                own *= 1 + abs(exact.depths["conditional"] - exact.anchor) / wanted
            if not largest_error(found[name], [wanted], tiny=precision.tiny) <= own:
                beyond.add(name)
    return beyond


@pytest.mark.parametrize("precision", PRECISIONS, ids=lambda precision: precision.name)
def test_depths_of_hard_rays_have_their_exact_answers(precision):
    assert depths_beyond_their_bounds(precision) == set()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_gradients_of_a_table_in_half_precision_are_summed_in_its_sink(dtype):
    """4,096 gradients of 1 to 1e-8 in a cell, in a float32 sink as in training: only the table is of half precision."""
    times, grids = 256, (4, 16)
    crowd = tuple((0.5 + 2.0**-9 * (k % 8), 0.25, 0.125 * (1 + k // 8)) for k in range(16))
    given = operations.grid_inputs(crowd, grids, 0, FLOAT)
    wanted = exact_answers.hash_encode(given)
    points, weights = given["points"].repeat(times, 1), given["table"].to(dtype).requires_grad_()
    table_grad = torch.zeros_like(weights, dtype=torch.float32)
    encoded = kernels.backend_for(torch.device("cpu"), dtype).hash_encode(points, weights, grids, table_grad=table_grad)
    encoded = encoded.view(len(points), len(grids), -1)
    (encoded * given["gains"]).sum().backward()
    assert largest_error(encoded, wanted.values["encoded"].repeat(times, 1, 1), tiny=FLOAT.tiny) <= 16 * FLOAT.unit
    size, sums = (times * part["by table"] for part in (wanted.sizes, wanted.gradients))
    assert largest_error(table_grad, sums, tiny=FLOAT.tiny, scale=size) <= (16 + len(points)) * FLOAT.unit


@pytest.fixture(scope="module")
def own_rows() -> list[Row]:
    """The rows that the command measures: the kernels against the definitions in float64."""
    return list(table.rows("cpu", lambda text: None))


def test_the_command_is_within_its_bounds_and_says_why_they_are_what_they_are(own_rows):
    assert [row for row in own_rows if row.verdict == NOT_MET] == []
    assert all(row.reason for row in own_rows)
    tried = {(row.operation, row.precision) for row in own_rows}
    compared = set(ANSWERS) - {"contract"}
    assert {(operation, name) for operation in compared for name in (SINGLE, "compiled")} <= tried
    assert {(operation, "bfloat16") for operation in ("composite", "ray_termination", "optical_depth_before")} <= tried


def by_one_minus_exp(density, lengths, offsets):
    before = reference.optical_depth_before(density, lengths, offsets)
    total = reference.sum_along_rays(density * lengths, offsets)
    return torch.exp(-before) * (1 - torch.exp(-density * lengths)), torch.exp(-total)


def composited_by_one_minus_exp(density, rgb, lengths, *, offsets, background):
    weights, left = by_one_minus_exp(density, lengths, offsets)
    return reference.sum_along_rays(weights[:, None] * rgb, offsets) + left[:, None] * background, left, weights


def depths_by_differences(density, lengths, offsets):
    return torch.cat([own.cumsum(0) - own for own in (density * lengths).split(offsets.diff().tolist())])


def distortion_by_differences(weights, starts, ends, offsets):
    middles = (starts + ends) / 2
    before, moment = (x.cumsum(0) - x for x in (weights, weights * middles))
    return (2 * weights * (middles * before - moment) + weights.square() * (ends - starts) / 3).sum()[None]


def in_half(points, table, resolutions, encode=reference.hash_encode):
    return encode(points.half(), table.half(), resolutions)


def by_float_numbers(chosen, pixels, rays=reference.pixel_rays):
    return rays(chosen.float().long(), pixels)


def contract_by_where(points):
    norm = points.square().sum(-1, keepdim=True).sqrt()
    return torch.where(norm <= 1.0, points, (2.0 - 1.0 / norm) * points / norm)


def adam_in_half(table, gradient, *moments, step, take=reference.adam_rows):
    half = gradient.half()
    table -= step.rate * half / ((0.01 * half * half / 0.01).sqrt() + step.eps)


def lines_in_single(volume, origins, directions, project=numba_cpu.project, **grid):
    return project(volume, origins.float().double(), directions.float().double(), **grid)


# Operations written the way textbooks write them: what is replaced, by what, in which precision, and what must fail.
MISTAKES: dict[str, tuple[Any, str, Any, Precision, str]] = {
    "weights by 1 - exp": (compositing, "interval_weights", by_one_minus_exp, FLOAT, "composite"),
    "gradient of expm1 by its value": (compositing, "opacity", lambda x: -torch.expm1(-x), FLOAT, "composite"),
    "broken compiled kernel": (numba_cpu, "composite", composited_by_one_minus_exp, COMPILED, "composite"),
    "optical depth by differences": (
        reference, "optical_depth_before", depths_by_differences, FLOAT, "optical_depth_before",
    ),
    "distortion by differences": (reference, "distortion", distortion_by_differences, FLOAT, "distortion"),
    "features in half precision": (reference, "hash_encode", in_half, FLOAT, "hash_encode"),
    "numbers of pixels in float32": (reference, "pixel_rays", by_float_numbers, FLOAT, "pixel_rays"),
    "contraction by where": (kernels, "contract", contract_by_where, FLOAT, "contract"),
    "exp without limits": (operations, "density_from_log", torch.exp, FLOAT, "density_from_log"),
    "Adam's state in half precision": (reference, "adam_rows", adam_in_half, FLOAT, "adam_rows"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_textbook_formulas_are_caught(mistake, monkeypatch):
    module, name, replacement, precision, operation = MISTAKES[mistake]
    monkeypatch.setattr(module, name, replacement)
    own = [check for check in checks() if check.operation == operation and is_for(check, precision)]
    assert any(exceeds(check, precision) for check in own)


def test_depths_by_textbook_formulas_are_caught(monkeypatch):
    """The spread of a far, thin surface was once the rounding of its distance."""
    for name, replacement, wrong in (
        ("opacity", lambda x: 1 - torch.exp(-x), {"opacity"}),
        ("mean_fraction", lambda x: torch.full_like(x, 0.5), {"conditional", "max-weight"}),
        ("max_weight", lambda weights, means, offsets: means.new_zeros(len(offsets) - 1), {"spread"}),
        ("interval_weights", lambda *given: [x.half().float() for x in by_one_minus_exp(*given)], {"transmittance"}),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(depth, name, replacement)
            assert wrong <= depths_beyond_their_bounds(FLOAT)


@pytest.mark.parametrize(
    ("operation", "broken"), [("composite", composited_by_one_minus_exp), ("project", lines_in_single)]
)
def test_a_broken_kernel_fails_the_command_too(operation, broken, monkeypatch):
    monkeypatch.setattr(numba_cpu, operation, broken)
    rows = [row_of(check, COMPILED) for check in checks() if check.operation == operation]
    assert NOT_MET in {row.verdict for row in rows}


def test_the_gradient_of_composited_rays_is_the_difference_quotient_in_sixty_digits():
    """Independent of the closed form: loss(density + h) - loss(density - h) over 2 h, with h = 1e-20."""
    density, lengths, h = (0.7, 2.5, 1.25), (0.5, 0.25, 1.0), Decimal("1e-20")
    getcontext().prec = 60

    def loss(density):
        passing, total = Decimal(1), Decimal(0)
        for sigma, length, c in zip(density, lengths, ("0.3", "0.9", "0.1"), strict=True):
            through = (-sigma * Decimal(length)).exp()
            total += passing * (1 - through) * Decimal(float(c)) * Decimal("1.75")
            passing *= through
        return total + passing * (Decimal("0.875") + Decimal("0.5"))

    rgb = tuple((c,) * 3 for c in (0.3, 0.9, 0.1))
    *_, found, _ = exact_answers.composited(density, lengths, rgb, (0.0,) * 3, (0.5,) * 3)
    for k, gradient in enumerate(found):
        up, down = ([Decimal(x) + s * h * (i == k) for i, x in enumerate(density)] for s in (1, -1))
        assert gradient == pytest.approx(float((loss(up) - loss(down)) / (2 * h)), rel=1e-14)


def test_errors_are_relative_and_nan_counts_only_where_one_of_the_two_is():
    nan, inf = float("nan"), float("inf")
    assert largest_error(torch.tensor([1.0, nan]), [1.0, nan], tiny=1e-38) == 0
    assert largest_error(torch.tensor([nan]), [1.0], tiny=1e-38) == inf
    assert largest_error(torch.tensor([1.0]), [nan], tiny=1e-38) == inf
    assert largest_error(torch.tensor([3e-6]), [2e-6], tiny=1e-38) == pytest.approx(0.5)
    assert largest_error(torch.tensor([]), [], tiny=1e-38) == 0
    row = Row("case", "op", "float32", Errors(nan), Errors(1.0), "reason", 0.001)
    assert row.verdict == NOT_MET
    assert json.loads(json.dumps(row.to_json(), allow_nan=False))["errors"]["value"] == "nan"


def test_the_command_prints_a_line_per_row_and_ends_with_7_where_a_bound_is_not_met(monkeypatch):
    good = Row("thin", "composite", "float32", Errors(1e-8), Errors(1e-6), "u", 0.001)
    bad = Row("thick", "composite", "float32", Errors(1e-2), Errors(1e-6), "u", 0.001)
    monkeypatch.setattr(table, "rows", lambda device, notify: iter([good]))
    result = CliRunner().invoke(cli.app, ["selftest", "--json", "--device", "cpu"])
    assert result.exit_code == 0
    assert json.loads(result.stdout)["verdict"] == MET
    monkeypatch.setattr(table, "rows", lambda device, notify: iter([good, bad]))
    result = CliRunner().invoke(cli.app, ["selftest", "--device", "cpu"])
    assert result.exit_code == GATE_NOT_MET
    assert "thick" in result.stdout
    assert "1 of 2 rows exceed their bounds; first: thick (composite, float32)" in result.stderr
