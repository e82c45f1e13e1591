"""The error of every depth of a ray against 60 decimal digits, on rays that are hard for rounding.

    python benchmarks/depth_cases.py -o depth_cases.csv

Columns: the definition in plain torch in float64 and in float32, and the compiled kernel (float32 in and out). The same
float32 inputs go into all of them. An error is relative to the value; "same" is no error at all, "undefined" that the
value is NaN and has to be.
"""

import csv
import math
from dataclasses import dataclass
from decimal import Decimal, localcontext
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.table import Table

from nerfcli import kernels
from nerfcli.kernels import depth
from nerfcli.kernels.depth import LightEnds
from nerfcli.render.depth import CONVENTIONS, DepthRequest, requested

FAR = 300.0
DEPTHS = (*CONVENTIONS, "quantile:0.05", "quantile:0.95")
ROWS = ("opacity", "transmittance", *DEPTHS, "spread")
SHARES = (0.5, 0.05, 0.95)


@dataclass(frozen=True)
class Case:
    """One ray: densities, and the distances at which its intervals start and end."""

    name: str
    density: list[float]
    starts: list[float]
    ends: list[float]


def even(name: str, density: list[float], near: float, length: float) -> Case:
    """Intervals of one length, side by side."""
    edges = [near + length * i for i in range(len(density) + 1)]
    return Case(name, density, edges[:-1], edges[1:])


def cases() -> list[Case]:
    """The rays."""
    ln2 = math.log(2)
    optical_depths = (1e-12, 1e-6, 1e-3, 0.1, 1.0, 30.0, 1e6)
    return [
        even("three slabs (worked example)", [ln2, ln2, 2 * ln2], 0.0, 1.0),
        even("empty, cut in 4", [0.0] * 4, 1.0, 0.5),
        Case("empty, not cut", [], [], []),
        *(even(f"one interval of optical depth {x:g}", [x / 0.25], 2.0, 0.25) for x in optical_depths),
        *(even(f"fog of optical depth {x:g} in 256", [x / 4] * 256, 1.0, 1 / 64) for x in optical_depths),
        *(even(f"thin shell 1e-4 at 3, density {x:g}", [x], 3.0, 1e-4) for x in (1.0, 1e4, 1e8)),
        Case("two surfaces at 1 and 5, half each", [ln2 * 128, 1e4], [1.0, 5.0], [1.0078125, 5.0078125]),
        Case("two surfaces in fog of 1e-9", [40.0, 1e-9, 1e5], [1.0, 1.015625, 5.0], [1.015625, 5.0, 5.25]),
        even("opaque first sample", [1e6, 1.0, 1.0], 0.5, 0.25),
        even("ever denser, 1e-9 to 1e5", [10.0**e for e in range(-9, 6)], 0.25, 0.125),
        even("far: fog of 1 from 200 to 300", [0.01] * 100, 200.0, 1.0),
    ]


def exact(case: Case) -> dict[str, float]:
    """Every row in 60 digits, from the float32 inputs, by the definitions of `render.depth`."""
    with localcontext() as context:
        context.prec = 60
        tau, moment, mass, samples = Decimal(0), Decimal(0), Decimal(0), []
        quantiles = dict.fromkeys(SHARES, Decimal("nan"))
        for sigma, start, end in zip(*(map(Decimal, values) for values in single(case)), strict=True):
            length, own = end - start, sigma * (end - start)
            weight = (-tau).exp() * (1 - (-own).exp())
            if own > 0:
                # Below this, sixty digits are not enough for the closed forms; their series then has one term.
                tiny = own < Decimal("1e-15")
                mean = start + (length / 2 - own * length / 12 if tiny else 1 / sigma - length / (own.exp() - 1))
                wide = length**2 / 12 if tiny else 1 / sigma**2 - length**2 * own.exp() / (own.exp() - 1) ** 2
                samples.append((weight, mean, wide))
                moment, mass = moment + weight * mean, mass + weight
            for share in SHARES:
                target = -(1 - Decimal(share)).ln()
                if quantiles[share].is_nan() and tau + own >= target:
                    quantiles[share] = start + (target - tau) / sigma
            tau += own
        left = (-tau).exp()
        values: dict[str, Decimal] = {"opacity": 1 - left, "transmittance": left, "moment": moment}
        values["background"] = moment + left * Decimal(FAR)
        middle = moment / mass if mass else Decimal("nan")
        values["conditional"] = middle
        values["spread"] = (
            (sum(w * (v + (m - middle) ** 2) for w, m, v in samples) / mass).sqrt() if mass else Decimal("nan")
        )
        heaviest = max((w for w, _, _ in samples), default=Decimal(0))
        # Equal weights are told apart by rounding alone; then the nearest counts.
        near = [m for w, m, _ in samples if w >= heaviest * (1 - Decimal("1e-15"))]
        values["max-weight"] = near[0] if near else Decimal("nan")
        values |= {"median": quantiles[0.5], "quantile:0.05": quantiles[0.05], "quantile:0.95": quantiles[0.95]}
        return {name: float(values[name]) for name in ROWS}


def single(case: Case) -> list[list[float]]:
    """Densities, starts and ends as float32 holds them."""
    return [torch.tensor(v, dtype=torch.float32).tolist() for v in (case.density, case.starts, case.ends)]


def computed(case: Case, backend: str) -> dict[str, float]:
    """Every row by one of the implementations."""
    dtype = torch.float64 if backend == "float64" else torch.float32
    module = kernels if backend == "compiled" else depth
    density, starts, ends = (torch.tensor(values, dtype=dtype) for values in single(case))
    offsets = torch.tensor([0, len(density)])

    def light(*shares: float) -> LightEnds:
        return module.light_ends(density, starts, ends, offsets=offsets, shares=shares)

    seen = light()
    values = {"opacity": seen.opacity.item(), "transmittance": seen.transmittance.item(), "spread": seen.spread.item()}
    for convention in DEPTHS:
        request = DepthRequest(convention, "ray", 0.0, FAR)
        shares = () if request.share is None else (request.share,)
        values[convention] = requested(request, light(*shares), background_distance=density.new_tensor([FAR])).item()
    return values


def error(value: float, wanted: float) -> float:
    """Relative error; infinite where only one of the two is defined. Below float32's range only 0 is asked for."""
    if math.isnan(value) or math.isnan(wanted):
        return 0.0 if math.isnan(value) and math.isnan(wanted) else math.inf
    if abs(wanted) < torch.finfo(torch.float32).tiny:
        return 0.0 if abs(value) < torch.finfo(torch.float32).tiny else math.inf
    return abs(value - wanted) / abs(wanted)


def main(output: Annotated[Path | None, typer.Option("--output", "-o", help="CSV of all errors.")] = None) -> None:
    """Print the largest error of every row over all cases, and the slabs in numbers."""
    backends = ("float64", "float32", "compiled")
    console, lines = Console(), []
    for case in cases():
        wanted = exact(case)
        answers = {backend: computed(case, backend) for backend in backends}
        for name in ROWS:
            errors = [error(answers[backend][name], wanted[name]) for backend in backends]
            lines.append((case.name, name, wanted[name], *errors))
    slabs = Table("three slabs from 0 to 3, background at 300", "exact", title="worked example")
    for case, name, value, *_ in lines:
        if case.startswith("three slabs"):
            slabs.add_row(name, f"{value:.12g}")
    console.print(slabs)
    table = Table(
        "depth", *(f"{b}: largest, where" for b in backends), title=f"relative error over {len(cases())} rays"
    )
    for name in ROWS:
        cells = []
        for column in range(3):
            worst = max((line for line in lines if line[1] == name), key=lambda line, c=column: line[3 + c])
            cells.append(f"{worst[3 + column]:.1e}  {worst[0]}")
        table.add_row(name, *cells)
    console.print(table)
    if output is not None:
        with output.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("case", "depth", "exact", *backends))
            writer.writerows(lines)


if __name__ == "__main__":
    typer.run(main)
