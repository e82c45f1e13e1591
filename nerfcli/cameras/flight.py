"""A smooth flight through poses at constant speed.

Between two poses the camera follows a cubic Hermite curve, in space and in rotation. Notation: h_i is the time between
poses i and i + 1, v_i the mean velocity (or angular velocity) over it, m_i the velocity at pose i.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid

# Number of samples to measure the curve's length: of the whole curve, and at least of each piece. The speed is then
# constant to about 1e-4 with many pieces, and to 1e-6 with few.
_CURVE_SAMPLES = 32768


def fly(world_from_cam: np.ndarray, count: int) -> np.ndarray:
    """Return poses (count, 4, 4) at equal steps on a smooth curve through the given ones, from the first to the last.

    A step's length is the larger of its distance and its angle times L, where L is the length for which all turning of
    the flight counts a quarter of all its movement. So the camera moves at constant speed, except that it turns at
    constant speed where it turns almost on the spot.

    Velocities come from the parabola through three poses with centripetal times h_i (the square root of the step's
    length): m_i = (h_i v_{i-1} + h_{i-1} v_i) / (h_{i-1} + h_i), and are limited to twice the smaller of |v_{i-1}| and
    |v_i|. Where movement outweighs turning, the camera thus passes a pose along the bisector of the directions to it
    and from it. The camera never flies past a pose and back: between poses on a line it moves along the line one way,
    likewise for turns about one axis, and it never strays from the two poses of a piece by more than 2/3 of their
    distance.

    Args:
        world_from_cam: (N, 4, 4), N >= 1; a pose that repeats the one before is ignored.
        count: at least 1.

    Sources: Yuksel et al. 2011, Parameterization and applications of Catmull-Rom curves, for the times; Fritsch &
    Carlson 1980, Monotone piecewise cubic interpolation, for the limit; Kim, Kim & Shin 1995, A general construction
    scheme for unit quaternion curves, for Hermite curves of rotations.
    """
    world_from_cam = _without_repeats(np.asarray(world_from_cam, dtype=np.float64))
    if len(world_from_cam) == 1:
        return np.repeat(world_from_cam, count, axis=0)
    moves = np.diff(world_from_cam[:, :3, 3], axis=0)
    rotations = Rotation.from_matrix(world_from_cam[:, :3, :3])
    turns = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
    moved, turned = np.linalg.norm(moves, axis=1), np.linalg.norm(turns, axis=1)
    # All turning of a flight weighs a quarter of all its movement.
    per_radian = 0.25 * moved.sum() / max(turned.sum(), 1e-12) if moved.sum() > 0 else 1.0
    times = np.sqrt(np.maximum(moved, per_radian * turned))
    position = _position_curve(world_from_cam[:, :3, 3], moves, times)
    rotation = _rotation_curve(rotations, turns, times)

    # The speed over t jumps where pieces meet, so there must be samples at these points.
    samples = max(64, -(-_CURVE_SAMPLES // len(times)))
    t = np.arange(samples * len(times) + 1) / samples
    along = rotation(t)
    steps = np.maximum(
        np.linalg.norm(np.diff(position(t), axis=0), axis=1),
        per_radian * (along[:-1].inv() * along[1:]).magnitude(),
    )
    length = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.interp(np.linspace(0.0, length[-1], count), length, t)
    return rigid.from_parts(rotation(at).as_matrix(), position(at))


def _position_curve(centres: np.ndarray, moves: np.ndarray, times: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from t (n,) to centres (n, 3); t counts the pieces: t = 2.5 is in the middle of the third."""
    velocities = _velocities(moves, times)
    leaving, arriving = velocities[:-1] * times[:, None], velocities[1:] * times[:, None]

    def curve(t: np.ndarray) -> np.ndarray:
        piece, s = _piece(t, len(times))
        return (
            centres[piece]
            + (3 - 2 * s) * s**2 * moves[piece]
            + s * (1 - s) ** 2 * leaving[piece]
            - s**2 * (1 - s) * arriving[piece]
        )

    return curve


def _rotation_curve(rotations: Rotation, turns: np.ndarray, times: np.ndarray) -> Callable[[np.ndarray], Rotation]:
    """Return a function from t (n,) to rotations R_i exp(a b1(s)) exp(b b2(s)) exp(c b3(s)).

    b1 to b3 are Bernstein's cumulative polynomials. a and c are a third of the turn that the angular velocities at the
    two ends would make, in the camera's own axes, and b is the rest of the turn.
    """
    velocities = _velocities(turns, times)
    leaving, arriving = velocities[:-1] * times[:, None] / 3, velocities[1:] * times[:, None] / 3
    steps = rotations[:-1].inv() * rotations[1:]
    quaternions = rotations.as_quat()
    left = (Rotation.from_rotvec(-leaving) * steps * Rotation.from_rotvec(-arriving)).as_rotvec()

    def curve(t: np.ndarray) -> Rotation:
        piece, s = _piece(t, len(times))
        return (
            Rotation.from_quat(quaternions[piece])
            * Rotation.from_rotvec((1 - (1 - s) ** 3) * leaving[piece])
            * Rotation.from_rotvec((3 - 2 * s) * s**2 * left[piece])
            * Rotation.from_rotvec(s**3 * arriving[piece])
        )

    return curve


def _piece(t: np.ndarray, pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the piece that each t falls into, (n,), and the position within the piece, (n, 1) in [0, 1]."""
    piece = np.clip(np.floor(t).astype(int), 0, pieces - 1)
    return piece, (t - piece)[:, None]


def _velocities(moves: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the velocities m (pieces + 1, 3) for moves (pieces, 3), with zero acceleration at both ends."""
    mean = moves / times[:, None]
    speed = np.linalg.norm(mean, axis=1)
    before, after = times[:-1, None], times[1:, None]
    inner = _cut((after * mean[:-1] + before * mean[1:]) / (before + after), 2 * np.minimum(speed[:-1], speed[1:]))
    first, last = (inner[0], inner[-1]) if len(inner) else (mean[0], mean[0])
    ends = _cut((3 * mean[[0, -1]] - [first, last]) / 2, 2 * speed[[0, -1]])
    return np.concatenate([ends[:1], inner, ends[1:]])


def _cut(velocities: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Shorten velocities (n, 3) to at most the given lengths (n,)."""
    speed = np.linalg.norm(velocities, axis=1)
    return velocities * np.where(speed > most, most / np.where(speed > 0, speed, 1.0), 1.0)[:, None]


def _without_repeats(poses: np.ndarray) -> np.ndarray:
    """Return the poses without those that repeat the one before, since a curve needs time between them."""
    kept = [poses[0]]
    for pose in poses[1:]:
        if np.abs(pose - kept[-1]).max() > 1e-9:
            kept.append(pose)
    return np.stack(kept)
