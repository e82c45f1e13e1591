"""Extract the sharpest frames of a video to a folder of JPEG photos, one of each stretch of equal camera motion.

Equal stretches of time would waste frames on a camera that stands still. So time is weighted by the speed of the
picture, up to its usual speed: standing still does not count, and a fast turn, where frames are blurred, counts no
more than the rest. The frames are named by their number in the video, so that pairs are chosen as for any ordered
capture; frames.json has their origin.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

import nerfcli
from nerfcli.atomic import atomic_folder, write_json
from nerfcli.errors import TOO_FEW_PHOTOS, UserError
from nerfcli.notices import Notify, Reporter
from nerfcli.photos.images import downscale
from nerfcli.photos.video import MeasuredFrames, Video, measure_frames, open_video, read_frames
from nerfcli.poses.input.photos import MIN_PHOTOS

FRAMES_FILE = "frames.json"
DEFAULT_FRAMES = 120

_JPEG_QUALITY = 97

# Longer sides, in pixels, of the pictures for measuring sharpness (about the size for extracting features) and motion.
SHARPNESS_SIZE_PX = 960

# The picture has moved when half of its corners moved by this fraction of its longer side: about what is needed for
# parallax, and more than the shake of a hand that holds still.
MOVED_FRACTION = 0.01
# If a whole video has fewer such movements than this (a drone far away), smaller ones count, down to this fraction of
# them: a handful of frames would be too few for poses and training.
_FEW_STEPS, _LEAST_STEP = 24, 0.25
# Fewer corners than this do not measure motion; then pictures that differ by less than this, of 255, are the same.
_MIN_CORNERS = 12
_SAME_LEVELS = 3.0


@dataclass(frozen=True)
class FrameMeasure:
    """Sharpness of a frame (comparable within a video), and its motion since the anchor.

    The anchor is the last earlier frame that had moved by `MOVED_FRACTION`. moved is a fraction of the longer side,
    infinite if the two show different things.
    """

    sharpness: float
    moved: float


class FrameMeter:
    """Measures the frames of a video in their order; it keeps only the picture of the anchor."""

    def __init__(self) -> None:
        self._anchor: MotionPicture | None = None

    def measure(self, grey: np.ndarray) -> FrameMeasure:
        """Return the measures of the next frame, uint8 (height, width), at `SHARPNESS_SIZE_PX`."""
        picture = MotionPicture(grey)
        moved = self._anchor.moved_to(picture) if self._anchor else np.inf
        if moved >= MOVED_FRACTION:
            self._anchor = picture
        return FrameMeasure(sharpness(grey), moved)


class MotionPicture:
    """A reduced frame, with the corners that are tracked from it."""

    def __init__(self, picture: np.ndarray):
        """picture: uint8, grey or RGB."""
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        self._grey = downscale(grey, max(1.0, max(grey.shape) / (SHARPNESS_SIZE_PX / 3)))
        self._corners: np.ndarray | None = None

    def moved_to(self, other: "MotionPicture") -> float:
        """Return the median displacement of the corners to another frame, as a fraction of the longer side."""
        if self._corners is None:
            found = cv2.goodFeaturesToTrack(self._grey, maxCorners=200, qualityLevel=0.01, minDistance=8)
            self._corners = np.zeros((0, 1, 2), np.float32) if found is None else found
        if len(self._corners) < _MIN_CORNERS:
            difference = np.abs(self._grey.astype(float) - other._grey).mean()
            return 0.0 if difference < _SAME_LEVELS else float("inf")
        room = np.empty_like(self._corners)
        followed, status, _ = cv2.calcOpticalFlowPyrLK(
            self._grey, other._grey, self._corners, room, winSize=(15, 15), maxLevel=4
        )
        found = status.ravel() == 1
        if found.mean() < 0.5:  # another part of the scene is in view
            return float("inf")
        lengths = np.linalg.norm((followed - self._corners)[found].reshape(-1, 2), axis=1)
        return float(np.median(lengths) / max(self._grey.shape))


def sharpness(grey: np.ndarray) -> float:
    """Compute the sharpness of a picture: the variance of its Laplacian, slightly smoothed against noise."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    return float(cv2.Laplacian(smooth, cv2.CV_32F).var())


def choose_frames(seconds: np.ndarray, measures: Sequence[FrameMeasure], *, count: int) -> list[int]:
    """Return the ascending numbers of `count` frames: the sharpest (the first of equals) of each of `count` stretches.

    `seconds` (frames,) increase; `count` is 1...frames.
    """
    if not 1 <= count <= len(measures):
        raise ValueError(f"count must be within 1...{len(measures)}, got {count}")
    path = _path(seconds, np.array([measure.moved for measure in measures]))
    # Stretch k begins with frame first[k]; each has at least one frame, even where the path leaves it none.
    first = np.searchsorted(path, path[-1] * np.arange(count) / count)
    first = np.maximum.accumulate(first - np.arange(count)) + np.arange(count)
    first = np.minimum(first, len(measures) - count + np.arange(count))
    sharp = np.array([measure.sharpness for measure in measures])
    stretches = zip(first, [*first[1:], len(measures)], strict=True)
    return [int(start + np.argmax(sharp[start:end])) for start, end in stretches]


def smallest_step(measures: Sequence[FrameMeasure]) -> float:
    """Return by how much a frame must have moved to differ from another, as a fraction of the longer side."""
    steps = sum(measure.moved >= MOVED_FRACTION for measure in measures)
    return MOVED_FRACTION * min(1.0, max(_LEAST_STEP, steps / _FEW_STEPS))


def _path(seconds: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the distance covered at each frame, (frames,), in seconds at the camera's usual speed; not decreasing.

    The speed is taken to be constant between successive anchors, and the usual speed is the median over these steps.
    """
    anchors = np.flatnonzero(moved >= MOVED_FRACTION)
    # Before the first step and after the last one, the picture moves by less than can be measured.
    times = seconds[anchors]
    steps = np.diff(times)
    if len(steps) == 0:
        return seconds - seconds[0]
    speeds = moved[anchors[1:]] / steps
    finite = speeds[np.isfinite(speeds)]
    usual = np.median(finite) if len(finite) else 0.0
    gains = steps * np.minimum(1.0, speeds / usual) if usual > 0 else steps
    knots = np.concatenate([[0.0], np.cumsum(gains)])
    return np.interp(seconds, times, knots)


def frames_folder(scene_dir: Path) -> Path:
    """Return the folder of the video frames for a scene: next to it, clip-frames for clip-scene."""
    scene = scene_dir.resolve() if scene_dir.name in ("", "..") else scene_dir
    return scene.with_name("frames" if scene.name == "scene" else f"{scene.name.removesuffix('-scene')}-frames")


def extract_frames(
    path: Path, folder: Path, *, count: int | None, overwrite: bool, reporter: Reporter = Reporter()
) -> None:
    """Write the sharpest frames of a video to `folder`, or keep them if they are there already.

    Of frames that show the same, only one is written. The same video gives the same frames.

    Args:
        folder: gets frame_000123.jpg... and frames.json, all or nothing.
        count: how many; None for 120. A video with fewer frames gives all of them.
        overwrite: replace frames that were made from another video or with another count.

    Raises:
        UserError: the video cannot be read or is cut short, or shows fewer than four different pictures; or `folder`
            contains something else.
    """
    video = open_video(path)
    request = {"video": _identity(path), "frames": count, "selection": 1}
    note = reporter.note
    if _kept(folder, path, request, overwrite=overwrite, note=note):
        return
    if video.num_streams > 1:
        note(f"{path.name} has {video.num_streams} video streams: the largest, {video.width}x{video.height}, is used")
    if video.hdr:
        note(f"{path.name} is an HDR video: its colours are converted to sRGB")
    # Measuring takes most of the time, since it also examines every frame; extracting only decodes.
    video, measured = _measured(video, reporter.part(0.0, 0.7, "looking for sharp frames"))
    if video.fields:
        note(f"{path.name} is interlaced: the lines of the later field of each frame are interpolated")
    if measured.errors:
        note(f"{path.name} is damaged in {measured.errors} places; nearby frames may show block artifacts")
    total = len(measured.values)
    if count is not None and count > total:
        note(f"{path.name} has only {total} frames, but --frames is {count}: using all of them")
    numbers = choose_frames(measured.seconds, measured.values, count=min(count or DEFAULT_FRAMES, total))
    with atomic_folder(folder) as partial:
        frames = _write(partial, video, numbers, measured, reporter.part(0.7, 1.0, "writing frames"))
        if len(frames) < MIN_PHOTOS:
            raise UserError(
                f"{path} has only {len(frames)} different frames; at least {MIN_PHOTOS} are needed",
                "film while walking around the scene; a still camera gives no depth",
                TOO_FEW_PHOTOS,
            )
        content = {
            "request": request,
            "width": video.width,
            "height": video.height,
            "frames_in_video": total,
            "frames": frames,
            "settings": {
                "moved_share": smallest_step(measured.values),
                "sharpness_size_px": SHARPNESS_SIZE_PX,
                "jpeg_quality": _JPEG_QUALITY,
            },
            "versions": {"nerfcli": nerfcli.__version__},
        }
        write_json(partial / FRAMES_FILE, content)
    same = len(numbers) - len(frames)
    duplicates = f"; {same} more are duplicates of the previous frame" if same else ""
    note(f"{folder}: {len(frames)} of {total} frames of {path.name}{duplicates}")


def _measured(video: Video, progress: Callable[[float], None]) -> tuple[Video, MeasuredFrames[FrameMeasure]]:
    """Measure all frames; once more if they show that the video's header is wrong about interlacing."""
    measured = measure_frames(video, FrameMeter().measure, longer_side=SHARPNESS_SIZE_PX, progress=progress)
    if measured.fields == video.fields:
        return video, measured
    return _measured(replace(video, fields=measured.fields), progress)


def _write(
    folder: Path,
    video: Video,
    numbers: Sequence[int],
    measured: MeasuredFrames[FrameMeasure],
    progress: Callable[[float], None],
) -> list[dict[str, Any]]:
    """Write the chosen frames that differ from the one written before; of similar frames, the sharpest one.

    Returns the file's name, the number in the video from 0, the time, and the sharpness of each.
    """
    written: list[dict[str, Any]] = []
    chosen = zip(numbers, read_frames(video, numbers), strict=True)
    for number, picture in _different(chosen, measured.values):
        name = f"frame_{number:06d}.jpg"
        Image.fromarray(picture).save(folder / name, quality=_JPEG_QUALITY, subsampling=0)
        seconds, sharp = float(measured.seconds[number]), measured.values[number].sharpness
        written.append({"name": name, "number": number, "seconds": round(seconds, 6), "sharpness": round(sharp, 3)})
        progress(number / len(measured.values))
    return written


def _different(
    frames: Iterator[tuple[int, np.ndarray]], measures: Sequence[FrameMeasure]
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the frames without repetitions: of a run of frames that show the same, only the sharpest."""
    step, best = smallest_step(measures), next(frames)
    first = MotionPicture(best[1])
    for number, picture in frames:
        motion = MotionPicture(picture)
        if first.moved_to(motion) >= step:
            yield best
            best, first = (number, picture), motion
        elif measures[number].sharpness > measures[best[0]].sharpness:
            best = number, picture
    yield best


def _kept(folder: Path, path: Path, request: dict[str, Any], *, overwrite: bool, note: Notify) -> bool:
    """Return whether `folder` already holds the requested frames.

    Raises:
        UserError: it contains something else, and must not be replaced.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    try:
        found = json.loads((folder / FRAMES_FILE).read_text(encoding="utf-8"))
        same, names = found["request"] == request, [frame["name"] for frame in found["frames"]]
        source = found["request"]["video"]["name"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        hint = "choose another folder with -o, or move it away"
        raise UserError(f"cannot write the frames of {path} to {folder}: it contains other files", hint) from error
    missing = sum(not (folder / name).is_file() for name in names)
    if same and not (missing and overwrite):
        left = f", {missing} of which are missing" if missing else ""
        note(f"{folder} is kept: {len(names)} frames{left}")
        return True
    if not overwrite:
        raise UserError(
            f"{folder} contains other frames: {len(names)} of {source}",
            "add --overwrite to replace them, or choose another folder with -o",
        )
    return False


def _identity(path: Path) -> dict[str, Any]:
    """Return data that identifies a video, whatever its folder, without reading all of it."""
    end_bytes = 1 << 20
    size = path.stat().st_size
    digest = hashlib.sha256()
    with path.open("rb") as file:
        digest.update(file.read(end_bytes))
        file.seek(max(0, size - end_bytes))
        digest.update(file.read(end_bytes))
    return {"name": path.name, "bytes": size, "sha256_of_ends": digest.hexdigest()}
