"""Layout of the cameras of a scene: baseline relative to depth, coverage of directions, outliers."""

import json
from collections.abc import Sequence

import numpy as np

from nerfcli.cameras.layout import centres_of, focus_point, gaps_between, horizontal_axes, up_direction, views_of
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.colmap import find_model, read_model
from nerfcli.doctor.geometry import BASELINE_BAD, BASELINE_LOOK
from nerfcli.doctor.photo_facts import PhotoFacts
from nerfcli.errors import several
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding, finding, verdict_below, worst
from nerfcli.photos.geodesy import east_north_up
from nerfcli.poses.judge.contradictions import FARTHEST
from nerfcli.poses.model.lens_observability import HARMLESS, WEAK_FOCAL
from nerfcli.poses.model.reasons import FEW_FEATURES

# Inward-looking cameras surround the scene if they span at least this angle; otherwise they face its front.
_AROUND_DEG = 180.0
_GAP_LOOK, _GAP_BAD = 45.0, 100.0
_SPAN_LOOK, _SPAN_BAD = 20.0, 6.0
# Focal lengths along x and y that differ by more than this mean pixels that are not square, or a wrong calibration.
_ASPECT_LOOK = 0.02
# GPS of phones is off by 5 m under open sky and by tens of metres indoors; a metric scale needs a wider capture.
_GPS_WIDE = 100.0
# Points that are enough for the median depth of a photo.
_MOST_POINTS = 20_000


def spread(scene: Capture) -> Finding:
    """Check the spread of the cameras relative to scene depth, and find cameras far from the rest."""
    centres = centres_of(scene.frames)
    depths = _depths(scene)
    middle = np.median(centres, axis=0)
    distances = np.linalg.norm(centres - middle, axis=1)
    ratio = float(np.sqrt(np.mean(distances**2)) / np.median(depths))
    typical = float(np.median(distances))
    far = [i for i in np.argsort(-distances) if distances[i] > FARTHEST * typical and typical > 0]
    step = float(np.median(gaps_between(centres) / depths)) if len(centres) > 1 else 0.0
    verdict = worst([verdict_below(ratio, look=BASELINE_LOOK, bad=BASELINE_BAD), LOOK if far else GOOD])
    summary = f"camera spread / depth {ratio:.2f}, distance to the nearest camera / depth {step:.3f}"
    advice = "step sideways between photos: depth is visible only if the camera moves"
    if far:
        summary += f"; {several(len(far), 'camera')} far from the others"
        advice = "check these poses: wrong ones ruin training; estimate poses again without these photos"
    threshold = (
        f"camera spread / depth: look below {BASELINE_LOOK}, bad below {BASELINE_BAD}; a camera: look from "
        f"{FARTHEST:g} times the median distance"
    )
    remarks = [(scene.frames[i].name, f"{distances[i] / typical:.0f} times the median distance") for i in far]
    return finding("camera spread", verdict, summary, ratio, threshold, advice=advice, photos=remarks)


def directions(scene: Capture) -> Finding:
    """Check from which directions the cameras see the scene."""
    up = up_direction(scene.frames)
    east, north = horizontal_axes(up)
    centres, views = centres_of(scene.frames), views_of(scene.frames)
    focus = focus_point(scene.frames, depth_hint=float(np.median(_depths(scene))))
    inward = (focus - centres) / np.maximum(np.linalg.norm(focus - centres, axis=1, keepdims=True), 1e-300)
    looks_in = float(np.mean((inward * views).sum(axis=1) > 0.5)) > 0.7
    rays = -inward if looks_in else views
    azimuth = np.sort(np.degrees(np.arctan2(rays @ north, rays @ east)))
    elevation = np.degrees(np.arcsin(np.clip(rays @ up, -1, 1)))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 360))
    span = 360 - float(gaps.max())
    high = f"elevation {elevation.min():.0f} to {elevation.max():.0f} degrees"
    if looks_in and span < _AROUND_DEG:
        span = max(span, float(np.ptp(elevation)))
        verdict = verdict_below(span, look=_SPAN_LOOK, bad=_SPAN_BAD)
        summary = f"cameras in front of the scene, within {span:.0f} degrees; {high}"
        threshold = f"span: look below {_SPAN_LOOK:g} degrees, bad below {_SPAN_BAD:g}"
        advice = "add photos from farther left, right, above and below"
        return finding("directions", verdict, summary, span, threshold, advice=advice)
    widest = float(gaps.max())
    verdict = BAD if looks_in and widest >= _GAP_BAD else LOOK if looks_in and widest >= _GAP_LOOK else GOOD
    layout = "around the scene" if looks_in else "looking outwards"
    summary = f"cameras {layout}, widest gap {widest:.0f} degrees; {high}"
    threshold = f"gap around the scene: look from {_GAP_LOOK:g} degrees, bad from {_GAP_BAD:g}"
    advice = "add photos in the gap: the scene is unknown from there"
    return finding("directions", verdict, summary, widest, threshold, advice=advice)


def focal_lengths(scene: Capture) -> Finding:
    """Check whether the focal lengths of a scene's cameras along x and y agree, as pixels of nearly all cameras are
    square."""
    apart = sorted(((abs(frame.camera.pixel_aspect - 1.0), frame.name) for frame in scene.frames), reverse=True)
    stretched = [
        (name, f"focal lengths along x and y differ by {100 * off:.1f} %") for off, name in apart if off > _ASPECT_LOOK
    ]
    fractions = [frame.camera.focal_px / max(frame.camera.width, frame.camera.height) for frame in scene.frames]
    summary = f"{np.median(fractions):.2f} times the longer side, from the scene"
    threshold = f"difference along x and y: look from {100 * _ASPECT_LOOK:g} %"
    summary += f"; {several(len(stretched), 'photo')} whose {stretched[0][1]}" if stretched else ""
    advice = (
        "pixels of nearly all cameras are square: unless these photos were stretched, the calibration is wrong; "
        "estimate poses with nerfcli poses and compare held-out photos"
    )
    verdict = LOOK if stretched else GOOD
    return finding("focal length", verdict, summary, apart[0][0], threshold, advice=advice, photos=stretched)


def points(scene: Capture) -> Finding | None:
    """Check the number of 3D points per photo; None if the format does not provide it."""
    model = find_model(scene.root)
    if scene.kind not in ("nerfcli", "colmap") or model is None:
        return None
    counts = {image.name: int((image.point_ids >= 0).sum()) for image in read_model(model).images}
    few = sorted((count, name) for name, count in counts.items() if count < FEW_FEATURES)
    middle = float(np.median(list(counts.values()))) if counts else 0.0
    summary, threshold = f"{middle:.0f} 3D points in the median photo", f"per photo: look below {FEW_FEATURES}"
    summary += f", {several(len(few), 'photo')} with few" if few else ""
    advice = "their poses are uncertain: check renderings from there"
    remarks = [(name, several(count, "point")) for count, name in few]
    return finding("points", LOOK if few else GOOD, summary, middle, threshold, advice=advice, photos=remarks)


def intrinsics(scene: Capture) -> Finding | None:
    """Check how well the photos determined the intrinsics, from the report of `nerfcli poses`; None without one."""
    path = scene.root / "poses_report.json"
    if scene.kind != "nerfcli" or not path.is_file():
        return None
    cameras = json.loads(path.read_text(encoding="utf-8"))["cameras"]
    certain = [camera["uncertainty"] for camera in cameras if (camera.get("uncertainty") or {}).get("weak") is not None]
    if not certain:
        return None
    weak = [one for one in certain if one["weak"]]
    focal = max(one["focal_percent"] for one in certain)
    borders_px = [one["distortion_border_px"] for one in certain if one["distortion_border_px"] is not None]
    accuracy = f"focal length ± {focal:.2g} %"
    if borders_px:
        accuracy += f", distortion ± {max(borders_px):.2g} px at the corners"
    threshold = (
        f"standard deviation: look from {100 * WEAK_FOCAL:g} % of the focal length, or {100 * HARMLESS:g} % of half "
        "the image diagonal"
    )
    summary = f"intrinsics are weakly determined: {accuracy}" if weak else accuracy
    advice = "use nerfcli poses --intrinsics, or add photos from more directions and distances"
    return finding("intrinsics", LOOK if weak else GOOD, summary, focal, threshold, advice=advice)


def check_scene_files(scene: Capture) -> list[Finding]:
    """Check for listed photos that are missing and for incomplete masks, and report the unit of length."""
    missing = scene.missing
    total = len(missing) + len(scene.frames)
    masked = [frame.name for frame in scene.frames if frame.mask is not None]
    unmasked = [(frame.name, "no mask") for frame in scene.frames if frame.mask is None] if masked else []
    verdict = BAD if len(missing) >= 0.5 * total and missing else LOOK if missing else GOOD
    summary = f"{len(missing)} of {several(total, 'listed photo')} missing" if missing else "none"
    advice = "put them back, or continue with the others" if missing else ""
    remarks, threshold = tuple((name, "missing") for name in missing), "look from 1, bad from half of them"
    of_photos = Finding("missing photos", verdict, summary, len(missing), threshold, advice, remarks)
    summary = f"{len(masked)} of {several(len(scene.frames), 'photo')} have a mask" if masked else "none"
    verdict, advice = (LOOK, "give all photos a mask, or none") if unmasked else (GOOD, "")
    threshold = "look if only some photos have a mask"
    of_masks = Finding("masks", verdict, summary, len(masked), threshold, advice, tuple(unmasked))
    summary, advice = "lengths are in metres", ""
    if scene.unit != "metre":
        summary = "no metric scale: depth maps are in scene units, not metres"
        advice = "for metres: nerfcli convert with --scale gps, --distance or --markers"
    return [of_photos, of_masks, Finding("unit", GOOD, summary, None, "for information", advice)]


def gps(photos: Sequence[PhotoFacts]) -> Finding | None:
    """Report the extent of the GPS positions of the photos; None if there are none."""
    positions = [photo.exif.gps for photo in photos if photo.exif.gps is not None]
    if not positions:
        return None
    metres = east_north_up(positions)
    extent = np.ptp(metres[:, :2], axis=0)
    widest = float(extent.max())
    summary = f"{several(len(positions), 'photo')} within {extent[0]:.0f} m x {extent[1]:.0f} m: "
    if widest > _GPS_WIDE:
        return Finding("GPS", GOOD, f"{summary}may be enough for a metric scale", widest, "for information")
    advice = "GPS errors are about 5 m outdoors and tens of metres indoors; use a known distance for metres"
    return Finding("GPS", GOOD, f"{summary}too close together for a metric scale", widest, "for information", advice)


def _depths(scene: Capture) -> np.ndarray:
    """Return the median depth that each camera sees, (frames,): along the optical axis, of panoramas along the rays."""
    frames = scene.frames
    if scene.depth_bounds is not None:
        # The middle of the range of inverse depths.
        return 2 / (1 / scene.depth_bounds).sum(axis=1)
    if len(scene.points):
        depths = np.full(len(frames), np.nan)
        points = scene.points[:: 1 + len(scene.points) // _MOST_POINTS]
        for index, frame in enumerate(frames):
            local = frame.in_camera(points)
            seen = local[frame.camera.shows(local)]
            if len(seen):
                depths[index] = np.median(np.linalg.norm(seen, axis=1) if frame.camera.is_spherical else seen[:, 2])
        if not np.isnan(depths).all():
            return np.where(np.isnan(depths), np.nanmedian(depths), depths)
    to_focus = np.linalg.norm(focus_point(frames) - centres_of(frames), axis=1)
    return np.maximum(to_focus, 1e-9 * max(float(to_focus.max()), 1e-300))
