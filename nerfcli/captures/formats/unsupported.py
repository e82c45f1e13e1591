"""Losses of a conversion, as clauses such as "k3 of 12 cameras" or "3 masks"."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable

from nerfcli.cameras.camera import Camera
from nerfcli.captures.capture import Capture
from nerfcli.errors import UserError, several

# Parameters that every format of perspective pictures has a place for.
_PINHOLE = ("f", "fx", "fy", "cx", "cy")


def lost_parts(capture: Capture, *, holds: Collection[str]) -> list[str]:
    """List the losses beyond cameras and poses of a capture.

    Args:
        holds: the parts that the format has a place for: "masks", "depths", "points", "colours", "observations",
            "splits", "depth bounds", "unit".
    """
    num_points = len(capture.points)
    num_observations = 0 if capture.observations is None else len(capture.observations.pixels)
    num_split = sum(frame.split is not None for frame in capture.frames)
    parts = {
        "masks": (num := sum(frame.mask is not None for frame in capture.frames), several(num, "mask")),
        "depths": (num := sum(frame.depth is not None for frame in capture.frames), several(num, "sensor depth map")),
        "points": (num_points, several(num_points, "point")),
        "colours": (num_points if capture.colours is not None else 0, f"colours of {several(num_points, 'point')}"),
        "observations": (num_observations, several(num_observations, "observation")),
        "splits": (num_split, f"the split of {several(num_split, 'frame')}"),
        "depth bounds": (capture.depth_bounds is not None, "depth bounds"),
        "unit": (capture.unit != "arbitrary", f"the unit of length ({capture.unit})"),
    }
    return [clause for part, (present, clause) in parts.items() if present and part not in holds]


def lost_of_cameras(capture: Capture, lost: Callable[[Camera], Iterable[str]]) -> list[str]:
    """List the losses of cameras as clauses "k3 of 2 cameras", with the number of distinct cameras affected."""
    cameras = {frame.camera for frame in capture.frames}
    counts = Counter(name for camera in cameras for name in lost(camera))
    return [f"{name} of {several(count, 'camera')}" for name, count in sorted(counts.items())]


def distortion(camera: Camera) -> dict[str, float]:
    """Return the non-zero parameters other than focal lengths and principal point, by name."""
    if camera.is_spherical:
        return {}
    return {name: value for name, value in camera.values.items() if name not in _PINHOLE and value}


def projection(camera: Camera) -> str:
    """Return a camera's projection without distortion: "perspective", "fisheye" (equidistant) or "spherical"."""
    return "spherical" if camera.is_spherical else "fisheye" if "FISHEYE" in camera.model else "perspective"


def lost_to_pinhole(camera: Camera) -> list[str]:
    """List what is lost when a camera keeps one focal length and its size, with a centred principal point."""
    if camera.is_spherical:
        return ["the spherical projection"]
    lost = ["the fisheye projection"] if projection(camera) == "fisheye" else []
    lost += distortion(camera)
    if camera != camera.centred():
        lost.append("the principal point")
    if len(set(camera.focal_lengths)) > 1:
        lost.append("the second focal length")
    return lost


def refuse_spherical(capture: Capture, what: str) -> None:
    """Refuse a capture with a spherical picture, which has no focal length or field of view, for a format of these."""
    for frame in capture.frames:
        if frame.camera.is_spherical:
            hint = "write transforms.json instead"
            raise UserError(f"the spherical picture {frame.name} has no {what}, which this format requires", hint)
