"""Correctness and speed of the GPU kernels, on a machine with a GPU, in less than 25 minutes.

    python benchmarks/gpu.py --capture sample_scenes/spheres -o gpu-results
    python benchmarks/gpu.py --capture sample_scenes/spheres -o /tmp/dry --dry

Results are kept in OUT/results.json, and a call with the same OUT continues from there; OUT/table.md shows them.
`--dry` runs everything without a GPU: the kernels run in Triton's interpreter, at sizes too small to be meaningful.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

ROOT = Path(__file__).parent.parent
BUDGETS = (5, 15, 60, 300)


@dataclass(frozen=True)
class Sizes:
    """Sizes and repetitions of the measurements."""

    samples: tuple[int, ...]
    log2_rows: tuple[int, ...]
    batches: tuple[int, ...]
    budgets: tuple[int, ...]
    picture: int
    repeats: int
    warm_up_steps: int


FULL = Sizes((2**16, 2**18, 2**20), (16, 19, 21), (2**16, 2**17, 2**18, 2**19, 2**20), BUDGETS, 800, 20, 600)
TINY = Sizes((48,), (6,), (96,), (5,), 6, 1, 1)


class Results:
    """Measurements by name, written to disk after each one."""

    def __init__(self, folder: Path, seconds: float):
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self._until = folder, time.monotonic() + seconds
        self._path = folder / "results.json"
        self.values: dict[str, Any] = json.loads(self._path.read_text()) if self._path.is_file() else {}

    def measure(self, name: str, function: Callable[[], Any], *, needs: float = 0.0) -> None:
        """Store the result of a function, unless it is there already or no time is left."""
        if name in self.values:
            return
        if time.monotonic() + needs > self._until:
            print(f"{name}: no time left", flush=True)
            return
        try:
            self.values[name] = function()
        except Exception as error:  # the other measurements are still useful
            self.values[name] = {"error": f"{type(error).__name__}: {error}"}
        print(f"{name}: {self.values[name]}", flush=True)
        self._path.write_text(json.dumps(self.values, indent=1))


def timed(function: Callable[[], Any], device: Any, repeats: int) -> float:
    """Return the median seconds of a call, by the device's clock."""
    import torch

    if device.type != "cuda":
        began = time.perf_counter()
        function()
        return time.perf_counter() - began
    for _ in range(3):
        function()
    seconds = []
    for _ in range(repeats):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        function()
        end.record()
        end.synchronize()
        seconds.append(start.elapsed_time(end) / 1e3)
    return statistics.median(seconds)


def correct(dry: bool) -> str:
    """Run the tests of the kernels; raise an error with the end of their output if one fails."""
    only = ["-k", "adam_rows"] if dry else []
    suite = ("tests/triton_kernels.py", "tests/test_kernels.py", *only)
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *suite]
    environment = {**os.environ, "NERFCLI_KERNELS": "triton_cuda"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode:
        raise RuntimeError(done.stdout[-2000:])
    return "agree"


def stages(samples: int, log2_rows: int, device: Any, repeats: int) -> dict[str, float]:
    """Return nanoseconds per sample of every kernel, with 32 samples per ray."""
    import torch

    from nerfcli.kernels.interface import AdamStep, HashGrid, March, Rays
    from nerfcli.kernels.triton_cuda import compositing, depth, hash_grid, marching, networks, row_adam

    torch.manual_seed(0)
    rays, each = max(1, samples // 32), 32 if samples >= 32 else samples
    count = rays * each
    offsets = torch.arange(rays + 1, device=device) * each
    index = torch.arange(rays, device=device).repeat_interleave(each)
    origins = 0.2 * torch.randn(rays, 3, device=device)
    directions = torch.nn.functional.normalize(torch.randn(rays, 3, device=device), dim=-1)
    edges = torch.linspace(0.05, 1.5, each + 2, device=device)
    starts, ends = edges[:each].repeat(rays), edges[1 : each + 1].repeat(rays)
    points = (origins[index] + directions[index] * ((starts + ends) / 2)[:, None]).clamp(-2, 2) / 4 + 0.5
    table = (torch.rand(8, 2**log2_rows, 4, device=device) - 0.5).half()
    resolutions = tuple(round(16 * 1.8114**level) for level in range(8))
    shapes = ((32, 32), (16, 32), (32, 32), (32, 32), (3, 32))
    layers = tuple(0.2 * torch.randn(shape, device=device) for shape in shapes)
    code = hash_grid.encode(points, table, resolutions, widths=None, dtype=torch.float16)
    density, rgb = networks.radiance(code, directions, index, layers, degree=3)
    by_density, by_rgb = 1e-6 * torch.randn_like(density), 1e-6 * torch.randn_like(rgb)
    one, table_grad = torch.ones(1, device=device), torch.zeros(8, 2**log2_rows, 4, device=device)
    thick, colours = (x.detach().clone().requires_grad_() for x in (density, rgb))
    lengths, background = ends - starts, torch.zeros(rays, 3, device=device)
    march = March(edges, torch.ones(64, 64, 64, dtype=torch.bool, device=device), "l2", 7.0)
    along = Rays(origins, directions, torch.rand(rays, device=device))
    master, first, second = (torch.zeros_like(table_grad) for _ in range(3))
    capacity = marching.Capacity()
    grid = HashGrid(table.float(), resolutions, layers)
    named = {"scale": one, "widths": None}

    def gradients() -> Any:
        return networks.radiance_gradients(
            code, directions, index, layers, degree=3, density=density, by_density=by_density, by_rgb=by_rgb,
            rays_learn=False,
        )  # fmt: skip

    def composite() -> Any:
        return compositing.composite(thick, colours, lengths, offsets=offsets, background=background)

    def composite_both() -> None:
        composite()[0].sum().backward()

    def adam() -> None:
        table_grad.fill_(1e-6)
        row_adam.adam_rows(
            master, table_grad, first, second, half=table, step=AdamStep(1, 1e-3, (0.9, 0.99), 1e-15)
        )  # fmt: skip

    functions: dict[str, Callable[[], Any]] = {
        "march": lambda: marching.occupied_samples(along, march),
        "visible": lambda: marching.visible_samples(along, march, grid, table=table, capacity=capacity),
        "encode": lambda: hash_grid.encode(points, table, resolutions, widths=None, dtype=torch.float16),
        "encode backward": lambda: hash_grid.add_table_gradient(table_grad, points, code, resolutions, **named),
        "points backward": lambda: hash_grid.points_gradient(points, table, code, resolutions, **named),
        "density": lambda: networks.density(code, layers),
        "radiance": lambda: networks.radiance(code, directions, index, layers, degree=3),
        "radiance backward": gradients,
        "composite": composite,
        "composite, both ways": composite_both,
        "distortion": lambda: compositing.distortion(density, starts, ends, offsets),
        "depth": lambda: depth.ray_termination(density, starts, ends, offsets=offsets, fractions=(0.5,)),
        "adam of all rows, with fill": adam,
    }
    return {name: 1e9 * timed(function, device, repeats) / count for name, function in functions.items()}


def fitting_of(capture: Path, device: Any, batch: int, log2_rows: int) -> tuple[Any, Any]:
    """Return a fresh training with the GPU kernels, and the similarity to its training frame."""
    from nerfcli.captures.loading import load_scene
    from nerfcli.kernels.triton_cuda.backend import TritonBackend
    from nerfcli.training.extent import choose_extent
    from nerfcli.training.fitting import Fitting, TrainingInputs
    from nerfcli.training.pool import PixelPool, load_album
    from nerfcli.training.runs.settings import TrainSettings, automatic_downscale
    from nerfcli.training.storage import IN_MEMORY

    captured = load_scene(capture)
    first = captured.train_frames[0].camera
    dry = device.type == "cpu"
    frames = captured.train_frames[:3] if dry else captured.train_frames
    factor = 8 if dry else automatic_downscale([first])
    album = load_album(frames, factor=factor, threads=4, storage=IN_MEMORY)
    settings = TrainSettings(
        budget_seconds=None,
        steps=1000,
        device=str(device),
        first_samples_per_step=batch,
        samples_per_step=batch,
        log2_rows=log2_rows,
    )
    extent = choose_extent(captured, settings, is_object=not album.fills_frame)
    pool = PixelPool(album, extent.training_from_scene, device)
    marching = extent.marching.stretched(20.0) if dry else extent.marching
    fitting = Fitting(TrainingInputs(settings, replace(extent, marching=marching), pool))
    fitting.field.backend = TritonBackend(device)
    return fitting, extent.training_from_scene


def same_losses(capture: Path, device: Any, sizes: Sizes) -> dict[str, float]:
    """Return relative differences of the losses of six steps from those in plain torch; float16 causes about 1e-4.

    Raises:
        RuntimeError: more than 1e-2.
    """
    from nerfcli.kernels import Backend

    losses: list[list[Any]] = []
    for plain in (False, True):
        fitting, _ = fitting_of(capture, device, 2 * sizes.batches[0], sizes.log2_rows[0])
        if plain:
            fitting.field.backend = Backend(device)
        losses.append([])
        for step in range(6):
            fitting.advance(0.3 + 0.1 * step)
            fitting.settle()
            losses[-1].append(sum(fitting.losses.values()))
    apart = [abs(fast - exact) / exact for fast, exact in zip(*losses, strict=True)]
    if max(apart) > 1e-2:
        raise RuntimeError(f"losses {losses[0]} instead of {losses[1]}")
    return {"first step": apart[0], "largest": max(apart)}


def whole_step(capture: Path, device: Any, batch: int, sizes: Sizes) -> dict[str, float]:
    """Return millions of samples per second of whole steps, with quartiles, after some training."""
    import torch

    fitting, _ = fitting_of(capture, device, batch, sizes.log2_rows[min(1, len(sizes.log2_rows) - 1)])
    for _ in range(sizes.warm_up_steps):
        fitting.advance(0.5)
    speeds, result = [], fitting.advance(0.6)
    for _ in range(max(2, 5 * sizes.repeats)):
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        began = time.perf_counter()
        result = fitting.advance(0.6)
        speeds.append(result.samples / (time.perf_counter() - began) / 1e6)
    low, middle, high = statistics.quantiles(speeds, n=4)
    return {"M samples/s": middle, "lower quartile": low, "upper quartile": high, "samples": float(result.samples)}


def quality(capture: Path, device: str, seconds: int, folder: Path, *, dry: bool) -> dict[str, float]:
    """Return held-out PSNR after a training of `seconds`."""
    import nerfcli
    from nerfcli.training.runs.settings import TrainSettings

    settings = TrainSettings(budget_seconds=float(seconds), device=device, threads=os.cpu_count() or 1)
    if dry:
        settings = replace(settings, budget_seconds=None, steps=2, downscale=8)
    output = nerfcli.Output(folder / f"{device.replace(':', '-')}-{seconds}", overwrite=True)
    run = nerfcli.train_scene(capture, output, settings)
    metrics = nerfcli.evaluate_run(
        run.path, nerfcli.Output(overwrite=True), resources=nerfcli.Resources(device=device)
    ).metrics
    summary = run.summary
    assert summary is not None
    return {"psnr": float(metrics.mean.psnr), "steps": summary.steps, "seconds": summary.seconds}


def pictures(capture: Path, device: Any, sizes: Sizes) -> dict[str, float]:
    """Return square pictures per second (800x800 at full size) after a short training."""
    from nerfcli.cameras.camera import Camera
    from nerfcli.render.model import Model
    from nerfcli.render.pictures import render_picture

    fitting, frame_of_training = fitting_of(capture, device, sizes.batches[len(sizes.batches) // 2], sizes.log2_rows[0])
    for _ in range(sizes.warm_up_steps):
        fitting.advance(0.5)
    steps = fitting.ray_steps.render_steps(fitting.plan.stride)
    model = Model(fitting.field, fitting.cells.coarse, steps, (1.0, 1.0, 1.0), frame_of_training, unit="arbitrary")
    from nerfcli.captures.loading import load_scene

    frame = load_scene(capture).train_frames[0]
    side = sizes.picture
    focal = frame.camera.focal_px * side / frame.camera.width
    frame = replace(frame, camera=Camera("SIMPLE_PINHOLE", side, side, (focal, side / 2, side / 2)))
    seconds = timed(lambda: render_picture(model, frame, background=(1.0, 1.0, 1.0)), device, sizes.repeats)
    return {"pictures/s": 1.0 / seconds, "side": side}


def table(values: dict[str, Any]) -> str:
    """Return the measurements as a Markdown table."""
    lines = ["| what | result |", "|---|---|"]
    for name, value in values.items():
        if isinstance(value, dict):
            numbers = (f"{key} {number:.4g}" if isinstance(number, float) else f"{key} {number}"
                       for key, number in value.items())  # fmt: skip
            value = ", ".join(numbers)
        lines.append(f"| {name} | {value} |")
    return "\n".join(lines) + "\n"


def main(
    capture: Annotated[Path, typer.Option(help="A scene, as nerfcli train takes it.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the results.")],
    device: Annotated[str, typer.Option(help="cuda or cuda:1.")] = "cuda",
    minutes: Annotated[float, typer.Option(help="Begin nothing that would end later than this.")] = 25.0,
    dry: Annotated[bool, typer.Option("--dry", help="Run everything at tiny sizes in Triton's interpreter.")] = False,
    cpu: Annotated[bool, typer.Option(help="Train on the CPU, too.")] = True,
) -> None:
    """Measure the GPU kernels."""
    if dry:
        os.environ["TRITON_INTERPRET"] = "1"
    import torch

    from nerfcli import kernels
    from nerfcli.kernels import describe_machine

    sizes, where = (TINY, torch.device("cpu")) if dry else (FULL, torch.device(device))
    if not dry:
        if (why_not := kernels.triton_unavailable_reason(where)) is not None:
            raise typer.BadParameter(f"the GPU kernels do not run on {device}: {why_not}", param_hint="--device")
        kernels.prepare(print, device)
    results = Results(output, 60 * minutes)
    results.measure("machine", lambda: describe_machine(os.cpu_count() or 1))
    for turn in ("once", "again"):
        results.measure(f"all kernels against float64, {turn}", lambda: correct(dry), needs=60)
    for samples in sizes.samples:
        for log2_rows in sizes.log2_rows:
            name = f"ns per sample, {samples} samples, 2^{log2_rows} rows"
            results.measure(name, lambda n=samples, rows=log2_rows: stages(n, rows, where, sizes.repeats), needs=30)
    results.measure("losses of six steps", lambda: same_losses(capture, where, sizes), needs=60)
    for batch in sizes.batches:
        name = f"whole steps of {batch} samples"
        results.measure(name, lambda n=batch: whole_step(capture, where, n, sizes), needs=60)
    results.measure(f"pictures of {sizes.picture}x{sizes.picture}", lambda: pictures(capture, where, sizes), needs=30)
    for name in ["cpu" if dry else device, *(["cpu"] if cpu and not dry else [])]:
        for seconds in sizes.budgets:
            results.measure(
                f"training of {seconds} s on {name}",
                lambda name=name, seconds=seconds: quality(capture, name, seconds, output, dry=dry),
                needs=1.3 * seconds + 20,
            )
    (output / "table.md").write_text(table(results.values))
    print(output / "table.md")
    if failed := [name for name, value in results.values.items() if isinstance(value, dict) and "error" in value]:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    typer.run(main)
