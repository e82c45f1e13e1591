"""A set of Gaussian splats: the record that everything in this folder makes, refines, renders, reads and writes."""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
import torch

from nerfcli.cameras.rigid import Similarity, quaternion_from_rotation
from nerfcli.kernels.harmonics import splat_harmonics


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in some frame, as float32, with the parameters that splat files hold.

    Args:
        means: (N, 3).
        log_scales: (N, 3) natural logarithms of the standard deviations along the own axes.
        quaternions: (N, 4) rotation of the own axes, w x y z, of any norm above 0.
        logits: (N,) of the opacity at the mean, 1 / (1 + exp(-logit)).
        harmonics: (N, K, 3) with K = 1, 4, 9 or 16; the sRGB colour in direction d from the camera to the mean is
            max(0, 0.5 + sum_k Y_k(d) harmonics[k]).

    Source: Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering, and its released code.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    logits: np.ndarray
    harmonics: np.ndarray

    def __post_init__(self) -> None:
        for field in fields(self):
            values = np.ascontiguousarray(getattr(self, field.name), dtype=np.float32)
            object.__setattr__(self, field.name, values)
        shapes = [values.shape[1:] for values in self]
        if shapes[:4] != [(3,), (3,), (4,), ()] or shapes[4] not in [(k, 3) for k in (1, 4, 9, 16)]:
            raise ValueError(f"expected (N, 3), (N, 3), (N, 4), (N,) and (N, 1|4|9|16, 3), got {shapes}")

    def __iter__(self) -> Iterator[np.ndarray]:
        return (getattr(self, field.name) for field in fields(self))

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics, 0 to 3."""
        return {1: 0, 4: 1, 9: 2, 16: 3}[self.harmonics.shape[1]]

    def taken(self, rows: np.ndarray | slice) -> "Gaussians":
        """Return some of the Gaussians."""
        return Gaussians(*(values[rows] for values in self))

    def moved(self, b_from_a: Similarity) -> "Gaussians":
        """Return the same Gaussians in frame b: means, sizes, rotations, and the directions of their colours."""
        turn = harmonics_rotation(b_from_a.rotation, self.degree)
        return Gaussians(
            b_from_a.apply(self.means),
            self.log_scales + np.log(b_from_a.scale),
            _product(quaternion_from_rotation(b_from_a.rotation), self.quaternions.astype(np.float64)),
            self.logits,
            np.einsum("kl,nlc->nkc", turn, self.harmonics),
        )


def harmonics_rotation(b_from_a: np.ndarray, degree: int) -> np.ndarray:
    """Return the matrix (K, K) that turns coefficients of harmonics: the colour in b_from_a @ d is that in d before.

    The harmonics are evaluated in directions that determine them, and the linear system is solved: exact to rounding.
    """
    count = (degree + 1) ** 2
    directions = np.random.default_rng(0).normal(size=(4 * count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = basis(directions, degree), basis(directions @ b_from_a.T, degree)
    return np.linalg.lstsq(after, before, rcond=None)[0]


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return the harmonics (N, K) of splat files in unit directions (N, 3), float64."""
    values = splat_harmonics(torch.from_numpy(np.asarray(directions, dtype=np.float64)))
    return values[:, : (degree + 1) ** 2].numpy()


def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the products (N, 4) of a quaternion (4,) with quaternions (N, 4), both w x y z."""
    a, b, c, d = left
    w, x, y, z = right.T
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def rows_of(gaussians: Gaussians) -> np.ndarray:
    """Return rows (N, 11 + 3 K) float32."""
    count = len(gaussians)
    parts = [gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.logits[:, None]]
    return np.concatenate([*parts, gaussians.harmonics.reshape(count, -1)], axis=1)


def gaussians_of(rows: np.ndarray) -> Gaussians:
    """Return the Gaussians of rows, with unit quaternions."""
    quaternions = rows[:, 6:10] / np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    return Gaussians(rows[:, :3], rows[:, 3:6], quaternions, rows[:, 10], rows[:, 11:].reshape(len(rows), -1, 3))
