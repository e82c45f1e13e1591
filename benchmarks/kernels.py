"""Speed and error of every compiled kernel, compared with the plain-torch reference in the same run.

    python benchmarks/kernels.py -o kernels.csv
    python benchmarks/kernels.py --sizes 131072 --log2-rows 17,19 --threads 1

One line per kernel, direction, size, table and thread count: nanoseconds per sample (median and quartiles), speed-up
over the reference, and the largest error against the reference in float64, relative to the largest value. Rays have 32
samples in order, as in training. Run nothing else meanwhile.
"""

import csv
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from rich.console import Console
from rich.table import Table
from torch import Tensor

from nerfcli.field.hash_field import HashField, HashFieldSettings
from nerfcli.kernels import AdamStep, HashGrid, March, Rays, numba_cpu, reference

SAMPLES_PER_RAY = 32
SECONDS_EACH = 0.4
FEWEST, MOST = 3, 2000


@dataclass(frozen=True)
class Measurement:
    """One line of the table. `ns` is the median per sample, `ns_low` and `ns_high` the quartiles."""

    kernel: str
    direction: str
    samples: int
    log2_rows: int
    threads: int
    ns: float
    ns_low: float
    ns_high: float
    times_reference: float
    error: float


@dataclass(frozen=True)
class Operation:
    """A kernel and its reference on the same inputs.

    Args:
        name: of the kernel.
        fast, exact: map the inputs to the outputs.
        inputs: differentiable, float32; `exact` also takes them in float64.
        has_backward: whether the kernel has gradients.
    """

    name: str
    inputs: tuple[Tensor, ...]
    fast: Callable[..., tuple[Tensor, ...]]
    exact: Callable[..., tuple[Tensor, ...]]
    has_backward: bool = True


def operations(samples: int, log2_rows: int) -> Iterator[Operation]:
    """Yield every kernel on `samples` samples along random straight rays through the unit cube."""
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    rays = -(-samples // SAMPLES_PER_RAY)
    offsets = torch.clamp(torch.arange(rays + 1) * SAMPLES_PER_RAY, max=samples)
    begin, finish = torch.rand(2, rays, 1, 3, generator=generator)
    along = ((torch.arange(SAMPLES_PER_RAY) + 0.5) / SAMPLES_PER_RAY)[None, :, None]
    points = (begin + (finish - begin) * along).reshape(-1, 3)[:samples].contiguous()
    field = HashField(HashFieldSettings(contraction="none", log2_rows=log2_rows))
    table = torch.randn(field.table.shape, generator=generator) * 0.1
    resolutions = field.settings.resolutions
    yield Operation(
        "hash_encode",
        (table,),
        lambda t: (numba_cpu.hash_encode(points, t, resolutions),),
        # also in float64, coordinates are scaled in float32: at 1024 cells that rounding alone costs 4 digits
        lambda t: (reference.hash_encode(points, t, resolutions).to(t.dtype),),
    )
    encoded = reference.hash_encode(points, table, resolutions)
    harmonics = torch.randn(rays, 16, generator=generator)
    index = reference.ray_indices(offsets)
    weights = tuple(w.detach() for w in field.weights)
    yield Operation(
        "radiance",
        (encoded, *weights),
        lambda e, *w: numba_cpu.radiance(e, harmonics, index, w),
        lambda e, *w: reference.radiance(e, harmonics.to(e.dtype), index, w),
    )
    yield Operation(
        "density",
        (encoded, *weights[:2]),
        lambda e, *w: (numba_cpu.density(e, w),),
        lambda e, *w: (reference.density(e, w),),
        has_backward=False,
    )
    origins = begin[:, 0] * 0.5 - 0.25  # rays of 32 steps of 1 / 32, well inside the cube [-1, 1]^3
    edges = torch.arange(SAMPLES_PER_RAY + 2) / SAMPLES_PER_RAY * 0.5
    axis = torch.tensor([0.0, 0.0, 1.0]).expand(rays, 3)
    occupied = torch.ones(64, 64, 64, dtype=torch.bool)

    def follow(module: Any, table: Tensor) -> tuple[Tensor, ...]:
        """Return density and features, too thin to end a ray; a jitter of 0 keeps all 32 steps of each ray."""
        o, d, e, *layers = (x.to(table.dtype) for x in (origins, axis, edges, *weights))
        out = module.visible_samples(
            Rays(o, d, torch.zeros_like(o[:, 0])),
            March(e, occupied, "none", 1e9),
            HashGrid(table, resolutions, tuple(layers)),
        )
        return out.density, out.encoded

    yield Operation(
        "visible_samples",
        (table * 0.1,),
        lambda t: follow(numba_cpu, t),
        lambda t: follow(reference, t),
        has_backward=False,
    )
    thickness = torch.rand(samples, generator=generator) * 4.0
    rgb = torch.rand(samples, 3, generator=generator)
    lengths = torch.full((samples,), 1 / SAMPLES_PER_RAY)
    background = torch.rand(rays, 3, generator=generator)
    yield Operation(
        "composite",
        (thickness, rgb),
        lambda d, c: numba_cpu.composite(d, c, lengths, offsets=offsets, background=background),
        lambda d, c: reference.composite(d, c, lengths.to(d.dtype), offsets=offsets, background=background.to(d.dtype)),
    )

    middles = (torch.arange(samples) % SAMPLES_PER_RAY) / SAMPLES_PER_RAY
    yield Operation(
        "distortion",
        (torch.rand(samples, generator=generator),),
        lambda w: (numba_cpu.distortion(w, middles, middles + 1 / SAMPLES_PER_RAY, offsets),),
        lambda w: (reference.distortion(w, middles.to(w.dtype), (middles + 1 / SAMPLES_PER_RAY).to(w.dtype), offsets),),
    )
    rows = [torch.randn(1, samples, 4, generator=generator) for _ in range(4)]
    rows[3] = rows[3].square()

    def step(module: Any, dtype: torch.dtype) -> tuple[Tensor, ...]:
        """Take a step of Adam on `samples` rows with gradients; the time includes copying the arrays."""
        arrays = [x.to(dtype, copy=True) for x in rows]
        module.adam_rows(*arrays, step=AdamStep(3, 0.01, (0.9, 0.99), 1e-15))
        return arrays[0], arrays[2], arrays[3]

    yield Operation(
        "adam_rows, with a copy",
        (rows[0],),
        lambda t: step(numba_cpu, t.dtype),
        lambda t: step(reference, t.dtype),
        has_backward=False,
    )


def median_seconds(action: Callable[[], object]) -> tuple[float, float, float]:
    """Return median and quartiles of the seconds that `action` takes, after a call that does not count."""
    action()
    times: list[float] = []
    until = time.perf_counter() + SECONDS_EACH
    while len(times) < FEWEST or (time.perf_counter() < until and len(times) < MOST):
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
    low, middle, high = statistics.quantiles(times, n=4)
    return middle, low, high


def relative_error(actual: tuple[Tensor, ...], exact: tuple[Tensor, ...]) -> float:
    """Return the largest difference, relative to the largest value of its tensor."""
    worst = 0.0
    for a, b in zip(actual, exact, strict=True):
        scale = b.abs().max().item()
        worst = max(worst, (a.double() - b).abs().max().item() / scale if scale else 0.0)
    return worst


def measure(operation: Operation, samples: int, log2_rows: int, threads: int) -> Iterator[Measurement]:
    """Measure the forward and backward passes of one kernel."""

    def leaves(dtype: torch.dtype) -> tuple[Tensor, ...]:
        return tuple(x.to(dtype, copy=True).requires_grad_(operation.has_backward) for x in operation.inputs)

    fast_in, slow_in, exact_in = leaves(torch.float32), leaves(torch.float32), leaves(torch.float64)
    fast, slow, exact = operation.fast(*fast_in), operation.exact(*slow_in), operation.exact(*exact_in)

    def line(direction: str, quick: Callable[[], object], plain: Callable[[], object], error: float) -> Measurement:
        middle, low, high = median_seconds(quick)
        scale = 1e9 / samples
        times = median_seconds(plain)[0] / middle
        return Measurement(
            operation.name, direction, samples, log2_rows, threads, middle * scale, low * scale, high * scale, times,
            error,
        )  # fmt: skip

    error = relative_error(fast, exact)
    yield line("forward", lambda: operation.fast(*fast_in), lambda: operation.exact(*slow_in), error)
    if not operation.has_backward:
        return
    generator = torch.Generator().manual_seed(1)
    given = [torch.randn(out.shape, generator=generator) for out in fast]

    def gradients(outputs: tuple[Tensor, ...], inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        back = [g.to(out.dtype) for g, out in zip(given, outputs, strict=True)]
        return torch.autograd.grad(outputs, inputs, back, retain_graph=True)

    error = relative_error(gradients(fast, fast_in), gradients(exact, exact_in))
    yield line("backward", lambda: gradients(fast, fast_in), lambda: gradients(slow, slow_in), error)


def numbers(text: str) -> list[int]:
    """Parse a comma-separated list."""
    return [int(part) for part in text.split(",")]


def main(
    output: Annotated[Path | None, typer.Option("-o", help="Also write the table as CSV.")] = None,
    sizes: Annotated[str, typer.Option(help="Samples.")] = "1,100,10000,131072,1000000",
    log2_rows: Annotated[str, typer.Option(help="Rows per level, as powers of two.")] = "14,17,19,21",
    threads: Annotated[str, typer.Option(help="Thread counts.")] = "1,2",
) -> None:
    """Measure every compiled kernel against the reference."""
    numba_cpu.warm_up()
    lines: list[Measurement] = []
    console = Console(stderr=True)
    for count in numbers(threads):
        torch.set_num_threads(count)
        for rows in numbers(log2_rows):
            for samples in numbers(sizes):
                for operation in operations(samples, rows):
                    # Only these two depend on the size of the table.
                    if operation.name in ("hash_encode", "visible_samples") or rows == numbers(log2_rows)[0]:
                        console.print(f"{operation.name}, {samples} samples, 2^{rows} rows, {count} threads")
                        lines.extend(measure(operation, samples, rows, count))
    names = [field.name for field in fields(Measurement)]
    table = Table(title=f"{platform.machine()}, {platform.platform(terse=True)}, torch {torch.__version__}")
    for name in names:
        table.add_column(name.replace("_", " "), justify="right", no_wrap=True)
    rows_of_text = [[_text(getattr(line, name)) for name in names] for line in lines]
    for row in rows_of_text:
        table.add_row(*row)
    Console(width=140).print(table)
    if output is not None:
        with output.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(names)
            writer.writerows(rows_of_text)


def _text(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    typer.run(main)
