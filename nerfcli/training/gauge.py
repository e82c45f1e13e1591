"""Gauge freedom of refined cameras: keep their common rotation, translation and scale fixed.

A field that turns together with its cameras looks the same from all of them, but held-out cameras, which are not
refined, would be left behind. The mean similarity of all corrections is therefore removed from them.
"""

import numpy as np

from nerfcli.cameras.rigid import Similarity, rotation_from_vector, vector_from_rotation

# Fewer cameras leave too few residuals to weight rotations against translations.
LEAST_TOLD = 6


def mean_similarity(before: np.ndarray, after: np.ndarray) -> Similarity:
    """Return the mean similarity of the motions of cameras, to first order.

    With the rotation w_i of camera i and the translation t_i of its centre c_i, in the world, the rotation w, the
    translation u and the logarithm of the scale s about the mean centre c minimise

        sum_i d^2 |w_i - w|^2 + |t_i - u - w x (c_i - c) - s (c_i - c)|^2

    d is the root mean square distance of the cameras from c: a rotation counts as much as the translation that it
    causes at that distance. Parameters that the cameras do not determine are 0, such as the scale of a single place.

    With `LEAST_TOLD` cameras or more, rotations and translations are weighted by the inverse of their residuals: where
    rotations were wrong and centres right, the centres determine the similarity, and vice versa.

    Args:
        before, after: (P, 4, 4) `world_from_cam`.
    """
    centres = before[:, :3, 3]
    middle = centres.mean(axis=0)
    arms = centres - middle
    reach = float(np.sqrt((arms**2).sum(axis=1).mean()))
    reach = reach if reach > 1e-9 else 1.0  # cameras in one place have only a rotation and a translation in common
    turns = reach * vector_from_rotation(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], -1, -2))
    moves = after[:, :3, 3] - centres
    rows = np.zeros((len(before), 6, 7))
    rows[:, :3, :3] = reach * np.eye(3)
    rows[:, 3:, :3] = np.cross(arms[:, None], np.eye(3))  # (w x arm)_i = (arm x e_i) . w
    rows[:, 3:, 3:6] = np.eye(3)
    rows[:, 3:, 6] = arms
    wanted = np.concatenate([turns, moves], axis=1)
    weights = np.ones(6)
    found = _least_squares(rows, wanted, weights)
    for _ in range(10 if len(before) >= LEAST_TOLD else 0):
        left = ((wanted - rows @ found) ** 2).reshape(-1, 2, 3).mean(axis=(0, 2)) ** 0.5
        if not left.any():
            break
        weights = np.repeat(left.max() / np.maximum(left, left.max() / 100.0), 3)
        found = _least_squares(rows, wanted, weights)
    rotation, scale = rotation_from_vector(found[:3]), float(np.exp(found[6]))
    return Similarity(scale, rotation, middle + found[3:6] - scale * rotation @ middle)


def without_mean(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return `after` (P, 4, 4) without the mean similarity from `before`; relative poses change only in scale."""
    return mean_similarity(before, after).inverse().apply_pose(after)


def _least_squares(rows: np.ndarray, wanted: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return x (7,) that minimises the difference of rows (P, 6, 7) @ x and wanted (P, 6), weighted by (6,)."""
    return np.linalg.lstsq((weights[:, None] * rows).reshape(-1, 7), (weights * wanted).ravel(), rcond=1e-9)[0]
