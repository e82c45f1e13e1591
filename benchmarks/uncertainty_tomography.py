"""The question of `uncertainty.py` with an exactly known null space: linear tomography of slices, in a minute.

    python benchmarks/uncertainty_tomography.py -o tomography.csv

Slices of the phantom of `sample_scenes/ellipsoids.py` on 32 x 32 pixels, parallel beam, 1 % noise: with 60 of 180
degrees missing, and with a detector that sees only the middle 60 %. A fit is the least-squares solution nearest to its
start, so that components in the null space keep their start. Members differ in their starts (seeds: white noise of
1e-4; prior: smooth over 6 pixels, with the standard deviation of the slice) or in their views (photos: 80 %, from 0).
U0 is the quarter of the pixels whose unit vectors are most in the null space, D the quarter that is least in it. The
positive control draws slices from the Gaussian of the prior and members from its posterior: 90 % intervals must hold 87
to 93 %.
"""

import csv
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
import uncertainty_statistics as statistics
from rich.console import Console
from rich.table import Table
from scipy.sparse import csr_matrix

sys.path.insert(0, str(Path(__file__).parent.parent / "sample_scenes"))
from ellipsoids import attenuation_at, bean

SIDE, VIEWS, NOISE, SMOOTH_PX = 32, 45, 0.01, 6.0
HEIGHTS = (0.0, 1.5)
MEMBERS, CONTROLS = 8, 40
KINDS = ("seeds", "photos", "prior")
# Singular values below this fraction of the largest count as 0, as they would amplify noise 50 times more.
CUT = 0.02
QUARTER = 0.25


@dataclass(frozen=True)
class Geometry:
    """Lines of a scan: angles of its views in degrees, and the fraction of the width that the detector sees."""

    name: str
    angles_deg: np.ndarray
    width: float

    def matrix(self) -> np.ndarray:
        """Return (lines, pixels): bilinear weights of points every half pixel along each line, times their spacing."""
        offsets = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
        offsets = offsets[np.abs(offsets) < self.width]
        along = (np.arange(3 * SIDE) + 0.5) / (1.5 * SIDE) * 1.5 - 1.5
        rows, columns, weights = [], [], []
        for view, angle in enumerate(np.radians(self.angles_deg)):
            c, s = np.cos(angle), np.sin(angle)
            x, y = offsets[:, None] * c - along * s, offsets[:, None] * s + along * c
            u, v = (x + 1) * SIDE / 2 - 0.5, (y + 1) * SIDE / 2 - 0.5
            for du in (0, 1):
                for dv in (0, 1):
                    i, j = np.floor(u).astype(int) + du, np.floor(v).astype(int) + dv
                    weight = (1 - np.abs(u - i)) * (1 - np.abs(v - j)) * (along[1] - along[0])
                    inside = (i >= 0) & (j >= 0) & (i < SIDE) & (j < SIDE)
                    line = np.broadcast_to(view * len(offsets) + np.arange(len(offsets))[:, None], u.shape)
                    rows.append(line[inside])
                    columns.append((j * SIDE + i)[inside])
                    weights.append(weight[inside])
        shape = (len(self.angles_deg) * len(offsets), SIDE**2)
        return csr_matrix(
            (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=shape
        ).toarray()


GEOMETRIES = (
    Geometry("limited angle", np.linspace(0, 120, VIEWS, endpoint=False), 1.0),
    Geometry("truncated", np.linspace(0, 180, VIEWS, endpoint=False), 0.6),
)


@dataclass(frozen=True)
class Inverse:
    """The least-squares inverse of a matrix, by its singular vectors above `CUT`.

    Args:
        back: (pixels, lines) pseudo-inverse.
        null: (pixels,) squared length of each pixel's unit vector in the null space, in [0, 1].
    """

    back: np.ndarray
    null: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray) -> "Inverse":
        u, values, v = np.linalg.svd(matrix, full_matrices=False)
        kept = values > CUT * values[0]
        v = v[kept]
        return cls((v.T / values[kept]) @ u.T[kept], 1.0 - (v**2).sum(axis=0))


def smooth_root() -> np.ndarray:
    """Return a square root (pixels, pixels) of the covariance exp(-d^2 / (2 l^2)), with l = `SMOOTH_PX`."""
    y, x = np.divmod(np.arange(SIDE**2), SIDE)
    squared = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    values, vectors = np.linalg.eigh(np.exp(-squared / (2 * SMOOTH_PX**2)))
    return vectors * np.sqrt(np.maximum(values, 0.0))


def slice_at(height: float) -> np.ndarray:
    """Return the attenuation (pixels,) of the phantom at a height, with mean 0 and standard deviation 1."""
    at = 9.0 * ((np.arange(SIDE) + 0.5) / SIDE * 2 - 1)
    points = np.stack(np.meshgrid(at, at, [height], indexing="xy"), axis=-1).reshape(-1, 3)
    values = attenuation_at(bean(), points)
    return (values - values.mean()) / values.std()


def fits(kind: str, matrix: np.ndarray, data: np.ndarray, root: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return fits (MEMBERS, pixels) of a kind; each view has the same number of rows in the matrix."""
    whole, lines = Inverse.of(matrix), len(data) // VIEWS
    members = []
    for _ in range(MEMBERS):
        start, inverse, rows = np.zeros(SIDE**2), whole, np.arange(len(data))
        if kind == "photos":
            views = np.sort(rng.choice(VIEWS, round(0.8 * VIEWS), replace=False))
            rows = (views[:, None] * lines + np.arange(lines)).ravel()
            inverse = Inverse.of(matrix[rows])
        else:
            start = root @ rng.normal(size=SIDE**2) if kind == "prior" else 1e-4 * rng.normal(size=SIDE**2)
        members.append(start + inverse.back @ (data[rows] - matrix[rows] @ start))
    return np.stack(members)


def cases() -> Iterator[dict[str, float | str]]:
    """Yield the numbers of each kind in each case; the deployed fit starts at 0."""
    root = smooth_root()
    for number, (geometry, height) in enumerate((g, h) for g in GEOMETRIES for h in HEIGHTS):
        matrix, true, rng = geometry.matrix(), slice_at(height), np.random.default_rng(number)
        clean = matrix @ true
        data = clean + NOISE * np.abs(clean).max() * rng.normal(size=len(clean))
        inverse = Inverse.of(matrix)
        error = np.abs(inverse.back @ data - true)
        lines_through = (matrix > 0).sum(axis=0)
        unseen = inverse.null >= np.quantile(inverse.null, 1 - QUARTER)
        seen = inverse.null <= np.quantile(inverse.null, QUARTER)
        for kind in KINDS:
            members = fits(kind, matrix, data, root, rng)
            spread = members.std(axis=0, ddof=1)
            ends = unseen | seen
            yield {
                "case": f"{geometry.name}, z = {height:g}",
                "kind": kind,
                "null space U0": float(inverse.null[unseen].mean()),
                "null space D": float(inverse.null[seen].mean()),
                **{
                    f"{name} {stratum}": value
                    for stratum, rows in (("U0", unseen), ("D", seen))
                    for name, value in {
                        "v": statistics.variance_fraction(members[:, rows], true[rows]),
                        "held 90 %": statistics.held_by_interval(members[:, rows], true[rows], level=0.9),
                        "Spearman": statistics.rank_correlation(spread[rows], error[rows]),
                    }.items()
                },
                "AUROC U0 against D": statistics.area_under_roc(spread[ends], unseen[ends]),
                "mean error": float(error.mean()),
                **{
                    f"AUSE {name}": statistics.ause(error, values)
                    for name, values in {
                        "spread": spread,
                        "lines": -lines_through.astype(float),
                        "null space": inverse.null,
                        "random": rng.random(len(error)),
                    }.items()
                },
            }


def positive_control(geometry: Geometry) -> float:
    """Return the fraction of true values in 90 % intervals if truth and prior are the same Gaussian.

    A draw of the posterior is x + C A' (A C A' + s^2)^-1 (b + s e - A x), x from the prior, e white.
    Source: Papandreou and Yuille 2010, Gaussian sampling by local perturbations, section 2.
    """
    root, matrix, rng = smooth_root(), geometry.matrix(), np.random.default_rng(0)
    covariance = root @ root.T
    noise = NOISE * np.abs(matrix @ slice_at(0.0)).max()
    gain = np.linalg.solve(matrix @ covariance @ matrix.T + noise**2 * np.eye(len(matrix)), matrix @ covariance).T
    held = []
    for _ in range(CONTROLS):
        true, *starts = (root @ rng.normal(size=(SIDE**2, 1 + MEMBERS))).T
        data = matrix @ true + noise * rng.normal(size=len(matrix))
        members = [x + gain @ (data + noise * rng.normal(size=len(data)) - matrix @ x) for x in starts]
        held.append(statistics.held_by_interval(np.stack(members), true, level=0.9))
    return float(np.mean(held))


def main(output: Annotated[Path, typer.Option("--output", "-o", help="CSV.")] = Path("tomography.csv")) -> None:
    """Print and write the numbers of all cases."""
    rows = list(cases())
    with output.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(value if isinstance(value, str) else f"{value:.3g}" for value in row.values()))
    console = Console(width=260)
    console.print(table)
    for geometry in GEOMETRIES:
        console.print(f"positive control, {geometry.name}: 90 % intervals hold {positive_control(geometry):.1%}")


if __name__ == "__main__":
    typer.run(main)
