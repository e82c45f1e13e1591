"""Reconstructions of computed scans, by number of views and seed of the noise.

    python benchmarks/tomography.py ct_tooth/line_integrals_f32.npy -o tooth --views 60,30,15 --seeds 3
    python benchmarks/tomography.py sample_scenes/phantom -o phantom --views 40,20,10

SCAN is any input of `ct convert` that names its true volume. Line integrals get counting noise of --photons, different
for each seed; counts stay unchanged. Every n-th training view is fitted; the held-out views are always the same. All
other settings are the defaults of `ct train`. Writes OUT.csv and prints a table; the runs stay in the folder OUT.
"""

import csv
import statistics
import time
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table
from torch import Tensor

from nerfcli import kernels
from nerfcli.ct.convert import read_scan
from nerfcli.ct.evaluate import evaluate_scan, held_out_air, logarithms, score_projections, score_volume
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.reconstruct import Projector
from nerfcli.ct.result import Reconstruction, ReconstructionSettings, scan_of
from nerfcli.ct.scan import Scan, load_truth, save_scan
from nerfcli.ct.train import train_scan
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output

# Number of rounds over all views; relaxation of the first round and its decay per round.
SART_ROUNDS = 8
RELAXATION, DECAY = 0.3, 0.9
# Threshold of SART's total variation, as a fraction of the largest attenuation, times the number of views. It was found
# on a tooth at 60, 30 and 15 views (0.004, 0.008, 0.015).
TV_OF_VIEWS = 0.24
TV_STEPS = 20


@dataclass(frozen=True)
class Line:
    """One reconstruction; times are 0 for the baselines."""

    method: str
    views: int
    seed: int
    volume_db: float
    ssim: float
    held_out_rms: float
    held_out_db: float
    chi_square: float
    passes: int
    settled: bool
    clock_s: float
    cpu_s: float


def with_noise(scan: Scan, photons: float, seed: int) -> Scan:
    """Return line integrals as noisy transmissions of `photons`; other scans are returned unchanged."""
    if scan.kind != "line_integral":
        return scan
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-scan.values.astype(np.float64)))
    values = (counts / photons).astype(np.float32)
    return replace(scan, kind="transmission", values=values, photons_per_value=photons)


def thinned(scan: Scan, views: int) -> Scan:
    """Return the scan with every n-th of its training views, and all held-out ones."""
    training = scan.training_views
    chosen = training[:: max(1, len(training) // views)][:views]
    index = np.sort(np.concatenate([chosen, np.array(scan.held_out, dtype=int)]))
    arrays: dict[str, Any] = {name: scan.of_views(name, index) for name in ("open_beam", "dark", "usable")}
    held_out = tuple(int(k) for k in np.flatnonzero(np.isin(index, scan.held_out)))
    return replace(scan, geometry=scan.geometry.select(index), values=scan.values[index], held_out=held_out, **arrays)


def sart_total_variation(geometry: ScanGeometry, integrals: np.ndarray, grid: VoxelGrid) -> Tensor:
    """Reconstruct by SART with positivity and total variation denoising after each round over the views.

    Args:
        integrals: (V, rows, columns) line integrals.

    Returns:
        (Z, Y, X) attenuation, >= 0.

    Source: Andersen and Kak 1984, Simultaneous algebraic reconstruction technique, Ultrasonic Imaging 6; Chambolle 2004
    for the denoising.
    """
    projector = Projector(geometry, grid)
    backend = kernels.backend_for(torch.device("cpu"), torch.float32)
    ones = torch.ones(grid.shape)
    volume, dual = torch.zeros(grid.shape), torch.zeros(3, *grid.shape)
    measured = torch.from_numpy(np.ascontiguousarray(integrals, dtype=np.float32).reshape(geometry.views, -1))
    order = sorted(range(geometry.views), key=lambda view: int(format(view, "016b")[::-1], 2))
    for number in range(SART_ROUNDS):
        for view in order:
            index = np.array([view])
            chord = projector.forward(ones, index)
            left = (measured[index] - projector.forward(volume, index)) / chord.clamp_min(grid.size)
            left = torch.where(chord > 0, left, 0)
            met = projector.backward(torch.ones_like(chord), index)
            step = projector.backward(left, index) / met.clamp_min(1e-3 * float(met.max()) + 1e-30)
            volume = (volume + RELAXATION * DECAY**number * step).clamp_min(0)
        threshold = torch.full(grid.shape, TV_OF_VIEWS / geometry.views * float(volume.max()) + 1e-30)
        volume = backend.denoise_total_variation(volume, threshold, dual.zero_(), iterations=TV_STEPS)
    return volume


def scores_of_sart(scan: Scan, result: Reconstruction) -> dict[str, Any]:
    """Return the metrics of SART with total variation, from the views and with the geometry of a reconstruction."""
    geometry, truth = scan.geometry.corrected(result.used["centre"], result.used["tilt"]), load_truth(scan.history)
    assert truth is not None
    integrals = logarithms(scan, result.used["air"])
    volume = sart_total_variation(geometry.select(scan.training_views), integrals, result.grid)
    air = held_out_air(scan, geometry, result)
    projections = score_projections(scan, geometry, volume, result.grid, air=air)
    assert projections is not None
    return {
        "projections": asdict(projections),
        "volume": asdict(score_volume(volume.numpy(), result.grid, truth[1], truth[0])),
    }


def main(
    scan: Annotated[Path, typer.Argument()],
    output: Annotated[Path, typer.Option("-o")],
    views: str = "60,30,15",
    seeds: int = 1,
    first_seed: int = 0,
    seconds: float = 120.0,
    passes: Annotated[int | None, typer.Option(help="Passes, instead of a time.")] = None,
    photons: float = 2e4,
    threads: int = 2,
    baselines: Annotated[bool, typer.Option(help="SART with total variation, too, for the first seed.")] = True,
    processor_time: Annotated[
        bool, typer.Option(help="Budgets count seconds of processor time per thread, for a machine with other work.")
    ] = False,
) -> None:
    """See the module's text."""
    kernels.prepare(print)
    clock = time.perf_counter
    if processor_time:
        time.perf_counter = lambda: time.process_time() / threads
    whole = read_scan(scan)
    output.mkdir(parents=True, exist_ok=True)
    lines: list[Line] = []
    with Path(f"{output}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Line)])
        writer.writeheader()
        for count in (int(text) for text in views.split(",")):
            for seed in range(first_seed, first_seed + seeds):
                folder = output / f"{count}-views-{seed}"
                save_scan(folder, thinned(with_noise(whole, photons, seed), count))
                settings = ReconstructionSettings(None if passes else seconds, passes, threads=threads)
                run = folder.with_name(f"{folder.name}-run")
                begun, used = clock(), time.process_time()
                result = train_scan(folder, Output(run, overwrite=True), settings, reporter=Reporter(note=print))
                spent = {"clock_s": clock() - begun, "cpu_s": time.process_time() - used}
                methods = evaluate_scan(run, Output(overwrite=True), resources=Resources(threads)).metrics["methods"]
                if baselines and seed == first_seed:
                    methods["SART with total variation"] = scores_of_sart(scan_of(result, run), result)
                for name, found in methods.items():
                    own = name == "nerfcli"
                    projections, volume = found["projections"], found["volume"]
                    line = Line(
                        name,
                        *(count, seed, volume["psnr"], volume["ssim"]),
                        *(projections["rms"], projections["psnr"], projections["chi_square"]),
                        *((result.passes, result.settled) if own else (0, False)),
                        **(spent if own else dict.fromkeys(spent, 0.0)),
                    )
                    lines.append(line)
                    writer.writerow(asdict(line))
                    file.flush()
                    print(line, flush=True)
    print_table(lines)


def print_table(lines: list[Line]) -> None:
    """Print means and standard deviations over seeds."""
    table = Table("method", "views", "seeds", "volume dB", "SSIM", "held-out dB", "chi-square", "s", "CPU s")
    for method, views in dict.fromkeys((line.method, line.views) for line in lines):
        own = [line for line in lines if (line.method, line.views) == (method, views)]

        def cell(name: str, digits: int, own: list[Line] = own) -> str:
            values = [getattr(line, name) for line in own]
            spread = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
            return f"{statistics.mean(values):.{digits}f}{spread}"

        numbers = (("volume_db", 2), ("ssim", 3), ("held_out_db", 2), ("chi_square", 3), ("clock_s", 0), ("cpu_s", 0))
        table.add_row(method, str(views), str(len(own)), *(cell(*number) for number in numbers))
    Console().print(table)


if __name__ == "__main__":
    typer.run(main)
