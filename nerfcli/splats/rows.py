"""Gaussians as rows, one array for the kernels: mean, log scales, quaternion, logit, harmonics."""

import numpy as np

from nerfcli.splats.gaussians import Gaussians


def rows_of(gaussians: Gaussians) -> np.ndarray:
    """Return rows (N, 11 + 3 K) float32."""
    count = len(gaussians)
    parts = [gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.logits[:, None]]
    return np.concatenate([*parts, gaussians.harmonics.reshape(count, -1)], axis=1)


def gaussians_of(rows: np.ndarray) -> Gaussians:
    """Return the Gaussians of rows, with unit quaternions."""
    quaternions = rows[:, 6:10] / np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    return Gaussians(rows[:, :3], rows[:, 3:6], quaternions, rows[:, 10], rows[:, 11:].reshape(len(rows), -1, 3))
