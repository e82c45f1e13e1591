"""Gain and cost of each component on the scene that needs it, and what `--model auto` picks there.

    python benchmarks/component_scenes.py scenes
    python benchmarks/components.py scenes -o components
    python benchmarks/components.py scenes -o exposure --only exposure --steps 600
    python benchmarks/components.py scenes -o picked --choices auto --steps 6700 --seeds 10

Each choice is trained with the same seeds and steps; "auto" searches on 15 % of them first. Held-out PSNR is the mean
over whole photos, as in `nerfcli evaluate`. Seconds are processor time of the training only, so that other work on the
machine hardly matters. Prints a table and writes OUT.csv.
"""

import csv
import statistics
import tempfile
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.table import Table

from nerfcli import kernels
from nerfcli.captures.loading import load_scene
from nerfcli.evaluate.photos import held_out_photos
from nerfcli.evaluate.protocol import evaluate_model
from nerfcli.training.loop import Progress, train
from nerfcli.training.runs.components import Components, choose, differences
from nerfcli.training.runs.run import Run
from nerfcli.training.runs.settings import TrainSettings

# Scene, downscale, and the choices to compare, the baseline first. "-name" is --without, "auto" is --model auto.
CASES: tuple[tuple[str, int, tuple[str, ...]], ...] = (
    ("exposure-balls", 1, ("", "exposure", "auto")),
    ("exposure-exif-balls", 1, ("", "exposure=exif", "exposure", "auto")),
    ("alpha", 1, ("", "exposure", "-view", "-near", "-distortion", "background=black", "auto")),
    ("exposure", 2, ("", "exposure", "auto")),
    ("glossy", 1, ("-view", "view=1", "view=2", "", "auto")),
    ("unbounded", 1, ("", "background=constant", "background", "auto")),
    ("poses-balls", 1, ("", "cameras=poses", "auto")),
    ("focal", 2, ("", "cameras=focal", "auto")),
    ("poses", 2, ("", "cameras=poses", "auto")),
    ("desk", 2, ("", "auto")),
    ("scales", 1, ("", "antialias")),
)


@dataclass(frozen=True)
class Trained:
    """One training and its held-out metrics; `picked` lists what differs from the default components."""

    scene: str
    components: str
    picked: str
    seed: int
    steps: int
    psnr: float
    ssim: float
    cpu_seconds: float
    samples: float


def fit(folder: Path, choice: str, *, seed: int, steps: int, downscale: int, samples_per_step: int) -> Trained:
    """Train with one choice of components, and measure."""
    names = choice.replace("auto", "").split()
    components = choose(
        Components(),
        included=[name for name in names if not name.startswith("-")],
        excluded=[name[1:] for name in names if name.startswith("-")],
    )
    settings = TrainSettings(
        budget_seconds=None,
        steps=steps,
        downscale=downscale,
        seed=seed,
        samples_per_step=samples_per_step,
        components=components,
        model="auto" if choice == "auto" else "default",
    )
    capture = load_scene(folder)
    began = used = 0.0
    samples = 0.0

    def clock(progress: Progress) -> None:
        nonlocal began, used, samples
        began = began or time.process_time()
        used = time.process_time() - began
        samples = progress.samples_per_second * progress.seconds

    with tempfile.TemporaryDirectory() as run:
        train(capture, Path(run), settings, resume=False, notify=lambda text: None, on_progress=clock)
        trained = Run(Path(run))
        model, picked = trained.model(), differences(trained.components)
        held_out = held_out_photos(trained, capture.test_frames)
    mean = evaluate_model(model, held_out).mean
    found = " ".join(f"{name}={value}" for name, value in picked.items())
    return Trained(folder.name, choice or "default", found, seed, steps, mean.psnr, mean.ssim or 0.0, used, samples)


def print_table(trained: list[Trained]) -> None:
    """Print one line per scene and choice: means over the seeds, and gains over the first choice at equal seeds."""
    table = Table(title=f"{trained[0].steps} steps")
    for name in ("scene", "components", "PSNR dB", "gain dB", "spread of it", "SSIM", "CPU s", "picked"):
        table.add_column(name, justify="left" if name in ("scene", "components", "picked") else "right")
    for place in dict.fromkeys(t.scene for t in trained):
        of_scene = [t for t in trained if t.scene == place]
        first = {t.seed: t.psnr for t in of_scene if t.components == of_scene[0].components}
        for choice in dict.fromkeys(t.components for t in of_scene):
            mine = [t for t in of_scene if t.components == choice]
            gains = [t.psnr - first[t.seed] for t in mine]
            picked = [t.picked or "nothing" for t in mine]
            table.add_row(
                place,
                choice,
                f"{statistics.fmean(t.psnr for t in mine):.2f}",
                f"{statistics.fmean(gains):+.2f}",
                f"{max(gains) - min(gains):.2f}",
                f"{statistics.fmean(t.ssim for t in mine):.3f}",
                f"{statistics.fmean(t.cpu_seconds for t in mine):.1f}",
                ", ".join(f"{picked.count(one)} x {one}" for one in dict.fromkeys(picked)),
            )
    Console(width=140).print(table)


def main(
    scenes: Annotated[Path, typer.Argument(help="What component_scenes.py wrote.")],
    output: Annotated[Path, typer.Option("-o", help="Where to write, without suffix.")],
    only: Annotated[list[str] | None, typer.Option(help="Scenes; all by default.")] = None,
    choices: Annotated[str | None, typer.Option(help="Instead of those of the scene, separated by commas.")] = None,
    seeds: Annotated[int, typer.Option(help="Trainings of each.")] = 3,
    steps: Annotated[int, typer.Option(help="Of each training.")] = 500,
    samples: Annotated[int, typer.Option(help="Samples of the last steps.")] = 2**14,
) -> None:
    """Compare trainings with and without components."""
    torch.set_num_threads(1)
    kernels.prepare(Console(stderr=True).print)
    trained: list[Trained] = []
    with output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Trained)])
        writer.writeheader()
        for name, downscale, listed in CASES:
            if only and name not in only:
                continue
            for seed in range(seeds):
                for choice in [text.strip() for text in choices.split(",")] if choices else listed:
                    trained.append(
                        fit(
                            scenes / name, choice, seed=seed, steps=steps, downscale=downscale, samples_per_step=samples
                        )
                    )
                    writer.writerow(asdict(trained[-1]))
                    file.flush()
    print_table(trained)


if __name__ == "__main__":
    typer.run(main)
