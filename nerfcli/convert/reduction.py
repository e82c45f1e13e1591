"""Reduce a capture to what a format can hold: cameras without the lost terms, and names as other programs read them.

A written file is compared with the reduced capture when losses were accepted. This module states independently what
each writer keeps, so that a writer that loses anything else is detected.
"""

import math
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import replace

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Capture
from nerfcli.convert.scene_folder import named_for_scene

# Camera models that transforms.json can hold completely.
_HELD = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"),
)


# Contents that each format holds besides cameras, poses and points.
_PARTS = {
    "nerfcli": ("masks", "split", "colours", "observations", "depth bounds", "unit"),
    "colmap": ("colours", "observations"),
    "colmap-text": ("colours", "observations"),
    "transforms": ("masks", "split", "colours"),
    "blender": ("split",),
    "llff": ("depth bounds",),
    "opensfm": ("colours",),
    "ply": ("colours",),
}


def reduced(capture: Capture, format_name: str) -> Capture:
    """Return the capture with the cameras, names and other parts that a format can hold."""
    return _with_parts(_with_expressible_cameras(capture, format_name), _PARTS.get(format_name, ()))


def _with_parts(capture: Capture, held: Collection[str]) -> Capture:
    frames = tuple(
        replace(f, mask=f.mask if "masks" in held else None, split=f.split if "split" in held else None)
        for f in capture.frames
    )
    return replace(
        capture,
        frames=frames,
        colours=capture.colours if "colours" in held else None,
        observations=capture.observations if "observations" in held else None,
        depth_bounds=capture.depth_bounds if "depth bounds" in held else None,
        unit=capture.unit if "unit" in held else "arbitrary",
    )


def _with_expressible_cameras(capture: Capture, format_name: str) -> Capture:
    """Return the capture with the cameras and names that a format can express."""
    if format_name == "nerfcli":
        return named_for_scene(capture)
    if format_name == "colmap-text":
        return replace(capture, frames=tuple(replace(f, name=f.name.split(" ")[0]) for f in capture.frames))
    if format_name == "blender":
        return _with_one_angle(_with_cameras(capture, _pinhole))
    change = {"transforms": _to_transforms, "llff": _pinhole, "opensfm": _to_opensfm}.get(format_name)
    return capture if change is None else _with_cameras(capture, change)


def _with_cameras(capture: Capture, change: Callable[[Camera], Camera]) -> Capture:
    changed = {camera: change(camera) for camera in {frame.camera for frame in capture.frames}}
    return replace(capture, frames=tuple(replace(frame, camera=changed[frame.camera]) for frame in capture.frames))


def _with_one_angle(capture: Capture) -> Capture:
    """Give all views of a split the angle of view that most of them have, because its file holds only one."""
    angles: dict[str, Counter[float]] = {}
    for frame in capture.frames:
        angle = 2 * math.atan(frame.camera.width / 2 / frame.camera.params[0])
        angles.setdefault(frame.split or "train", Counter())[angle] += 1
    shared = {split: counts.most_common(1)[0][0] for split, counts in angles.items()}
    frames = []
    for frame in capture.frames:
        width, height = frame.camera.width, frame.camera.height
        focal_px = width / 2 / math.tan(shared[frame.split or "train"] / 2)
        frames.append(replace(frame, camera=Camera.pinhole(width, height, focal_px), split=frame.split or "train"))
    return replace(capture, frames=tuple(frames))


def _pinhole(camera: Camera) -> Camera:
    """Keep only the horizontal focal length; the principal point is the picture's centre."""
    if camera.is_spherical:
        return camera
    return Camera.pinhole(camera.width, camera.height, camera.params[0])


def _to_transforms(camera: Camera) -> Camera:
    """Keep OpenCV's k1, k2, p1, p2, k3, or its fisheye's k1 to k4; a camera without other terms is unchanged."""
    if camera.is_spherical or camera.model in _HELD:
        return camera
    value, head = camera.values, (*camera.focal_lengths, *camera.principal_point)
    if "FISHEYE" in camera.model:
        keys = ("k0", "k1", "k2", "k3") if camera.model.startswith("RAD_TAN") else ("k1", "k2", "k3", "k4")
        return Camera("OPENCV_FISHEYE", camera.width, camera.height, (*head, *(value.get(key, 0.0) for key in keys)))
    if camera.model == "FULL_OPENCV":
        return camera.with_values(dict.fromkeys(("k4", "k5", "k6"), 0.0))
    return Camera("PINHOLE", camera.width, camera.height, head)


def _to_opensfm(camera: Camera) -> Camera:
    """Keep Brown's terms without those of the denominator, or the six radial terms of the fisheye."""
    if camera.model == "FULL_OPENCV":
        return camera.with_values(dict.fromkeys(("k4", "k5", "k6"), 0.0))
    if camera.model == "RAD_TAN_THIN_PRISM_FISHEYE":
        return camera.with_values(dict.fromkeys(("p0", "p1", "s0", "s1", "s2", "s3"), 0.0))
    return camera
