"""Gauge freedom of refined cameras: keep their common rotation, translation and scale fixed.

A field that turns with its cameras looks the same from all of them. Cameras that were not refined, those of held-out
photos, would be left behind: the similarity that is in the mean of all corrections is taken out of them.
"""

import numpy as np

from nerfcli.cameras.rigid import Similarity, inverse, rotation_from_vector, vector_from_rotation

# Cameras within such a distance stand in one place, and only turn together.
LEAST_REACH = 1e-9
# Fewer cameras leave too little to tell turns from moves.
LEAST_TOLD = 6
_ROUNDS, _MOST_WEIGHT = 10, 100.0


def mean_similarity(before: np.ndarray, after: np.ndarray) -> Similarity:
    """Return the similarity that is in the mean of the moves of cameras, to first order.

    With the turn w_i of camera i and the move t_i of its centre c_i, in the world, it is the turn w, the move u and the
    growth s about the mean centre c that

        sum_i d^2 |w_i - w|^2 + |t_i - u - w x (c_i - c) - s (c_i - c)|^2

    is least for. d is the root mean square distance of the cameras from c: a turn counts as much as the move that it
    would be at that distance. What the cameras do not tell, such as the growth of one place, is none.

    With `LEAST_TOLD` cameras or more, turns and moves are weighted by one over what is left of each: where turns were
    wrong and centres were right, the centres say where the cameras are, and the other way round.

    Args:
        before, after: (P, 4, 4) `world_from_cam`.
    """
    centres = before[:, :3, 3]
    middle = centres.mean(axis=0)
    arms = centres - middle
    reach = float(np.sqrt((arms**2).sum(axis=1).mean()))
    reach = reach if reach > LEAST_REACH else 1.0
    turns = reach * vector_from_rotation(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], -1, -2))
    moves = after[:, :3, 3] - centres
    rows = np.zeros((len(before), 6, 7))
    rows[:, :3, :3] = reach * np.eye(3)
    rows[:, 3:, :3] = -_cross_matrices(arms)  # w x arm = -arm x w
    rows[:, 3:, 3:6] = np.eye(3)
    rows[:, 3:, 6] = arms
    wanted = np.concatenate([turns, moves], axis=1)
    weights = np.ones(6)
    found = _least_squares(rows, wanted, weights)
    for _ in range(_ROUNDS if len(before) >= LEAST_TOLD else 0):
        left = ((wanted - rows @ found) ** 2).reshape(-1, 2, 3).mean(axis=(0, 2)) ** 0.5
        if not left.any():
            break
        weights = np.repeat(left.max() / np.maximum(left, left.max() / _MOST_WEIGHT), 3)
        found = _least_squares(rows, wanted, weights)
    rotation, scale = rotation_from_vector(found[:3]), float(np.exp(found[6]))
    return Similarity(scale, rotation, middle + found[3:6] - scale * rotation @ middle)


def without_mean(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """`after` (P, 4, 4) without the mean similarity from `before`: as they stood to each other, but for the scale."""
    return mean_similarity(before, after).inverse().apply_pose(after)


def relative_motions(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(P, 4, 4) `cam_before_from_cam_after`."""
    return inverse(before) @ after


def _least_squares(rows: np.ndarray, wanted: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(7,) for which rows (P, 6, 7) @ it is nearest to wanted (P, 6), by weights (6,)."""
    return np.linalg.lstsq((weights[:, None] * rows).reshape(-1, 7), (weights * wanted).ravel(), rcond=1e-9)[0]


def _cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """(N, 3, 3) with matrix @ x = vector x x."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
