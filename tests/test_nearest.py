"""Nearest descriptors of two photos against a double loop in float64, with products of bytes and of floats."""

from unittest.mock import patch

import numpy as np
import pytest

from nerfcli.kernels import nearest
from nerfcli.kernels.nearest import mutual_nearest, prepare

SIZES = [(0, 5), (5, 0), (1, 1), (1, 2), (3, 1), (50, 1300), (1300, 50), (300, 2100)]
FAR = 2000.0


def root_sift(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return random descriptors with the length, the sparseness and the limit of real ones."""
    vectors = np.abs(rng.normal(size=(count, 128))) ** 1.5
    for _ in range(2):
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        vectors = np.minimum(vectors, 0.4)
    return np.round(512 * vectors).clip(0, 255).astype(np.uint8)


def by_definition(one: np.ndarray, other: np.ndarray, ratio: float, furthest: float) -> list[list[int]]:
    distances = np.array([[np.linalg.norm(a - b) for b in other] for a in one.astype(float)])
    found = []
    for i, row in enumerate(distances if len(other) else []):
        j = int(row.argmin())
        rivals = [*np.delete(row, j), *np.delete(distances[:, j], i)]
        if int(distances[:, j].argmin()) == i and row[j] <= furthest and row[j] < ratio * min(rivals, default=np.inf):
            found.append([i, j])
    return found


@pytest.mark.parametrize("bytewise", [True, False])
@pytest.mark.parametrize(("rows", "columns"), SIZES)
@pytest.mark.parametrize("furthest", [250.0, FAR])
def test_matches_are_those_of_a_double_loop(rows: int, columns: int, furthest: float, bytewise: bool):
    """Half of the smaller set are noisy copies, one of them twice; sizes below, at and beyond a tile."""
    rng = np.random.default_rng(rows)
    one, other = root_sift(rng, rows), root_sift(rng, columns)
    copies = min(rows, columns) // 2
    noise = rng.integers(-25, 26, (copies, 128))
    other[:copies] = (one[:copies].astype(int) + noise).clip(0, 255)
    if copies > 4:
        other[copies] = other[0]
    other = rng.permutation(other)
    with patch.object(nearest, "_multiplies_bytes", lambda: bytewise):
        found = mutual_nearest(prepare(one), prepare(other), ratio=0.8, furthest=furthest)
    assert found.tolist() == by_definition(one, other, 0.8, furthest)
    assert len(found) >= (copies - 1 if furthest == FAR else 0)


def test_the_farthest_descriptors_do_not_overflow():
    """Corners of a cube are as far apart as descriptors can be: squared, 2 * 512^2 and some rounding."""
    corners = np.zeros((8, 128), np.uint8)
    for corner in range(8):
        corners[corner, 16 * corner : 16 * corner + 5] = 235  # 743.13 apart
    found = mutual_nearest(prepare(corners), prepare(corners[::-1].copy()), ratio=0.8, furthest=FAR)
    assert found.tolist() == [[i, 7 - i] for i in range(8)]
    one, other = prepare(corners[:1]), prepare(corners[1:2])
    assert len(mutual_nearest(one, other, ratio=1.0, furthest=743.14)) == 1
    assert len(mutual_nearest(one, other, ratio=1.0, furthest=743.12)) == 0
