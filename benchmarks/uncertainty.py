"""Does the spread of repeated fits predict the error of depth where no photo looked?

    python benchmarks/uncertainty.py train -o uncertainty             # needs `pip install embreex` for the desk
    python benchmarks/uncertainty.py judge -o uncertainty

`train` goes on where it was stopped. A replicate is a scene with a sector of 120 degrees of its ring withheld; of each,
one field is deployed (all training photos) and every kind of ensemble has MEMBERS fields. Kept are distances in
small views of the withheld photos and of controls, what is true in them, and seconds. `judge` reads these, prints the
tables and the verdicts of `uncertainty_statistics.verdict`, and writes OUT/table.csv and figures.
"""

import csv
import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import matplotlib
import numpy as np
import torch
import typer
import uncertainty_statistics as statistics
from rich.console import Console
from rich.table import Table
from scipy import ndimage
from uncertainty_scenes import STRATA, VIEW_PX, TruePixels, load_replicate, looks, true_pixels, truth_of, write_capture

from nerfcli.cameras.frame import Frame
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import RenderedPicture, render_picture
from nerfcli.render.visibility import coverage_and_parallax, depth_maps
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings
from nerfcli.workflows.members import member_settings
from nerfcli.workflows.train import train_scene, was_interrupted

matplotlib.use("Agg")
from matplotlib import pyplot as plt

# Scenes and the sectors of their rings; steps of a training, and the downscale of the desk's photos.
REPLICATES = {"spheres": (0, 1, 2, 3), "desk": (0, 1, 2, 3), "blocks-1": (0, 2), "blocks-2": (0, 2)}
STEPS, DESK_STEPS, DESK_DOWNSCALE = 400, 800, 4
KINDS = ("seeds", "photos", "prior", "field")
MEMBERS = 5
# All captures are four by three.
PIXELS_PER_VIEW = VIEW_PX * VIEW_PX * 3 // 4
CONTROLS = (
    *("coverage", "parallax", "true coverage", "opacity", "gradient", "distance", "random", "another replicate"),
    *("Laplace", "combined", "combined, free"),
)
# Predictors to combine: with the spread, and those that need no further training.
COMBINED = {"combined": ("spread", "coverage", "parallax"), "combined, free": ("coverage", "parallax", "opacity")}

# All numbers of each replicate, by kind.
Numbers = dict[str, list[dict[str, float | str]]]

app = typer.Typer(help=__doc__, add_completion=False)
Out = Annotated[Path, typer.Option("--output", "-o", help="Folder of this experiment.")]


@dataclass(frozen=True)
class Replicate:
    """A scene with a sector of its ring withheld."""

    scene: str
    sector: int

    @property
    def name(self) -> str:
        return f"{self.scene}-sector-{self.sector}"

    def settings(self, longer: int) -> TrainSettings:
        """Return the settings of every training: default components, one thread, `longer` times the usual steps."""
        steps, downscale = (DESK_STEPS, DESK_DOWNSCALE) if self.scene == "desk" else (STEPS, 1)
        return TrainSettings(budget_seconds=None, steps=longer * steps, downscale=downscale, threads=1)


def replicates() -> list[Replicate]:
    """Return all replicates, in the order of their sectors: the first sector of every scene comes first."""
    pairs = [(place, scene, sector) for scene, of in REPLICATES.items() for place, sector in enumerate(of)]
    return [Replicate(scene, sector) for _, scene, sector in sorted(pairs, key=lambda pair: pair[0])]


@app.command()
def train(
    output: Out,
    kinds: str = ",".join(KINDS),
    only: Annotated[str, typer.Option(help="Names of replicates, as desk-sector-0; all by default.")] = "",
    members: Annotated[int, typer.Option(help="Of each kind; the tables are of the first five.")] = MEMBERS,
    longer: Annotated[int, typer.Option(help="Times the usual number of steps; give another folder, too.")] = 1,
) -> None:
    """Train what is missing, kind by kind, and keep the distances that the fields show."""
    torch.set_num_threads(1)
    for kind in ("deployed", *kinds.split(",")):
        for one in replicates():
            if not only or one.name in only.split(","):
                train_kind(one, kind, output, members=members, longer=longer)


def train_kind(one: Replicate, kind: str, output: Path, *, members: int, longer: int) -> None:
    """Train the members of a kind that a replicate lacks."""
    folder, capture = output / one.name, output / "captures" / one.scene
    if not (capture / "transforms.json").exists():
        write_capture(one.scene, capture)
    scene = load_replicate(capture, folder, sector=one.sector)
    views = looks(scene.test_frames)
    if not (folder / "truth.npz").exists():
        true = true_pixels(truth_of(one.scene), views, scene.train_frames)
        np.savez_compressed(folder / "truth.npz", allow_pickle=False, **vars(true))
    keep_distances(folder, kind, capture, views, first=one.settings(longer), members=members)


def keep_distances(
    folder: Path, kind: str, capture: Path, views: list[Frame], *, first: TrainSettings, members: int
) -> None:
    """Train the missing fields of a kind, and keep the distances that they render in views: FOLDER/KIND.npz.

    Fields are deleted afterwards. FOLDER/held_out.txt lists the withheld photos.

    Args:
        folder: of the replicate.
        kind: "deployed", a single field with the settings `first`, or one of `KINDS`.
        capture: to train on.
        views: in which depth is compared.
        first: settings of the deployed field.
        members: number of fields of the kind.
    """
    kept, holdout, columns, seconds = folder / f"{kind}.npz", str(folder / "held_out.txt"), [], 0.0
    if kept.exists():
        before = np.load(kept)
        columns, seconds = list(before["distances"]), float(before["seconds"])
    wanted = [first] if kind == "deployed" else member_settings(first, members, vary=kind)
    missing = list(enumerate(wanted, start=1))[len(columns) :]
    if not missing:
        return
    began = time.process_time()
    for number, settings in missing:
        path = folder / kind / str(number)
        resume = was_interrupted(capture, path, settings, holdout=holdout)
        run = train_scene(capture, path, settings, holdout=holdout, resume=resume)
        model = run.model()
        pictures = [
            render_picture(model, view, background=model.background, depth=DepthRequest("median", "ray"))
            for view in views
        ]
        columns.append(np.concatenate([depth_of(picture).ravel() for picture in pictures]))
        if kind == "deployed":
            extras = deployed_maps(model, run, views, [picture.rgb for picture in pictures])
            extras["opacity"] = np.concatenate([picture.opacity.ravel() for picture in pictures])
            np.savez_compressed(folder / "maps.npz", allow_pickle=False, **extras)
    seconds += time.process_time() - began
    np.savez_compressed(kept, distances=np.stack(columns), seconds=np.array(seconds))
    shutil.rmtree(folder / kind)
    print(f"{folder.name} {kind}: {len(wanted)} fields, {seconds:.0f} CPU s", flush=True)


def depth_of(picture: RenderedPicture) -> np.ndarray:
    """Return the depth (H, W) of a picture that was rendered with depth."""
    assert picture.depth is not None
    return picture.depth


def deployed_maps(model: Model, run: Run, views: list[Frame], colours: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Return coverage and parallax by the field's own depth, and the picture's gradient norm, of all pixels."""
    photos = depth_maps(model, run.cameras.train)
    request, found = DepthRequest("median", "ray"), []
    for view, rgb in zip(views, colours, strict=True):
        seen = render_picture(model, view, background=model.background, depth=request)
        rays, _ = view.camera.pixel_bearings()
        pose = view.world_from_cam
        places = (rays * depth_of(seen).reshape(-1, 1)) @ pose[:3, :3].T + pose[:3, 3]
        coverage, parallax = coverage_and_parallax(photos, places)
        grey = rgb.mean(axis=2)
        found.append((coverage, parallax, np.hypot(ndimage.sobel(grey, 0), ndimage.sobel(grey, 1)).ravel()))
    names = ("coverage", "parallax", "gradient")
    return {name: np.concatenate(column) for name, column in zip(names, zip(*found, strict=True), strict=True)}


@dataclass(frozen=True)
class Pixels:
    """The pixels of a replicate and a kind in which the deployed field and all members have a depth.

    Args:
        members: (M, P) distances.
        true, error: (P,) distance, and |deployed - true|.
        stratum: (P,) index in `STRATA`.
        views: (P,) number of the view.
        uncertainty: (P,) by name; larger is less certain.
        abstained: in each stratum, the fraction of the pixels with a true surface that lack a depth.
    """

    members: np.ndarray
    true: np.ndarray
    error: np.ndarray
    stratum: np.ndarray
    views: np.ndarray
    uncertainty: dict[str, np.ndarray]
    abstained: dict[str, float]

    @property
    def spread(self) -> np.ndarray:
        return self.uncertainty["spread"]

    def only(self, name: str) -> "Pixels":
        """Return the pixels of one stratum."""
        rows = self.stratum == STRATA.index(name)
        uncertainty = {key: values[rows] for key, values in self.uncertainty.items()}
        return replace(
            self,
            members=self.members[:, rows],
            true=self.true[rows],
            error=self.error[rows],
            stratum=self.stratum[rows],
            views=self.views[rows],
            uncertainty=uncertainty,
        )


def read_pixels(folder: Path, kind: str, members: int = MEMBERS) -> Pixels:
    """Read the results of `train_kind`, for the first `members` only."""
    true = TruePixels(**np.load(folder / "truth.npz"))
    maps, deployed = np.load(folder / "maps.npz"), np.load(folder / "deployed.npz")["distances"][0]
    distances = np.load(folder / f"{kind}.npz")["distances"][:members]
    there = np.isfinite(true.distance)
    used = there & np.isfinite(deployed) & np.isfinite(distances).all(axis=0)
    abstained = {
        name: float((~used[true.stratum == index]).mean()) if (true.stratum == index).any() else float("nan")
        for index, name in enumerate(STRATA)
    }
    distances, rng = distances[:, used], np.random.default_rng(0)
    uncertainty = {
        "spread": distances.std(axis=0, ddof=1),
        "coverage": -maps["coverage"][used],
        "parallax": -maps["parallax"][used],
        "true coverage": -true.photos[used],
        "opacity": -maps["opacity"][used],
        "gradient": maps["gradient"][used],
        "distance": deployed[used],
        "random": rng.random(used.sum()),
    }
    if (folder / "laplace.npz").exists():
        uncertainty["Laplace"] = np.load(folder / "laplace.npz")["deviation"][used]
    return Pixels(
        members=distances,
        true=true.distance[used],
        error=np.abs(deployed - true.distance)[used],
        stratum=true.stratum[used],
        views=np.flatnonzero(used) // PIXELS_PER_VIEW,
        uncertainty=uncertainty,
        abstained=abstained,
    )


def measures(pixels: Pixels) -> dict[str, float]:
    """Return all numbers of a replicate and a kind."""
    found: dict[str, float] = {"pixels": len(pixels.true), "mean error": float(pixels.error.mean())}
    for name, values in pixels.uncertainty.items():
        found[f"AUSE {name}"] = statistics.ause(pixels.error, values)
        found[f"AURG {name}"] = statistics.aurg(pixels.error, values)
        found[f"AUSE of views {name}"] = statistics.ause_of_views(pixels.error, values, pixels.views)
    found["AUROC error above 5 %"] = statistics.area_under_roc(
        pixels.spread, pixels.error > statistics.WRONG * pixels.true
    )
    ends = np.isin(pixels.stratum, (STRATA.index("U0"), STRATA.index("D")))
    unseen = pixels.stratum[ends] == STRATA.index("U0")
    for name in ("spread", "coverage"):
        found[f"AUROC U0 against D, {name}"] = statistics.area_under_roc(pixels.uncertainty[name][ends], unseen)
    for name in STRATA:
        part = pixels.only(name)
        found[f"pixels {name}"], found[f"abstained {name}"] = len(part.true), pixels.abstained[name]
        if len(part.true) < statistics.LEAST_PIXELS:
            continue
        found[f"error {name}"] = float(part.error.mean())
        found[f"v {name}"] = statistics.variance_fraction(part.members, part.true)
        squares = (part.error**2).mean() / (part.spread**2).mean()
        found[f"RMS error over RMS spread {name}"] = float(np.sqrt(squares))
        for level in statistics.LEVELS:
            held = statistics.held_by_interval(part.members, part.true, level=level)
            found[f"held {100 * level:g} % {name}"] = held
        found[f"NLL {name}"] = statistics.log_likelihood_loss(part.members, part.true)
        for predictor in ("spread", "coverage", "gradient", "distance"):
            values = statistics.rank_correlation(part.uncertainty[predictor], part.error)
            found[f"Spearman {predictor} {name}"] = values
    return found


def widened(one: Replicate, pixels: Pixels, replicates: list[Replicate], every: list[Pixels]) -> dict[str, float | str]:
    """Return the coverage of 90 % intervals, widened by the factor that gives 90 % in stratum D of the other scenes."""
    others = [of.only("D") for other, of in zip(replicates, every, strict=True) if other.scene != one.scene]
    if not others:
        return {}
    reaches = [statistics.in_reaches(part.members, part.true, level=0.9) for part in others]
    factor = float(np.quantile(np.concatenate(reaches), 0.9))
    parts = {name: pixels.only(name) for name in STRATA}
    held = {
        f"held 90 % widened {name}": statistics.held_by_interval(part.members, part.true, level=0.9, widened=factor)
        for name, part in parts.items()
        if len(part.true) >= statistics.LEAST_PIXELS
    }
    return {"factor": factor, **held}


def combined(
    one: Replicate, pixels: Pixels, replicates: list[Replicate], every: list[Pixels], names: Sequence[str]
) -> np.ndarray:
    """Return the linear combination of the predictors' ranks that best fits the rank of the error in the other scenes.

    Ranks are within a replicate, from 0 to 1; replicates have equal weights in the least squares.
    """

    def rows(of: Pixels) -> np.ndarray:
        return np.stack([statistics.ranks(of.uncertainty[name]) for name in names] + [np.ones(len(of.true))], axis=1)

    others = [of for other, of in zip(replicates, every, strict=True) if other.scene != one.scene]
    equally = [len(of.true) ** -0.5 for of in others]
    left = np.concatenate([weight * rows(of) for weight, of in zip(equally, others, strict=True)])
    right = np.concatenate([weight * statistics.ranks(of.error) for weight, of in zip(equally, others, strict=True)])
    return rows(pixels) @ np.linalg.lstsq(left, right)[0]


def trained(output: Path, kind: str) -> list[Replicate]:
    """Return the replicates that have results of a kind."""
    return [one for one in replicates() if (output / one.name / f"{kind}.npz").exists()]


@app.command()
def judge(output: Out) -> None:
    """Print tables and verdicts of what has been trained so far, and write table.csv, summary.json and figures."""
    table: Numbers = {}
    for kind in KINDS:
        there = trained(output, kind)
        every = [read_pixels(output / one.name, kind) for one in there]
        spreads = [pixels.spread for pixels in every]
        for index, pixels in enumerate(every):
            pixels.uncertainty["another replicate"] = statistics.permuted(spreads, index)
            for name, parts in COMBINED.items() if len({one.scene for one in there}) > 1 else ():
                pixels.uncertainty[name] = combined(there[index], pixels, there, every, parts)
        if every:
            table[kind] = [
                {"replicate": one.name, **measures(pixels), **widened(one, pixels, there, every)}
                for one, pixels in zip(there, every, strict=True)
            ]
    if not table:
        raise typer.BadParameter(f"there is nothing in {output}: run train first")
    write_table(table, output / "table.csv")
    found = summaries(table)
    print_tables(table, found)
    print_by_members(output)
    draw(table, output / "uncertainty.png")
    content = {kind: {**vars(one), "verdict": statistics.verdict(one)} for kind, one in found.items()}
    (output / "summary.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def column(rows: list[dict[str, float | str]], name: str) -> np.ndarray:
    """Return one number of all replicates; NaN where it is missing."""
    return np.array([row.get(name, np.nan) for row in rows], dtype=float)


def mean_of(values: np.ndarray) -> float:
    """Return the mean of the finite values; NaN if there are none."""
    there = values[np.isfinite(values)]
    return float(there.mean()) if len(there) else float("nan")


def summaries(table: Numbers) -> dict[str, statistics.Summary]:
    """Return the numbers that decide the verdict on each kind."""
    differences = {kind: column(rows, "AUSE spread") - column(rows, "AUSE coverage") for kind, rows in table.items()}
    adjusted = statistics.holm({kind: statistics.sign_flip(values) for kind, values in differences.items()})
    return {
        kind: statistics.Summary(
            held=mean_of(column(rows, "held 90 % U0")),
            v_unseen=mean_of(column(rows, "v U0")),
            v_seen=mean_of(column(rows, "v D")),
            correlation=statistics.mean_with_interval(column(rows, "Spearman spread U0")),
            marks=mean_of(column(rows, "AUROC U0 against D, spread")),
            p_of_ause=adjusted[kind],
            ause_difference=mean_of(differences[kind]),
        )
        for kind, rows in table.items()
    }


def print_tables(table: Numbers, found: dict[str, statistics.Summary]) -> None:
    """Print a line for each kind, and AUSE over the mean error by predictor."""
    console = Console(width=160)
    shown = Table(
        *("kind", "replicates", "v U0", "v D", "90 % hold U0", "D", "Spearman U0 (95 %)", "AUROC U0/D"),
        *("AUSE - coverage's", "p (Holm)", "verdict"),
    )
    for kind, one in found.items():
        mean, low, high = one.correlation
        held = mean_of(column(table[kind], "held 90 % D"))
        shown.add_row(
            kind, str(len(table[kind])), f"{one.v_unseen:.3f}", f"{one.v_seen:.3f}", f"{one.held:.0%}", f"{held:.0%}",
            f"{mean:.2f} ({low:.2f} to {high:.2f})", f"{one.marks:.2f}", f"{one.ause_difference:+.4f}",
            f"{one.p_of_ause:.3f}", statistics.verdict(one),
        )  # fmt: skip
    console.print(shown)
    names = ("spread", *CONTROLS)
    areas = Table("AUSE / mean error", *names)
    for kind, rows in table.items():
        means = [mean_of(column(rows, f"AUSE {name}") / column(rows, "mean error")) for name in names]
        areas.add_row(kind, *(f"{value:.3f}" for value in means))
    console.print(areas)
    of_views = Table("AUSE as Bayes' Rays", "scene", *names)
    for kind, rows in table.items():
        for scene in REPLICATES:
            of_scene = [row for row in rows if str(row["replicate"]).startswith(f"{scene}-sector")]
            if of_scene:
                means = [mean_of(column(of_scene, f"AUSE of views {name}")) for name in names]
                of_views.add_row(kind, scene, *(f"{value:.3f}" for value in means))
    console.print(of_views)
    for kind, rows in table.items():
        for name in (*COMBINED, "Laplace"):
            over = column(rows, f"AUSE {name}") - column(rows, "AUSE coverage")
            p = statistics.sign_flip(over)
            console.print(
                f"{kind}: AUSE {name} - coverage {mean_of(over):+.4f}, {np.isfinite(over).sum()} replicates, p {p:.3f}"
            )


def print_by_members(output: Path) -> None:
    """Print the results with fewer of the same members, as means over replicates."""
    counts = range(2, MEMBERS + 1)
    shown = Table("first members", *(f"{count}: v U0, AUSE / mean error" for count in counts))
    for kind in KINDS:
        cells = []
        for count in counts:
            every = [read_pixels(output / one.name, kind, count) for one in trained(output, kind)]
            unseen = [(part.members, part.true) for part in (pixels.only("U0") for pixels in every) if len(part.true)]
            v = [statistics.variance_fraction(*pair) for pair in unseen]
            areas = [statistics.ause(pixels.error, pixels.spread) / pixels.error.mean() for pixels in every]
            cells.append(f"{np.mean(v):.3f}, {np.mean(areas):.3f}" if every else "")
        shown.add_row(kind, *cells)
    Console(width=160).print(shown)


def write_table(table: Numbers, path: Path) -> None:
    """Write all numbers, a line for each kind and replicate."""
    names = list(dict.fromkeys(name for rows in table.values() for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["kind", *names])
        writer.writeheader()
        writer.writerows({"kind": kind, **row} for kind, rows in table.items() for row in rows)


def draw(table: Numbers, path: Path) -> None:
    """Draw v, the held part of 90 % intervals and the rank correlation by stratum, a point for each replicate."""
    panels = {"v {}": "variance / (variance + bias²)", "held 90 % {}": "truth in 90 % intervals",
              "Spearman spread {}": "rank correlation of spread and error"}  # fmt: skip
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for axis, (pattern, title) in zip(axes, panels.items(), strict=True):
        for number, (kind, rows) in enumerate(table.items()):
            for place, stratum in enumerate(STRATA):
                values = column(rows, pattern.format(stratum))
                at = place + 0.18 * (number - 0.5 * (len(table) - 1))
                axis.plot(np.full(len(values), at), values, ".", color=f"C{number}", alpha=0.5)
                axis.plot(at, mean_of(values), "_", ms=14, color=f"C{number}", label=kind if place == 0 else None)
        axis.set(title=title, xticks=range(len(STRATA)), xticklabels=STRATA)
        axis.grid(axis="y", alpha=0.3)
    axes[1].axhline(0.9, color="black", lw=0.8, ls=":")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(table))
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    app()
