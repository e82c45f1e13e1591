"""The figures of docs/figures.md: measured cell by cell, kept in benchmarks/figures.json, written as one page.

    python benchmarks/figures.py captures/                                  # all cells, about seven hours
    python benchmarks/figures.py captures/ --budgets 60s,5m --captures desk,fox
    python benchmarks/figures.py                                            # writes the page again

`captures/` holds the folders that `CAPTURES` names, with photos in images/ or cameras of their own; desk is in
sample_scenes. Calls the commands as a user does, and adds every finished cell to the JSON file with commit, date and
processor. Cells of this commit (the last one that changed nerfcli/) are not measured again, so that it can be stopped
at any time and started again. Scenes and runs are kept in figure-runs/COMMIT. Run nothing else meanwhile.
"""

import json
import math
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Any

import depth
import poses
import typer
from jinja2 import Environment, StrictUndefined
from training import measure, nerfcli

from nerfcli.cli.options import seconds_from_text
from nerfcli.machine import processor_name

ROOT = Path(__file__).parent.parent
TEMPLATE = Path(__file__).with_name("figures.md.j2")
BUDGETS = (60.0, 300.0, 1800.0)
# Splats and depth are of the training whose budget is nearest.
USUAL_S = 300.0
SPLATS_BUDGET = "60s"
THREADS = 2
DEPTHS = ("conditional", "median")
# A cell: its kind, capture, budget_s, where and when it was measured, and its numbers.
Cell = dict[str, Any]


@dataclass(frozen=True)
class Capture:
    """A capture that is measured.

    Args:
        title: in the page.
        downscale: of its photos in training.
        own_poses: whether it is trained with the poses that it has, rather than those of `nerfcli poses`.
        posed: whether the time and the error of `nerfcli poses` are measured.
        depth: whether true or measured depth is known.
    """

    title: str
    downscale: str = "auto"
    own_poses: bool = False
    posed: bool = True
    depth: bool = False


CAPTURES = {
    "desk": Capture("desk at 400x300, 48 photos", "2", depth=True),
    "lego_400": Capture("lego at 400x400, 125 pictures", own_poses=True, posed=False),
    "fox": Capture("fox at 270x480, 50 photos", own_poses=True),
    "fern": Capture("fern at 1008x756, 20 photos", "1"),
    "banana": Capture("banana at 752x500, 16 photos"),
    "dtu24": Capture("dtu24 at 800x600, 49 photos"),
    "redkitchen": Capture("redkitchen at 640x480, 100 frames", depth=True),
    "monstree": Capture("monstree at 800x600, 23 photos"),
    "sceaux": Capture("sceaux at 708x532, 11 photos"),
}


class Measurement:
    """The measurements of one commit, in a folder for scenes and runs.

    Args:
        captures: the folder that holds them.
        folder: for scenes and runs.
    """

    def __init__(self, captures: Path, folder: Path):
        self.captures, self.folder = captures, folder

    def capture(self, name: str) -> Path:
        """Return the folder of a capture."""
        return ROOT / "sample_scenes" / name if name == "desk" else self.captures / name

    def poses(self, name: str, budget: float = 0.0) -> Cell:
        """Measure time and error of `nerfcli poses`; a scene that exists is kept with its time."""
        row = asdict(poses.measure(self.capture(name), "default", self.folder, seed=0, threads=THREADS))
        accuracy = row.pop("accuracy")
        return row | accuracy

    def run(self, name: str, budget: float) -> Path:
        """Return the folder of a training."""
        return self.folder / f"{name}-{budget:g}s"

    def quality(self, name: str, budget: float) -> Cell:
        """Train and evaluate."""
        capture, run = CAPTURES[name], self.run(name, budget)
        shutil.rmtree(run, ignore_errors=True)
        if capture.own_poses:
            scene = self.capture(name)
        else:
            self.poses(name)
            scene = self.folder / f"{name}-default"
        return asdict(measure(scene, budget, "auto", seed=0, threads=THREADS, run=run, downscale=capture.downscale))

    def trained(self, name: str, budget: float) -> Path:
        """Return a run that is trained and evaluated."""
        run = self.run(name, budget)
        if not (run / "metrics.json").is_file():
            self.quality(name, budget)
        return run

    def depth(self, name: str, budget: float) -> Cell:
        """Measure errors of depth: of desk with its true cameras, so that its depth is in metres."""
        if name == "desk":
            scene, run = self.folder / "desk-true", self.run("desk-true", budget)
            depth.desk_scene(scene)
            options = ("--budget", f"{budget}s", "--downscale", CAPTURES[name].downscale, "--threads", str(THREADS))
            nerfcli("train", str(scene), "-o", str(run), *options, "--overwrite", "--quiet")
        else:
            run = self.trained(name, budget)
        truth = None if name == "desk" else self.capture(name)
        found = depth.errors_of_run(run, truth, self.folder / f"{name}-depth")
        return {errors.depth: asdict(errors) for errors in found if errors.depth in DEPTHS}

    def splats(self, name: str, budget: float) -> Cell:
        """Export splats in every format, and compare them with the field."""
        run = self.trained(name, budget)
        common = ("--threads", str(THREADS), "--quiet")
        files = {suffix: run.with_name(f"{run.name}-splats.{suffix}") for suffix in ("ply", "spz", "html")}
        for file in files.values():
            nerfcli(
                "export", str(run), "--to", "splats", "-o", str(file), "--budget", SPLATS_BUDGET, "--overwrite", *common
            )
        (field, ply), (_, spz) = (self.beside_field(run, files[suffix]) for suffix in ("ply", "spz"))
        return {
            "field_psnr": field["mean"]["psnr"],
            "field_ssim": field["mean"]["ssim"],
            "count": ply["splats"]["count"],
            "psnr": ply["mean"]["psnr"],
            "ssim": ply["mean"]["ssim"],
            "spz_psnr": spz["mean"]["psnr"],
            "render_s": ply["render"]["seconds_per_image"],
            **{f"{kind}_mb": file.stat().st_size / 1e6 for kind, file in files.items()},
        }

    def page(self, name: str, budget: float) -> Cell:
        """Export the page of a field, and compare its pictures with those of `nerfcli render`."""
        from browser import Browser

        run = self.trained(name, budget)
        page = run.with_name(f"{run.name}.html")
        nerfcli(
            "export", str(run), "--to", "page", "-o", str(page), "--overwrite", "--threads", str(THREADS), "--quiet"
        )
        with Browser(self.folder / "browser") as browser:
            browser.open(page, "#check")
            found = json.loads(browser.wait("document.getElementById('checked').dataset.found", seconds=600))
        return {"page_mb": page.stat().st_size / 1e6, "page_psnr": -20 * math.log10(found["colour"]["rms"])}

    def beside_field(self, run: Path, splats: Path) -> list[Cell]:
        """Return the metrics of a field and of splats."""
        (run / f"metrics-{splats.name}.json").unlink(missing_ok=True)
        lines = nerfcli("evaluate", str(run), "--splats", str(splats), "--threads", str(THREADS), "--json", "--quiet")
        return [json.loads(line) for line in lines.splitlines()]


def has_browser() -> bool:
    """Return whether pages can be opened."""
    sys.path.append(str(ROOT / "tests"))
    from browser import find_browser

    return find_browser() is not None


def plan(names: Iterable[str], budgets: Sequence[float]) -> Iterator[tuple[str, str, float]]:
    """Yield kind, capture and budget of every cell, the longest trainings last."""
    names = list(names)
    yield from (("poses", name, 0.0) for name in names if CAPTURES[name].posed)
    usual, browser = min(budgets, key=lambda budget: abs(budget - USUAL_S)), has_browser()
    for budget in sorted(budgets):
        yield from (("quality", name, budget) for name in names)
        if budget == usual:
            yield from (("depth", name, budget) for name in names if CAPTURES[name].depth)
            yield from (("splats", name, budget) for name in names)
            yield from (("page", name, budget) for name in names if browser)


def read_cells(path: Path) -> list[Cell]:
    """Read the cells of a JSON file; none if there is no file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []


def key(cell: Cell) -> tuple[str, str, float | None]:
    """Return what is unique to a cell: the quality of fields is measured for several budgets, the rest for one."""
    return cell["kind"], cell["capture"], cell["budget_s"] if cell["kind"] in ("quality", "gpu") else None


def write_cells(path: Path, cells: Iterable[Cell]) -> None:
    """Write the latest measurement of each cell, one a line."""
    lines = ",\n".join(json.dumps(cell) for cell in {key(cell): cell for cell in cells}.values())
    path.write_text(f"[\n{lines}\n]\n", encoding="utf-8")


def rounded(numbers: Cell) -> Cell:
    """Return the numbers with four digits, without those that are NaN."""
    short = {name: rounded(value) if isinstance(value, dict) else value for name, value in numbers.items()}
    short = {name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in short.items()}
    return {name: value for name, value in short.items() if value == value}


def text(cell: Cell, *forms: str) -> str:
    """Return numbers of a cell in forms such as "{psnr:.2f} dB"; an en dash for what was not measured."""
    shown = []
    for form in forms:
        try:
            shown.append(form.format(**cell))
        except KeyError:
            shown.append("–")
    return "–" if set(shown) == {"–"} else ", ".join(shown)


def day(iso: str) -> str:
    """Return a date such as 29 November 2026."""
    found = date.fromisoformat(iso)
    return f"{found.day} {found:%B} {found.year}"


def page(cells: Sequence[Cell]) -> str:
    """Return docs/figures.md: benchmarks/figures.md.j2, filled with the latest measurement of each cell."""
    by_name = {key(cell): cell for cell in cells}
    measured = [cell for cell in cells if cell["kind"] != "gpu"]
    usual = Counter(map(origin, measured)).most_common(1)[0][0]
    dates = sorted(cell["date"] for cell in measured if origin(cell) == usual)

    def mark(cell: Cell) -> str:
        """Return a dagger for a cell that was measured elsewhere than the others."""
        return " †" if cell and origin(cell) != usual else ""

    def of(kind: str, name: str, budget: float | None = None) -> Cell:
        """Return a cell, without numbers if it was not measured."""
        return by_name.get((kind, name, budget), {})

    template = Environment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    return template.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        captures=CAPTURES,
        budgets=sorted({*BUDGETS, *(cell["budget_s"] for cell in cells if cell["kind"] == "quality")}),
        depths=DEPTHS,
        gpus=[cell for cell in cells if cell["kind"] == "gpu"],
        commit=usual[0],
        processor=usual[1],
        dates=" to ".join(dict.fromkeys(day(iso) for iso in (dates[0], dates[-1]))),
        mark=mark,
        others="; ".join(sorted({f"{', '.join(origin(one))}, {day(one['date'])}" for one in measured if mark(one)})),
        of=of,
        text=text,
        day=day,
    )


def origin(cell: Cell) -> tuple[str, str]:
    """Return where a cell was measured: commit and processor."""
    return cell["commit"], cell["processor"]


def program_commit() -> str:
    """Return the last commit that changed the program."""
    return subprocess.check_output(["git", "log", "-1", "--format=%h", "--", "nerfcli"], cwd=ROOT, text=True).strip()


def main(
    captures: Annotated[Path | None, typer.Argument(help="Folder of captures; without it, only the page.")] = None,
    budgets: Annotated[str, typer.Option(help="Of training.")] = "60s,5m,30m",
    names: Annotated[str, typer.Option("--captures", help="Which, separated by commas.")] = ",".join(CAPTURES),
    output: Annotated[Path | None, typer.Option("-o", help="Another JSON file; the page beside it.")] = None,
) -> None:
    """Measure the cells that are missing, and write the page."""
    path = output or ROOT / "benchmarks" / "figures.json"
    cells = read_cells(path)
    failed = 0
    if captures is not None:
        where = {"commit": program_commit(), "processor": processor_name(), "threads": THREADS}
        measurement = Measurement(captures, ROOT / "figure-runs" / program_commit())
        for kind, name, budget in plan(names.split(","), [seconds_from_text(one) for one in budgets.split(",")]):
            what = {"kind": kind, "capture": name, "budget_s": budget}
            if any((what | where).items() <= cell.items() for cell in cells):
                continue
            began = time.monotonic()
            try:
                numbers = getattr(measurement, kind)(name, budget)
            except (Exception, SystemExit) as error:  # the other cells are still useful
                print(f"{kind} {name} {budget:g}: {type(error).__name__}: {error}", flush=True)
                failed += 1
                continue
            seconds = time.monotonic() - began
            print(f"{kind} {name} {budget:g}: {seconds:.0f} s", flush=True)
            cells.append(rounded(numbers) | what | where | {"date": date.today().isoformat()})
            write_cells(path, cells)
    target = path.with_suffix(".md") if output is not None else ROOT / "docs" / "figures.md"
    target.write_text(page(cells), encoding="utf-8")
    raise typer.Exit(1 if failed else 0)


if __name__ == "__main__":
    typer.run(main)
