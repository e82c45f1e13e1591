"""Poses that are measured at other times than photos are taken: interpolated to the time of each photo."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.captures.formats.fields import malformed
from nerfcli.captures.formats.limits import without

# Poses are interpolated between two that are at most this far apart; trackers and motion capture run at 30 to 200 Hz.
MOST_GAP_SECONDS = 0.1
# A single pose counts for a photo within this time, as in associate.py of the TUM RGB-D benchmark.
MOST_AWAY_SECONDS = 0.02


def poses_at(seconds: np.ndarray, world_from_body: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate poses: positions along a line, rotations at constant speed about one axis.

    Args:
        seconds: (N,) times of the poses, N > 0, in any order.
        world_from_body: (N, 4, 4).
        wanted: (M,) times.

    Returns:
        The poses (M, 4, 4) and whether each is known (M,). A pose measured at just this time is returned bit for bit;
        the pose at a time that none is near is the nearest one, and not known.
    """
    order = np.argsort(seconds, kind="stable")
    seconds, poses = seconds[order], world_from_body[order]
    after = np.searchsorted(seconds, wanted)
    lower, upper = np.maximum(after - 1, 0), np.minimum(after, len(seconds) - 1)
    nearest = np.where(wanted - seconds[lower] < seconds[upper] - wanted, lower, upper)
    result = poses[nearest]
    gap = seconds[upper] - seconds[lower]
    away = np.abs(wanted - seconds[nearest])
    is_between = (gap > 0) & (gap <= MOST_GAP_SECONDS) & (away > 0)
    low, high = poses[lower[is_between]], poses[upper[is_between]]
    weight = ((wanted - seconds[lower]) / np.where(gap > 0, gap, 1))[is_between, None]
    turn = Rotation.from_matrix(np.swapaxes(low[:, :3, :3], 1, 2) @ high[:, :3, :3]).as_rotvec()
    rotations = low[:, :3, :3] @ Rotation.from_rotvec(weight * turn).as_matrix()
    result[is_between] = rigid.from_parts(rotations, (1 - weight) * low[:, :3, 3] + weight * high[:, :3, 3])
    return result, is_between | (away <= MOST_AWAY_SECONDS)


def photos_at(
    names: Sequence[str], seconds: Sequence[float], times: Sequence[float], world_from_body: np.ndarray, *, where: str
) -> tuple[list[int], np.ndarray, tuple[str, ...]]:
    """Return the numbers of the photos with a pose at their time, these poses (N, 4, 4), and a note on the others.

    Raises:
        UserError: no photo has one; `where` is the file of the poses.
    """
    poses, is_known = poses_at(np.array(times), world_from_body, np.array(seconds))
    if not is_known.any():
        raise malformed(where, "has no pose at the time of a photo", "copy the whole sequence")
    unposed = [names[index] for index in np.flatnonzero(~is_known).tolist()]
    return np.flatnonzero(is_known).tolist(), poses[is_known], without(unposed, "a pose near in time")
