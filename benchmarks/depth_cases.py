"""The error of every depth of a ray against 60-digit answers, on rays that are prone to rounding errors.

    python benchmarks/depth_cases.py -o depth_cases.csv

Columns: the definition in plain torch in float64 and in float32, and the compiled kernel (float32 in and out). All get
the same float32 inputs. Errors are relative to the value; 0 also where the value is NaN as it should be.
"""

import csv
import math
import sys
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.table import Table

from nerfcli.kernels import LightEnds, numba_cpu
from nerfcli.kernels.reference import depth
from nerfcli.render.depth import CONVENTIONS, DepthRequest, requested
from nerfcli.selftest.cases import Ray, depth_rays

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))  # answers in 60 digits
from hard_cases import exact_depths

FAR = 300.0
DEPTHS = (*CONVENTIONS, "quantile:0.05", "quantile:0.95")
ROWS = ("opacity", "transmittance", *DEPTHS, "spread")


def single(ray: Ray) -> list[list[float]]:
    """Return densities, starts and ends rounded to float32."""
    return [torch.tensor(v, dtype=torch.float32).tolist() for v in (ray.density, ray.starts, ray.ends)]


def computed(case: Ray, backend: str) -> dict[str, float]:
    """Return every row, computed by one of the implementations."""
    dtype = torch.float64 if backend == "float64" else torch.float32
    module = numba_cpu if backend == "compiled" else depth
    density, starts, ends = (torch.tensor(values, dtype=dtype) for values in single(case))
    offsets = torch.tensor([0, len(density)])

    def light(*fractions: float) -> LightEnds:
        return module.light_ends(density, starts, ends, offsets=offsets, fractions=fractions)

    seen = light()
    values = {"opacity": seen.opacity.item(), "transmittance": seen.transmittance.item(), "spread": seen.spread.item()}
    for convention in DEPTHS:
        request = DepthRequest(convention, "ray", 0.0, FAR)
        fractions = () if request.fraction is None else (request.fraction,)
        values[convention] = requested(request, light(*fractions), background_distance=density.new_tensor([FAR])).item()
    return values


def answers_of(ray: Ray) -> dict[str, float]:
    """Return every row by its definition, from 60-digit answers."""
    wanted = {name: found.value for name, found in exact_depths.light_ends(ray).depths.items()}
    mean = wanted["conditional"]
    wanted["moment"] = 0.0 if math.isnan(mean) else mean * wanted["opacity"]
    return wanted | {"background": wanted["moment"] + wanted["transmittance"] * FAR}


def error(value: float, wanted: float) -> float:
    """Return the relative error; infinite if only one value is NaN.

    If the wanted value is below float32's normal range, the error is 0 for a value that is too, else infinite.
    """
    if math.isnan(value) or math.isnan(wanted):
        return 0.0 if math.isnan(value) and math.isnan(wanted) else math.inf
    if abs(wanted) < torch.finfo(torch.float32).tiny:
        return 0.0 if abs(value) < torch.finfo(torch.float32).tiny else math.inf
    return abs(value - wanted) / abs(wanted)


def main(output: Annotated[Path | None, typer.Option("--output", "-o", help="CSV of all errors.")] = None) -> None:
    """Print the largest error of every row over all cases, and the slabs in numbers."""
    backends = ("float64", "float32", "compiled")
    console, lines = Console(), []
    rays = depth_rays()
    for case in rays:
        wanted = answers_of(Ray(case.name, *single(case)))
        answers = {backend: computed(case, backend) for backend in backends}
        for name in ROWS:
            errors = [error(answers[backend][name], wanted[name]) for backend in backends]
            lines.append((case.name, name, wanted[name], *errors))
    slabs = Table("three slabs from 0 to 3, background at 300", "exact", title="worked example")
    for case, name, value, *_ in lines:
        if case.startswith("three slabs"):
            slabs.add_row(name, f"{value:.12g}")
    console.print(slabs)
    table = Table("depth", *(f"{b}: largest, where" for b in backends), title=f"relative error over {len(rays)} rays")
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
