"""Storage, computation and quality of the three kinds of fields, at equal bytes and equal processor time.

    python benchmarks/representations.py photos-scene lego_400 -o representations
    python benchmarks/representations.py desk -o desk --seconds 30 --megabytes 1,4

Each field is trained for a fixed processor time, which other programs on the machine disturb less than wall-clock time;
then the same pixels of held-out photos are rendered. Writes OUT.csv and prints a table.
"""

import csv
import statistics
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table

from nerfcli import kernels, scene
from nerfcli.field.cost import optimiser_bytes, parameter_bytes, work
from nerfcli.field.kinds import KINDS
from nerfcli.fit.extent import choose_extent
from nerfcli.fit.fitting import Fitting
from nerfcli.photos.loading import load_photos
from nerfcli.photos.pool import PixelPool
from nerfcli.render.model import Model
from nerfcli.runs.settings import TrainSettings, automatic_downscale
from nerfcli.train.waypoints import HeldoutPixels

# Samples per step of a network: with those of a hash grid, one step of a network of megabytes exceeds the budget.
NETWORK_SAMPLES = 2**13


@dataclass(frozen=True)
class Line:
    """One training: its inputs, costs and results."""

    scene: str
    kind: str
    megabytes: float
    size: str
    weight_bytes: int
    training_bytes: int
    operations_per_sample: int
    bytes_per_sample: int
    cpu_s: float
    clock_s: float
    steps: int
    samples: int
    cpu_us_per_sample: float
    psnr: float
    render_cpu_us_per_ray: float


class Capture:
    """The photos of a scene, prepared for many trainings."""

    def __init__(self, folder: Path, *, pixels: int, threads: int):
        capture = scene.load(folder)
        self.name = folder.name
        first = capture.train_frames[0].camera
        factor = automatic_downscale(first)
        photos = load_photos(capture.train_frames, factor=factor, threads=threads)
        fills_frame = any(photo.pixels.shape[-1] == 3 for photo in photos)
        settings = TrainSettings(threads=threads)
        self.extent = choose_extent(capture, settings, fills_frame=fills_frame)
        self.similarity = self.extent.training_from_scene
        self.pool = PixelPool(photos, self.similarity, torch.device("cpu"))
        self.test_photos = load_photos(capture.test_frames, factor=factor, threads=threads)
        self.heldout = HeldoutPixels(self.test_photos, self.similarity, torch.device("cpu"))
        # Fewer pixels: a network of megabytes takes seconds to render what takes a grid milliseconds.
        for name in ("origins", "directions", "colours", "cones", "photos"):
            setattr(self.heldout, name, getattr(self.heldout, name)[:pixels])
        self.background = (1.0, 1.0, 1.0) if self.pool.has_alpha else (0.0, 0.0, 0.0)

    def psnr(self, model: Model) -> float:
        """Return PSNR on the held-out pixels, taking all photos as equally exposed."""
        return self.heldout.psnr(model, log_gains=np.zeros((len(self.test_photos), 3)))

    def model(self, fitting: Fitting) -> Model:
        """Return the current model of a training."""
        return Model(
            fitting.field, fitting.cells.coarse, self.extent.marching, self.background, self.similarity, "arbitrary"
        )


def measure(capture: Capture, kind: str, *, megabytes: float, seconds: float, threads: int) -> Line:
    """Train one field for `seconds` of processor time per thread."""
    samples = NETWORK_SAMPLES if kind == "mlp" else TrainSettings.samples_per_step
    settings = TrainSettings(
        budget_seconds=seconds,
        threads=threads,
        field=kind,
        field_memory_bytes=round(megabytes * 1e6),
        first_samples_per_step=min(samples, TrainSettings.first_samples_per_step),
        samples_per_step=samples,
    )
    fitting = Fitting(capture.pool, capture.extent.marching, contraction=capture.extent.contraction, settings=settings)
    budget, taken = seconds * threads, 0
    clock, began = time.perf_counter(), time.process_time()
    while (used := time.process_time() - began) < budget:
        taken += fitting.advance(used / budget).samples
    clock = time.perf_counter() - clock
    model = capture.model(fitting)
    rendering = time.process_time()
    psnr = capture.psnr(model)
    rendering = time.process_time() - rendering
    counts = work(fitting.field.settings)
    size = fitting.field.settings.to_json()
    return Line(
        scene=capture.name,
        kind=kind,
        megabytes=megabytes,
        size=" ".join(f"{name} {size[name]}" for name in ("log2_rows", "log2_vertices", "width") if name in size),
        weight_bytes=parameter_bytes(counts.parameters),
        training_bytes=optimiser_bytes(counts.parameters) + counts.activation_bytes(samples),
        operations_per_sample=counts.operations,
        bytes_per_sample=counts.bytes_moved,
        cpu_s=round(used, 2),
        clock_s=round(clock, 2),
        steps=fitting.step,
        samples=taken,
        cpu_us_per_sample=round(used / max(1, taken) * 1e6, 3),
        psnr=round(psnr, 3),
        render_cpu_us_per_ray=round(rendering / len(capture.heldout.origins) * 1e6, 2),
    )


def print_table(lines: list[Line], seconds: float, threads: int) -> None:
    """Print one line per training, and the mean PSNR of each kind."""
    table = Table(title=f"{seconds:g} s of processor time on each of {threads} threads")
    names = ("scene", "field", "MB", "training MB", "ops", "B", "steps", "M samples", "CPU us", "PSNR dB", "us a ray")
    for name in names:
        table.add_column(name, justify="left" if name in names[:2] else "right")
    for line in lines:
        table.add_row(
            line.scene, f"{line.kind} ({line.size})", f"{line.weight_bytes / 1e6:.2f}",
            f"{line.training_bytes / 1e6:.0f}", f"{line.operations_per_sample}", f"{line.bytes_per_sample}",
            f"{line.steps}", f"{line.samples / 1e6:.2f}", f"{line.cpu_us_per_sample:.2f}", f"{line.psnr:.2f}",
            f"{line.render_cpu_us_per_ray:.0f}",
        )  # fmt: skip
    console = Console(width=140)
    console.print(table)
    for kind in KINDS:
        of_kind = [line.psnr for line in lines if line.kind == kind]
        if of_kind:
            console.print(f"{kind}: {statistics.fmean(of_kind):.2f} dB in the mean over scenes and sizes")


def main(
    folders: Annotated[list[Path], typer.Argument(help="Scenes, as nerfcli train takes them.")],
    output: Annotated[Path, typer.Option("-o", help="Where to write, without suffix.")],
    seconds: Annotated[float, typer.Option(help="Processor time per thread for each training.")] = 20.0,
    megabytes: Annotated[str, typer.Option(help="Sizes of the fields.")] = "1,4,16,64",
    kinds: Annotated[str, typer.Option(help="Kinds of fields.")] = ",".join(KINDS),
    pixels: Annotated[int, typer.Option(help="Held-out pixels, the same for all; at most 4096.")] = 1024,
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 2,
) -> None:
    """Measure the kinds of fields at equal bytes and equal time."""
    torch.set_num_threads(threads)
    kernels.prepare(Console(stderr=True).print)
    lines: list[Line] = []
    with output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Line)])
        writer.writeheader()
        for folder in folders:
            capture = Capture(folder, pixels=pixels, threads=threads)
            for size in (float(part) for part in megabytes.split(",")):
                for kind in kinds.split(","):
                    lines.append(measure(capture, kind, megabytes=size, seconds=seconds, threads=threads))
                    writer.writerow(asdict(lines[-1]))
                    file.flush()
                    Console(stderr=True).print(lines[-1])
    print_table(lines, seconds, threads)


if __name__ == "__main__":
    typer.run(main)
