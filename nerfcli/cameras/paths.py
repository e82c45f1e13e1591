"""Camera paths for renders and videos: an orbit, an ellipse, a spiral, and a flight through the frames.

All move at constant speed and use the first frame's picture size and focal length, without its distortion. `count` is
the number of views; the last view of a closed path is followed by the first. `depth_hint` is the distance to the focus,
in scene units, for cameras with parallel axes; `up` (3,) is what is up in the world, by default the cameras' own up.

All raise a ValueError without a frame, or if count is below 1.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import (
    centres_of,
    focus_point,
    horizontal_axes,
    mean_direction,
    surrounds,
    up_direction,
    views_of,
)
from nerfcli.errors import UserError

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
        np.linalg.norm(np.diff(position(t), axis=0), axis=1), per_radian * (along[:-1].inv() * along[1:]).magnitude()
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


# Fraction of the cameras' spread that a path uses: nothing was observed from beyond its rim.
_INSIDE = 0.8


def orbit(frames: Sequence[Frame], *, count: int, depth_hint: float | None = None) -> tuple[Frame, ...]:
    """Return a closed path around the focus point, looking at it.

    If the cameras surround the focus, the path goes around it once, at their mean elevation, on an ellipse fitted to
    their distances. If they are on one side, it is a small ellipse within the angles from which they view the focus.

    Raises:
        UserError: all cameras are in one place.
    """
    _check(frames, count)
    focus = focus_point(frames, depth_hint=depth_hint)
    up = up_direction(frames)
    offsets = centres_of(frames) - focus
    distances = np.linalg.norm(offsets, axis=1)
    elsewhere = distances > 0
    if not elsewhere.any():
        hint = "use --cameras interpolate, the path through the photos"
        raise UserError("all cameras are in one place and look outwards: there is nothing to orbit", hint)
    if surrounds(frames, up):
        curve = _ring(offsets[elsewhere], distances[elsewhere], up)
    else:
        viewing = _show(frames, focus) & elsewhere
        # Who walks past the focus photographs other things from behind it.
        # The angles of one or two cameras that view the focus say little; those of all cameras are used then.
        kept = viewing if viewing.sum() >= 3 else elsewhere
        curve = _frontal_ellipse(offsets[kept], distances[kept], up)
    centres = focus + _equal_steps(curve, count)
    return _looking_at(frames, centres, focus, up=up, name="orbit")


def ellipse(frames: Sequence[Frame], *, count: int, depth_hint: float | None = None) -> tuple[Frame, ...]:
    """Return a closed level ellipse about the focus point, at the cameras' mean height, looking at the focus.

    Its axes are the principal axes of the camera centres on the ground, and each half axis is the 90th percentile of
    their distances from the focus along it. Unlike `orbit` it always goes all the way around, behind the scene too.

    Raises:
        UserError: the cameras and the focus are on a line, so there is no ellipse.

    Source: generate_ellipse_path of google-research/multinerf, internal/camera_utils.py (mip-NeRF 360, Zip-NeRF), where
    up is the third principal axis of all centres; here it is the cameras' own.
    """
    _check(frames, count)
    focus = focus_point(frames, depth_hint=depth_hint)
    up = up_direction(frames)
    centres = centres_of(frames)
    ground = np.stack(horizontal_axes(up), axis=-1)  # (3, 2)
    flat = (centres - centres.mean(axis=0)) @ ground
    axes = ground @ np.linalg.eigh(flat.T @ flat)[1]
    half = np.percentile(np.abs((centres - focus) @ axes), 90, axis=0)
    if half.min() <= 1e-6 * np.linalg.norm(centres - focus, axis=1).max():
        raise UserError(
            f"the cameras do not surround what they look at: the half axes of the ellipse are {half[1]:.3g} and "
            f"{half[0]:.3g}",
            "use --cameras orbit, or interpolate for the path through the photos",
        )
    middle = focus + ((centres - focus) @ up).mean() * up

    def curve(t: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * t
        return middle + np.stack([np.cos(angle), np.sin(angle)], axis=-1) * half @ axes.T

    return _looking_at(frames, _equal_steps(curve, count), focus, up=up, name="ellipse")


def spiral(frames: Sequence[Frame], *, count: int, depth_hint: float | None = None) -> tuple[Frame, ...]:
    """Return a closed spiral of two turns about the mean camera, within the cameras' bounding box.

    All views look at a point straight ahead of the mean camera, as deep as the focus or at least 2 |radii|. If the
    cameras surround the scene, their mean would be inside it, so only the quarter nearest to the middle frame is used.

    Source: the render path of Fyusion/LLFF and of bmild/nerf, load_llff.py.
    """
    _check(frames, count)
    up = up_direction(frames)
    focus = focus_point(frames, depth_hint=depth_hint)
    near_frames = frames
    if surrounds(frames, up):
        distances = np.linalg.norm(centres_of(frames) - frames[len(frames) // 2].centre, axis=1)
        nearest = np.argsort(distances, kind="stable")[: max(4, len(frames) // 4)]
        near_frames = [frames[index] for index in nearest]
    centres = centres_of(near_frames)
    middle = centres.mean(axis=0)
    axes = rigid.look_at(middle, middle + mean_direction(views_of(near_frames)), up)[:3, :3]
    local = (centres - middle) @ axes
    # The spiral extends equally to both sides, so the narrower side limits it.
    radii = _INSIDE * np.minimum(local.max(axis=0), -local.min(axis=0)).clip(min=0.0)

    def curve(t: np.ndarray) -> np.ndarray:
        angle = 4 * np.pi * t
        return np.stack([np.cos(angle), np.sin(angle), np.sin(2 * np.pi * t)], axis=-1) * radii

    path = middle + _equal_steps(curve, count) @ axes.T
    depth = max(float((focus - middle) @ axes[:, 2]), 2.0 * float(np.linalg.norm(radii))) or 1.0
    return _looking_at(frames, path, middle + depth * axes[:, 2], up=up, name="spiral")


def interpolate(frames: Sequence[Frame], *, count: int) -> tuple[Frame, ...]:
    """Return a smooth flight at constant speed through the frames in order, from the first to the last; see `fly`."""
    _check(frames, count)
    poses = fly(np.stack([frame.world_from_cam for frame in frames]), count)
    return tuple(_path_frame(frames[0], pose, f"flight_{i:04d}") for i, pose in enumerate(poses))


def _show(frames: Sequence[Frame], point: np.ndarray) -> np.ndarray:
    """Return which frames have a point (3,) in their pictures, (frames,) bool; what may stand before it is ignored."""
    shown = np.zeros(len(frames), dtype=bool)
    for index, frame in enumerate(frames):
        (shown[index],) = frame.camera.shows(frame.in_camera(point[None]))
    return shown


def _check(frames: Sequence[Frame], count: int) -> None:
    if not frames or count < 1:
        raise ValueError(f"a path needs a frame and a view, got {len(frames)} frames and count {count}")


def _ring(offsets: np.ndarray, distances: np.ndarray, up: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a curve once around at the mean elevation, whose distance follows an ellipse over the azimuth."""
    east, north = horizontal_axes(up)
    elevation = float(np.mean(np.arcsin(np.clip(offsets @ up / distances, -1.0, 1.0))))
    azimuth = np.arctan2(offsets @ north, offsets @ east)
    inverse_square = _ellipse(azimuth, distances)

    def curve(t: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * t
        distance = inverse_square(angle) ** -0.5
        ground = np.cos(angle)[:, None] * east + np.sin(angle)[:, None] * north
        return distance[:, None] * (np.cos(elevation) * ground + np.sin(elevation) * up)

    return curve


def _ellipse(azimuth: np.ndarray, distances: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Fit a centred ellipse, or else the circle of the mean distance; return 1 / distance^2 as a function of azimuth.

    In polar form a centred ellipse is 1 / r^2 = a + b cos 2 phi + c sin 2 phi, linear in a, b and c. The circle is used
    for fewer than 8 cameras, and where scattered distances give axes beyond 2 : 1 or an a far from 1 / mean^2.
    """
    mean = float(np.mean(distances))
    columns = np.stack([np.ones_like(azimuth), np.cos(2 * azimuth), np.sin(2 * azimuth)], axis=-1)
    a, b, c = np.linalg.lstsq(columns, (mean / distances) ** 2, rcond=None)[0]
    eccentric = np.hypot(b, c)
    if len(azimuth) < 8 or a <= 0 or (a + eccentric) > 4 * (a - eccentric) or not 0.5 < a < 2:
        a, b, c = 1.0, 0.0, 0.0
    return lambda angle: (a + b * np.cos(2 * angle) + c * np.sin(2 * angle)) / mean**2


def _frontal_ellipse(offsets: np.ndarray, distances: np.ndarray, up: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a small ellipse in angles about the focus, within those of the cameras and at their mean distance."""
    towards = mean_direction(offsets / distances[:, None])
    # Azimuth and elevation are about `up`, unless the cameras look down too steeply for that.
    pole = up if abs(towards @ up) < 0.9 else np.cross(towards, horizontal_axes(towards)[0])
    front = towards - (towards @ pole) * pole
    front /= np.linalg.norm(front)
    side = np.cross(pole, front)
    azimuth = np.arctan2(offsets @ side, offsets @ front)
    elevation = np.arcsin(np.clip(offsets @ pole / distances, -1.0, 1.0))
    (a_low, a_high), (e_low, e_high) = (np.percentile(angle, [5, 95]) for angle in (azimuth, elevation))
    distance = float(np.mean(distances))

    def curve(t: np.ndarray) -> np.ndarray:
        a = (a_low + a_high) / 2 + _INSIDE * (a_high - a_low) / 2 * np.cos(2 * np.pi * t)
        e = (e_low + e_high) / 2 + _INSIDE * (e_high - e_low) / 2 * np.sin(2 * np.pi * t)
        ground = np.cos(a)[:, None] * front + np.sin(a)[:, None] * side
        return distance * (np.cos(e)[:, None] * ground + np.sin(e)[:, None] * pole)

    return curve


def _equal_steps(curve: Callable[[np.ndarray], np.ndarray], count: int) -> np.ndarray:
    """Return points (count, 3) at equal arc lengths along a closed curve over [0, 1], excluding its end."""
    # With so many samples of the curve, the speed is constant to about 1e-5.
    t = np.linspace(0.0, 1.0, 8193)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve(t), axis=0), axis=1))])
    if length[-1] == 0:
        return curve(np.zeros(count))
    at = np.linspace(0.0, length[-1], count, endpoint=False)
    return curve(np.interp(at, length, t))


def _looking_at(
    frames: Sequence[Frame], centres: np.ndarray, focus: np.ndarray, *, up: np.ndarray, name: str
) -> tuple[Frame, ...]:
    return tuple(
        _path_frame(frames[0], rigid.look_at(centre, focus, up), f"{name}_{index:04d}")
        for index, centre in enumerate(centres)
    )


def _path_frame(like: Frame, world_from_cam: np.ndarray, name: str) -> Frame:
    return Frame(name, like.camera.undistorted(), world_from_cam)
